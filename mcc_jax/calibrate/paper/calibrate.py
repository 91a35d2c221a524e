"""The paper's whole calibration, step after step, for any campaign."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, get_args

import equinox as eqx
import numpy as np

from ... import arguments
from ..._errors import InputError
from ..._types import Progress
from ...campaign import (
    THRESHOLD_MPA,
    Adjustment,
    Campaign,
    Finding,
    adjust,
    check_tests,
    of_each_particle,
    particle_batch,
)
from ...campaign.adjustment import refusal
from ...geometry import plastic_shape_factor
from ...law import MccLaw, StrainScaling, Unloading
from ..data import MOST_POINTS, point_noise_um, rows_from_contact
from ..estimates import NO_SAMPLER, estimate, finite, force_zero
from ..judgement import judged, misfit_note, numbers_in_reach, unlike_others
from ..results import Calibration
from .loading import MasterCurve, PlasticFit, StrainTable, fit_population, master_curve, strain_table
from .modulus import ElasticFit, campaign_branches, fit_effective_modulus
from .prediction import ParticleFit, predict_particles
from .shape import Objective, ShapeFit, fit_shape_parameter

LARGEST_SHAPE_FACTOR = 4.0  # twice the paper's largest: shape factors beyond come from curves that do not collapse


@dataclass(frozen=True, repr=False)
class PaperCalibration(Calibration):
    """Everything that the paper's calibration finds, with what it was made from.

    Attributes:
        campaign: the tests, checked; `campaign.raw` as they were given.
        adjustment: the offset step.
        table: strain over stress of the kept particles.
        shape: `a` by the full objective; the one in `law`, unless the reference objective was asked for.
        shape_reference: `a` by the reference-particle objective, None if it could not be fitted.
        objective: which of the two is in `law`.
        master: the master curve under that `a`.
        plastic: log-normal C1, C3, C5.
        elastic: the effective modulus.
        mean_law: the law of the expected stress.
        particles: one entry per particle of the campaign, None where it was not kept.
        displacement_noise_um: standard deviation of displacement from point to point [um], for comparison with the
            residuals.
        seed: kept for the record; nothing here is random.
        runtime_s: time taken.
        findings: what a reader must know of the tests and of the plausibility of the answer.
    """

    campaign: Campaign
    adjustment: Adjustment
    table: StrainTable
    shape: ShapeFit
    shape_reference: ShapeFit | None
    objective: Objective
    master: MasterCurve
    plastic: PlasticFit
    elastic: ElasticFit
    mean_law: MccLaw
    particles: tuple[ParticleFit | None, ...]
    displacement_noise_um: float
    seed: int
    runtime_s: float
    findings: tuple[Finding, ...] = ()

    def compared(self) -> Mapping[int, tuple[np.ndarray, np.ndarray]]:
        """Every row from contact on of every kept particle's curve, and which of them are compared."""
        segments = self.adjustment.segments
        found = {}
        for i, fit in enumerate(self.particles):
            if fit is not None:
                rows = rows_from_contact(self.campaign.curves[i], segments[i], MOST_POINTS)
                found[i] = rows, fit.used[rows]
        return found

    @property
    def a(self) -> float:
        """The shape parameter in use [-]."""
        return float(self.mean_law.a)

    @property
    def converged(self) -> bool:
        """Whether shape parameter and modulus both converged."""
        return self.chosen_shape.converged and self.elastic.converged

    @property
    def chosen_shape(self) -> ShapeFit:
        """The fit whose `a` is in the law."""
        return self.shape if self.objective == "full" or self.shape_reference is None else self.shape_reference

    def warnings(self) -> list[str]:
        """What a reader of the numbers must know, one sentence each."""
        notes = [reason for reason in (self.chosen_shape.reason, self.elastic.reason) if reason]
        notes += map(str, self.findings)
        if self.plastic.at_bound:
            notes.append(
                f"{', '.join(self.plastic.at_bound)} ended at the lower bound: a collapsed estimate, not a measurement"
            )
        if not bool(self.mean_law.is_monotone):
            notes.append("the mean law is not monotone: under load control it snaps through")
        share = float(self.plastic.population.probability_not_monotone)
        if share > 0.05:
            notes.append(
                f"{100 * share:.0f} % of particles drawn from this population would have a law that is not monotone"
            )
        dropped = int((~self.adjustment.kept).sum())
        if dropped:
            notes.append(f"{dropped} of {len(self.campaign)} particles could not be used")
        if self.shape_factor_max > LARGEST_SHAPE_FACTOR:
            notes.append(
                f"a = {self.a:.3g} makes shape factors of up to {self.shape_factor_max:.3g}: "
                "the shape factor does not bring these curves together"
            )
        if self.misfit_note is not None:
            notes.append(self.misfit_note)
        return notes

    @property
    def shape_factor_max(self) -> float:
        """Largest shape factor of the particles used [-]; 1.87 in the paper."""
        return float(self.table.shape_factor(self.a).max())

    @property
    def misfit_note(self) -> str | None:
        """A sentence if the law describes the tests badly even with each particle's own coefficients, else None."""
        return misfit_note(self.own_misfit)

    @property
    def relative_misfit(self) -> float:
        """Median over the particles of `rms_um` over the range of displacement [-], with their scatter."""
        return self._misfit("rms_um")

    @property
    def own_misfit(self) -> float:
        """The same with every particle's own coefficients: what the form of the law leaves."""
        return self._misfit("own_rms_um")

    def _misfit(self, name: str) -> float:
        fits = [p for p in self.particles if p is not None and p.used.any()]
        return float(np.median([getattr(p, name) / max(p.range_um, 1e-300) for p in fits]))

    def answer(self) -> dict[str, Any]:
        """Whether it converged, a and the modulus, as in `calibration.json`."""
        return {
            "converged": self.converged,
            "a": estimate(self.a),
            "effective_modulus_MPa": estimate(self.elastic.effective_modulus_MPa),
        }

    @cached_property
    def content(self) -> dict[str, Any]:
        """The contents of `calibration.json`."""
        population = self.plastic.population
        eta = np.asarray(eqx.filter_vmap(self.mean_law.shape_factor)(particle_batch(self.campaign.diameters_um)))
        entries = []
        for i, name in enumerate(self.campaign.particles):
            fit = self.particles[i]
            C1, C3, C5 = fit.plastic if fit else (None, None, None)
            entries.append(
                {
                    "particle": name,
                    "eta_p": estimate(float(eta[i])),
                    "C1": estimate(C1),
                    "C3": estimate(C3),
                    "C5": estimate(C5),
                    "zero_um": estimate(fit.zero_um if fit else None),
                    "rms_um": finite(fit.rms_um) if fit else None,
                    "own_rms_um": finite(fit.own_rms_um) if fit else None,
                    "kept": fit is not None,
                    "why_not": self.adjustment.why_not[i],
                    "force_zero_mN": force_zero(self.campaign.curves[i]),
                }
            )
        reference = self.shape_reference
        return {
            "schema": 1,
            "method": "paper",
            **self.answer(),
            "runtime_s": self.runtime_s,
            "seed": self.seed,
            "law": {"unloading": self.mean_law.unloading.value, "strain_scaling": self.mean_law.strain_scaling.value},
            "effects": [],
            "a_objective": self.objective,
            "a_full": estimate(self.shape.a),
            "a_reference": estimate(reference.a if reference else None),
            "reference_particle": None
            if reference is None or reference.reference is None
            else self.campaign.particles[reference.reference],
            **{
                f"log_{name}": {"mean": estimate(float(c.mean)), "sd": estimate(float(c.sd))}
                for name, c in (("C1", population.C1), ("C3", population.C3), ("C5", population.C5))
            },
            "yield_stress_MPa": estimate(float(population.yield_stress)),
            "probability_not_monotone": estimate(float(population.probability_not_monotone)),
            "noise": {"displacement_um": estimate(self.displacement_noise_um)},
            "adjustment": {"threshold_MPa": self.adjustment.threshold_MPa, "strain": self.adjustment.strain},
            "particles": entries,
            "warnings": self.warnings(),
            "findings": [one.to_json() for one in self.findings],
            "diagnostics": {
                **NO_SAMPLER,
                "a_objective_value": finite(self.chosen_shape.objective),
                "a_objective_value_at_zero": finite(self.chosen_shape.objective_at_zero),
                "master_rms_MPa": self.plastic.rms_MPa,
                "elastic_rms_strain": finite(self.elastic.rms_strain),
                "elastic_branches": len(self.elastic.branches),
                "relative_misfit": finite(self.relative_misfit),
                "own_misfit": finite(self.own_misfit),
            },
        }


