"""How nature's formula may differ from the library's: a Gaussian process in the coordinates of a mechanism."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..calibrate.data import Tests
from ..calibrate.forward import Forms, Linear, Point
from ..calibrate.running import compiled_quickly
from ..effects.record import RELOAD, UNLOAD

HATS, DEGREE = 8, 2  # hat functions of each coordinate of a misfit, and total degree of its smooth products
SPLINES, FINE_SPLINES = 12, 24  # cosines of each coordinate of a discrepancy on no list, and of stress


@compiled_quickly
def coordinates(point: Point, tests: Tests, forms: Forms, a: Array) -> dict[str, Array]:
    """Coordinates of every point; `strain` is (1 + a H) epsilon_P, of which the law's loading curve is a function."""

    def one(latent: Array, tests: Tests) -> dict[str, Array]:
        law = forms.law(latent, jnp.zeros(0))
        c = law.context(tests.particle, tests.record)
        time = tests.record.time
        turned = jnp.concatenate([jnp.ones(1, bool), tests.record.kind[1:] != tests.record.kind[:-1]])
        begun = jax.lax.cummax(jnp.where(turned, time, -jnp.inf))
        ones = jnp.ones_like(time)
        return {
            "peak": jnp.sqrt(jnp.maximum(c.peak_stress, 0.0)),
            "strain": c.peak_strain * jnp.maximum(1 + a * tests.particle.flatness, 0.01),
            "load": c.load_share,
            "force": c.force,
            "peak_force": c.peak_force,
            "travel": c.displacement / tests.particle.effective_diameter,
            "drive": c.displacement,
            "time": jnp.log1p(time / 5.0),
            "since": jnp.log1p((time - begun) / 5.0),
            "unloading": jnp.where(tests.record.kind == UNLOAD, 1.0, 0.0),
            "reloading": jnp.where(tests.record.kind == RELOAD, 1.0, 0.0),
            "clock": time,
            "reload": c.progress,
            "cycles": c.cycles,
            "rate": jnp.log(jnp.maximum(tests.record.loading_rate, 1e-6)),
            "stress_rate": jnp.log(jnp.maximum(tests.particle.stress(tests.record.loading_rate), 1e-6)),
            "size": ones * jnp.log(tests.particle.effective_diameter),
            "shape": ones * tests.particle.flatness,
            "outline": ones * jnp.abs(jnp.log(tests.particle.D1 / tests.particle.D2)),
            "humidity": ones * tests.record.relative_humidity,
        }

    return jax.vmap(one)(point.latent, tests)


