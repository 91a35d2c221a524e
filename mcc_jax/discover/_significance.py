"""How probable it is that nothing is missing, over all formulas, places and words looked at."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from ._score import family_wise, flips, project
from ._system import System

INDEPENDENT = 100
"""So many independent columns are counted where no bootstrap does it."""

FREEDOM = 0.3
"""How far nature's formula may differ from the best one of its family: by so much of it in every other one."""

FEWEST = 4
"""Below so many particles their scatter says nothing; the noise model has to do."""


def p_nothing_left(system: System, seed: int, chosen: list[int]) -> float:
    """Family-wise probability that nothing is left beside some candidates, over candidates, map and words.

    The candidates are fitted; the other formulas of their families are let in within `FREEDOM`.
    """
    inside, precision = _family(system, chosen)
    columns = np.concatenate([system.candidate_columns, system.place_columns, system.word_columns])
    sign = np.concatenate([signs_of(system), np.zeros(len(columns) - len(system.candidates))])
    view = project(system, columns, inside=inside, precision=precision)
    keep = view.survival > (1e-6 if not len(inside) else 1e-2)
    if not keep.any():
        return 1.0
    scores, total, signs = view.scores[:, keep], view.total[keep], sign[keep]
    found = _probability(scores, total, signs, seed)
    # The scatter of few particles cannot be surer than their number of signs allows, however strong a second effect is.
    return min(found, 2 * by_noise_model(scores, total, signs)) if chosen else found


def _family(system: System, chosen: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the families of some candidates, and how tightly each is held to zero."""
    own = np.array([system.column(k) for k in chosen], int)
    if not chosen:
        return own, np.zeros(0)
    theta = system.at[chosen] + project(system, own[:0], inside=own).theta[len(system.globals) :]
    strength = project(system, system.candidate_columns).total
    columns, precision = list(own), [1e-12] * len(own)
    for k, amplitude in zip(chosen, theta, strict=True):
        effect = FREEDOM**2 * amplitude**2 * strength[k]
        for j, candidate in enumerate(system.candidates):
            if candidate.mechanism == system.candidates[k].mechanism and j not in chosen and strength[j] > 0:
                columns.append(system.column(j))
                precision.append(float(strength[j] / max(effect, 1e-300)))
    return np.array(columns, int), np.array(precision)


def _probability(scores: np.ndarray, total: np.ndarray, sign: np.ndarray, seed: int) -> float:
    if len(scores) < FEWEST:
        return by_noise_model(scores, total, sign)
    return float(family_wise(scores, sign, flips(len(scores), seed))[0].min())


def by_noise_model(scores: np.ndarray, total: np.ndarray, sign: np.ndarray) -> float:
    """Bonferroni's bound for the largest estimate over its standard error; a sign that is NaN does not count."""
    t = scores.sum(0) / np.sqrt(np.maximum(total, 1e-300))
    sided = np.where(np.isnan(sign), -np.inf, np.where(sign == 0, np.abs(t), t * np.nan_to_num(sign)))
    return float(min(1.0, INDEPENDENT * norm.sf(float(np.max(sided)))))


def signs_of(system: System) -> np.ndarray:
    """The sign that each candidate's amplitude must have; 0 where both are possible."""
    return np.array([c.variant.sign for c in system.candidates])