def calibrate_paper(
    campaign: Campaign,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    objective: Objective = "full",
    reference: str | None = None,
    unloading: Unloading | str = Unloading.PRINTED,
    strain_scaling: StrainScaling | str = StrainScaling.RAW,
    seed: int = 0,
    without_flagged: bool = True,
    progress: Progress | None = None,
) -> PaperCalibration:
    """The paper's calibration: offset step, shape parameter, master curve, plastic coefficients, effective modulus.

    Args:
        campaign: the tests.
        threshold_MPa: stress of the offset step [MPa]; 0 leaves it out (and removes its bias on `a`).
        objective: "full" or "reference", which objective's `a` the rest is built on; both are fitted and reported.
        reference: name of the reference particle; by the paper's rule if None.
        unloading: form of unloading that the modulus belongs to.
        strain_scaling: how the shape factor enters unloading.
        seed: kept for the record.
        without_flagged: where single particles are flagged (a broken one, one unlike all others), calibrate again
            without them and say what the answer is then.
        progress: called with the name of each step.

    Raises:
        InputError: if no two particles can be used, or the reference particle is unknown or unusable.

    References:
        Bommireddy et al. (2018), sections 3 to 6.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    arguments.choice(objective, get_args(Objective), "objective")
    unloading = arguments.member(unloading, Unloading, "unloading")
    strain_scaling = arguments.member(strain_scaling, StrainScaling, "strain_scaling")
    seed = arguments.seed(seed)
    progress = progress or (lambda _: None)
    progress("adjusting the curves")
    adjustment = adjust(campaign, threshold_MPa)
    if adjustment.kept.sum() < 2:
        if len(campaign) == 1:
            raise InputError(
                "the calibration needs two usable particles or more, 1 can be used: this method compares particles",
                file=campaign.source or None,
                remedy="Test a second particle, or calibrate by another method (least-squares, bayes).",
            )
        usable = int(adjustment.kept.sum())
        problem = f"the calibration needs two usable particles or more, {usable} can be used"
        raise refusal(campaign, problem, adjustment.reasons)
    with numbers_in_reach(campaign):
        table = strain_table(adjustment, campaign.diameters_um)
        progress("fitting the shape parameter")
        shape = fit_shape_parameter(table)
        shape_reference = _reference_fit(campaign, table, objective, reference)
        chosen = shape_reference if objective == "reference" and shape_reference is not None else shape
        progress("fitting the plastic coefficients")
        master = master_curve(table, chosen.a)
        plastic = fit_population(master, adjustment.threshold_MPa)
        progress("fitting the effective modulus")
        eta = of_each_particle(campaign.diameters_um, lambda p: plastic_shape_factor(p, chosen.a))
        elastic = fit_effective_modulus(campaign_branches(campaign, adjustment), eta, unloading, strain_scaling)
        # Without any unloading the modulus cannot matter to a prediction; a stiff one keeps the law defined.
        modulus = elastic.effective_modulus_MPa if elastic.effective_modulus_MPa is not None else 1e9
        law = MccLaw(plastic.population.mean_law, chosen.a, modulus, unloading, strain_scaling)
        progress("predicting every particle")
        particles = predict_particles(campaign, adjustment, law, eta)
        noise = float(np.median([point_noise_um(curve) for curve in campaign.curves]))
    calibration = PaperCalibration(
        campaign,
        adjustment,
        table,
        shape,
        shape_reference,
        objective,
        master,
        plastic,
        elastic,
        law,
        particles,
        noise,
        seed,
        time.perf_counter() - started,
    )
    fits = [(n, p) for n, p in zip(campaign.particles, particles, strict=True) if p is not None and p.used.any()]
    misfit, ranges = (np.array(v) for v in ([p.own_rms_um for _, p in fits], [p.range_um for _, p in fits]))
    outlying = unlike_others([name for name, _ in fits], misfit, ranges)

    def again(some: Campaign) -> dict[str, Any]:
        settings: dict[str, Any] = {"threshold_MPa": threshold_MPa, "objective": objective, "seed": seed}
        form: dict[str, Any] = {"unloading": unloading, "strain_scaling": strain_scaling}
        chosen = None if reference not in some.particles else reference
        return calibrate_paper(some, reference=chosen, without_flagged=False, **settings, **form).answer()

    findings = judged(campaign, calibration.answer(), outlying, again if without_flagged else None)
    return replace(calibration, findings=findings, runtime_s=time.perf_counter() - started)


def _reference_fit(campaign: Campaign, table: StrainTable, objective: Objective, name: str | None) -> ShapeFit | None:
    index = None
    if name is not None:
        if name not in campaign.particles:
            raise InputError(
                f"there is no particle {name!r} to serve as reference",
                file=campaign.source or None,
                remedy=f"Name one of: {', '.join(campaign.particles)}.",
            )
        index = campaign.index(name)
        if index not in table.index:
            raise InputError(
                f"the reference particle {name!r} cannot be used",
                file=campaign.source or None,
                remedy="Name another one, or leave the choice to the paper's rule.",
            )
    elif len(table.index) < 3 and objective == "full":
        return None
    return fit_shape_parameter(table, "reference", index)
