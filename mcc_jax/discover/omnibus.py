"""How probable it is that nothing is missing, over all formulas, places and words looked at."""

from __future__ import annotations

import numpy as np

from .evidence import evidence_of_any
from .linear_model import System
from .score import DRAWS, project, smallest_of_families

FREEDOM = 0.3
"""How far nature's formula may differ from the best one of its family: by so much of it in every other one."""

BESIDE_NOTHING = (0.8, 0.15, 0.05)
"""How much counts what all mechanisms together explain, what the formulas that are not common, map and words do, and
what waves in time and displacement do, which are many and come from room and gauge only.

An effect is far more often a known one. Whatever the shares, the level is kept."""

BESIDE_NAMES = (0.4375, 0.4375, 0.125)
"""The same where names are in the law already: the common formulas of all mechanisms come first there, and another
formula, or a place, is as likely to be what they leave."""

MIN_PARTICLES = 4
"""Below so many particles their scatter says nothing; the noise model has to do."""


def p_nothing_left(system: System, seed: int, chosen: list[int]) -> float:
    """Family-wise probability that nothing is left beside some candidates, over candidates, map and words.

    The candidates are fitted; the other formulas of their families are let in within `FREEDOM`. Beside nothing it is
    the evidence of all mechanisms together that counts, which finds more than the largest of their statistics: formulas
    are alike and add up, and what could be seen at impossible sizes only does not count.
    """
    inside, precision = _family(system, chosen)
    columns, sign = system.looked_at()
    view = project(system, columns, inside=inside, precision=precision)
    keep = view.survival > 1e-2 if len(inside) else view.alive
    if not keep.any():
        return 1.0
    own, sign, columns = view.only(keep), sign[keep], columns[keep]
    wave, common = np.isin(columns, system.waves), np.isin(columns, _common(system))
    any_mechanism = not chosen and bool(common.any())
    return smallest_of_families(
        own,
        sign,
        seed,
        [evidence_of_any(system, own) if any_mechanism else common, ~common & ~wave, wave],
        shares=BESIDE_NAMES if chosen else BESIDE_NOTHING,
        pairs=_places(system.quadratures, columns),
        few=len(view.particles) < MIN_PARTICLES,
        # The smallest share must be able to reach the least level that is asked for (`LEVEL_OF_UNLISTED`).
        draws=3 * DRAWS,
    )


def _places(pairs: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Where pairs of columns are among some columns; without those that are not there both."""
    there = np.isin(pairs, columns).all(1)
    order = np.argsort(columns)
    return order[np.searchsorted(columns, pairs[there], sorter=order)]


def _common(system: System) -> np.ndarray:
    """Columns of every mechanism's common formula.

    They are a family of their own: the other formulas, the map and the words are ten times as many.
    """
    first: dict[str, str] = {}
    for candidate in system.candidates:
        first.setdefault(candidate.mechanism, candidate.variant.name)
    common = [k for k, c in enumerate(system.candidates) if c.variant.name == first[c.mechanism]]
    return system.candidate_columns[common]


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
