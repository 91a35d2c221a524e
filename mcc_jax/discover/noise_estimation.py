"""Noise and population once more, with what is systematic taken off the residuals first.

A gap that the base law leaves looks like correlated noise and like particles that scatter. If it is left in when noise
and population are estimated, they swallow it: its own signature then stands out half as clearly. So the best few
formulas and words are fitted, subtracted, and noise and population are estimated from what is left. Where nothing is
missing, nothing or next to nothing is subtracted.
"""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from .legacy.data import longer
from .legacy.linearise import linear_data, summarise
from .legacy.noise import Noise, Whitening, estimate_noise, particle_scales
from .legacy.population import Summary
from .legacy.settings import noise_prior
from .legacy.sharding import Parts
from .legacy.transforms import LogPosterior, most_probable
from .linear_model import Base, Signals, System
from .score import project

STRONG = 3.5
"""Estimate over standard error from which on a column is taken off."""

STRONG_BETWEEN = 3.0
"""The same for effects that differ between particles only: they are few."""

STRONG_WAVE = 4.2
"""The same for waves in time and displacement, which are many."""

MOST = 5


def systematic(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Columns that explain what is left, one after the other (orthogonal matching pursuit), and their coefficients."""
    columns, sign = system.looked_at()
    between = np.flatnonzero([c.between_particles for c in system.candidates])  # candidates come first
    enough = np.full(len(columns), STRONG)
    enough[between] = STRONG_BETWEEN
    enough[np.isin(columns, system.waves)] = STRONG_WAVE
    inside: list[int] = []
    for _ in range(MOST):
        found = project(system, columns, inside=np.array(inside, int))
        t = np.where(found.survival > 1e-3, found.gaussian, 0.0)
        t = np.where(sign == 0, np.abs(t), t * sign)
        t[between] = unbounded(t[between], len(found.particles))
        best = int(np.argmax(t / enough))
        if t[best] < enough[best]:
            break
        inside.append(int(columns[best]))
    chosen = np.array(inside, int)
    theta = project(system, chosen[:0], inside=chosen).theta[len(system.globals) :] if inside else np.zeros(0)
    return chosen, theta


def unbounded(t: np.ndarray, count: int) -> np.ndarray:
    r"""What estimates over standard errors are worth if their effect is part of the scatter that gives the error.

    An effect that differs between particles only, with their size, say, is a regression over particles. The scatter
    fitted without it contains it, so that however large it is, t stays below the root of the number of particles N:

    .. math:: t = \sqrt{N} R, \qquad t' = R \sqrt{\frac{N - 2}{1 - R^2}}

    with R the correlation; t' follows Student's distribution with N - 2 degrees of freedom. Returned is the normal
    deviate as improbable as t'.
    """
    from scipy.stats import norm
    from scipy.stats import t as student

    if count < 4:
        return t
    R = np.minimum(np.abs(t) / np.sqrt(count), 1 - 1e-9)
    student_t = R * np.sqrt((count - 2) / (1 - R**2))
    return np.sign(t) * norm.isf(np.maximum(student.sf(student_t, count - 2), 1e-300))


def _least_squares(summary: Summary) -> np.ndarray:
    """chi2 of every test at its own best parameters: those of the fit were best with the gap still in the residual."""
    score = np.asarray(summary.score)[..., None]
    curvature = np.asarray(summary.precision)
    # What a test says nothing about gains nothing.
    best = np.linalg.pinv(curvature, rcond=1e-10, hermitian=True) @ score
    return np.asarray(summary.squares) - (score * best)[..., 0].sum(1)


def refined(base: Base, system: System, signals: Signals) -> tuple[Base, bool]:
    """The base fit with noise and population from residuals without what is systematic, and whether that differs."""
    columns, theta = systematic(system)
    if not len(columns):
        return base, False
    fit, model, count = base.fit, base.legacy_model, len(base.tests)
    # Filled up as for the fit itself: everything is compiled already.
    tests, blocks = base.filled()
    gap = jnp.einsum("k,nkp->np", jnp.asarray(theta), signals.of(columns))
    latent, zero, gap, scale = longer((fit.latent, fit.zero, gap, fit.noise.scale), len(tests))
    own, at = blocks.cut(tests), (blocks.cut(latent), blocks.cut(zero))
    linear = blocks.each(linear_data, *at, own, model.zero_sd, model.unloading)
    waves = zip(linear.waves, blocks.cut(gap).waves, strict=True)
    data = Parts(tuple(replace(wave, residual=jnp.where(wave.mask, wave.residual + g, 0.0)) for wave, g in waves))

    def summarised(noise: Noise) -> tuple[Summary, Whitening]:
        both = blocks.each(summarise, *at, own, data, blocks.cut(noise), model.zero_sd)
        summary, filters = (blocks.whole(Parts(tuple(wave[k] for wave in both.waves))) for k in (0, 1))
        return summary, filters

    start = replace(fit.noise, scale=scale)
    noise, _, fine = estimate_noise(data, noise_prior(model.chosen_priors), start, uncertainty=False, blocks=blocks)
    summary, filters = summarised(noise)
    old = np.asarray(noise.scale)
    parts = (old, _least_squares(summary), np.asarray(summary.count) - 4)
    some = np.pad(particle_scales(*(part[:count] for part in parts)), (0, len(tests) - count), mode="edge")
    if np.any(some != old):
        noise = replace(noise, scale=jnp.asarray(some))
        summary, filters = summarised(noise)
    numbers = replace(fit.numbers, flatness=tests.flatness, weight=tests.weight)
    mode, covariance, reached = most_probable(fit.mode, LogPosterior(numbers, summary, model.scatter))
    new = replace(
        fit,
        noise=noise,
        filters=filters,
        summary=summary,
        mode=mode,
        covariance=covariance,
        numbers=numbers,
        converged=np.asarray(fit.converged) & np.array([True, fine, reached]),
    )
    return replace(base, fit=new.first(count)), True
