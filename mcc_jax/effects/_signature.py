"""What one unit of each effect would add to a measured curve, to first order."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Path, Scalar
from ..geometry import Particle
from ..law import MccLaw
from ._effect import AbstractEffect, overrides
from ._extended import ExtendedLaw
from ._record import Record


def signatures(
    base: MccLaw, particle: Particle, record: Record, effects: Sequence[AbstractEffect]
) -> Float[Array, "effects steps"]:
    """Derivatives of the displacement by the amplitude of each effect, the others absent.

    The same as one `jax.jvp` of `ExtendedLaw(base, (effect,)).respond` per effect at its own amplitude, but effects
    that only add share one pass through the law, and effects of one class are done together: fewer and smaller
    programs to compile. Batch it over particles with `equinox.filter_vmap`.

    Args:
        base: the law.
        particle: the particle.
        record: its test.
        effects: usually at amplitude zero; one for every point of every variant's grid.

    Returns:
        Derivatives [um per unit of amplitude].
    """
    plain = ExtendedLaw(base, ())
    context = plain.context(particle, record)
    groups: dict[object, list[int]] = {}
    for i, effect in enumerate(effects):
        groups.setdefault((jax.tree.structure(effect), type(effect)), []).append(i)
    rows: list[Path | None] = [None] * len(effects)
    for members in groups.values():
        alike = [jax.tree.map(jnp.asarray, effects[i]) for i in members]
        adds = not overrides(alike[0], "modify", "loading", "stiffness")

        def one(effect: AbstractEffect, adds: bool = adds) -> Path:
            def displacement(amplitude: Scalar) -> Path:
                law = ExtendedLaw(base, (eqx.tree_at(lambda e: e.amplitude, effect, amplitude),))
                if not adds:
                    return law.respond(particle, record)
                start = eqx.tree_at(lambda s: s.point.time, law.init(particle), record.time[0])
                return law.add(start, context)[1]

            return jax.jvp(displacement, (effect.amplitude,), (jnp.ones_like(effect.amplitude),))[1]

        together = jax.vmap(one)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike))
        for row, i in enumerate(members):
            rows[i] = together[row]
    return jnp.stack([row for row in rows if row is not None])
