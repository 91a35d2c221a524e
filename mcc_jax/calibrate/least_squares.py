"""Joint least squares: everything at once, by gradients, with covariance and what the data leave open."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, check_tests
from .data import Tests
from .draws import Fit
from .estimates import NO_SAMPLER, effect_entries, estimate, finite, log_estimate, normal_estimate, power_of_e
from .fitting import checked_settings, prepare
from .forward import residuals
from .judgement import numbers_in_reach
from .numpyro_model import Model
from .pooled_fit import SHARED, Parameters, Pooled, Solution, fit_pooled, unpack
from .population import COEFFICIENTS
from .priors import SpreadCoordinate, nuisance_moments
from .results import JointCalibration
from .running import one_blas_thread, padded

Loss = Literal["linear", "soft_l1", "cauchy"]
SHAPES = (0.0, 2.5)  # values of a that least squares begins from in addition to the population's mode; found by trial
OPEN = 1e-3  # a combination of shared parameters is open where its curvature, each scaled to its own, is smaller


@dataclass(frozen=True)
class Identifiability:
    """What the data say of combinations of the shared parameters.

    Attributes:
        singular_values: of the curvature, every parameter on its own scale, largest first. All would be 1 if the
            parameters did not interact; 0 marks a combination that the data leave open.
        directions, names: the combinations, one row each, and the parameters that the columns are of.
    """

    singular_values: np.ndarray
    directions: np.ndarray
    names: tuple[str, ...]

    __repr__ = described()

    @property
    def open(self) -> list[str]:
        """Combinations that the data leave open, in words."""
        rows = self.directions[self.singular_values < OPEN]
        return [" ".join(f"{w:+.2f} {n}" for w, n in zip(row, self.names, strict=True) if abs(w) > 0.1) for row in rows]


@dataclass(frozen=True, repr=False, kw_only=True)
class LeastSquares(JointCalibration):
    """The joint least-squares fit of a campaign.

    Attributes:
        loss: of the residuals.
        settings: the pooled problem.
        solution: where the optimiser ended.
        agreeing_starts: how many starts ended at the same optimum, of how many.
    """

    method = "least-squares"

    loss: Loss
    settings: Pooled
    solution: Solution
    agreeing_starts: tuple[int, int]

    def failures(self) -> list[str]:
        """Why the fit must not be called converged; empty if every optimiser met its tolerances."""
        if not bool(self.solution.converged):
            return [f"the optimiser did not meet its tolerances within {int(self.solution.steps)} steps"]
        inside_out = np.flatnonzero(~(self._shape_factor > 0))
        if len(inside_out):
            return [
                f"a = {float(self.solution.value.shared[0]):.3g} leaves particle {self.particles[inside_out[0]]!r} "
                "without a positive shape factor: the curves do not come together under it; "
                "check the units and the signs of the columns, and the diameters"
            ]
        parts = zip(("the noise", "the spread of the particles"), self.fit.converged[1:], strict=True)
        return [f"the optimiser for {name} did not meet its tolerances" for name, fine in parts if not fine][:1]

    @cached_property
    def identifiability(self) -> Identifiability:
        """What the data leave open: the curvature of the shared parameters, all particles' own ones eliminated."""
        complement = np.asarray(self.solution.normal.schur()[2])
        raw = np.diagonal(np.asarray(self.solution.normal.shared))
        scale = 1 / np.sqrt(np.where(raw > 0, raw, 1.0))
        scaled = complement * scale * scale[:, None]
        # On the scale of what is left of each parameter's curvature when the particles are eliminated.
        left = np.sqrt(np.maximum(np.diagonal(scaled), 1e-300))
        values, vectors = np.linalg.eigh(scaled / left / left[:, None])
        names = (*SHARED, *self.model.forms.names)
        return Identifiability(np.maximum(values[::-1], 0.0), vectors.T[::-1], names)

    def _notes(self) -> Iterator[str]:
        yield from (f"the data leave this combination open: {text}" for text in self.identifiability.open)
        agree, count = self.agreeing_starts
        if agree < count:
            yield f"{count - agree} of {count} starts ended at a worse optimum"
        if self._alone:
            yield "one particle says nothing of the scatter between particles: no spread is given"
        elif small := [n for n, t in zip(COEFFICIENTS, self.settings.population.tau, strict=True) if t < 1e-3]:
            yield f"the spread of {', '.join(small)} cannot be distinguished from zero"
        yield from super()._notes()

    def answer(self) -> dict[str, Any]:
        """Whether it converged, a and the modulus, as in `calibration.json`."""
        a, modulus = ((float(self.solution.value.shared[k]), self._reported_sd[k]) for k in range(2))
        return {"converged": self.converged, "a": normal_estimate(*a), "effective_modulus_MPa": log_estimate(*modulus)}

    def _further_content(self) -> dict[str, Any]:
        tests = self.selection.tests
        point = unpack(self.solution.value, self.settings, tests)
        latent, zero, theta = np.asarray(point.latent), np.asarray(point.zero), np.asarray(point.theta)
        own, between, shared = self._covariance
        values, sds = np.asarray(self.solution.value.shared), self._reported_sd
        flat, eta = np.asarray(tests.flatness), self._shape_factor
        slope = flat / eta
        # Where it is not positive, which the reason says, there is no logarithm, and no coefficient without it.
        log_eta = np.log(np.where(eta > 0, eta, np.nan))

        def numbers(row: int) -> dict[str, Any]:
            found: dict[str, Any] = {"eta_p": normal_estimate(eta[row], abs(flat[row]) * sds[0])}
            for j, coefficient in enumerate(COEFFICIENTS):
                variance = own[row, j, j] - 2 * slope[row] * between[row, j, 0] + slope[row] ** 2 * shared[0, 0]
                sd = np.nan if np.isnan(sds[0]) else np.sqrt(max(variance, 0.0))
                found[coefficient] = log_estimate(latent[row, j] - log_eta[row], sd)
            found["zero_um"] = normal_estimate(zero[row], np.sqrt(own[row, 3, 3]))
            if self.model.modulus_scatter:
                log_modulus = float(latent[row, 3] - self.model.shape_power * log_eta[row])
                found["effective_modulus_MPa"] = estimate(power_of_e(log_modulus))
            if self.model.varying:
                places = self.model.varying_places
                found["amplitudes"] = {m: estimate(float(theta[row, k])) for m, k in places.items()}
            return found

        tau, steps = np.asarray(self.settings.population.tau), int(self.solution.steps)
        freedom = max(int(np.asarray(tests.mask).sum()) - 4 * len(self.selection.kept) - 5, 1)
        chi2 = np.sum(np.asarray(self.solution.residual[0]) ** 2) / freedom
        return {
            "reason": " ".join(self.failures()) or f"the tolerances were met after {steps} steps",
            "law": {"unloading": self.model.unloading.value, "strain_scaling": self.model.strain_scaling.value},
            "effects": effect_entries(self.model, self._effects()),
            "loss": self.loss,
            **{
                f"log_{name}": {
                    "mean": normal_estimate(values[2 + j], sds[2 + j]),
                    "sd": estimate(None) if self._alone else normal_estimate(tau[j], self._spread_sd(name), least=0.0),
                }
                for j, name in enumerate(COEFFICIENTS)
            },
            # The scatter of C1 is part of its mean.
            "yield_stress_MPa": estimate(None if self._alone else power_of_e(values[2] + tau[0] ** 2 / 2) / 17.16),
            "noise": self._noise_numbers(),
            "priors": self.model.chosen_priors.to_json(),
            "particles": self._entries_of_tests(numbers),
            "diagnostics": {
                **NO_SAMPLER,
                "steps": steps,
                "loss": finite(float(self.solution.loss)),
                "chi2_per_dof": finite(chi2),
                "noise_share": finite(self.noise_share),
                "own_misfit": finite(self.own_misfit),
                "singular_values": [float(v) for v in self.identifiability.singular_values],
                "open_combinations": self.identifiability.open,
                "agreeing_starts": list(self.agreeing_starts),
            },
        }

    def residual(self) -> np.ndarray:
        """Measured less predicted displacement [um], shape (N, points), 0 where masked."""
        tests = self.selection.tests
        point = unpack(self.solution.value, self.settings, tests)
        return np.asarray(jax.jit(residuals)(point, tests, self.model.forms))

    @property
    def _shape_factor(self) -> np.ndarray:
        """eta_p of the particles that took part, shape (N,)."""
        return 1 + float(self.solution.value.shared[0]) * np.asarray(self.selection.tests.flatness)

    @cached_property
    def _covariance(self) -> tuple[np.ndarray, ...]:
        """Of each particle's own parameters, between them and the shared ones, and of the shared ones."""
        return tuple(map(np.asarray, self.solution.normal.covariance()))

    @property
    def _reported_sd(self) -> np.ndarray:
        """Standard deviations of the shared parameters; NaN where the data leave one open."""
        rows = self.identifiability.directions[self.identifiability.singular_values < OPEN]
        return np.where(np.sum(rows**2, 0) > 0.1, np.nan, np.sqrt(np.diagonal(self._covariance[2])))

    @property
    def _alone(self) -> bool:
        """Whether one particle is all there is: the mode of a spread of one is 0, and means nothing."""
        return len(self.selection.kept) == 1

    def _spread_sd(self, name: str) -> float:
        """Standard deviation of a coefficient's spread, from that of its coordinate."""
        place = self.fit.names.index(f"tau_{name}_coordinate")
        spread = SpreadCoordinate(getattr(self.model.chosen_priors, f"tau_{name}")).spread
        slope = jax.grad(spread)(jnp.asarray(np.asarray(self.fit.mode)[place]))
        return abs(float(slope)) * float(np.sqrt(np.asarray(self.fit.covariance)[place, place]))

    def _effects(self) -> dict[str, Any]:
        """Estimates of the effects' numbers by the names of their sites."""
        values, variances = np.asarray(self.solution.value.shared), np.diagonal(self._covariance[2])
        values, sds = values[len(SHARED) :], np.sqrt(variances[len(SHARED) :])
        size, found = len(self.model.effects), {}
        for k, name in enumerate(self.model.forms.names):
            log = k >= size and self.model.forms.positive[k - size]
            found[name] = (log_estimate if log else normal_estimate)(values[k], sds[k])
        for j, name in enumerate(self.model.varying_places):
            found[f"tau_{name}"] = estimate(float(self.settings.population.theta_scatter[j]))
        return found


