"""Array types shared by every module, and the converter that keeps fields scalar."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from jaxtyping import ScalarLike as ScalarLike

from ._errors import InputError
from .arguments import is_traced
from .arguments import values as values_of

Scalar: TypeAlias = Float[Array, ""]
Flag: TypeAlias = Bool[Array, ""]
Path: TypeAlias = Float[Array, " steps"]
Values: TypeAlias = Float[Array, "..."]  # one number or many at once, for functions that act on each alone
Progress: TypeAlias = Callable[[str], None]  # called with the name of each step of a long computation


def scalar(value: ScalarLike) -> Scalar:
    """Convert a field's value to a floating-point scalar array, keeping the precision of arrays.

    Raises `InputError` if it is no number, or has a batch axis; modules describe one contact and are batched by `vmap`.
    """
    plain = isinstance(value, int | float) or is_traced(value)
    array = jnp.asarray(value) if plain else values_of(value, "a parameter", shape="a number")
    if array.ndim:
        raise InputError(f"Expected a scalar, got shape {array.shape}; batch with equinox.filter_vmap(Class).")
    return array if jnp.issubdtype(array.dtype, jnp.inexact) else array.astype(float)


def checked(check: Callable[..., None], name: str, **options: bool) -> Callable[[ScalarLike], Scalar]:
    """`scalar` for a field whose plain numbers a check of `arguments` judges first."""

    def convert(value: ScalarLike) -> Scalar:
        check(value, name, **options)
        return scalar(value)

    return convert
