"""The answer of a discovery."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from .._errors import InputError
from .._format import described, table
from ..calibrate import Model, Posterior
from ..calibrate.curves import law_of
from ..calibrate.estimates import estimate, finite, normal_estimate
from ..calibrate.results import DISCOVERY_ARCHIVE, Calibration, Saved
from ..campaign import Finding
from ..effects import EQUIVALENCES, AbstractEffect, Variant
from ..law import MccLaw
from .base import Base
from .closure import Closure
from .hypothesis import Jump
from .verify import NOT_ASKED, HeldOut

Verdict = Literal["NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED"]


@dataclass(frozen=True)
class Effect:
    """A mechanism that was added.

    Attributes:
        variant: the formula.
        nuisance: its further parameters.
        amplitude, sd: estimate of the amplitude in the variant's unit.
        probability: that this mechanism is missing, if anything is.
        p_family_wise: probability of so much evidence of anything at all if nothing were missing.
        at_random: whether the amplitude differs from test to test.
        misfit: how far nature's formula is from this one, as a share of the effect [-].
        estimates: amplitude and further parameters with their uncertainty, by name, where the posterior was sampled.
        jumps: sudden steps of the tests that have one; the amplitude is then their mean size.
    """

    variant: Variant
    nuisance: dict[str, float]
    amplitude: float
    sd: float
    probability: float
    p_family_wise: float
    at_random: bool = False
    misfit: float = 0.0
    estimates: dict[str, dict[str, Any]] = field(default_factory=dict)
    jumps: tuple[Jump, ...] = ()

    __repr__ = described()

    @property
    def mechanism(self) -> str:
        """Name of the mechanism."""
        return self.variant.mechanism

    def build(self) -> AbstractEffect:
        """The effect as a part of the law."""
        return self.variant.build(self.amplitude, **self.nuisance)

    def to_json(self) -> dict[str, Any]:
        """As in `discovery.json`."""
        own = normal_estimate(self.amplitude, self.sd)
        fixed = {name: estimate(value) for name, value in self.nuisance.items()}
        unit = self.variant.unit
        jumps = [
            {f"{key}_{unit}" if key in ("size", "sd") else key: value for key, value in vars(jump).items()}
            for jump in self.jumps
        ]
        return {
            "mechanism": self.mechanism,
            "variant": self.variant.name,
            "probability": float(self.probability),
            "p_family_wise": float(self.p_family_wise),
            "equation": self.variant.equation,
            "explanation": self.variant.explanation,
            "parameters": {self.variant.parameter: own, **fixed} | self.estimates,
            "unit": unit,
            "differs_from_test_to_test": self.at_random,
            "misfit": self.misfit,
        } | ({"jumps": jumps} if jumps else {})


@dataclass(frozen=True)
class Residuals:
    """Measured less predicted displacement, every particle's own numbers fitted without and with what was added."""

    time_s: np.ndarray  # shape (N, points), as the others
    kind: np.ndarray  # of segment, codes of `mcc_jax.effects.Record`
    used: np.ndarray  # which points count
    before: np.ndarray  # of the base law [um]
    after: np.ndarray  # of the law with what was added [um]
    white_before: np.ndarray  # in units of the noise, independent from point to point
    white_after: np.ndarray
    noise: np.ndarray  # standard deviation of what the points before do not predict [um]
    particles: tuple[int, ...]  # positions of the tests in the campaign


@dataclass(frozen=True)
class Place:
    """A place of the map of disagreement."""

    segment: str
    load_fraction: tuple[float, float]  # range of force over the test's largest force [-]
    share: float  # of the squared difference [-]; NaN where there are no points
    sign: int  # +1 where more displacement is measured than the law predicts, -1 where less
    particles: tuple[int, ...]  # rows of the tests in which most of it lies


@dataclass(frozen=True)
class Likeness:
    """How alike mechanisms look once the law has taken up what it can."""

    names: tuple[str, ...]  # members of the sets first, then the ranking from the top; shape (K,)
    # Of their projected best formulas, each with its physical sign, shape (K, K): 1 means that these data cannot
    # separate the two, -1 that one would look like the other with the impossible sign.
    correlation: np.ndarray


