"""What may be missing: a hypothesis and its log evidence in its several forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..calibrate.model import Model
from .columns import Design, with_noise
from .evidence import Optimum, Solution
from .own_numbers import OwnNumbers
from .refine import Refined
from .settings import DECISIONS

Names = tuple[str, ...]
UNLISTED: Names = ("UNLISTED",)


@dataclass
class Hypothesis:
    """What may be missing, with its log evidence in its several forms.

    Attributes:
        names: of the mechanisms; none for nothing, `UNLISTED` for a discrepancy that none explains.
        alone: log evidence by formulas of the library alone.
        with_misfit: where the formulas may be wrong.
        beside: with a smooth discrepancy beside them.
        best: at the optimum of its best formulas.
        own: numbers of every test's own instead.
        smooth: the discrepancy of `UNLISTED`.
        misfit_form: design and hyperparameters with their misfit, at the mode.
        other_noise: what other kinds of noise add to its log evidence.
        under_other_noise: another kind of noise, where the tests prefer it, and the hyperparameters there.
    """

    names: Names
    alone: float = -np.inf
    with_misfit: float = -np.inf
    beside: float = -np.inf
    best: Refined | None = None
    own: OwnNumbers | None = None
    smooth: Smooth | None = None
    misfit_form: tuple[Design, np.ndarray] | None = None
    other_noise: float = 0.0
    under_other_noise: tuple[Model, np.ndarray] | None = None

    @property
    def log_evidence(self) -> float:
        """Log marginal likelihood, averaged over its formulas alone and with their misfit."""
        if not self.names or self.names == UNLISTED or (self.own is not None and not np.isfinite(self.with_misfit)):
            return self.alone + self.other_noise
        return float(np.logaddexp(self.alone, self.with_misfit) - np.log(2)) + self.other_noise

    @property
    def fitted(self) -> tuple[Design, Optimum, Solution] | None:
        """Design, hyperparameters and numbers of the form in which it is added to the law."""
        one = self.formulas if self.smooth is None else self.smooth.at
        return None if one is None else (one.design, one.optimum, one.solution)

    @property
    def is_off(self) -> bool:
        """Whether the tests prefer its formulas with a misfit."""
        return self.with_misfit > self.alone

    @property
    def sizes(self) -> tuple[float, ...]:
        """How far the formulas are off, as shares of the effects: scales that follow the other hyperparameters."""
        if self.misfit_form is None:
            return ()
        one = self.formulas
        assert one is not None
        design, free = self.misfit_form
        logs = free[len(one.optimum.free) + len(one.variants) :] - design.misfits[:, 0]
        return tuple(float(x) for x in DECISIONS.misfit * np.exp(logs))

    @property
    def formulas(self) -> Refined | None:
        """Its formulas at their optimum, beside numbers of every test's own if it has any."""
        return self.best if self.own is None else self.own.at

    def likely_form(self, *, misfit: bool = True) -> tuple[Design, np.ndarray]:
        """Design and hyperparameters under the kind of noise that the tests prefer, at the mode.

        Args:
            misfit: with its misfit, if the tests prefer that, too; if not, noise is still that of the likelier form.
        """
        assert self.fitted is not None
        design, free = self.fitted[0], self.fitted[1].free
        if misfit and self.is_off and self.misfit_form is not None:
            design, free = self.misfit_form
        if self.under_other_noise is not None:
            model, at = self.under_other_noise
            design, free = with_noise(design, model), at[: len(free)]
        return design, free


@dataclass(frozen=True)
class Smooth:
    """A smooth discrepancy common to all particles.

    Attributes:
        at: the law with it at its optimum.
        basis: its functions [um].
    """

    at: Refined
    basis: np.ndarray

    @property
    def curve_um(self) -> np.ndarray:
        """What it adds to the law's displacement at every point [um]."""
        return self.basis @ self.at.solution.common[self.at.design.of_misfits]
