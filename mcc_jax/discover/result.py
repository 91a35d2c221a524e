"""The answer of a discovery."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from .._errors import InputError
from .._format import table
from ..calibrate.estimates import finite
from ..calibrate.laws import law_of
from ..calibrate.results import DISCOVERY_ARCHIVE, Saved
from ..campaign import Finding
from ..effects import EQUIVALENCES, AbstractEffect, Variant
from ..law import MccLaw
from .cross_validation import HeldOut
from .discrepancy import Closure
from .evidence import Ranking
from .linear_model import Base, System, feature_values
from .pop_in import Jump
from .posterior import ExtendedPosterior
from .remaining import Likeness, Residuals
from .residual_map import Place
from .score import project

Verdict = Literal["NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED"]


@dataclass(frozen=True)
class Effect:
    """A mechanism that was added.

    Attributes:
        variant: the formula.
        nuisance: its further parameters.
        amplitude, sd: estimate of the amplitude in the variant's unit.
        probability: of the mechanism among all, tempered.
        p_family_wise: probability of so large a statistic of any mechanism if nothing were missing.
        at_random: whether the amplitude differs from test to test.
        by_particle: each test's own estimate of the amplitude.
        estimates: amplitude and further parameters with their uncertainty, by name, where the posterior was sampled.
        jumps: sudden steps, size in the variant's unit, of the tests that probably have one; the amplitude is then
            their mean size.
    """

    variant: Variant
    nuisance: dict[str, float]
    amplitude: float
    sd: float
    probability: float
    p_family_wise: float
    at_random: bool
    by_particle: np.ndarray
    estimates: dict[str, dict[str, Any]] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return self.variant.mechanism

    def build(self) -> AbstractEffect:
        """The effect as a part of the law."""
        return self.variant.build(self.amplitude, **self.nuisance)

    def to_json(self) -> dict[str, Any]:
        """As in `discovery.json`."""
        pair = [self.amplitude - 1.96 * self.sd, self.amplitude + 1.96 * self.sd]
        own = {"value": finite(self.amplitude), "sd": finite(self.sd), "interval_95": [finite(v) for v in pair]}
        fixed = {
            name: {"value": float(value), "sd": None, "interval_95": None} for name, value in self.nuisance.items()
        }
        return {
            "mechanism": self.mechanism,
            "variant": self.variant.name,
            "probability": float(self.probability),
            "p_family_wise": float(self.p_family_wise),
            "equation": self.variant.equation,
            "explanation": self.variant.explanation,
            "parameters": {self.variant.parameter: own, **fixed} | self.estimates,
            "unit": self.variant.unit,
            "differs_from_test_to_test": self.at_random,
        }


@dataclass(frozen=True, repr=False)
class Discovery(Saved):
    """What is missing in the law, how sure that is, and what would tell more.

    Attributes:
        verdict: NO_GAP, NAMED, SET, UNLISTED or FIT_NOT_CONVERGED.
        summary: the answer in one paragraph.
        base: the base fit.
        system: its linear system; a working array of the search, which files do not hold.
        effects: what was added, in order.
        candidate_set: for each effect, the mechanisms that explain it as well, best first.
        ranking: all mechanisms against the base law.
        untestable: mechanisms these data cannot show, and what they need.
        where: places of disagreement.
        closure: a formula where no listed mechanism explains the gap.
        held_out: the gap on particles that took no part; None if not asked for.
        labels: what was added at each step of `held_out`.
        p_any: family-wise probability that anything is missing.
        before, after: the population's parameters without and with the effects.
        next_experiments: further tests that would probably tell the members of a set apart.
        checks: for every member of a set with rivals, what would show it by itself: `mechanism`, `check`.
        posterior: of the law with effects; None where nothing was added, its fit has an impossible sign, or it was not
            asked for.
        notes: what a reader must know.
        findings: what the checks of the tests found, and which particles took no part for it.
        residuals: of every test, without and with what was added; None where the base law was not fitted.
        places: the whole map of disagreement.
        likeness: which mechanisms look alike.
    """

    content_file, archive_file = "discovery.json", DISCOVERY_ARCHIVE
    archived: ClassVar[tuple[str, ...]] = ("content",)  # kept with the fields: the system it needs is not

    verdict: Verdict
    summary: str
    base: Base | None
    system: System | None = field(metadata={"archived": False})
    effects: tuple[Effect, ...]
    candidate_set: tuple[tuple[str, ...], ...]
    ranking: Ranking | None
    untestable: tuple[dict[str, str], ...]
    where: tuple[dict[str, Any], ...]
    closure: Closure | None
    held_out: HeldOut | None
    labels: tuple[str | None, ...]
    p_any: float
    before: dict[str, Any]
    after: dict[str, Any]
    next_experiments: tuple[dict[str, Any], ...]
    limits: dict[str, tuple[float, float, float]]
    seed: int
    runtime_s: float
    checks: tuple[dict[str, str], ...] = ()
    posterior: ExtendedPosterior | None = None
    notes: tuple[str, ...] = field(default=())
    findings: tuple[Finding, ...] = field(default=())
    residuals: Residuals | None = None
    places: tuple[Place, ...] = ()
    likeness: Likeness | None = None

    def __repr__(self) -> str:
        rows = [("added", repr(effect.build())) for effect in self.effects]
        return table(f"Discovery: {self.verdict}. {self.summary[:200]}", rows + [("note", n[:100]) for n in self.notes])

    def law(self, particle: str | None = None) -> MccLaw:
        """The calibrated law with the effects that were added.

        Raises:
            InputError: if there was no fit, or the gap is closed by a formula that no listed mechanism has.
        """
        if self.closure is not None:
            remedy = "Draw or tabulate it: its terms stand in discovery.json."
            raise InputError("the formula of this discovery is no effect of the library", remedy=remedy)
        if self.base is None:
            raise InputError("this discovery has no law: its fit did not converge", remedy="Calibrate first.")
        model = self.base.model
        numbers = {"method": "bayes", "law": {"unloading": model.unloading, "strain_scaling": model.strain_scaling}}
        law = law_of(numbers | (self.after or self.before), particle)
        return law.with_effects(*(effect.build() for effect in self.effects))

    def gap(self) -> dict[str, Any]:
        """The gap at every step, on held-out particles."""
        if self.held_out is None:
            return {"floor": 1.0, "heldout": None, "steps": [], "closed_fraction": None}
        h = self.held_out
        reference = h.elpd[0]
        typical = self._typical_noise_um()
        steps = []
        for label, chi2, energy, elpd in zip(self.labels, h.chi2_per_dof, h.energy, h.elpd, strict=True):
            difference = elpd - reference
            sd = float(np.std(difference, ddof=1) * np.sqrt(len(difference))) if len(difference) > 1 else None
            steps.append(
                {
                    "added": label,
                    "chi2_per_dof": finite(float(chi2)),
                    "systematic_um": finite(float(np.sqrt(max(energy, 0.0) / h.points.sum()) * typical)),
                    "elpd": finite(float(difference.sum())),
                    "elpd_se": sd,
                }
            )
        closed = None
        if len(h.energy) > 1 and h.energy[0] > 0:
            closed = finite(float(min(1 - h.energy[-1] / h.energy[0], 1.0)))
        return {"floor": 1.0, "heldout": "leave-one-particle-out", "steps": steps, "closed_fraction": closed}

    def correction_um(self, *, held_out: bool = False) -> dict[str, np.ndarray]:
        """Displacement that the formula adds to the base law's at every row of every test that took part [um].

        Empty without a formula. Rows that the fit leaves out, of an approach or of a record that was thinned, are NaN.

        Args:
            held_out: every test by the formula that the tests without its fold make, words and numbers looked for
                anew; by the whole formula where there are too few tests for folds.
        """
        if self.closure is None or self.base is None or self.system is None:
            return {}
        base, system = self.base, self.system
        coefficients = np.zeros((len(base.tests), len(system.formula)))
        coefficients[:, self.closure.words - system.formula_columns[0]] = self.closure.coefficients
        for group, words in self.closure.folds if held_out else ():
            others = np.setdiff1d(np.flatnonzero(system.usable), group)
            fitted = project(system, words[:0], inside=words, particles=others).theta[len(system.globals) :]
            coefficients[group] = 0.0
            coefficients[group[:, None], words - system.formula_columns[0]] = fitted
        added = np.einsum("nw,nwp->np", coefficients, np.asarray(feature_values(base, system.formula)))
        found = {}
        for i, rows, of_test in zip(base.selection.kept, base.selection.rows, added, strict=True):
            whole = np.full(len(base.campaign.curves[i]), np.nan)
            whole[rows] = of_test[: len(rows)]
            found[base.campaign.particles[i]] = whole
        return found

    def name_of(self, row: int) -> str:
        """The particle of a row of the tests that took part."""
        return str(row + 1) if self.base is None else self.base.name_of(row)

    def _jumps(self, effect: Effect) -> dict[str, Any]:
        """The sudden steps of an effect, one for each test that probably has one."""
        if not effect.jumps:
            return {}
        unit = effect.variant.unit
        return {
            "jumps": [
                {
                    "particle": self.name_of(jump.particle),
                    "stress_MPa": jump.stress_MPa,
                    f"size_{unit}": jump.size,
                    f"sd_{unit}": jump.sd,
                    "probability": jump.probability,
                }
                for jump in effect.jumps
            ]
        }

    def _typical_noise_um(self) -> float:
        if self.base is None:
            return 0.0
        weight = np.asarray(self.base.fit.filters.weight)
        return float(np.sqrt((weight > 0).sum() / np.maximum((weight**2).sum(), 1e-300)))

    def to_json(self) -> dict[str, Any]:
        """The contents of `discovery.json`."""
        return self.content

    @cached_property
    def content(self) -> dict[str, Any]:
        """The contents of `discovery.json`, worked out once."""
        ranking = []
        if self.ranking is not None and self.system is not None:
            r = self.ranking
            for i, name in enumerate(r.names):
                variant = self.system.candidates[r.best[i]].variant
                statistic, estimate, limit = self.limits[name]
                ranking.append(
                    {
                        "mechanism": name,
                        "variant": variant.name,
                        "statistic": finite(statistic),
                        "estimate": finite(estimate),
                        "detection_limit": finite(limit),
                        "unit": variant.unit,
                        "parameter": variant.parameter,
                        "probability": finite(float(r.probability[i])),
                        "sign": variant.sign,
                    }
                )
        return {
            "schema": 1,
            "verdict": self.verdict,
            "summary": self.summary,
            "effects": [effect.to_json() | self._jumps(effect) for effect in self.effects],
            "candidate_set": [list(names) for names in self.candidate_set],
            "ranking": ranking,
            "untestable": list(self.untestable),
            "where": list(self.where),
            "closure": None if self.closure is None else self.closure.to_json(),
            "gap": self.gap(),
            "parameters_before": self.before,
            "parameters_after": self.after,
            "posterior": None if self.posterior is None else self.posterior.to_json(),
            "next_experiments": list(self.next_experiments),
            "checks": list(self.checks),
            "p_anything_missing": finite(self.p_any),
            "equivalent_by_construction": [
                {"names": list(e.names), "why": e.explanation, "told_apart_by": e.broken_by} for e in EQUIVALENCES
            ],
            "notes": list(self.notes),
            "findings": [one.to_json() for one in self.findings],
            "seed": self.seed,
            "runtime_s": self.runtime_s,
        }
