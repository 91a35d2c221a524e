"""Hypotheses whose formulas may be wrong, and those of a smooth discrepancy that no mechanism explains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..calibrate.priors import NakagamiPrior, SpreadCoordinate
from ..effects import Mechanism
from .base import Base
from .columns import Design, without_further
from .design import NO_EXTRA, ExtraColumns, design_of, moved
from .evidence import LinearModel, Optimum, likely_start, optimise, visible
from .fit import Fitted
from .hypothesis import Hypothesis
from .misfit import functions
from .settings import DECISIONS, EARLY, HYPERPARAMETERS, VERY_STRONG

SCATTER = NakagamiPrior(DECISIONS.scatter)
"""Prior of the spread of an amplitude over the particles, as a share of it."""

FOLLOWED = 4  # times at most that the prior of a misfit follows the amplitude of its formula
AGREE = 0.1  # difference of the logarithms of the two at which it need not

Coordinates = Mapping[str, np.ndarray]
Signatures = Callable[[str], Mapping[str, np.ndarray]]
"""Signatures of all formulas of a mechanism."""


def fit_with_misfit(
    base: Base, one: Hypothesis, at: Coordinates, signatures: Signatures, library: Mapping[str, Mechanism]
) -> tuple[tuple[np.ndarray, Design], float]:
    """A hypothesis where every name's formula may be wrong by a share of the effect.

    Columns of a misfit are made at the amplitude of the formula alone. Where the amplitude is another with them, so is
    the effect of which they may be a share: their prior follows it until both agree. Else a formula that explains
    nothing by itself would lend its name to what its misfit explains.

    Args:
        base: the tests.
        one: the hypothesis by its formulas alone.
        at: coordinates of all points, between 0 and 1.
        signatures: of the formulas of each mechanism.
        library: the mechanisms, which name the coordinates that their formulas may be wrong in.

    Returns:
        Hyperparameters at their mode and design, and the log evidence.
    """
    r, design = one.at, _design(base, one, at, signatures, library)
    assert r is not None
    some = float(SpreadCoordinate(SCATTER).coordinate(SCATTER.sd))
    start = np.concatenate([r.optimum.hyper, [some] * len(r.variants), design.misfits[:, 0]])
    optimum = optimise(design, start, without=r.optimum)
    sizes, shift = design.misfits, np.zeros(len(design.misfits))
    for _ in range(FOLLOWED):
        away = _amplitudes(r, design, optimum) - shift
        if optimum.log_evidence < r.log_evidence or np.all(np.abs(away) < AGREE):
            break
        shift = shift + away / 2  # all of the way would overshoot
        design = replace(design, misfits=sizes + shift[:, None] * [1.0, 0.0, 1.0])
        start = np.concatenate([optimum.hyper[: -len(sizes)], design.misfits[:, 0]])
        optimum = optimise(design, start, without=r.optimum)
    value = optimum.log_evidence + (0.0 if one.own is None else one.own.of_choices)
    return (optimum.hyper, replace(design)), value  # a copy, without its whitened columns


def _amplitudes(r: Fitted, design: Design, optimum: Optimum) -> np.ndarray:
    """Logarithms of the amplitudes with misfits, over those of the formulas alone; 0 of a test's own numbers."""
    names = len(r.variants)
    now = LinearModel(optimum.hyper, design).solve().amplitude[:names] * np.array([v.plausible[0] for v in r.variants])
    alone = np.maximum(np.abs(r.theta[:names]), 1e-300)
    return np.append(np.log(np.maximum(np.abs(now), 1e-300) / alone), np.zeros(len(design.misfits) - names))


