"""Small linear systems made by hand: whitened columns, random effects of every particle, and their dense solution."""

from dataclasses import dataclass

import numpy as np

from mcc_jax.discover.candidates import Candidate
from mcc_jax.discover.dictionary import map_features, words
from mcc_jax.discover.linear_model import GLOBALS, System
from mcc_jax.effects import LIBRARY

G = len(GLOBALS)
FORMULAS = (
    ("frame_compliance", "linear"),
    ("thermal_drift", "linear"),
    ("creep", "kelvin_voigt"),
    ("adhesion", "bond"),
    ("reverse_plasticity", "quartic"),
    ("platen_friction", "siebel"),
    ("unloading_shape", "symmetric_bow"),
    ("reload_hysteresis", "parabolic"),
)
PLACES, WORDS = 4, 6


def candidate(mechanism, variant, **nuisance):
    found = LIBRARY[mechanism][variant]
    return Candidate(found, {n.name: n.middle for n in found.nuisances} | nuisance)


@dataclass(frozen=True)
class Dense:
    """The same campaign without any algebra of ours: tall matrices and covariances with everything in them."""

    own: np.ndarray
    """Whitened columns of a particle's own standard normal deviations, shape (N, points, k)."""
    columns: np.ndarray
    """Whitened residual and columns, shape (N, points, Q)."""
    prior: np.ndarray

    def covariance(self, particle):
        """Of the whitened residual: noise and the particle's own deviations."""
        Z = self.own[particle]
        return np.eye(len(Z)) + Z @ Z.T

    def stacked(self, columns, particles=None):
        """Columns of all particles one under the other, and the inverse covariance of everything."""
        chosen = range(len(self.columns)) if particles is None else particles
        X = np.concatenate([self.columns[i][:, columns] for i in chosen])
        points = self.columns.shape[1]
        M = np.zeros((len(X), len(X)))
        for row, i in enumerate(chosen):
            at = slice(row * points, (row + 1) * points)
            M[at, at] = np.linalg.inv(self.covariance(i))
        return X, M


def random_campaign(seed, *, particles=7, points=25, own=3, formulas=FORMULAS, words_used=WORDS):
    """A random system with its dense twin; the residual is noise with the particles' deviations."""
    rng = np.random.default_rng(seed)
    candidates = tuple(candidate(*names) for names in formulas)
    places, some = map_features()[:PLACES], words()[:words_used]
    size = 1 + G + len(candidates) + len(places) + len(some)
    Z = rng.normal(size=(particles, points, own)) * rng.uniform(0.2, 3.0, own)
    X = rng.normal(size=(particles, points, size)) * rng.uniform(0.3, 3.0, size)
    deviations = rng.normal(size=(particles, own))
    X[:, :, 0] = rng.normal(size=(particles, points)) + np.einsum("npk,nk->np", Z, deviations)
    prior = rng.uniform(0.1, 2.0, G)
    dense = Dense(Z, X, prior)
    return system_of(dense, candidates, places, some), dense


def system_of(dense, candidates, places, some, usable=None):
    """Gram matrices by the inverse of the dense covariance."""
    count, points = dense.columns.shape[:2]
    gram = np.stack([X.T @ np.linalg.solve(dense.covariance(i), X) for i, X in enumerate(dense.columns)])
    free = np.ones(count, bool) if usable is None else usable
    none, still = np.zeros(len(candidates)), np.zeros(len(dense.prior))
    return System(gram, np.full(count, points), candidates, places, some, dense.prior, free, none, still)


def planted(seed, amounts, *, particles=20, points=60, own=4):
    """A system whose residual holds amounts of its candidates: +r is what the law leaves, a column is -its signature.

    Args:
        amounts: estimate over standard error that each named mechanism gets on average.
    """
    system, dense = random_campaign(seed, particles=particles, points=points, own=own)
    names = [c.mechanism for c in system.candidates]
    from mcc_jax.discover.score import project

    view = project(system, system.candidate_columns)
    X = dense.columns.copy()
    for name, strength in amounts.items():
        k = names.index(name)
        X[:, :, 0] -= strength / np.sqrt(view.total[k]) * X[:, :, system.column(k)]
    dense = Dense(dense.own, X, dense.prior)
    return system_of(dense, system.candidates, system.places, system.words)
