"""The joint hierarchical posterior: population and particles, with what may be believed of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args

import jax
import numpy as np

from .. import arguments
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, Finding, check_plausibility, check_tests
from ..campaign.findings import worst
from .compiling import imported_meanwhile, one_blas_thread
from .data import Selection, ranges_um
from .draws import Draws, draw_fast, draw_joint, named_population
from .estimates import effect_entries, finite, summary
from .fitting import Start, checked_settings, prepare
from .importance import LEAST_ESS, MOST_PARETO_K, MOST_RHAT
from .judgement import at_noise_level, judged, numbers_in_reach, unlike_others
from .mode import Fit
from .model import Model
from .particles import Length
from .population import COEFFICIENTS
from .predict import predict_measured
from .results import PosteriorDraws

Mode = Literal["fast", "joint"]


@dataclass(frozen=True, repr=False, kw_only=True)
class Posterior(PosteriorDraws, Draws):
    """The posterior of a campaign.

    Draws have the axes (chain, draw, ...); where importance weights were needed they have been applied, in order within
    each chain, so every draw counts the same.

    Attributes:
        campaign: the tests, checked; `campaign.raw` as they were given.
        selection: which particles and points took part.
        model: what was assumed.
        fit: the joint fit it started from.
        mode: "fast" or "joint".
        seed, runtime_s: for the record.
        findings: what a reader must know of the tests and of the plausibility of the answer.

    The others are those of `Draws`.
    """

    campaign: Campaign
    selection: Selection
    model: Model
    fit: Fit
    mode: Mode
    seed: int
    runtime_s: float
    findings: tuple[Finding, ...] = field(default=())

    def predictions(self, particle: str) -> np.ndarray | None:
        """Draws of what may be measured of a particle at its rows [um], shape (draws, rows)."""
        return predict_measured(self, particle, seed=self.seed).observed_um

    def failures(self) -> list[str]:
        """Why the result must not be called converged, and what to do; empty if all gates are passed."""
        reasons = ("noise", "population")
        unfitted = [r for r, fine in zip(reasons, np.asarray(self.fit.converged)[1:], strict=True) if not fine]
        if unfitted and self.mode == "fast":  # of what was drawn around a fit that is none, no diagnostic says anything
            by, what = self._missed, " and ".join(unfitted)
            if at_noise_level(self.fit, self.rms_um()):
                return [
                    f"the search for the {what} did not come to rest, although the law misses these tests by no more "
                    f"than noise, {by}: they leave numbers of the model open; narrow the priors, or leave out an effect"
                ]
            return [
                f"no {what} was found that fits these tests: the law misses them by {by}; look at the curves, leave "
                "out the particles that are unlike the others, or look for what is missing (discover)"
            ]
        found = []
        slowest = max(self.rhat, key=lambda name: self.rhat[name])
        if not (rhat := self.rhat[slowest]) <= MOST_RHAT:
            found.append(f"R-hat of {slowest} is {rhat:.3f}, above {MOST_RHAT}: draw longer (--draws)")
        fewest = min(self.ess_bulk, key=lambda name: self.ess_bulk[name])
        if not (ess := self.ess_bulk[fewest]) >= LEAST_ESS:
            found.append(f"bulk ESS of {fewest} is {ess:.0f}, below {LEAST_ESS:.0f}: draw longer (--draws)")
        if self.divergences:
            found.append(f"{self.divergences} trajectories diverged: draw longer, or narrow the priors")
        bad = np.flatnonzero(~(self.pareto_k <= MOST_PARETO_K))
        if len(bad):
            names = ", ".join(self.particles[i] for i in bad[:5]) + (", ..." if len(bad) > 5 else "")
            found.append(
                f"Pareto k is above {MOST_PARETO_K} for particle {names}: its likelihood is far from the quadratic "
                "that the fast mode takes it for; use --mode joint, or leave the particle out"
            )
        if self.pareto_k_joint is not None and not self.pareto_k_joint <= MOST_PARETO_K:
            found.append(
                f"Pareto k of all particles together is {self.pareto_k_joint:.2f}, above {MOST_PARETO_K}: "
                "use --mode joint"
            )
        return found

    @property
    def converged(self) -> bool:
        """Whether every gate is passed."""
        return not self.failures()

    def named_population(self) -> dict[str, np.ndarray]:
        """Draws of the population by the names used in files, shape (chains, draws)."""
        return named_population(self.population, self.model)

    def warnings(self) -> list[str]:
        """What a reader of the numbers must know, one sentence each."""
        notes = [*self.failures(), *map(str, self.findings), *self._notes_of_the_fit()]
        if len(self.particles) < 3:
            notes.append(
                f"{len(self.particles)} particles say little about a population: its spread is mostly the prior"
            )
        flat = np.asarray(self.selection.tests.flatness)
        if np.ptp(flat) < 0.02:
            notes.append("all particles have the same shape: nothing here tells a from C1, C3, C5; a is its prior")
        share = float(np.mean(self.probability_not_monotone()))
        if share > 0.05:
            notes.append(f"{100 * share:.0f} % of new particles would have a law that is not monotone (snap-through)")
        return notes

    def probability_not_monotone(self) -> np.ndarray:
        """Share of a new particle's laws that are not monotone, one number per draw of the population."""
        mu, tau = np.asarray(self.population.mu), np.asarray(self.population.tau)
        gap = np.log(20 / 9) + mu[..., 0] + 5 * mu[..., 2] - 6 * mu[..., 1]
        spread = np.sqrt(tau[..., 0] ** 2 + 25 * tau[..., 2] ** 2 + 36 * tau[..., 1] ** 2)
        from scipy.special import ndtr

        return ndtr(-gap / np.maximum(spread, 1e-12))

    def yield_stress_MPa(self) -> np.ndarray:
        r""":math:`\sigma_y = E[C_1]/17.16` [MPa] (eq. 22), one number per draw of the population."""
        return np.exp(np.asarray(self.population.mu)[..., 0] + np.asarray(self.population.tau)[..., 0] ** 2 / 2) / 17.16

    def answer(self) -> dict[str, Any]:
        """Whether it converged, a, the modulus and the population, as in `calibration.json`."""
        mu, tau = np.asarray(self.population.mu), np.asarray(self.population.tau)
        return {
            "converged": self.converged,
            "a": summary(np.asarray(self.population.a)),
            "effective_modulus_MPa": summary(np.exp(np.asarray(self.population.log_modulus))),
            **{
                f"log_{name}": {"mean": summary(mu[..., j]), "sd": summary(tau[..., j])}
                for j, name in enumerate(COEFFICIENTS)
            },
        }

    def to_json(self) -> dict[str, Any]:
        """The contents of `calibration.json`."""
        named = self.named_population()

        def numbers(row: int) -> dict[str, Any]:
            found = {"eta_p": summary(self.shape_factor[..., row])}
            found |= {name: summary(self.C[..., row, j]) for j, name in enumerate(COEFFICIENTS)}
            found["zero_um"] = summary(self.zero_um[..., row])
            if self.model.modulus_scatter:
                found["effective_modulus_MPa"] = summary(self.modulus_MPa[..., row])
            if self.model.varying:
                places = self.model.varying_places
                found["amplitudes"] = {m: summary(self.theta[..., row, k]) for m, k in places.items()}
            return found

        return {
            "schema": 1,
            "method": "bayes",
            "mode": self.mode,
            **self.answer(),
            "runtime_s": self.runtime_s,
            "seed": self.seed,
            "law": {"unloading": self.model.unloading.value, "strain_scaling": self.model.strain_scaling.value},
            "effects": effect_entries(self.model, named),
            "modulus_scatter": summary(named["modulus_scatter"]) if self.model.modulus_scatter else None,
            "shape_scatter": summary(named["shape_scatter"]) if self.model.shape_scatter else None,
            "yield_stress_MPa": summary(self.yield_stress_MPa()),
            "probability_not_monotone": summary(self.probability_not_monotone()),
            "noise": self._noise_numbers() | {"factor": summary(named["noise_factor"])},
            "priors": self.model.chosen_priors.to_json(),
            "particles": self._entries(numbers, pareto_k=self.pareto_k),
            "warnings": self.warnings(),
            "findings": [one.to_json() for one in self.findings],
            "diagnostics": {
                "rhat_max": finite(max(self.rhat.values())),
                "ess_bulk_min": finite(min(self.ess_bulk.values())),
                "ess_tail_min": finite(min(self.ess_tail.values())),
                "divergences": self.divergences,
                "pareto_k_max": finite(float(np.max(self.pareto_k))),
                "pareto_k_joint": None if self.pareto_k_joint is None else finite(self.pareto_k_joint),
                "weights_applied": self.weights_applied,
                "leapfrogs_mean": finite(self.leapfrogs),
                "log_evidence": finite(self.log_evidence[0]),
                "log_evidence_error": finite(self.log_evidence[1]),
                "noise_share": finite(self.noise_share),
                "own_misfit": finite(self.own_misfit),
                "failures": self.failures(),
            },
        }


