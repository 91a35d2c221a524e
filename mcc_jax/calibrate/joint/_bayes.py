"""The joint hierarchical posterior: population and particles, with what may be believed of them."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...campaign import THRESHOLD_MPA, Campaign
from .._predict import point_noise_um
from .._result import estimate, finite, misfit_note
from ._data import Selection, Tests, own_misfit, select_tests, spread
from ._fit import JointFit, JointModel, fit_joint, population_at, populations, prior_numbers
from ._noise import Whitening
from ._population import Population, Summary, laplace
from ._sampling import (
    Exact,
    draw_particles,
    exact_of,
    sample_joint,
    sample_population,
)

COEFFICIENTS = ("C1", "C3", "C5")
RHAT_MOST = 1.01
ESS_LEAST = 400.0
PARETO_K_MOST = 0.7
"""The gate: R-hat at most, bulk ESS at least, no divergence, Pareto k at most (Vehtari et al. 2021, 2024)."""

MOST_CHECKED = 400_000
"""Up to as many draws of single particles, every one is compared with the exact likelihood and the weights are applied;
of larger campaigns some draws are compared, to know how good each particle's summary is."""

RESTLESS = 0.3
"""A particle whose weight scatters by more than this share of its mean gets several candidates per draw."""

CANDIDATES = (16, 64)
"""How many: first, and for the few that scatter most even then."""

FEW = 4

MOST_PARTICLE_DRAWS = 4_000_000
"""At most as many draws of single particles are kept; of very large campaigns every n-th draw."""

ACCEPT = (0.8, 0.95, 0.99)
"""Acceptance that the sampler aims at: after divergences once more, and once more, with smaller steps."""

Mode = Literal["fast", "joint"]


