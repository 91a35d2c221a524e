"""How nature's formula may differ from the library's: a Gaussian process in the coordinates of a mechanism."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mcc_jax.calibrate.compiling import compiled
from mcc_jax.calibrate.data import Tests
from mcc_jax.calibrate.forward import Forms

from .design import State

HATS, DEGREE = 8, 2
COORDINATES = {
    "frame_compliance": ("force",),
    "thermal_drift": ("time",),
    "creep": ("time", "since", "load", "peak"),
    "rate_dependence": ("peak", "rate"),
    "adhesion": ("load", "peak"),
    "damage": ("peak", "cycles"),
    "densification_stiffening": ("peak",),
    "reload_hysteresis": ("load", "reload", "peak"),
    "ratcheting": ("cycles", "peak"),
    "finite_hardening_exponent": ("peak",),
    "unloading_shape": ("load", "peak"),
    "size_effect": ("size",),
    "shape_second_order": ("shape",),
    "pop_in": (),
    "toe_asperity": ("peak",),
    "platen_friction": ("peak",),
    "misalignment": ("peak", "size"),
    "platen_sink_in": ("peak", "load"),
    "reverse_plasticity": ("load", "peak"),
    "humidity": ("humidity", "peak"),
}
"""In what a formula of each mechanism may be wrong: what its own formulas depend on."""


@compiled
def coordinates(state: State, tests: Tests, forms: Forms) -> dict[str, Array]:
    """Coordinates of every point, each between 0 and 1 over the campaign."""

    def one(latent: Array, tests: Tests) -> dict[str, Array]:
        law = forms.law(latent, jnp.zeros(0))
        c = law.context(tests.particle, tests.record)
        time = tests.record.time
        turned = jnp.concatenate([jnp.ones(1, bool), tests.record.kind[1:] != tests.record.kind[:-1]])
        begun = jax.lax.cummax(jnp.where(turned, time, -jnp.inf))
        ones = jnp.ones_like(time)
        return {
            "peak": jnp.sqrt(jnp.maximum(c.peak_stress, 0.0)),
            "strain": c.peak_strain,
            "load": c.load_share,
            "force": c.force,
            "travel": c.displacement,
            "time": jnp.log1p(time / 5.0),
            "since": jnp.log1p((time - begun) / 5.0),
            "clock": time,
            "reload": c.progress,
            "cycles": c.cycles,
            "rate": jnp.log(jnp.maximum(tests.record.loading_rate, 1e-6)),
            "size": ones * jnp.log(tests.particle.effective_diameter),
            "shape": ones * tests.particle.flatness,
            "humidity": ones * tests.record.relative_humidity,
        }

    found = jax.vmap(one)(state.point.latent, tests)

    def scaled(x: Array) -> Array:
        low = jnp.min(jnp.where(tests.mask, x, jnp.inf))
        high = jnp.max(jnp.where(tests.mask, x, -jnp.inf))
        return jnp.clip((x - low) / jnp.where(high > low, high - low, 1.0), 0.0, 1.0)

    return {name: scaled(x) for name, x in found.items()}


def functions(names: tuple[str, ...], at: dict[str, Array], *, degree: int = DEGREE, hats: int = HATS) -> Array:
    """Smooth products of cosines and hat functions over some coordinates, shape (N, points, functions).

    Their squares add up to about 1 at every point for the products and for the hats of each coordinate together, so
    that one scale says how large they are together.
    """
    columns = []
    some = [n for n in names if float(jnp.max(at[n]) - jnp.min(at[n])) > 0]
    for powers in itertools.product(range(degree + 1), repeat=len(some)):
        if not 0 < sum(powers) <= degree:
            continue
        x = jnp.ones_like(next(iter(at.values())))
        for n, k in zip(some, powers, strict=True):
            x = x * jnp.cos(np.pi * k * at[n])
        columns.append(x)
    smooth = [x * np.sqrt(1.0 / max(len(columns), 1)) * np.sqrt(2) for x in columns]
    width, share = 1 / (hats - 1), np.sqrt(len(some))
    centres = [(n, centre) for n in some for centre in np.linspace(0, 1, hats)]
    rough = [jnp.maximum(1 - jnp.abs(at[n] - centre) / width, 0.0) / share for n, centre in centres]
    return jnp.stack([*smooth, *rough], -1) if columns else jnp.zeros((*next(iter(at.values())).shape, 0))


def padded(columns: Array, size: int) -> Array:
    """Columns of nothing added, so that few shapes are compiled."""
    return jnp.pad(columns, ((0, 0), (0, 0), (0, size - columns.shape[-1])))
