"""Whether a modulus that depends on the peak lets a contact give back more energy than it took."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from .._types import Scalar
from ..formulas import Contact

POINTS = 256
"""Peaks, evenly spread, each of which is asked whether it loses at least as much as the one before."""


def first_gain(at_peak: Callable[[Scalar], Contact], highest: Scalar) -> Scalar:
    """Smallest peak displacement beyond which further loading gains energy; infinite where it never does.

    What is lost, the work of loading less what full release gives back, depends on the peak alone. Where it falls (by
    more than rounding) from one peak to the next, a contact that is released, loaded further and released again has
    gained. NaN counts as a gain.

    Args:
        at_peak: the contact that unloads from a peak displacement.
        highest: largest displacement to look at.
    """
    peaks = highest * jnp.linspace(0.0, 1.0, POINTS + 1, dtype=highest.dtype)

    def balance(peak: Scalar) -> tuple[Scalar, Scalar]:
        contact = at_peak(peak)
        return contact.work(peak), contact.stored(peak, jnp.zeros_like(peak))[0]

    work, stored = jax.vmap(balance)(peaks)
    holds = jnp.diff(work - stored) >= -8 * jnp.finfo(work.dtype).eps * work[-1]
    return jax.lax.stop_gradient(jnp.where(jnp.all(holds), jnp.inf, peaks[jnp.argmin(holds)]))