@dataclass(frozen=True)
class BayesCalibration:
    """The posterior of a campaign.

    Draws have the axes (chain, draw, ...); where importance weights were needed they have been applied, in order within
    each chain, so every draw counts the same.

    Attributes:
        campaign: the tests.
        selection: which particles and points took part.
        model: what was assumed.
        fit: the joint fit it started from.
        population: draws of the population.
        C: draws of every particle's C1, C3, C5, shape (chains, draws, N, 3).
        modulus_MPa: draws of every particle's effective modulus.
        zero_um: draws of every particle's zero.
        shape_factor: draws of every particle's eta_p.
        log_likelihood: of every particle's whole test under each draw of the population, the particle integrated out:
            what leave-one-particle-out needs.
        mode: "fast" or "joint".
        pareto_k: of every particle's importance weights.
        pareto_k_joint: of the weights of all particles together; None where they were not formed.
        weights_applied: whether the draws were resampled by their weights.
        divergences: number of divergent trajectories.
        rhat, ess_bulk, ess_tail: by parameter of the population, before any thinning.
        leapfrogs: mean number of leapfrog steps of a draw.
        seed, runtime_s: for the record.
    """

    campaign: Campaign
    selection: Selection
    model: JointModel
    fit: JointFit
    population: Population
    C: np.ndarray
    modulus_MPa: np.ndarray
    zero_um: np.ndarray
    shape_factor: np.ndarray
    log_likelihood: np.ndarray
    mode: Mode
    pareto_k: np.ndarray
    pareto_k_joint: float | None
    weights_applied: bool
    divergences: int
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    leapfrogs: float
    seed: int
    runtime_s: float
    notes: tuple[str, ...] = field(default=())

    @property
    def particles(self) -> tuple[str, ...]:
        """Names of the particles that took part."""
        return tuple(self.campaign.particles[i] for i in self.selection.kept)

    def failures(self) -> list[str]:
        """Why the result must not be called converged, and what to do; empty if all gates are passed."""
        found = []
        worst = max(self.rhat.values())
        if not worst <= RHAT_MOST:
            found.append(f"R-hat of {_argmax(self.rhat)} is {worst:.3f}, above {RHAT_MOST}: draw longer (--draws)")
        least = min(self.ess_bulk.values())
        if not least >= ESS_LEAST:
            name = min(self.ess_bulk, key=lambda k: self.ess_bulk[k])
            found.append(f"bulk ESS of {name} is {least:.0f}, below {ESS_LEAST:.0f}: draw longer (--draws)")
        if self.divergences:
            found.append(f"{self.divergences} trajectories diverged: draw longer, or narrow the priors")
        bad = np.flatnonzero(~(self.pareto_k <= PARETO_K_MOST))
        if len(bad):
            names = ", ".join(self.particles[i] for i in bad[:5]) + (", ..." if len(bad) > 5 else "")
            found.append(
                f"Pareto k is above {PARETO_K_MOST} for particle {names}: its likelihood is far from the quadratic "
                "that the fast mode takes it for; use --mode joint, or leave the particle out"
            )
        if self.pareto_k_joint is not None and not self.pareto_k_joint <= PARETO_K_MOST:
            found.append(
                f"Pareto k of all particles together is {self.pareto_k_joint:.2f}, above {PARETO_K_MOST}: "
                "use --mode joint"
            )
        reasons = ("the noise", "the population's mode")
        for reason, fine in zip(reasons, np.asarray(self.fit.converged)[1:], strict=True):
            if not fine and self.mode == "fast":
                found.append(f"the optimiser for {reason} did not meet its tolerances")
        return found

    @property
    def converged(self) -> bool:
        """Whether every gate is passed."""
        return not self.failures()

    def named_population(self) -> dict[str, np.ndarray]:
        """Draws of the population by the names used in files, shape (chains, draws)."""
        p = self.population
        named = {"a": p.a, "effective_modulus_MPa": np.exp(np.asarray(p.log_modulus))}
        for j, name in enumerate(COEFFICIENTS):
            named[f"mu_{name}"] = p.mu[..., j]
        for j, name in enumerate(COEFFICIENTS):
            named[f"tau_{name}"] = p.tau[..., j]
        if self.model.modulus_scatter:
            named["modulus_scatter"] = p.modulus_scatter
        if self.model.shape_scatter:
            named["shape_scatter"] = p.shape_scatter
        named["noise_factor"] = np.exp(np.asarray(p.log_noise))
        return {name: np.asarray(values) for name, values in named.items()}

    def warnings(self) -> list[str]:
        """What a reader of the numbers must know, one sentence each."""
        notes = [*self.failures(), *self.selection.notes, *self.notes]
        misfit = misfit_note(own_misfit(self.selection.tests, self.fit.residual))
        if misfit is not None:
            notes.append(misfit)
        dropped = sum(reason is not None for reason in self.selection.why_not)
        if dropped:
            notes.append(f"{dropped} of {len(self.campaign)} particles could not be used")
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

    def rms_um(self) -> np.ndarray:
        """Root mean square residual of every particle at the most probable parameters [um]."""
        mask = np.asarray(self.selection.tests.mask)
        return np.sqrt((np.asarray(self.fit.residual) ** 2).sum(1) / np.maximum(mask.sum(1), 1))

    def to_json(self) -> dict[str, Any]:
        """The contents of `calibration.json`."""
        named = self.named_population()
        noise = self.fit.noise
        numbers = ("displacement_um", "force_mN", "correlated_um", "correlation_length")
        logs, sds = np.asarray(noise.logs), np.asarray(self.fit.noise_log_sd)
        entries = []
        rms = self.rms_um()
        position = {i: row for row, i in enumerate(self.selection.kept)}
        for i, name in enumerate(self.campaign.particles):
            row = position.get(i)
            draws: dict[str, Any] = dict.fromkeys(("eta_p", *COEFFICIENTS, "zero_um"), estimate(None))
            if row is not None:
                draws["eta_p"] = summary(self.shape_factor[..., row])
                for j, coefficient in enumerate(COEFFICIENTS):
                    draws[coefficient] = summary(self.C[..., row, j])
                draws["zero_um"] = summary(self.zero_um[..., row])
            entries.append(
                {
                    "particle": name,
                    **draws,
                    "rms_um": finite(rms[row]) if row is not None else None,
                    "noise_scale": finite(float(noise.scale[row])) if row is not None else None,
                    "pareto_k": finite(float(self.pareto_k[row])) if row is not None else None,
                    "kept": row is not None,
                    "why_not": self.selection.why_not[i],
                }
            )
        return {
            "schema": 1,
            "method": "bayes",
            "mode": self.mode,
            "converged": self.converged,
            "runtime_s": self.runtime_s,
            "seed": self.seed,
            "law": {"unloading": self.model.unloading.value, "strain_scaling": self.model.strain_scaling.value},
            "a": summary(named["a"]),
            "effective_modulus_MPa": summary(named["effective_modulus_MPa"]),
            **{
                f"log_{name}": {"mean": summary(named[f"mu_{name}"]), "sd": summary(named[f"tau_{name}"])}
                for name in COEFFICIENTS
            },
            "modulus_scatter": summary(named["modulus_scatter"]) if self.model.modulus_scatter else None,
            "shape_scatter": summary(named["shape_scatter"]) if self.model.shape_scatter else None,
            "yield_stress_MPa": summary(self.yield_stress_MPa()),
            "probability_not_monotone": summary(self.probability_not_monotone()),
            "noise": {
                **{name: log_estimate(m, s) for name, m, s in zip(numbers, logs, sds, strict=True)},
                "factor": summary(named["noise_factor"]),
            },
            "priors": self.model.beliefs.to_json(),
            "particles": entries,
            "warnings": self.warnings(),
            "diagnostics": {
                "rhat_max": finite(max(self.rhat.values())),
                "ess_bulk_min": finite(min(self.ess_bulk.values())),
                "ess_tail_min": finite(min(self.ess_tail.values())),
                "divergences": self.divergences,
                "pareto_k_max": finite(float(np.max(self.pareto_k))),
                "pareto_k_joint": None if self.pareto_k_joint is None else finite(self.pareto_k_joint),
                "weights_applied": self.weights_applied,
                "leapfrogs_mean": finite(self.leapfrogs),
                "own_misfit": finite(own_misfit(self.selection.tests, self.fit.residual)),
                "failures": self.failures(),
            },
        }


