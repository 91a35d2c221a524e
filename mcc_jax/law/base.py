"""Interface of a contact law: a state, one step of it, and the same along a path."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Flag, Path, Scalar
from ..geometry import Particle


class AbstractContactLaw[State](eqx.Module):
    """One particle between two platens: `init` gives the virgin state, `step` advances it.

    There is no batch axis: batch laws and particles with `equinox.filter_vmap`. No method checks values: entry points
    such as `simulate.drive` do.
    """

    @property
    def is_monotone(self) -> Flag:
        """Whether force never falls while the displacement of a virgin particle grows."""
        return jnp.asarray(True)

    @property
    def is_valid(self) -> Flag:
        """Whether every parameter is in its range."""
        return jnp.asarray(True)

    def carries_stress(self, particle: Particle) -> Flag:
        """Whether the law gives this particle any stress at all."""
        return jnp.asarray(True)

    def gain_strain(self, particle: Particle, state: State) -> Scalar:
        """Peak strain [-], up to that of the state, beyond which loading and release gain energy; infinite if none."""
        return jnp.full_like(particle.D3, jnp.inf)

    @abc.abstractmethod
    def init(self, particle: Particle) -> State:
        """State of a particle that was never loaded."""

    @abc.abstractmethod
    def step(
        self, particle: Particle, state: State, displacement: Scalar, time: Scalar | None = None
    ) -> tuple[State, Scalar]:
        """Force [mN] at the platen displacement [um] at the time [s], and the state after it."""

    @abc.abstractmethod
    def step_load(
        self, particle: Particle, state: State, force: Scalar, time: Scalar | None = None
    ) -> tuple[State, Scalar]:
        """Platen displacement [um] under the force [mN] at the time [s], and the state after it."""

    def path(
        self, particle: Particle, state: State, displacement: Path, time: Path | None = None
    ) -> tuple[State, Path]:
        """Forces [mN] along a path of displacements [um] at times [s], by `lax.scan` of `step`."""
        return _scan(self.step, particle, state, displacement, time)

    def path_load(self, particle: Particle, state: State, force: Path, time: Path | None = None) -> tuple[State, Path]:
        """Displacements [um] along a path of forces [mN] at times [s], by `lax.scan` of `step_load`."""
        return _scan(self.step_load, particle, state, force, time)


def _scan(step: Callable[..., Any], particle: Particle, state: Any, path: Path, time: Path | None) -> Any:
    """A law that knows no time need not have it among its arguments."""
    along = (path,) if time is None else (path, time)
    return jax.lax.scan(lambda past, now: step(particle, past, *now), state, along)
