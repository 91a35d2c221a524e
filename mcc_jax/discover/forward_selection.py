"""How much listed words explain, one after the other: what a name has to stand up to."""

from __future__ import annotations

import numpy as np

from .linear_model import System
from .score import project_summed

MAX_WORDS = 3
WORTH = 14.0
"""Least drop of chi2 for which another word is taken: about log of the number of words, twice, and one parameter."""

WORTH_OF_WAVE = 18.0
"""The same for sine and cosine of a wave together: less than both alone, since there are a hundred frequencies only."""


def pursue(system: System, *, particles: np.ndarray | None = None, most: int = MAX_WORDS) -> tuple[list[int], float]:
    """Words one after the other, each time the one that takes away most together with those before; where no single
    one is worth it, sine and cosine of a wave may be.

    Returns:
        Columns, and the drop of chi2 by all of them.
    """
    columns, total = system.word_columns, system.total(particles)
    waves = system.quadratures
    places = waves - columns[0]
    inside: list[int] = []
    base = float("nan")
    while True:
        found = project_summed(total, system, columns, np.array(inside, int), 1e-4, places)
        if not inside:
            base = found.residual
        best, room = int(np.argmax(found.drop)), most - len(inside)
        if room >= 1 and found.drop[best] >= WORTH:
            inside.append(int(columns[best]))
        elif room >= 2 and np.max(found.of_both, initial=0.0) >= WORTH_OF_WAVE:
            inside.extend(waves[np.argmax(found.of_both)].tolist())
        else:
            return inside, base - found.residual
