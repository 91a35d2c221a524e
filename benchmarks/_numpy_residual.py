"""The residual function of the joint least squares, written by hand in NumPy: what SciPy and lmfit are fed with."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax.calibrate.pooled_fit import LEAST_SPREAD

FIELDS = ("D1", "D2", "D3")


def numpy_residual(tests, settings):
    """The pooled residuals as a function of one flat vector: every particle's b1, b3, b5, zero, then the shared five.

    For monotone laws, the printed form with its limit and raw scaling, without further scatter.
    """
    D1, D2, D3 = (np.asarray(getattr(tests.particle, name)) for name in FIELDS)
    diameter = (D1 * D2 / D3)[:, None]
    flatness = 1 - D3**2 / (D1 * D2)
    force = np.asarray(tests.force)
    stress = np.maximum(force * 1e3 / (np.pi * diameter**2 / 4), 0)
    highest = np.maximum.accumulate(stress, axis=1)
    ratio = np.minimum(stress / np.maximum(highest, 1e-300), 1)
    recovered = kepler(ratio)
    measured, mask, contact = (np.asarray(v) for v in (tests.displacement, tests.mask, tests.contact))
    # The noise is whitened by a linear map: written out, it costs SciPy and lmfit least.
    with jax.numpy_dtype_promotion("standard"):
        maps = np.asarray(jax.vmap(lambda one: one(jnp.eye(force.shape[1])))(settings.whitening))
    tau = np.maximum(np.asarray(settings.population.tau), LEAST_SPREAD)
    mean_zero, zero_sd = (float(v) for v in settings.zero_prior)
    count = len(force)

    def residual(flat):
        local, (a, e, *mu) = flat[: 4 * count].reshape(count, 4), flat[4 * count :]
        b, zero = local[:, :3], local[:, 3]
        K1, K3, K5 = (np.exp(k * b[:, j])[:, None] for j, k in enumerate((1, 3, 5)))
        x = loading_strain(K1, K3, K5, highest)
        secant, tangent = K1 - x**2 * (K3 - x**2 * K5), K1 - x**2 * (3 * K3 - 5 * x**2 * K5)
        least = 3 * np.pi / 8 * secant
        limit = x * least / np.maximum(tangent, least)  # no contact gives back more than it took
        predicted = diameter * (x - np.minimum(np.sqrt(secant / (4.12 * np.exp(e))), limit) * recovered)
        r = np.where(mask, measured - predicted - zero[:, None], 0.0)
        white = np.einsum("nij,nj->ni", maps, r)
        pooled = (b - np.array(mu) - np.log(1 + a * flatness)[:, None]) / tau
        return np.concatenate([white[mask], pooled.ravel(), (zero - contact - mean_zero) / zero_sd])

    return residual


def loading_strain(K1, K3, K5, stress):
    """Newton from an upper bound on the convex part, from below on the concave one."""
    bend = np.sqrt(0.3 * K3 / K5)
    at_bend = bend * (K1 - bend**2 * (K3 - bend**2 * K5))
    above = np.minimum(9 * stress / (4 * K1), (9 * stress / (4 * K5)) ** 0.2)
    x = np.where(stress <= at_bend, stress / K1, above)
    for _ in range(14):
        square = x * x
        x = x - (x * (K1 - square * (K3 - square * K5)) - stress) / (K1 - square * (3 * K3 - 5 * square * K5))
    return x


def kepler(ratio):
    """Recovered share of strain at a share of the peak stress: E - sin E = pi ratio, s = cos(E/2)."""
    z = np.cbrt(6 * np.pi * ratio)
    E = z + z**3 / 60 + z**5 / 1400 + z**7 / 25200 + 43 * z**9 / 17248000
    for _ in range(4):
        slope = np.where(E > 1e-3, 1 - np.cos(E), 1.0)
        excess = np.where(E > 0.1, E - np.sin(E), E**3 / 6 - E**5 / 120 + E**7 / 5040) - np.pi * ratio
        E = np.where(E > 1e-3, E - excess / slope, E)
    return np.cos(E / 2)
