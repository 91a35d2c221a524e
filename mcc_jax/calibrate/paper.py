"""The paper's whole calibration, step after step, for any campaign."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Progress
from ..campaign import (
    THRESHOLD_MPA,
    Adjustment,
    Campaign,
    adjust,
    check_tests,
    effective_diameter_um,
    of_each_particle,
    particle_batch,
    stress_and_strain,
)
from ..campaign.adjustment import refusal
from ..campaign.signal import point_noise
from ..geometry import plastic_shape_factor
from ..law import MccLaw, Plastic, StrainScaling, Unloading
from . import paper_steps as steps
from .curves import RIGID_MPA, responses_um
from .data import MOST_POINTS, row_kinds, rows_from_contact
from .estimates import NO_SAMPLER, estimate, finite
from .judgement import numbers_in_reach
from .population import COEFFICIENTS
from .results import Calibration

LARGEST_SHAPE_FACTOR = 4.0  # twice the paper's largest: shape factors beyond come from curves that do not collapse


@dataclass(frozen=True)
class ParticleFit:
    """One particle against the calibrated law."""

    # C1, C3, C5 of this particle's own adjusted loading curve, under the common `a`
    plastic: tuple[float, float, float]
    zero_um: float  # what the offset step, and the contact point, take off its displacement [um]
    measured_um: np.ndarray  # measured displacement less `zero_um` [um], at every point
    # displacement under the measured force by the mean law, scaled by this particle's size and shape [um]
    predicted_um: np.ndarray
    own_um: np.ndarray  # the same with the particle's own C1, C3, C5
    used: np.ndarray  # which points enter `rms_um`: those after contact and above the threshold that may be compared

    __repr__ = described()

    @property
    def rms_um(self) -> float:
        """Root mean square of measured less predicted [um]; NaN where nothing is compared."""
        return self._rms(self.predicted_um)

    @property
    def own_rms_um(self) -> float:
        """The same with its own coefficients [um]."""
        return self._rms(self.own_um)

    @property
    def range_um(self) -> float:
        """Range of the measured displacement where it is compared [um]."""
        return float(np.ptp(self.measured_um[self.used]))

    def _rms(self, expected_um: np.ndarray) -> float:
        away = (self.measured_um - expected_um)[self.used]
        return float(np.sqrt(np.mean(away**2))) if len(away) else float("nan")


@dataclass(frozen=True, repr=False, kw_only=True)
class PaperCalibration(Calibration):
    """Everything that the paper's calibration finds, with what it was made from.

    Attributes:
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
    """

    method = "paper"

    adjustment: Adjustment
    table: steps.StrainTable
    shape: steps.ShapeFit
    shape_reference: steps.ShapeFit | None
    objective: steps.Objective
    master: steps.MasterCurve
    plastic: steps.PlasticFit
    elastic: steps.ElasticFit
    mean_law: MccLaw
    particles: tuple[ParticleFit | None, ...]
    displacement_noise_um: float

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
    def chosen_shape(self) -> steps.ShapeFit:
        """The fit whose `a` is in the law."""
        return self.shape if self.objective == "full" or self.shape_reference is None else self.shape_reference

    @property
    def why_not(self) -> tuple[str | None, ...]:
        """Why each particle of the campaign took no part; None if it did."""
        return self.adjustment.why_not

    def failures(self) -> list[str]:
        """Why shape parameter or modulus could not be found."""
        return [reason for reason in (self.chosen_shape.reason, self.elastic.reason) if reason]

    def _notes(self) -> Iterator[str]:
        if bound := ", ".join(self.plastic.at_bound):
            yield f"{bound} ended at the lower bound: a collapsed estimate, not a measurement"
        if not bool(self.mean_law.is_monotone):
            yield "the mean law is not monotone: under load control it snaps through"
        share = float(self.plastic.population.probability_not_monotone)
        if share > 0.05:
            yield f"{100 * share:.0f} % of particles drawn from this population would have a law that is not monotone"
        largest = float(self.table.shape_factor(self.a).max())
        if largest > LARGEST_SHAPE_FACTOR:
            factors = f"a = {self.a:.3g} makes shape factors of up to {largest:.3g}"
            yield f"{factors}: the shape factor does not bring these curves together"

    @property
    def _compared(self) -> dict[str, ParticleFit]:
        """The particles of which points are compared with the law, by name."""
        fits = zip(self.campaign.particles, self.particles, strict=True)
        return {name: fit for name, fit in fits if fit is not None and fit.used.any()}

    def _own_residuals(self) -> tuple[Sequence[str], np.ndarray, np.ndarray]:
        fits = self._compared
        rms, ranges = np.array([(one.own_rms_um, one.range_um) for one in fits.values()]).reshape(-1, 2).T
        return tuple(fits), rms, ranges

    def answer(self) -> dict[str, Any]:
        """Whether it converged, a and the modulus, as in `calibration.json`."""
        modulus = estimate(self.elastic.effective_modulus_MPa)
        return {"converged": self.converged, "a": estimate(self.a), "effective_modulus_MPa": modulus}

    def _further_content(self) -> dict[str, Any]:
        population = self.plastic.population
        eta = np.asarray(eqx.filter_vmap(self.mean_law.shape_factor)(particle_batch(self.campaign.diameters_um)))

        def numbers(i: int) -> dict[str, Any]:
            fit = self.particles[i]
            return {
                "eta_p": estimate(float(eta[i])),
                **{key: estimate(fit.plastic[j] if fit else None) for j, key in enumerate(COEFFICIENTS)},
                "zero_um": estimate(fit.zero_um if fit else None),
                "rms_um": finite(fit.rms_um if fit else None),
                "own_rms_um": finite(fit.own_rms_um if fit else None),
            }

        reference = self.shape_reference
        place = None if reference is None else reference.reference
        return {
            "law": {"unloading": self.mean_law.unloading.value, "strain_scaling": self.mean_law.strain_scaling.value},
            "effects": [],
            "a_objective": self.objective,
            "a_full": estimate(self.shape.a),
            "a_reference": estimate(reference.a if reference else None),
            "reference_particle": None if place is None else self.campaign.particles[place],
            **{
                f"log_{name}": {key: estimate(float(getattr(getattr(population, name), key))) for key in ("mean", "sd")}
                for name in COEFFICIENTS
            },
            "yield_stress_MPa": estimate(float(population.yield_stress)),
            "probability_not_monotone": estimate(float(population.probability_not_monotone)),
            "noise": {"displacement_um": estimate(self.displacement_noise_um)},
            "adjustment": {"threshold_MPa": self.adjustment.threshold_MPa, "strain": self.adjustment.strain},
            "particles": self._entries(numbers),
            "diagnostics": {
                **NO_SAMPLER,
                "a_objective_value": finite(self.chosen_shape.objective),
                "a_objective_value_at_zero": finite(self.chosen_shape.objective_at_zero),
                "master_rms_MPa": self.plastic.rms_MPa,
                "elastic_rms_strain": finite(self.elastic.rms_strain),
                "elastic_branches": len(self.elastic.branches),
                "relative_misfit": finite(
                    np.median([p.rms_um / max(p.range_um, 1e-300) for p in self._compared.values()])
                ),
                "own_misfit": finite(self.own_misfit),
            },
        }


def calibrate_paper(
    campaign: Campaign,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    objective: steps.Objective = "full",
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
        unloading, strain_scaling: as of `MccLaw`.
        seed: kept for the record.
        without_flagged, progress: as in `sample`.

    Raises:
        InputError: if no two particles can be used, or the reference particle is unknown or unusable.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    arguments.choice(objective, get_args(steps.Objective), "objective")
    unloading = arguments.member(unloading, Unloading, "unloading")
    strain_scaling = arguments.member(strain_scaling, StrainScaling, "strain_scaling")
    seed = arguments.seed(seed)
    progress = progress or (lambda _: None)
    progress("adjusting the curves")
    adjustment = adjust(campaign, threshold_MPa)
    if adjustment.kept.sum() < 2:
        problem = f"the calibration needs two usable particles or more, {adjustment.kept.sum()} can be used"
        if len(campaign) == 1:
            remedy = "Test a second particle, or calibrate by another method (least-squares, bayes)."
            raise InputError(f"{problem}: this method compares particles", file=campaign.source or None, remedy=remedy)
        raise refusal(campaign, problem, adjustment.reasons)
    with numbers_in_reach(campaign):
        table = steps.strain_table(adjustment, campaign.diameters_um)
        progress("fitting the shape parameter")
        shape = steps.fit_shape_parameter(table)
        shape_reference = _reference_fit(campaign, table, objective, reference)
        chosen = shape_reference if objective == "reference" and shape_reference is not None else shape
        progress("fitting the plastic coefficients")
        master = steps.master_curve(table, chosen.a)
        plastic = steps.fit_population(master, adjustment.threshold_MPa)
        progress("fitting the effective modulus")
        eta = of_each_particle(campaign.diameters_um, lambda p: plastic_shape_factor(p, chosen.a))
        branches = steps.campaign_branches(campaign, adjustment)
        elastic = steps.fit_effective_modulus(branches, eta, unloading, strain_scaling)
        modulus = RIGID_MPA if elastic.effective_modulus_MPa is None else elastic.effective_modulus_MPa
        law = MccLaw(plastic.population.mean_law, chosen.a, modulus, unloading, strain_scaling)
        progress("predicting every particle")
        particles = predict_particles(campaign, adjustment, law, eta)
        noise = float(np.median([point_noise(curve.displacement_um) for curve in campaign.curves]))
    calibration = PaperCalibration(
        campaign=campaign,
        adjustment=adjustment,
        table=table,
        shape=shape,
        shape_reference=shape_reference,
        objective=objective,
        master=master,
        plastic=plastic,
        elastic=elastic,
        mean_law=law,
        particles=particles,
        displacement_noise_um=noise,
        seed=seed,
    )

    settings: dict[str, Any] = {"threshold_MPa": threshold_MPa, "objective": objective}
    settings |= {"unloading": unloading, "strain_scaling": strain_scaling, "without_flagged": False}

    def again(some: Campaign) -> PaperCalibration:
        return calibrate_paper(some, reference=reference if reference in some.particles else None, **settings)

    return calibration.judged(started, again if without_flagged else None)


def _reference_fit(
    campaign: Campaign, table: steps.StrainTable, objective: steps.Objective, name: str | None
) -> steps.ShapeFit | None:
    """`a` by the objective with a reference particle; of two particles only if that was asked for."""
    if name is None and objective == "full" and len(table.index) < 3:
        return None
    index = None if name is None else campaign.index(name)
    if index is not None and index not in table.index:
        remedy = "Name another one, or leave the choice to the paper's rule."
        raise InputError(f"the reference particle {name!r} cannot be used", file=campaign.source or None, remedy=remedy)
    return steps.fit_shape_parameter(table, "reference", index)


def predict_particles(
    campaign: Campaign, adjustment: Adjustment, law: MccLaw, eta: np.ndarray
) -> tuple[ParticleFit | None, ...]:
    """Every particle's displacement under its measured force by the mean law and by its own coefficients, None where it
    was not kept; `eta` are the shape factors of all, shape (N,)."""
    kept = np.flatnonzero(adjustment.kept).tolist()
    factors = []
    for i in kept:
        curve = adjustment.curves[i]
        assert curve is not None
        # Residuals are relative: below a fiftieth of the peak they would be those of the force read-out.
        use = curve.stress_MPa >= max(adjustment.threshold_MPa, 0.02 * curve.stress_max_MPa)
        factors.append(steps.fit_polynomial(eta[i] * curve.strain[use], curve.stress_MPa[use])[0])
    C = np.array(factors) ** (1 / np.array([1, 3, 5]))
    mean = jax.tree.map(lambda x: jnp.asarray(np.broadcast_to(x, len(kept))), law)
    own = eqx.tree_at(lambda one: one.plastic, mean, eqx.filter_vmap(Plastic)(*jnp.asarray(C.T)))
    rows = [np.arange(len(campaign.curves[i])) for i in kept]
    by_mean, by_own = responses_um(campaign, kept, adjustment.segments, rows, mean, own)
    fits: list[ParticleFit | None] = [None] * len(campaign)
    for row, i in enumerate(kept):
        curve = campaign.curves[i]
        stress, strain = stress_and_strain(curve, campaign.diameters_um[i], adjustment.segments[i])
        measured = (strain + adjustment.shift[i]) * effective_diameter_um(campaign.diameters_um[i])
        used = (stress > max(adjustment.threshold_MPa, 0.02 * stress.max())) & curve.compared
        used &= row_kinds(adjustment.segments[i]) != "approach"
        fits[i] = ParticleFit(
            (float(C[row, 0]), float(C[row, 1]), float(C[row, 2])),
            float(curve.displacement_um[0] - measured[0]),
            measured,
            by_mean[row, : len(curve)],
            by_own[row, : len(curve)],
            used,
        )
    return tuple(fits)