@dataclass(frozen=True, repr=False)
class Discovery(Saved):
    """What is missing in the law, how sure that is, and which tests would show more.

    Attributes:
        verdict: NO_GAP, NAMED, SET, UNLISTED or FIT_NOT_CONVERGED.
        summary: the answer in one paragraph.
        base: the tests and the base law; None where it could not be fitted.
        model: with what was found in it; that of the base law without a name, or where tests have steps of their own.
        effects: what was added, in order.
        candidate_set: for each effect, the mechanisms that may be in its place, most probable first.
        pairs: two names each that together may be in place of the one that was added.
        ranking, untestable, where, leads, next_experiments: as in `discovery.json`.
        closure: a curve and a formula where no listed mechanism explains the gap.
        held_out: the gap on particles that took no part; None if not asked for.
        p_any: probability of so much evidence of anything if nothing were missing.
        parameters_before, parameters_after: the population's parameters by the law alone and with the effects.
        checks: for every member of a set, what would show it by itself: `mechanism`, `check`.
        posterior: of the law with effects; None where no `Model` holds what was added, or it was not asked for.
        findings, notes: what a reader must know, of the tests and of the answer.
        residuals: of every test, without and with what was added; None where the base law was not fitted.
        places: the whole map of disagreement.
        likeness: which mechanisms look alike; None where there was nothing to compare.
        before: the calibration in whose folder `mcc.load` found it.
    """

    content_file, archive_file = "discovery.json", DISCOVERY_ARCHIVE
    archived: ClassVar[tuple[str, ...]] = ("content",)

    verdict: Verdict
    summary: str
    base: Base | None
    model: Model | None
    seed: int
    runtime_s: float
    effects: tuple[Effect, ...] = ()
    candidate_set: tuple[tuple[str, ...], ...] = ()
    pairs: tuple[tuple[str, ...], ...] = ()
    ranking: tuple[dict[str, Any], ...] = ()
    untestable: tuple[dict[str, str], ...] = ()
    where: tuple[dict[str, Any], ...] = ()
    closure: Closure | None = None
    held_out: HeldOut | None = None
    p_any: float = float("nan")
    parameters_before: dict[str, Any] = field(default_factory=dict)
    parameters_after: dict[str, Any] = field(default_factory=dict)
    next_experiments: tuple[dict[str, Any], ...] = ()
    leads: tuple[dict[str, Any], ...] = ()
    checks: tuple[dict[str, str], ...] = ()
    posterior: Posterior | None = None
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    residuals: Residuals | None = None
    places: tuple[Place, ...] = ()
    likeness: Likeness | None = None
    before: Calibration | None = None

    def __repr__(self) -> str:
        rows = [("added", repr(effect.build())) for effect in self.effects]
        return table(f"Discovery: {self.verdict}. {self.summary[:200]}", rows + [("note", n[:100]) for n in self.notes])

    @property
    def outcome(self) -> Verdict:
        """The verdict."""
        return self.verdict

    def law(self, particle: str | None = None) -> MccLaw:
        """The calibrated law with the effects that were added: of the median particle, or of one of the tests.

        Raises:
            InputError: if there was no fit, a formula closes the gap, or one test's law is wanted without a posterior.
        """
        if self.closure is not None:
            remedy = "Draw or tabulate it: its terms are in discovery.json."
            raise InputError("the formula of this discovery is no effect of the library", remedy=remedy)
        if self.base is None:
            raise InputError("this discovery has no law: its fit did not converge", remedy="Calibrate first.")
        if particle is not None:
            if self.posterior is None:
                remedy = "Sample it: mcc.sample(campaign, found.model).law(particle)."
                raise InputError("the law of one particle with effects takes its posterior", remedy=remedy)
            return self.posterior.law(particle)
        form = {"unloading": self.base.model.unloading, "strain_scaling": self.base.model.strain_scaling}
        law = law_of({"law": form, "method": "bayes"} | (self.parameters_after or self.parameters_before))
        return law.with_effects(*(effect.build() for effect in self.effects))

    def gap(self) -> dict[str, Any]:
        """The gap at every step, on held-out particles."""
        return dict(NOT_ASKED) if self.held_out is None else self.held_out.to_json()

    def correction_um(self, *, held_out: bool = False) -> dict[str, np.ndarray]:
        """Displacement that the formula adds to the base law's at every row of every test that took part [um].

        Empty without a formula; NaN at rows that the fit leaves out. With `held_out`, the other tests give the weights.
        """
        if self.closure is None or self.base is None:
            return {}
        added = self.closure.held_out_um if held_out else self.closure.correction_um
        found = {}
        for i, rows, of_test in zip(self.base.selection.kept, self.base.selection.rows, added, strict=True):
            whole = np.full(len(self.base.campaign.curves[i]), np.nan)
            whole[rows] = of_test[: len(rows)]
            found[self.base.campaign.particles[i]] = whole
        return found

    @cached_property
    def content(self) -> dict[str, Any]:
        """The contents of `discovery.json`, worked out once."""
        posterior = self.posterior
        return {
            "schema": 1,
            "verdict": self.verdict,
            "summary": self.summary,
            "effects": [effect.to_json() for effect in self.effects],
            "candidate_set": [list(names) for names in self.candidate_set],
            "candidate_pairs": [list(names) for names in self.pairs],
            "ranking": list(self.ranking),
            "untestable": list(self.untestable),
            "where": list(self.where),
            "closure": None if self.closure is None else self.closure.to_json(),
            "leads": list(self.leads),
            "gap": self.gap(),
            "parameters_before": self.parameters_before,
            "parameters_after": self.parameters_after,
            "posterior": posterior and {"converged": posterior.converged} | posterior.diagnostics(),
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