def _design(
    base: Base, one: Hypothesis, at: Coordinates, signatures: Signatures, library: Mapping[str, Mechanism]
) -> Design:
    """Every formula with its misfit, and an amplitude that differs from particle to particle."""
    r = one.at
    assert r is not None
    basis, more = [misfit_columns(r, i, at, signatures, library) for i in range(len(r.variants))], NO_EXTRA
    # A formula is wrong by a share of what can be seen of it: most of some is like a particle's own numbers.
    seen = list(visible(r.optimum.hyper, r.design, r.curves_um))
    if one.own is not None:
        more = one.own.more
        if not one.own.jumps:
            curve = one.own.curve_um[..., None]
            basis.append(curve * functions(library[one.own.variant.mechanism].coordinates, at))
            seen.extend(visible(r.optimum.hyper[:HYPERPARAMETERS], without_further(r.design), curve))
    basis = [share * columns for share, columns in zip(seen, basis, strict=True)]
    sizes = [(np.log(DECISIONS.misfit), DECISIONS.misfit_log_sd, float(np.log(DECISIONS.misfit_most)))] * len(basis)
    group = [i for i, columns in enumerate(basis, 1) for _ in range(columns.shape[-1])]
    more = more.with_own(r.curves_um, [SCATTER] * len(r.variants))
    more = replace(more, basis=np.concatenate(basis, -1), group=group, sizes=sizes)
    return design_of(base, r.state, r.variants, more)


def misfit_columns(
    r: Fitted, which: int, at: Coordinates, signatures: Signatures, library: Mapping[str, Mechanism]
) -> np.ndarray:
    """Columns by which one of the formulas may be wrong: at its amplitude, and towards each of its siblings."""
    variant, own = r.variants[which], r.curves_um[..., which]
    smooth = own[..., None] * functions(library[variant.mechanism].coordinates, at)
    size = float(np.sqrt(np.sum(own**2)))
    others = []
    for formula, column in signatures(variant.mechanism).items():
        length = float(np.sqrt(np.sum(column**2)))
        if formula != variant.name and length > 0:
            likeness = float(np.sum(column * own))
            others.append(column * np.copysign(size / length, likeness) - own)
    siblings = np.stack(others, -1) if others else smooth[..., :0]
    return np.concatenate([siblings, smooth], -1)


@dataclass(frozen=True)
class Discrepancy:
    """A smooth discrepancy common to all particles, which no mechanism explains: its functions."""

    basis: np.ndarray  # the functions [um]
    group: Sequence[int]  # of which part each is
    log_white: float  # logarithm of the standard deviation of white noise, by which they are measured

    def added_to(self, base: Base, r: Fitted, at_least: float = -np.inf) -> Fitted | None:
        """The law, or what is named, with the discrepancy in addition, at its optimum.

        None where it begins `VERY_STRONG` below a log evidence to compare with: it would not come near.
        """
        unit, parts = float(np.log(DECISIONS.general)) + self.log_white, max(self.group)
        sizes = [(unit, DECISIONS.general_log_sd, np.inf)] * parts
        more = ExtraColumns(basis=self.basis, group=self.group, sizes=sizes)
        design = design_of(base, r.state, r.variants, more)
        start, value = likely_start(design, np.append(r.optimum.hyper, [unit - 1.0] * parts))
        if value < at_least - VERY_STRONG:
            return None
        optimum = optimise(design, start, without=r.optimum)
        at = Fitted(r.variants, r.state, design, optimum)
        if not r.variants and optimum.log_joint > r.optimum.log_joint + VERY_STRONG:
            # What it takes away from the law's numbers moves these as far as a name does; with a name that is done.
            there = at
            for _ in range(EARLY):
                state = moved(base, there.state, r.variants, there.solution)
                design = design_of(base, state, r.variants, more)
                there = replace(there, state=state, design=design)
            optimum = optimise(design, optimum.hyper, without=r.optimum)
            if optimum.log_joint > at.optimum.log_joint:
                at = replace(there, optimum=optimum)
        return at

    def curve_um(self, at: Fitted) -> np.ndarray:
        """What it adds to the law's displacement at every point, where it is part of a hypothesis [um]."""
        return self.basis @ at.solution.common[at.design.of_misfits]
