"""How much listed words explain, one after the other: what a name has to stand up to."""

from __future__ import annotations

import numpy as np

from ._score import project_summed
from ._system import System

MOST_WORDS = 3
WORTH = 14.0
"""Least drop of chi2 for which another word is taken: about log of the number of words, twice, and one parameter."""


def pursue(system: System, *, particles: np.ndarray | None = None, most: int = MOST_WORDS) -> tuple[list[int], float]:
    """Words one after the other, each time the one that takes away most together with those before.

    Returns:
        Columns, and the drop of chi2 by all of them.
    """
    columns, total = system.word_columns, system.total(particles)
    inside: list[int] = []
    base = float("nan")
    while True:
        found = project_summed(total, system, columns, np.array(inside, int), 1e-4)
        if not inside:
            base = found.residual
        best = int(np.argmax(found.drop))
        if len(inside) == most or found.drop[best] < WORTH:
            return inside, base - found.residual
        inside.append(int(columns[best]))
