"""The joint hierarchical posterior: population and particles, with what may be believed of them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import numpy as np

from .. import arguments
from .._format import first_few
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, check_plausibility, check_tests
from ..campaign.findings import has_error
from .draws import Fit, draw_fast, draw_joint, effect_numbers
from .estimates import effect_entries, finite, summary
from .fitting import Start, checked_settings, prepare
from .importance import LEAST_ESS, MOST_PARETO_K, MOST_RHAT
from .judgement import numbers_in_reach
from .numpyro_model import Model
from .particles import Length
from .population import COEFFICIENTS
from .predict import data_tree, predict_measured
from .results import PosteriorDraws
from .running import block_size, imported_meanwhile, one_blas_thread

if TYPE_CHECKING:
    from xarray import DataTree

Mode = Literal["fast", "joint"]


@dataclass(frozen=True, repr=False, kw_only=True)
class Posterior(PosteriorDraws):
    """The posterior of a campaign.

    Draws have the axes (chain, draw, ...); where importance weights were needed they have been applied, in order within
    each chain, so every draw counts the same.

    Attributes:
        population: draws of the population.
        C, modulus_MPa, zero_um, shape_factor: of every particle's C1, C3, C5, shape (chains, draws, N, 3), of its
            effective modulus, displacement offset and eta_p.
        theta: of the parameters of its effects, in the order of `model.forms.names`.
        log_likelihood: of its whole test under each draw of the population, the particle integrated out: what
            leave-one-particle-out needs.
        pareto_k, pareto_k_joint: of every particle's importance weights, and of those of all together or None.
        mode: "fast" or "joint".
        weights_applied: whether the draws were resampled by the particles' own weights.
        divergences, leapfrogs: of NUTS, divergent trajectories and mean steps of a draw; 0 of independent draws.
        rhat, ess_bulk, ess_tail: by parameter of the population, before any thinning.
        log_evidence: the log marginal likelihood of the model, and its standard error (infinite where it is Laplace's
            approximation alone). Population and effects are integrated by importance sampling, particles by Laplace's
            approximation corrected with the exact likelihood, the noise by Laplace's method around its mode.
    """

    method = "bayes"

    mode: Mode
    pareto_k_joint: float | None
    weights_applied: bool
    divergences: int
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    leapfrogs: float
    log_evidence: tuple[float, float] = (np.nan, np.inf)

    def predictions(self, particle: str) -> np.ndarray | None:
        """Draws of what may be measured of a particle at its rows [um], shape (draws, rows)."""
        return predict_measured(self, particle, seed=self.seed).observed_um

    def failures(self) -> list[str]:
        """Why the result must not be called converged, and what to do; empty if all gates are passed."""
        parts = zip(("noise", "population"), self.fit.converged[1:], strict=True)
        unfitted = " and ".join(part for part, fine in parts if not fine)
        if unfitted and self.mode == "fast":  # diagnostics of draws around a fit that is none mean nothing
            if self.at_noise_level():
                return [
                    f"the search for the {unfitted} did not come to rest, although the law misses these tests by no "
                    f"more than noise, {self._missed}: they leave numbers of the model open; narrow the priors, or "
                    "leave out an effect"
                ]
            return [
                f"no {unfitted} was found that fits these tests: the law misses them by {self._missed}; look at the "
                "curves, leave out the particles that are unlike the others, or look for what is missing (discover)"
            ]
        found = []
        slowest, rhat = max(self.rhat.items(), key=lambda item: item[1])
        if not rhat <= MOST_RHAT:
            found.append(f"R-hat of {slowest} is {rhat:.3f}, above {MOST_RHAT}: draw longer (--draws)")
        fewest, ess = min(self.ess_bulk.items(), key=lambda item: item[1])
        if not ess >= LEAST_ESS:
            found.append(f"bulk ESS of {fewest} is {ess:.0f}, below {LEAST_ESS:.0f}: draw longer (--draws)")
        if self.divergences:
            found.append(f"{self.divergences} trajectories diverged: draw longer, or narrow the priors")
        bad = np.flatnonzero(~(self.pareto_k <= MOST_PARETO_K))
        if len(bad):
            names = first_few((self.particles[i] for i in bad), 5)
            found.append(
                f"Pareto k is above {MOST_PARETO_K} for particle {names}: its likelihood is far from the quadratic "
                "that the fast mode takes it for; use --mode joint, or leave the particle out"
            )
        if self.pareto_k_joint is not None and not self.pareto_k_joint <= MOST_PARETO_K:
            joint = f"Pareto k of all particles together is {self.pareto_k_joint:.2f}"
            found.append(f"{joint}, above {MOST_PARETO_K}: use --mode joint")
        return found

    def _notes(self) -> Iterator[str]:
        yield from super()._notes()
        if (count := len(self.particles)) < 3:
            yield f"{count} particles say little about a population: its spread is mostly the prior"
        if np.ptp(np.asarray(self.selection.tests.flatness)) < 0.02:
            yield "all particles have the same shape, which does not determine a: a is its prior"
        if (share := float(np.mean(self.probability_not_monotone()))) > 0.05:
            yield f"{100 * share:.0f} % of new particles would have a law that is not monotone (snap-through)"

    def probability_not_monotone(self) -> np.ndarray:
        """Share of a new particle's laws that are not monotone, one number per draw of the population."""
        from scipy.special import ndtr

        powers = np.array([1.0, -6.0, 5.0])  # of C1 C5^5 / C3^6, which is 9/20 where the curve goes flat
        gap = np.log(20 / 9) + np.asarray(self.population.mu) @ powers
        spread = np.sqrt(np.asarray(self.population.tau) ** 2 @ powers**2)
        return ndtr(-gap / np.maximum(spread, 1e-12))

    def yield_stress_MPa(self) -> np.ndarray:
        r""":math:`\sigma_y = E[C_1]/17.16` [MPa] (eq. 22), one number per draw of the population."""
        mu, tau = np.asarray(self.population.mu), np.asarray(self.population.tau)
        return np.exp(mu[..., 0] + tau[..., 0] ** 2 / 2) / 17.16

    def to_arviz(self, *, seed: int = 0) -> DataTree:
        """The posterior as an ArviZ `DataTree`; its `to_netcdf(file)` writes it.

        Groups: `posterior` (population, effects and every particle), `log_likelihood`, `log_prior` (by site), `prior`,
        `prior_predictive` and `posterior_predictive` (displacement at the measured forces), `sample_stats` (`lp_test`),
        `observed_data`, `constant_data`. Every variable has its unit in its attributes.

        `log_likelihood` has the variable `test`: each particle's whole test given the population, the particle
        integrated out, so that ArviZ's `loo` leaves one *particle* out. `seed` is that of prior and predictive draws.
        """
        return data_tree(self, seed)

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

    def _further_content(self) -> dict[str, Any]:
        named = self.named_population()
        effects = {name: summary(draws) for name, draws in effect_numbers(self.population, self.model).items()}

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
            "mode": self.mode,
            "law": {"unloading": self.model.unloading.value, "strain_scaling": self.model.strain_scaling.value},
            "effects": effect_entries(self.model, effects),
            "modulus_scatter": summary(named["modulus_scatter"]) if self.model.modulus_scatter else None,
            "shape_scatter": summary(named["shape_scatter"]) if self.model.shape_scatter else None,
            "yield_stress_MPa": summary(self.yield_stress_MPa()),
            "probability_not_monotone": summary(self.probability_not_monotone()),
            "noise": self._noise_numbers() | {"factor": summary(named["noise_factor"])},
            "priors": self.model.chosen_priors.to_json(),
            "particles": self._entries_of_tests(numbers, pareto_k=self.pareto_k),
            "diagnostics": self.diagnostics()
            | {
                "ess_tail_min": finite(min(self.ess_tail.values())),
                "weights_applied": self.weights_applied,
                "leapfrogs_mean": finite(self.leapfrogs),
                "log_evidence": finite(self.log_evidence[0]),
                "log_evidence_error": finite(self.log_evidence[1]),
                "noise_share": finite(self.noise_share),
                "own_misfit": finite(self.own_misfit),
            },
        }

    def diagnostics(self) -> dict[str, Any]:
        """What `failures` goes by, as in `calibration.json`."""
        return {
            "rhat_max": finite(max(self.rhat.values())),
            "ess_bulk_min": finite(min(self.ess_bulk.values())),
            "divergences": self.divergences,
            "pareto_k_max": finite(float(np.max(self.pareto_k))),
            "pareto_k_joint": finite(self.pareto_k_joint),
            "failures": self.failures(),
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

    The population is drawn around its mode and weighted, or sampled by NUTS where the weights are not good enough. Of
    many particles (more than 400,000 draws of single ones) the exact likelihood enters by regression, and at most four
    million draws of single particles are stored. Particles are distributed over all devices of the process and, once
    `jax.distributed.initialize` has been called, over all processes, each of which then calls this function with the
    same arguments and gets the result of one process.

    Args:
        campaign: the tests.
        model: form of unloading, what scatters, and priors.
        threshold_MPa: points below this stress on loading do not count [MPa].
        mode: "fast" integrates the particles out through quadratic summaries of their tests and corrects by exact
            importance weights; "joint" samples everything at once under the exact likelihood, the reference.
        chains: how many, each from its own random numbers.
        warmup: steps of each that tune NUTS, where it runs, and are discarded.
        draws: of each that are returned.
        seed: random seed.
        without_flagged: where single particles are flagged, calibrate again without them and report that answer, too.
        start: where the fit begins: what `fit` gave of the same campaign and model.
        progress: called with the name of each step.

    Raises:
        InputError: if no particle can be used, or processes were given different campaigns.
    """
    started = time.perf_counter()
    imported_meanwhile("scipy.stats", "arviz_stats.base.array")
    campaign = check_tests(campaign)
    progress, model, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    arguments.choice(mode, get_args(Mode), "mode")
    counts = {"chains": chains, "warmup": warmup, "draws": draws}
    length = Length(*(arguments.whole(count, name, least=1) for name, count in counts.items()))
    fast = mode == "fast"
    with numbers_in_reach(campaign):
        begin = Start(start.point, start.population, start.noise.noise) if isinstance(start, Fit) else start
        selection, fit = prepare(campaign, model, threshold_MPa, start=begin, progress=progress)
        progress("sampling the population" if fast else "sampling everything")
        key = jax.random.key(seed)
        if fast:
            plausible = not has_error(check_plausibility(campaign))
            drawn = draw_fast(key, fit, length, block_size(len(fit.tests)), fallback=plausible)
        else:
            drawn = draw_joint(key, fit, length)
    progress("diagnosing")
    found = Posterior(campaign=campaign, selection=selection, model=fit.model, fit=fit, seed=seed, mode=mode, **drawn)
    settings = {"threshold_MPa": threshold_MPa, "mode": mode, "seed": seed, **length._asdict()}
    again = partial(sample, model=model, without_flagged=False, **settings)
    return found.judged(started, again if without_flagged else None)
