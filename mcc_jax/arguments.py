"""Values of arguments of public functions: what is obviously meant is converted, what gives wrong numbers is refused.

What is refused raises `InputError`, in one line that names it; an object of a wrong class is left to Python. A tracer
(inside `jax.jit`, `vmap` or `grad`) passes, so nothing here is part of what is compiled.
"""

from __future__ import annotations

import enum
import math
import os
from collections.abc import Collection, Iterable, Sized
from numbers import Real
from pathlib import Path, PurePath
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ._errors import InputError


def is_traced(value: Any) -> bool:
    """Whether a value, or one of a list of values, is known only when compiled code runs."""
    if isinstance(value, list | tuple):
        return any(is_traced(one) for one in value)
    return isinstance(value, Tracer)


def shown(value: Any) -> str:
    """A value for a message: its text, cut short."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def kind_of(value: Any) -> str:
    """What kind of thing a value is, for a message: texts and paths with what they say."""
    if isinstance(value, str | PurePath):
        return f"the text {shown(str(value))}"
    return "None" if value is None else f"a {type(value).__name__}"


def choice[T](value: Any, choices: Collection[T], name: str) -> T:
    """The value, if it is one of the choices."""
    if isinstance(value, str | int | float) and value in choices:
        return cast(T, value)
    raise InputError(f"there is no {name} {shown(value)}", remedy=f"Choices: {', '.join(map(str, choices))}.")


def member[E: enum.Enum](value: E | str, choices: type[E], name: str) -> E:
    """The member of an enumeration, given itself or as its text."""
    if isinstance(value, choices):
        return value
    texts = {one.value: one for one in choices}
    return texts[choice(value, texts, name)]


def is_number(value: Any) -> bool:
    """Whether a value is one real number, finite or not, of Python, numpy or JAX; no truth value."""
    if isinstance(value, bool | np.bool_ | str | bytes | None) or is_traced(value):
        return False
    array = _array_of(value)
    return array is not None and array.ndim == 0 and array.dtype.kind in "iuf"


def number(
    value: Any,
    name: str,
    *,
    least: float | int = -math.inf,
    above: float | int = -math.inf,
    most: float | int = math.inf,
    below: float | int = math.inf,
) -> float:
    """A finite number as a Python float: `least` and `most` are allowed, `above` and `below` are not.

    It may be of NumPy, JAX or pandas. The name is for messages, with its unit.
    """
    found = float(value) if is_number(value) else math.nan
    if math.isfinite(found) and least <= found <= most and above < found < below:
        return found
    bounds = {">=": least, ">": above, "<=": most, "<": below}
    limits = "".join(f" and {sign} {bound:g}" for sign, bound in bounds.items() if math.isfinite(bound))
    must = f"{name} must be a finite number{limits.removeprefix(' and')}"
    raise InputError(f"{must}, got {f'{found:g}' if is_number(value) else shown(value)}")


def whole(value: Any, name: str, *, least: int = 0, most: int | None = None) -> int:
    """A whole number within bounds, as a Python integer: a count, a seed."""
    found = int(value) if is_number(value) and math.isfinite(value) else least - 1
    if found < least or found != value or (most is not None and found > most):
        upper = "" if most is None else f" and <= {most}"
        raise InputError(f"{name} must be a whole number >= {least}{upper}, got {shown(value)}")
    return found


def seed(value: Any, name: str = "seed") -> int:
    """A seed of random numbers: a whole number from 0 to 2^63 - 1."""
    return whole(value, name, most=2**63 - 1)


def flag(value: Any, name: str) -> bool:
    """True or False, and nothing that only counts as such: the text "no" would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def _array_of(value: Any) -> np.ndarray | None:
    """Anything as a numpy array, or None where it is none."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        return None


def floats(value: Any, name: str, *, shape: str = "an array of numbers") -> np.ndarray:
    """Numbers as a NumPy array of floats: from a list, a Series, an array of any kind; no tracers."""
    if isinstance(value, Iterable) and not isinstance(value, str | bytes) and not hasattr(value, "__array__"):
        value = list(value)
    array = None if isinstance(value, str | bytes) else _array_of(value)
    if array is None:
        raise InputError(f"{name} must be {shape}, got {kind_of(value)}")
    if array.dtype.kind == "f":
        return array
    # Objects: a Series of mixed numbers, or nothing at all.
    if array.dtype.kind in "iu" or (array.dtype.kind == "O" and all(isinstance(x, Real) for x in array.ravel())):
        return array.astype(float)
    raise InputError(f"{name} must be {shape}, got {shown(value)}")


def values(value: Any, name: str, *, shape: str = "a number or an array of numbers") -> jax.Array:
    """Numbers of any shape as a JAX array of floating-point numbers; tracers pass."""
    if is_traced(value) or isinstance(value, jax.Array) or type(value) in (int, float):
        array = jnp.asarray(value)
        if jnp.issubdtype(array.dtype, jnp.floating):
            return array
        if jnp.issubdtype(array.dtype, jnp.integer):
            return array.astype(float)
        raise InputError(f"{name} must be {shape}, got {array.dtype} values")
    # As with JAX's own: Python numbers take the default precision, arrays keep theirs.
    found = floats(value, name, shape=shape)
    return jnp.asarray(found) if hasattr(value, "dtype") else jnp.asarray(found, float)


def path(value: Any, name: str, *, many: str = "") -> jax.Array:
    """A 1-D array of at least one point, from anything that `values` takes; `many` is the remedy for several paths."""
    shape = "a 1-D array of at least one point"
    array = values(value, name, shape=shape)
    if array.ndim != 1 or not array.size:
        raise InputError(f"{name} must be {shape}, got the shape {array.shape}", remedy=many or None)
    return array


def same_length(**arrays: Any) -> int:
    """The length that all arrays share; two that differ are named, and one that is a single number."""
    for name, array in arrays.items():
        if not isinstance(array, Sized) or (isinstance(array, np.ndarray | jax.Array) and array.ndim == 0):
            raise InputError(f"{name} must be a list of numbers, got {shown(array)}")
    (first, one), *others = arrays.items()
    for name, other in others:
        if len(other) != len(one):
            problem = f"{first} has {len(one)} entries and {name} has {len(other)}"
            raise InputError(problem, remedy="Give as many of each.")
    return len(one)


def diameters(value: Any) -> np.ndarray:
    """D1, D2, D3 [um] of N particles as an array of shape (N, 3), all positive and finite."""
    array = floats(value, "diameters_um", shape="D1, D2, D3 [um] of every particle, shape (N, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        problem = f"diameters_um has the shape {array.shape} where (N, 3) is expected: D1, D2, D3 [um]"
        remedy = "For one particle write [[D1, D2, D3]]." if array.shape == (3,) else None
        raise InputError(problem, remedy=remedy)
    for i in np.flatnonzero(~(np.isfinite(array) & (array > 0)).all(axis=1)):
        sizes = f"the diameters {array[i].tolist()} um of particle {i + 1}"
        raise InputError(f"diameters_um: {sizes} are not positive numbers")
    return array


def one_particle(value: Any, name: str = "diameters_um") -> np.ndarray:
    """D1, D2, D3 [um] of one particle as an array of shape (3,), all positive and finite."""
    array = floats(value, name, shape="D1, D2, D3 [um] of one particle")
    if array.shape == (3,) and (np.isfinite(array) & (array > 0)).all():
        return array
    must = f"{name} must be the three positive diameters D1, D2, D3 [um] of a particle"
    raise InputError(f"{must}, got {shown(array.tolist())}")


def positive(value: Any, name: str, *, zero: bool = False, plain: bool = False) -> None:
    """Refuse a size that is not positive (or `zero`) and finite; tracers pass, with `plain` all that JAX computed."""
    if is_traced(value) or (plain and isinstance(value, jax.Array)):
        return
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        return  # what is no number at all is refused where it is converted
    if not (np.isfinite(array) & (array >= 0 if zero else array > 0)).all():
        must = "zero or positive" if zero else "positive"
        raise InputError(f"{name} must be {must} and finite, got {shown(array.tolist())}")


def finite(value: Any, name: str) -> None:
    """Refuse a plain number that is NaN or infinite; what is computed or traced passes."""
    if isinstance(value, int | float | np.number | np.ndarray) and not np.isfinite(value).all():
        raise InputError(f"{name} must be a finite number, got {shown(value)}")


def double_precision(what: str) -> None:
    """Raise `RuntimeError` in single precision: `what` needs double precision."""
    if not jax.config.read("jax_enable_x64"):
        call = 'jax.config.update("jax_enable_x64", True)'
        raise RuntimeError(f"{what} needs double precision; call {call} before anything else")


def file_path(value: Any, name: str) -> Path:
    """The path of a file or folder."""
    if not isinstance(value, str | os.PathLike) or not str(value):
        raise InputError(f"{name} must be the path of a file or folder, got {kind_of(value)}")
    return Path(value)
