"""The hidden effects: for each listed mechanism an exact form and variants of the same physics, and forms on no list.

A hook is f(amplitude, value, state) and changes one step of `law.simulate`: "shape", "C1", "C3", "C5", "flow" (with x),
"overstress", "modulus", "recovered_fraction", "recovery", "strain", "observable". Every effect is nil at amplitude
zero. Conventions: displacement in um, force in mN, stress in MPa; u = F / F_P, sigma_P and eps_P the largest stress and
its strain.
"""

from . import _cycles, _loading, _machine, _time, _unlisted, _unloading
from ._form import HUMIDITY as HUMIDITY
from ._form import RELOAD as RELOAD
from ._form import Effect as Effect
from ._form import Form as Form

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
"""Names in the order in which campaigns are drawn: another order would be another plan."""

_FORMS = (*_machine.FORMS, *_time.FORMS, *_unloading.FORMS, *_cycles.FORMS, *_loading.FORMS)
LISTED = tuple(form for name in MECHANISMS for form in _FORMS if form.mechanism == name)
UNLISTED = _unlisted.FORMS

EXACT = {form.mechanism: form for form in LISTED if form.form == "exact"}
VARIANTS = {name: tuple(f for f in LISTED if f.mechanism == name and f.form != "exact") for name in MECHANISMS}
BY_NAME = {(form.mechanism, form.form): form for form in (*LISTED, *UNLISTED)}