@one_blas_thread
def sample(
    campaign: Campaign,
    model: Model | None = None,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    mode: Mode = "fast",
    chains: int = 4,
    warmup: int = 300,
    draws: int = 1000,
    seed: int = 0,
    without_flagged: bool = True,
    start: Start | Fit | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """The joint posterior of everything: a, modulus, population, noise, and every particle's C1, C3, C5 and zero.

    The population is drawn around its mode and weighted, or sampled by NUTS where the weights are not good enough: see
    `importance`. Of many particles (more than 400,000 draws of single ones) the exact likelihood enters by
    regression, and at most four million draws of single particles are kept: see `particles`.

    The particles are worked on in blocks, which spread over all devices of the process and, once
    `jax.distributed.initialize` has been called, over all processes: every one of them then calls this function with
    the same campaign and settings, and gets the result of one process. Over several devices of one process the fits are
    the same to about 1e-9 and the draws are other draws of the same posterior.

    Args:
        campaign: the tests.
        model: form of unloading, what scatters, and priors.
        threshold_MPa: points below this stress on loading do not count [MPa].
        mode: "fast" integrates the particles out through quadratic summaries of their tests and corrects by exact
            importance weights; "joint" samples everything at once under the exact likelihood, the reference.
        chains: how many, each from random numbers of its own.
        warmup: steps of each that tune NUTS, where it runs, and are thrown away.
        draws: of each that are kept.
        seed: random seed.
        start: where the fit begins, for one: what `fit` gave of the same campaign and model.
        progress: called with the name of each step.

    Raises:
        InputError: if no particle can be used, or processes were given different campaigns; for an argument of the
            wrong kind or out of its range.
    """
    started = time.perf_counter()
    imported_meanwhile("scipy.stats", "arviz_stats.base.array")
    campaign = check_tests(campaign)
    progress, model, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    arguments.choice(mode, get_args(Mode), "mode")
    chains, draws = (arguments.whole(n, name, least=1) for n, name in ((chains, "chains"), (draws, "draws")))
    length = Length(chains, arguments.whole(warmup, "warmup", least=1), draws)
    fast = mode == "fast"
    with numbers_in_reach(campaign):
        begin = Start(start.point, start.population, start.noise.noise) if isinstance(start, Fit) else start
        selection, fit, size = prepare(campaign, model, threshold_MPa, start=begin, progress=progress)
        progress("sampling the population" if fast else "sampling everything")
        key = jax.random.key(seed)
        likely = worst(check_plausibility(campaign)) != "error"
        kept = fit.first(len(selection.kept))
        drawn = draw_fast(key, fit, length, size, fallback=likely) if fast else draw_joint(key, kept, length)
    progress("diagnosing")
    calibration = Posterior(
        campaign=campaign,
        selection=selection,
        model=fit.model,
        fit=kept,
        mode=mode,
        seed=seed,
        runtime_s=time.perf_counter() - started,
        **{f.name: getattr(drawn, f.name) for f in fields(Draws)},
    )
    tests = calibration.selection.tests
    outlying = unlike_others(calibration.particles, calibration.rms_um(), ranges_um(tests))

    def again(some: Campaign) -> dict[str, Any]:
        settings: dict[str, Any] = {"threshold_MPa": threshold_MPa, "mode": mode, "seed": seed}
        few: dict[str, Any] = {"chains": chains, "warmup": warmup, "draws": draws}
        return sample(some, model, without_flagged=False, **settings, **few).answer()

    findings = judged(campaign, calibration.answer(), outlying, again if without_flagged else None)
    return replace(calibration, findings=findings, runtime_s=time.perf_counter() - started)