def informative(at: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """The coordinates without time where few tests unload: there it is the displacement of a drive at one speed."""
    unloads = np.max(np.where(mask, at["unloading"], 0.0), 1)
    return at if np.median(unloads) > 0 else {name: x for name, x in at.items() if name != "clock"}


def scaled(at: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Coordinates between 0 and 1 over the campaign."""

    def one(x: np.ndarray) -> np.ndarray:
        low = np.min(np.where(mask, x, np.inf))
        high = np.max(np.where(mask, x, -np.inf))
        return np.clip((x - low) / np.where(high > low, high - low, 1.0), 0.0, 1.0)

    found = {name: one(x) for name, x in at.items()}
    high = float(np.max(np.where(mask, at["peak_force"], 0.0)))
    for name in ("force", "peak_force"):  # of one scale
        found[name] = np.clip(at[name] / max(high, 1e-300), 0.0, 1.0)
    return found


def functions(names: tuple[str, ...], at: Mapping[str, np.ndarray]) -> np.ndarray:
    """Smooth products of cosines, and hat functions, over some coordinates, shape (N, points, functions). The squares
    of either kind add up to about 1 at every point, so that one scale says how large they are together."""
    some = [at[n] for n in names if np.ptp(at[n]) > 0]
    if not some:
        return np.zeros((*next(iter(at.values())).shape, 0))
    powers = (p for p in itertools.product(range(DEGREE + 1), repeat=len(some)) if 0 < sum(p) <= DEGREE)
    smooth = np.stack([np.prod([np.cos(np.pi * k * x) for x, k in zip(some, p, strict=True)], 0) for p in powers], -1)
    # Piecewise linear, 1 at one of even places.
    hats = [np.maximum(1 - np.abs(x[..., None] - np.linspace(0, 1, HATS)) * (HATS - 1), 0.0) for x in some]
    rough = [one / np.sqrt(len(some)) for one in hats]
    return np.concatenate([smooth * np.sqrt(1 / smooth.shape[-1]) * np.sqrt(2), *rough], -1)


def misfit_columns(curve: np.ndarray, smooth: np.ndarray, siblings: Iterable[np.ndarray]) -> np.ndarray:
    """Columns by which a formula may be wrong that adds a curve to the tests: towards its siblings, and smooth ones."""
    size, towards = np.linalg.norm(curve), []
    for column in filter(np.any, siblings):
        factor = np.copysign(size / np.linalg.norm(column), np.sum(column * curve))
        towards.append((column * factor - curve)[..., None])
    return np.concatenate([*towards, curve[..., None] * smooth], -1)


def splines(x: np.ndarray, count: int) -> np.ndarray:
    """Cosines of a coordinate between 0 and 1, with a variance of about 1 together and as a smoothing spline weighs
    them: sds fall with the square of the frequency (Wahba 1990)."""
    k = np.arange(1, count + 1)
    weight = k**-2.0 * np.sqrt(2 / np.sum(k**-4.0))
    return weight * np.cos(np.pi * k * x[..., None])


def general(at: Mapping[str, np.ndarray], tests: Tests, linear: Linear) -> tuple[np.ndarray, ...]:
    """Functions of a discrepancy that no mechanism explains, those of each of its parts.

    It is a sum of Gaussian processes, each in one coordinate and with a scale of its own, so that coordinates that
    explain nothing cost next to nothing (automatic relevance determination; Duvenaud et al. 2011). All are common to
    all particles and in proportion to their size, but for errors of the instrument, which depend on micrometres and
    millinewtons alone. In stress they are fine: a particle's layers and flaws yield within a narrow range of it. A
    stress that the loading curve lacks, and a force that the cell gets wrong, move every particle as far as it is soft.
    """
    mask, size = np.asarray(tests.mask), np.asarray(tests.effective_diameter)[:, None, None]
    products = splines(at["peak"], 3)[..., :, None] * splines(at["load"], 3)[..., None, :]
    timed = ("clock",) if "clock" in at else ()
    reduced = [
        splines(at["peak"], FINE_SPLINES),
        *(splines(at[name], SPLINES) for name in ("strain", "travel", "load", *timed)),
        splines(at["load"], SPLINES) * at["reloading"][..., None],
        products.reshape(*products.shape[:-2], -1),
    ]
    by_force, by_peak = (np.where(mask, x, 0.0)[..., None] for x in (linear.by_force, linear.by_peak))
    yielding = np.where(np.asarray(tests.loading)[..., None], by_force, by_peak)
    stress = splines(at["strain"], SPLINES) * yielding * size**2
    cell = [splines(at[name], SPLINES) for name in ("force", "peak_force")]
    parts = [part * (size / np.mean(size)) for part in reduced]
    of_forces = stress, by_force * cell[0] + by_peak * cell[1]  # each with a variance of 1
    parts += [part / max(float(np.sqrt(np.mean(np.sum(part[mask] ** 2, -1)))), 1e-300) for part in of_forces]
    for way in ("unloading", "reloading"):  # what a drive loses at a reversal, it loses at once
        turned = at[way][..., None]
        parts.append(np.concatenate([turned, splines(at["since"], HATS) * turned], -1))
    return tuple(np.where(mask[..., None], part, 0.0) for part in parts)
