"""The hidden effects: three formulas for each listed mechanism, the first the specification's, and eight on no list."""

from . import _cycles, _events, _flow, _machine, _particles, _time, _unlisted, _unloading
from ._effect import Effect as Effect

MECHANISMS = (
    "frame_compliance",
    "thermal_drift",
    "creep",
    "rate_dependence",
    "adhesion",
    "damage",
    "densification_stiffening",
    "reload_hysteresis",
    "ratcheting",
    "finite_hardening_exponent",
    "unloading_shape",
    "size_effect",
    "shape_second_order",
    "pop_in",
    "toe_asperity",
    "platen_friction",
    "misalignment",
    "platen_sink_in",
    "reverse_plasticity",
    "humidity",
)
"""Names in the order in which cases are planned: another order would be another plan."""

_FORMULAS = tuple(
    formula
    for module in (_machine, _time, _unloading, _cycles, _flow, _particles, _events)
    for formula in module.FORMULAS
)
LISTED = {name: tuple(f for f in _FORMULAS if f.mechanism == name) for name in MECHANISMS}
UNLISTED = _unlisted.FORMULAS
