"""The hidden effects: three formulas for each listed mechanism, the first the specification's, and eight on no list."""

from . import loading, tester, unlisted, unloading
from .effect import Effect as Effect
from .effect import Formula as Formula

_FORMULAS = (*tester.FORMULAS, *loading.FORMULAS, *unloading.FORMULAS)
LISTED = {name: tuple(f for f in _FORMULAS if f.mechanism == name) for name in (f.mechanism for f in _FORMULAS)}
UNLISTED = unlisted.FORMULAS