def summary(draws: np.ndarray) -> dict[str, Any]:
    """Mean, standard deviation and central 95 % interval of draws."""
    low, high = np.quantile(draws, [0.025, 0.975])
    return estimate(float(np.mean(draws)), float(np.std(draws)), (float(low), float(high)))


def log_estimate(log: float, sd: float) -> dict[str, Any]:
    """An estimate from its logarithm's mean and standard deviation."""
    value = math.exp(log)
    if not math.isfinite(sd):
        return estimate(value)
    sd = min(sd, 5.0)
    return estimate(value, value * sd, (value * math.exp(-1.96 * sd), value * math.exp(1.96 * sd)))


def _argmax(values: dict[str, float]) -> str:
    return max(values, key=lambda k: values[k])


def calibrate_bayes(
    campaign: Campaign,
    *,
    model: JointModel | None = None,
    threshold_MPa: float = THRESHOLD_MPA,
    mode: Mode = "fast",
    chains: int = 4,
    warmup: int = 300,
    draws: int = 1000,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> BayesCalibration:
    """The joint posterior of everything: a, modulus, population, noise, and every particle's C1, C3, C5 and zero.

    Args:
        campaign: the tests.
        model: form of unloading, what scatters, and priors.
        threshold_MPa: points below this stress on loading do not count [MPa].
        mode: "fast" integrates the particles out through quadratic summaries of their tests and corrects by exact
            importance weights; "joint" samples everything at once under the exact likelihood, the reference.
        chains, warmup, draws: of the sampler, per chain.
        seed: random seed.
        progress: called with the name of each step.

    Raises:
        InputError: if no particle can be used.
    """
    started = time.perf_counter()
    tell = progress or (lambda _: None)
    model = model or JointModel()
    tell("selecting points")
    selection = select_tests(campaign, threshold_MPa=threshold_MPa)
    tests = spread(selection.tests)
    read_out = float(np.median([point_noise_um(campaign.curves[i]) for i in selection.kept]))
    compiling = None
    if mode == "fast":
        compiling = threading.Thread(target=_compile, args=(tests, model, chains, warmup, draws), daemon=True)
        compiling.start()
    try:
        fit = fit_joint(tests, model, read_out, tell=tell)
    finally:
        if compiling is not None:
            compiling.join()  # also on an error: a compiler must not outlive the interpreter
    key = jax.random.key(seed)
    tell("sampling the population" if mode == "fast" else "sampling everything")
    found = _fast if mode == "fast" else _joint
    parts = found(key, tests, model, fit, chains, warmup, draws)
    tell("diagnosing")
    return BayesCalibration(
        campaign=campaign,
        selection=selection,
        model=model,
        fit=fit,
        mode=mode,
        seed=seed,
        runtime_s=time.perf_counter() - started,
        **parts,
    )


def _compile(tests: Tests, model: JointModel, chains: int, warmup: int, draws: int) -> None:
    """Compile what is needed last while the first steps run: the same functions, for arrays of the same shapes."""
    count, points = tests.force.shape
    d = 6 + model.scatter.size

    def dummy(*shape: int) -> Array:
        return jnp.asarray(np.ones(shape))

    one, four = dummy(count), dummy(count, 4)
    quadratic = Summary(four, dummy(count, 4, 4), four, one, one, one, four, one)
    numbers = prior_numbers(model.beliefs, tests.flatness)
    # Almost all campaigns pin their coefficients down; the others compile again.
    key, flat, scatter = jax.random.key(0), tests.flatness, replace(model.scatter, newton=0)
    settings = {"chains": chains, "warmup": warmup, "draws": draws}
    cast(Any, sample_population).lower(
        key, dummy(d), dummy(d, d), numbers, quadratic, flat, scatter, dummy(), **settings
    ).compile()
    exact = Exact(
        tests,
        eqx.filter_vmap(Whitening)(*(dummy(count, points) for _ in range(4)), tests.branch),
        quadratic,
        model.zero_sd,
        model.unloading,
    )
    several = dummy(len(range(0, chains * draws, _stride(count, chains * draws))))
    triple = dummy(*several.shape, 3)
    some = eqx.filter_vmap(Population)(several, several, triple, triple, several, several, several)
    cast(Any, draw_particles).lower(key, some, exact, flat, scatter).compile()
    import arviz_stats.base  # noqa: F401  # seconds on a cold machine, so here too


SHARP = 0.03
"""Posterior standard deviation of the logarithm of a polynomial's coefficient below which one Newton step is enough."""


def newton_steps(fit: JointFit, tests: Tests, model: JointModel) -> int:
    """How many Newton steps the integration over the particles needs: none if every coefficient is known sharply."""
    population = population_at(fit.mode, fit.numbers, model.scatter)
    at = eqx.filter_jit(laplace)(population, fit.summary, tests.flatness, model.scatter)
    variance = np.diagonal(np.linalg.inv(np.asarray(at.hessian)), axis1=1, axis2=2)
    widest = float(np.max(np.sqrt(variance) * np.asarray(at.stretch)))
    return 0 if widest < SHARP else 4


def _stride(count: int, total: int) -> int:
    """Every how many-th draw is compared with the exact likelihood: all of them for few particles."""
    return max(1, -(-total * count // MOST_CHECKED))


def _fast(
    key: Array, tests: Tests, model: JointModel, fit: JointFit, chains: int, warmup: int, draws: int
) -> dict[str, Any]:
    flat, scatter = tests.flatness, replace(model.scatter, newton=newton_steps(fit, tests, model))
    population_key, particle_key, check_key, pick_key = jax.random.split(key, 4)
    for accept in ACCEPT:
        run, population = sample_population(
            population_key,
            fit.mode,
            fit.covariance,
            fit.numbers,
            fit.summary,
            flat,
            scatter,
            jnp.asarray(accept),
            chains=chains,
            warmup=warmup,
            draws=draws,
        )
        if not np.any(np.asarray(run.divergent)):
            break
    total, count = chains * draws, len(tests)
    exact = exact_of(fit, tests, model.zero_sd, model.unloading)
    stride = _stride(count, total)
    checked = [np.array(v) for v in draw_particles(check_key, _every(population, stride), exact, flat, scatter)]
    ratio = checked[3]
    k = pareto_k(ratio)
    restless = np.flatnonzero(_unrest(ratio) > RESTLESS)
    applied = stride == 1
    notes: list[str] = []
    names, stacked = _stack(population, scatter, (chains, draws))
    if applied:
        latent, zero, likelihood, ratio = checked
        for candidates in CANDIDATES:
            if not len(restless):
                break
            # Always of one of a few sizes, the first one repeated: every size would be compiled anew.
            size = min(count, 4 ** int(np.ceil(np.log(max(len(restless), 2)) / np.log(4))))
            padded = np.concatenate([restless, np.full(size - len(restless), restless[0])])
            some = _take(exact, padded, flat)
            more = draw_particles(jax.random.fold_in(pick_key, candidates), population, *some, scatter, candidates)
            better = [np.asarray(v)[:, : len(restless)] for v in more]
            latent[:, restless], zero[:, restless], ratio[:, restless] = better[0], better[1], better[3]
            k[restless] = pareto_k(ratio[:, restless])
            restless = restless[np.argsort(-_unrest(ratio[:, restless]))][:FEW]
            restless = restless[_unrest(ratio[:, restless]) > RESTLESS]
        weight, joint = smoothed_weights(ratio.sum(1))
        rows = (slice(c * draws, (c + 1) * draws) for c in range(chains))
        chosen = np.concatenate([row.start + ordered_resample(weight[row], draws) for row in rows])
        population = jax.tree.map(lambda x: np.asarray(x)[chosen], population)
        latent, zero, likelihood = latent[chosen], zero[chosen], likelihood[chosen]
        stacked = stacked.reshape(total, -1)[chosen].reshape(stacked.shape)
        keep = 1
    else:
        joint = None
        if len(restless):
            affected = ", ".join(str(i) for i in restless[:5])
            notes.append(f"{len(restless)} particles are far from their quadratic summary (positions {affected}, ...)")
        keep = max(1, -(-total * count // MOST_PARTICLE_DRAWS))
        kept = _every(population, keep)
        latent, zero, likelihood, _ = draw_particles(particle_key, kept, exact, flat, scatter, 0)
    rhat, bulk, tail = diagnostics(names, stacked)
    shaped = jax.tree.map(lambda x: np.asarray(x).reshape(chains, draws, *x.shape[1:])[:, ::keep], population)
    return {
        "population": shaped,
        **_particles(np.asarray(latent), np.asarray(zero), shaped, np.asarray(flat), model, chains),
        "log_likelihood": np.asarray(likelihood).reshape(chains, -1, count),
        "pareto_k": k,
        "pareto_k_joint": joint,
        "weights_applied": applied,
        "divergences": int(np.sum(np.asarray(run.divergent))),
        "rhat": rhat,
        "ess_bulk": bulk,
        "ess_tail": tail,
        "leapfrogs": float(np.mean(np.asarray(run.steps))),
        "notes": tuple(notes),
    }


def _joint(
    key: Array, tests: Tests, model: JointModel, fit: JointFit, chains: int, warmup: int, draws: int
) -> dict[str, Any]:
    flat, scatter = tests.flatness, replace(model.scatter, newton=newton_steps(fit, tests, model))
    exact = exact_of(fit, tests, model.zero_sd, model.unloading)
    run, free, latent, zero, likelihood = sample_joint(
        key, fit.mode, fit.covariance, fit.numbers, exact, flat, scatter, chains=chains, warmup=warmup, draws=draws
    )
    population = populations(free.reshape(-1, free.shape[-1]), fit.numbers, scatter)
    names, stacked = _stack(population, scatter, (chains, draws))
    rhat, bulk, tail = diagnostics(names, stacked)
    shaped = jax.tree.map(lambda x: np.asarray(x).reshape(chains, draws, *x.shape[1:]), population)
    count = len(tests)
    return {
        "population": shaped,
        **_particles(
            np.asarray(latent).reshape(-1, count, 4),
            np.asarray(zero).reshape(-1, count),
            shaped,
            np.asarray(flat),
            model,
            chains,
        ),
        "log_likelihood": np.asarray(likelihood),
        "pareto_k": np.zeros(count),
        "pareto_k_joint": None,
        "weights_applied": False,
        "divergences": int(np.sum(np.asarray(run.divergent))),
        "rhat": rhat,
        "ess_bulk": bulk,
        "ess_tail": tail,
        "leapfrogs": float(np.mean(np.asarray(run.steps))),
    }


def _particles(
    latent: np.ndarray, zero: np.ndarray, population: Population, flatness: np.ndarray, model: JointModel, chains: int
) -> dict[str, np.ndarray]:
    """C, modulus, zero and shape factor of the particles from their latent vectors."""
    count = len(flatness)
    eta = 1 + np.asarray(population.a)[..., None] * flatness
    latent = latent.reshape(chains, -1, count, 4)
    log_eta = np.log(eta)
    # What scatter of `a` there is has gone into b alone; a particle's coefficients are those under the common a.
    C = np.exp(latent[..., :3] - log_eta[..., None])
    modulus = np.exp(latent[..., 3] - model.shape_power * log_eta)
    return {"C": C, "modulus_MPa": modulus, "zero_um": zero.reshape(chains, -1, count), "shape_factor": eta}


def _every(population: Population, stride: int) -> Population:
    return jax.tree.map(lambda x: x[::stride], population)


def _take(exact: Exact, which: np.ndarray, flatness: Float[Array, " n"]) -> tuple[Exact, Float[Array, " m"]]:
    """The exact likelihood of some of the particles."""
    index = jnp.asarray(which)
    take = partial(jax.tree.map, lambda x: x[index])
    return (
        Exact(take(exact.tests), take(exact.filters), take(exact.summary), exact.zero_sd, exact.unloading),
        flatness[index],
    )


def _stack(population: Population, scatter: Any, shape: tuple[int, int]) -> tuple[list[str], np.ndarray]:
    columns = {"a": population.a, "log_modulus": population.log_modulus}
    columns |= {f"mu_{n}": population.mu[:, j] for j, n in enumerate(COEFFICIENTS)}
    columns |= {f"tau_{n}": population.tau[:, j] for j, n in enumerate(COEFFICIENTS)}
    if scatter.modulus:
        columns["modulus_scatter"] = population.modulus_scatter
    if scatter.shape:
        columns["shape_scatter"] = population.shape_scatter
    columns["noise_factor"] = population.log_noise
    return list(columns), np.stack([np.asarray(v).reshape(shape) for v in columns.values()], -1)


def diagnostics(names: list[str], draws: np.ndarray) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """R-hat, bulk and tail ESS by name, of draws with the axes (chain, draw, name)."""
    from arviz_stats.base.array import array_stats

    axes: dict[str, Any] = {"chain_axis": 0, "draw_axis": 1}
    # Chains that never moved have no variance to divide by; their R-hat then is infinite, as it should be.
    with np.errstate(all="ignore"):
        rhat = array_stats.rhat(draws, **axes)
        bulk = array_stats.ess(draws, method="bulk", **axes)
        tail = array_stats.ess(draws, method="tail", prob=(0.05, 0.95), **axes)

    def named(values: Any) -> dict[str, float]:
        return {n: float(v) for n, v in zip(names, np.atleast_1d(values), strict=True)}

    return named(rhat), named(bulk), named(tail)


def _unrest(log_weight: np.ndarray) -> np.ndarray:
    """Standard deviation of each particle's weights over their mean, draws along the first axis."""
    relative = np.exp(np.maximum(log_weight - np.maximum(log_weight.max(0), -1e300), -700.0))
    return relative.std(0) / np.maximum(relative.mean(0), 1e-300)


def pareto_k(log_weight: np.ndarray) -> np.ndarray:
    """Pareto k of importance weights, draws along the first axis."""
    from arviz_stats.base.array import array_stats

    columns = np.where(np.isfinite(log_weight), log_weight, -1e10).T
    result = np.zeros(len(columns))
    # Weights that are all equal have no tail to fit.
    varied = np.std(columns, axis=1) > 1e-9
    if varied.any():
        with np.errstate(all="ignore"):
            result[varied] = array_stats.psislw(-columns[varied], axis=-1)[1]
    return np.where(np.isnan(result), np.inf, result)


def smoothed_weights(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Pareto-smoothed importance weights, normalised, and their k."""
    from arviz_stats.base.array import array_stats

    finite_weight = np.where(np.isfinite(log_weight), log_weight, -1e10)
    if np.std(finite_weight) <= 1e-9:
        return np.full(len(finite_weight), 1 / len(finite_weight)), 0.0
    with np.errstate(all="ignore"):
        smooth, k = array_stats.psislw(-finite_weight, axis=-1)
    if not np.isfinite(smooth).all():  # one weight holds all: nothing to smooth
        smooth, k = finite_weight, np.inf
    weight = np.exp(np.maximum(np.asarray(smooth) - np.max(smooth), -700.0))
    return weight / weight.sum(), float(k) if np.isfinite(k) else float("inf")


def ordered_resample(weight: np.ndarray, count: int) -> np.ndarray:
    """Systematic resampling that keeps the order of the draws, so that autocorrelation still shows."""
    share = weight / weight.sum() if weight.sum() > 0 else np.full(len(weight), 1 / len(weight))
    return np.minimum(np.searchsorted(np.cumsum(share), (np.arange(count) + 0.5) / count), len(weight) - 1)
