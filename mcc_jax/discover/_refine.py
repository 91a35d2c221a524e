"""Noise and population once more, with what is systematic taken off the residuals first.

A gap that the base law leaves looks like correlated noise and like particles that scatter. If it is left in when noise
and population are estimated, they swallow it: its own signature then stands out half as clearly. So the best few
formulas and words are fitted, subtracted, and noise and population are estimated from what is left. Where nothing is
missing, nothing or next to nothing is subtracted.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..calibrate.joint._linearised import linear_data, summarise
from ..calibrate.joint._mode import Target, most_probable
from ..calibrate.joint._noise import estimate_noise, particle_scales
from ..calibrate.joint._population import Summary
from ._score import project
from ._system import Base, Signals, System

STRONG = 3.5
"""Estimate over standard error from which on a column is taken off."""

MOST = 5


def systematic(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Columns that explain what is left, one after the other (orthogonal matching pursuit), and their coefficients."""
    columns = np.concatenate([system.candidate_columns, system.place_columns, system.word_columns])
    sign = np.concatenate(
        [[c.variant.sign for c in system.candidates], np.zeros(len(columns) - len(system.candidates))]
    )
    inside: list[int] = []
    for _ in range(MOST):
        found = project(system, columns, inside=np.array(inside, int))
        t = np.where(found.survival > 1e-3, found.gaussian, 0.0)
        t = np.where(sign == 0, np.abs(t), t * sign)
        best = int(np.argmax(t))
        if t[best] < STRONG:
            break
        inside.append(int(columns[best]))
    chosen = np.array(inside, int)
    theta = project(system, chosen[:0], inside=chosen).theta[len(system.globals) :] if inside else np.zeros(0)
    return chosen, theta


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
    fit, tests, model = base.fit, base.tests, base.model
    zero_sd = model.zero_sd
    data = linear_data(fit.latent, fit.zero, tests, zero_sd, model.unloading)
    gap = jnp.einsum("k,nkp->np", jnp.asarray(theta), signals.of(columns))
    data = eqx.tree_at(lambda d: d.residual, data, jnp.where(tests.mask, data.residual + gap, 0.0))
    priors = model.beliefs
    noise, _, fine = estimate_noise(data, priors.noise, fit.noise, uncertainty=False)
    summary, filters = summarise(fit.latent, fit.zero, tests, data, noise, zero_sd)
    old = np.asarray(noise.scale)
    scale = particle_scales(old, _least_squares(summary), np.asarray(summary.count) - 4)
    if np.any(scale != old):
        noise = eqx.tree_at(lambda n: n.scale, noise, jnp.asarray(scale))
        summary, filters = summarise(fit.latent, fit.zero, tests, data, noise, zero_sd)
    mode, covariance, reached = most_probable(fit.mode, Target(fit.numbers, summary, model.scatter))
    converged = np.asarray(fit.converged) & np.array([True, fine, reached])
    new = eqx.tree_at(
        lambda f: (f.noise, f.filters, f.summary, f.mode, f.covariance, f.converged),
        fit,
        (noise, filters, summary, mode, covariance, converged),
    )
    return replace(base, fit=new), True
