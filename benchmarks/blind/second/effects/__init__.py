"""The hidden effects: three formulas for each listed mechanism, the first the specification's, and eight on no list."""

from . import cycles, events, flow, machine, particles, time, unlisted, unloading
from .effect import Effect as Effect

_FORMULAS = tuple(
    formula for module in (machine, time, unloading, cycles, flow, particles, events) for formula in module.FORMULAS
)
LISTED = {name: tuple(f for f in _FORMULAS if f.mechanism == name) for name in (f.mechanism for f in _FORMULAS)}
UNLISTED = unlisted.FORMULAS