@one_blas_thread
def least_squares(
    campaign: Campaign,
    model: Model | None = None,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    loss: Loss = "linear",
    seed: int = 0,
    without_flagged: bool = True,
    progress: Progress | None = None,
) -> LeastSquares:
    r"""Least squares for a, modulus, and every particle's C1, C3, C5 and zero at once.

    .. math:: \min \sum_i \left\| L^{-1} (d_i - z_i - \gamma_i) \right\|^2
        + \sum_{ij} \left(\frac{\log C_{ij} - \mu_j}{\tau_j}\right)^2 + \sum_i \left(\frac{z_i - z_{i0}}{s_z}\right)^2

    The first term alone does not contain `a` (see `forward`): the second one does, which says that particles of
    different shapes are of one material. The noise in L and the spreads tau are estimated first, by restricted maximum
    likelihood and as the mode of their posterior.

    Args:
        campaign, model, threshold_MPa, without_flagged, progress: as in `sample`.
        loss: "linear", or a robust one of the whitened residuals, "soft_l1" or "cauchy".
        seed: kept for the record.

    Raises:
        InputError: if no particle can be used.
    """
    started = time.perf_counter()
    campaign = check_tests(campaign)
    progress, model, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    seed = arguments.seed(seed)
    arguments.choice(loss, get_args(Loss), "loss")
    if model.robust and loss != "linear":
        raise InputError("robust noise and a robust loss exclude each other", remedy="Take one of them.")
    with numbers_in_reach(campaign):
        options: dict[str, Any] = {"correlated": loss == "linear", "rounds": 1}
        selection, fit = prepare(campaign, model, threshold_MPa, progress=progress, **options)
        tests, population = fit.tests, fit.population
        further = [nuisance_moments(n) for v in model.effects for n in v.nuisances]
        priors = model.zero_prior, jnp.asarray(np.array(further).reshape(-1, 2))
        settings = Pooled(fit.filters, population, *priors, model.forms, model.scatter, loss)
        progress("fitting all particles together")
        flatness = np.asarray(tests.flatness)
        low, high = -0.9 / max(flatness.max(), 1e-3), -0.9 / min(flatness.min(), -1e-3)
        starts = [float(population.a), *(a for a in SHAPES if low < a < high)]
        mu, log_modulus = np.asarray(population.mu), float(population.log_modulus)
        found = [solve(fit, settings, tests, a, mu, log_modulus) for a in starts]
        losses = np.nan_to_num([float(one.loss) for one in found], nan=np.inf, posinf=np.inf)
        if np.isinf(losses).all():
            raise FloatingPointError("no sum of squares is finite")
    best = found[int(np.argmin(losses))]
    agree = int(np.sum(losses <= losses.min() * (1 + 1e-5) + 1e-6))
    calibration = LeastSquares(
        campaign=campaign,
        selection=selection,
        model=fit.model,
        fit=fit,
        seed=seed,
        loss=loss,
        settings=settings,
        solution=best,
        agreeing_starts=(agree, len(starts)),
    )
    again = partial(
        least_squares, model=model, threshold_MPa=threshold_MPa, loss=loss, seed=seed, without_flagged=False
    )
    return calibration.judged(started, again if without_flagged else None)


def solve(fit: Fit, settings: Pooled, tests: Tests, a: float, mu: np.ndarray, log_modulus: float) -> Solution:
    """The pooled least squares from the fitted particles and the given shared parameters."""
    local = [fit.point.latent[:, :3], fit.point.zero[:, None]]
    local += [fit.point.latent[:, 3:]] if settings.scatter.modulus else []
    local += [fit.point.theta[:, k : k + 1] for k, _ in settings.scatter.varying]
    theta, size = np.asarray(fit.population.theta), len(settings.forms.effects)
    positive = settings.forms.positive
    further = np.where(positive, np.log(np.where(positive, theta[size:], 1.0)), theta[size:])
    shared = jnp.asarray(np.concatenate([[a, log_modulus], mu, theta[:size], further]))
    # Padded: campaigns of similar size share a compilation.
    (longer, filters, own), weight = padded((tests, settings.whitening, jnp.concatenate(local, 1)))
    found = fit_pooled(longer, replace(settings, whitening=filters), Parameters(own, shared), jnp.asarray(weight))
    return found.first(len(tests))
