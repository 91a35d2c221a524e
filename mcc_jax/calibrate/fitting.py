"""The fit that least squares, posterior and evidence start from: particles, noise and population in agreement."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, check_tests, other_material
from ..campaign.signal import point_noise
from .data import MOST_POINTS, Selection, Tests, select
from .draws import Fit, coordinates_of
from .forward import Linear, Linearisation, Point, linearise
from .judgement import numbers_in_reach
from .marginal import Marginal, summarise
from .mode import LogPosterior, careful_enough, expect, log_densities, most_probable
from .noise import (
    Noise,
    NoiseFit,
    Whitening,
    estimate_noise,
    grams_and_likelihoods,
    particle_scales,
    squared_innovations,
    student_weights,
)
from .numpyro_model import Model
from .particle_fit import ParticleFits, fit_particles, linear_starts
from .population import Population
from .priors import Priors, SpreadCoordinate, check_prior_of_a, population_sites
from .running import Blocks, compiled, make_room, one_blas_thread, require_same

# Found by trial on simulated campaigns (`benchmarks/study_posterior.py`, `study_noise.py`, `bench_scale.py`).
ALONE = 1.5  # standard deviation of the logarithms that a particle by itself is allowed around the prior's centre
NARROWEST = 1e-3  # least such standard deviation under the population: any smaller is badly scaled
NOISE_PARTICLES = 256  # of larger campaigns the noise is estimated from so many particles
ROUNDS, MOST_ROUNDS = 2, 20  # turns of noise, population and particles: at least, and at most, with effects
LEAST_GAIN = 0.005  # log density to gain below which effects are not linearised again: a tenth of an sd
HALVINGS = 8  # most halvings of a step of a model with effects until it raises the density
WIDEST = 1.0  # sd of the log of an effect's number over which the bend is taken; beyond, the exact likelihood corrects
STUDENT_STEPS = 4  # how often weights of readings and noise are taken in turn, in each round


@one_blas_thread
def fit(
    campaign: Campaign,
    model: Model | None = None,
    *,
    threshold_MPa: float = THRESHOLD_MPA,
    progress: Progress | None = None,
) -> Fit:
    """Fit particles, noise and population of a campaign: where samplers start, and in what coordinates. For arguments
    and errors see `sample`."""
    campaign = check_tests(campaign)
    progress, model, threshold_MPa = checked_settings(progress, model, threshold_MPa)
    with numbers_in_reach(campaign):
        return prepare(campaign, model, threshold_MPa, progress=progress)[1]


class Start(NamedTuple):
    """Where a fit may begin instead of from nothing: what another fit of the same tests found."""

    point: Point
    population: Population
    noise: Noise


def prepare(
    campaign: Campaign,
    model: Model,
    threshold_MPa: float = THRESHOLD_MPA,
    *,
    most_points: int = MOST_POINTS,
    start: Start | None = None,
    progress: Progress = lambda _: None,
    **settings: Any,
) -> tuple[Selection, Fit]:
    """What was selected, and its fit, with settings of `fit_tests`; to be called within `numbers_in_reach`. Raises
    `InputError` if no particle can be used, or processes were given different tests."""
    make_room()
    model, note = in_own_units(campaign, model)
    progress("selecting points")
    selection = select(campaign, threshold_MPa=threshold_MPa, most_points=most_points)
    selection = selection if note is None else replace(selection, notes=(*selection.notes, note))
    require_same(selection.tests)
    if start is not None and start.point.theta.shape != (len(selection.kept), len(model.forms.names)):
        problem = "start is of other particles or effects"
        raise InputError(problem, remedy="Give the fit of the same campaign and the same model.")
    read_out = float(np.median([point_noise(campaign.curves[i].displacement_um) for i in selection.kept]))
    found = fit_tests(selection.tests, model, read_out, start=start, progress=progress, **settings)
    parts = (found.point.latent, found.point.zero, found.mode, found.covariance)
    if not all(np.isfinite(np.asarray(part)).all() for part in parts):
        raise FloatingPointError("the fit ends in no numbers")
    return selection, found


def in_own_units(campaign: Campaign, model: Model) -> tuple[Model, str | None]:
    """The model with priors in the campaign's own stress and strain, if its material is not like cellulose, and what a
    reader must know of it; None where nothing was changed. Priors that were given stay."""
    material = other_material(campaign) if model.priors is None else None
    if material is None:
        return model, None
    priors = Priors.of_scale(material.stress_MPa, material.strain, model.unloading)
    return replace(model, priors=priors), (
        f"Priors are in this campaign's own units, {material.stress_MPa:.3g} MPa at a scaled strain of "
        f"{material.strain:.2g}, not in those of microcrystalline cellulose"
    )


class _Fitter:
    """A fit under way: particles, noise and summaries at the current point, as attributes; `weighted` are the tests
    with the weights of readings that inference takes."""

    def __init__(self, tests: Tests, model: Model, progress: Progress) -> None:
        if model.robust:
            tests = replace(tests, reading_weight=jnp.asarray(np.ones(tests.mask.shape)))
        self.model, self.blocks, self.progress = model, Blocks(len(tests)), progress
        self.tests = self.weighted = tests
        self.linearisation = Linearisation(tests, model.forms, model.scatter.positive, self.blocks)
        self.varying = [k for k, _ in model.scatter.varying]
        self.zero_mean = np.asarray(tests.contact) + model.chosen_priors.zero_um.mean  # where zeros are expected [um]

    def begin_at(self, start: Start) -> dict[str, float]:
        """Particles and noise of another fit, and its values of the model's sites."""
        self.noise = NoiseFit(start.noise, converged=True)
        self.individual = self.alone(start.point)
        self.point, self.linear = start.point, self.linearisation.at(start.point)
        one = jax.tree.map(lambda x: np.asarray(x)[None], start.population)
        known = coordinates_of(one, self.model)
        values = population_sites(self.model, np.asarray(self.tests.flatness), known).values
        return {name: float(value[0]) for name, value in values.items()}

    def begin(self, read_out_um: float) -> dict[str, float]:
        """Every particle on its own, and from which values of the model's sites to look for the population."""
        model, N = self.model, len(self.tests)
        noise = Noise.of([read_out_um, *np.asarray(model.chosen_priors.noise.median)[1:]], jnp.asarray(np.ones(N)))
        self.noise = NoiseFit(noise, converged=True)
        base, theta = _Fitter(self.tests, replace(model, effects=(), varying=()), self.progress), np.zeros(0)
        base.noise = self.noise
        self.individual = base.alone()
        if model.effects:
            law = self.individual.point
            theta = start_of_effects(law, self.tests, noise, model, self.blocks)
            self.individual = self.alone(replace(law, theta=jnp.asarray(np.tile(theta, (N, 1)))))
        self.point = self.individual.point
        self.linear = self.linearisation.at(self.point)
        return _start(np.asarray(self.individual.point.latent), np.asarray(self.tests.flatness), theta, model)

    # ---- noise -------------------------------------------------------------------------------------------------------

    def summaries(self, point: Point, linear: Linear) -> tuple[Marginal, Whitening, Array]:
        """The tests at any point, summarised under the noise."""
        m, straight = self.model, self.linearisation.straight
        of_particles = point, straight, self.weighted, linear, self.noise.noise
        return self.blocks.all(summarise, of_particles, m.zero_prior, m.scatter, m.correlation, m.along)

    def summarise(self) -> None:
        """Summarise the tests at the point."""
        self.marginal, self.filters, self.white = self.summaries(self.point, self.linear)

    def take_noise(self, *, uncertainty: bool) -> None:
        """Noise of what particles leave, with weights of readings and scales of particles; summaries under it."""
        self.estimate_noise(uncertainty)
        self.summarise()
        for _ in range(STUDENT_STEPS if self.model.robust else 0):
            self.weigh()
            self.estimate_noise(uncertainty)
            self.summarise()
        noise = self.noise.noise
        squares, points = np.asarray(self.marginal.gram)[:, -1, -1], np.asarray(self.marginal.count)
        scale = particle_scales(np.asarray(noise.scale), squares, points - 4)
        if np.any(scale != np.asarray(noise.scale)):
            self.noise = replace(self.noise, noise=replace(noise, scale=jnp.asarray(scale)))
            self.summarise()

    def take_white_noise(self) -> None:
        """White noise of the residuals' median modulus, which outliers do not move; summaries under it."""
        residual = np.asarray(self.linear.residual)[np.asarray(self.tests.mask)]
        width = max(1.4826 * np.median(np.abs(residual)), 1e-9)
        noise = Noise.of([width, 0.0, 0.0, 1.0], jnp.asarray(np.ones(len(self.tests))))
        self.noise = replace(self.noise, noise=noise)
        self.summarise()

    def estimate_noise(self, uncertainty: bool) -> None:
        """The four numbers of the noise, of very many particles from some of them."""
        self.progress("estimating the noise")
        m, blocks, old = self.model, self.blocks, self.noise.noise
        # Without what is never read, so that all models share a program.
        linear = replace(self.linear, columns=self.linear.columns[..., :4], bends=None)
        given: Any = old.scale, self.tests, linear
        if len(self.tests) > NOISE_PARTICLES:
            rows = np.linspace(0, len(self.tests) - 1, NOISE_PARTICLES).astype(int)
            blocks = Blocks(len(rows), blocks.size)
            given = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[rows]), given)
        shared = m.zero_prior[1], m.correlation, m.along

        def log_likelihoods(logs: Array) -> Array:
            return blocks.all(grams_and_likelihoods, given, logs, *shared)[1]

        self.noise = estimate_noise(log_likelihoods, m.chosen_priors.noise, old, uncertainty=uncertainty)

    def weigh(self) -> None:
        """New weights of the readings under Student noise."""
        of_particles = self.weighted, self.filters, self.linear, self.noise.noise
        squares = np.asarray(self.blocks.all(squared_innovations, of_particles))
        weight, overstated = student_weights(squares, np.asarray(self.tests.mask))
        self.tests = replace(self.tests, reading_weight=jnp.asarray(weight))
        self.weighted = replace(self.tests, reading_weight=jnp.asarray(weight / overstated))

    # ---- particles ---------------------------------------------------------------------------------------------------

    def particles(self, white: Any, centre: Any, width: Any, theta: Any, starts: np.ndarray) -> ParticleFits:
        """Every particle by itself, as `fit_particles`."""
        self.progress("fitting every particle")
        of_particles = self.tests, white, centre, width, theta, starts
        shared = self.model.forms, tuple(self.varying), self.blocks.size
        return self.blocks.share(fit_particles, of_particles, *shared)

    def alone(self, point: Point | None = None) -> ParticleFits:
        """Every particle on its own, from a point on, the effects' numbers held; from nothing without a point."""
        middle, N = _centre(self.model.chosen_priors), len(self.tests)
        theta = np.zeros((N, 0)) if point is None else np.asarray(point.theta)
        varying, zero_sd = theta[:, self.varying], self.model.chosen_priors.zero_um.sd
        own = None if point is None else np.column_stack([point.latent, point.zero, varying])
        starts = linear_starts(self.tests, middle[3]) if own is None else own[:, None]
        centre = np.column_stack([np.tile(middle, (N, 1)), self.zero_mean, varying])
        width = np.broadcast_to([ALONE] * 4 + [zero_sd] + [1e-12] * len(self.varying), centre.shape)
        white = np.exp(np.asarray(self.noise.noise.logs)[0]) * np.asarray(self.noise.noise.scale)
        return self.particles(white, centre, width, theta, starts)

    def together(self, target: LogPosterior, free: Float[Array, " d"]) -> Point:
        """Every particle under the population, from where it was and where the summaries expect it."""
        before, N = self.point, len(self.tests)
        at = jax.tree.map(lambda x: np.asarray(x)[:N], expect(free, target))  # without padding
        centre = np.column_stack([at.mean, self.zero_mean, at.theta_mean])
        zero_sd = np.full(N, self.model.chosen_priors.zero_um.sd)
        width = np.column_stack([np.maximum(at.sd, NARROWEST), zero_sd, np.maximum(at.theta_sd, 1e-12)])
        places = (before.latent, before.zero), (at.latent, at.zero), (at.mean, before.zero)
        starts = np.stack([np.column_stack([*place, at.theta[:, self.varying]]) for place in places], 1)
        return self.particles(self.white, centre, width, at.theta, starts).point

    def step(self, target: LogPosterior, before: Array, after: Array) -> Array:
        """A step of Gauss-Newton of population and particles, halved while the density, with the tests linearised where
        it ends, is lower than where it begins; where the population then is."""
        least, share = _density(before, target) - LEAST_GAIN, 1.0
        while True:
            free = before + share * (after - before)
            point = self.together(target, free)
            linear = self.linearisation.at(point)
            marginal, *_ = self.summaries(point, linear)
            marginal = replace(marginal, scatter=target.marginal.scatter)
            share /= 2
            if _density(free, LogPosterior.of(self.model, marginal)) > least or share < 0.5**HALVINGS:
                self.point, self.linear = point, linear
                return free


def fit_tests(
    tests: Tests,
    model: Model,
    read_out_um: float,
    *,
    correlated: bool = True,
    rounds: int = ROUNDS,
    start: Start | None = None,
    progress: Progress = lambda _: None,
) -> Fit:
    """Fit particles, noise and population, from a first guess of the noise of displacement from point to point [um].

    Particles come first, each on its own, with effects at their amplitudes to first order. Then, in `rounds` turns at
    least: the noise from residuals linear in the particles' numbers, the most probable population under the summaries,
    the most probable particles under that population. With a start the last turn is the only one, unless the tests want
    more. With effects every step but the first is halved until the tests are more probable where it ends
    (`_Fitter.step`). Noise that is not `correlated` is white, see `take_white_noise`.
    """
    check_prior_of_a(model.chosen_priors, np.asarray(tests.flatness))
    effects, count = bool(model.effects), len(tests)
    fitter = _Fitter(tests, model, progress)
    first = fitter.begin(max(read_out_um, 1e-4)) if start is None else fitter.begin_at(start)
    begun = 0 if start is None else rounds
    free, turn = None, begun
    while True:
        last = turn >= (max(rounds, MOST_ROUNDS) if effects else rounds)
        if not correlated:
            fitter.take_white_noise()
        elif last and turn > begun:
            fitter.summarise()
        else:  # with effects no round knows that it is the last
            fitter.take_noise(uncertainty=effects or turn >= rounds - 1)
        progress("fitting the population")
        target = LogPosterior.of(model, fitter.marginal)
        before = target.unconstrain(first) if free is None else free
        target = careful_enough(before, target, count)
        free, covariance, mode_converged = most_probable(before, target)
        gain = _density(free, target) - _density(before, target) if effects else 0.0
        finished = turn >= rounds and (not effects or gain < LEAST_GAIN)
        if last or finished:
            break
        turn += 1
        if effects and turn > 1:
            free = fitter.step(target, before, free)
        else:
            fitter.point = fitter.together(target, free)
            fitter.linear = fitter.linearisation.at(fitter.point)
    if effects:
        # Again, with how the law bends over what is still open of the effects' numbers.
        fitter.linear = fitter.linearisation.at(fitter.point, _widths(free, covariance, target))
        fitter.summarise()
        target = careful_enough(free, LogPosterior.of(model, fitter.marginal), count)
        free, covariance, mode_converged = most_probable(free, target)
    alone = bool(np.all(fitter.individual.converged))
    return Fit(
        model,
        fitter.weighted,
        fitter.individual,
        fitter.noise,
        fitter.filters,
        fitter.point,
        fitter.linear.residual,
        replace(fitter.marginal, scatter=target.marginal.scatter),
        free,
        covariance,
        np.asarray([alone, fitter.noise.converged, mode_converged and finished]),
    )


def _widths(free: Array, covariance: Array, target: LogPosterior) -> np.ndarray:
    """Standard deviations of the effects' numbers that all particles share, each within half of a number that is not
    0; of the logarithm of a positive one, up to `WIDEST`."""
    slope = np.asarray(theta_slope(free, target))
    sd = np.sqrt(np.maximum(np.einsum("kd,de,ke->k", slope, np.asarray(covariance), slope), 1e-300))
    middle = np.abs(np.asarray(target.population(free).theta))
    width = np.minimum(sd, np.where(middle > 0, 0.5 * middle, np.inf))
    for k, _ in target.marginal.scatter.positive:
        width[k] = min(sd[k] / middle[k], WIDEST)
    return width


@compiled
def theta_slope(free: Float[Array, " d"], target: LogPosterior) -> Float[Array, "numbers d"]:
    """Derivatives of the effects' numbers by the unbounded coordinates."""
    return jax.jacfwd(lambda x: target.population(x).theta)(free)


def _density(free: Array, target: LogPosterior) -> float:
    return float(log_densities(np.asarray(free)[None], target)[0])


def _centre(priors: Priors) -> np.ndarray:
    """Centre of b1, b3, b5, e for what a curve alone does not say: the prior's, at the paper's typical shape factor."""
    log_eta = np.log(1.4)
    C = np.array([np.log(priors.C1.median), priors.log_C3, np.log(priors.C5.median)])
    return np.append(C + log_eta, np.log(priors.effective_modulus_MPa.median))


def _start(latent: np.ndarray, flatness: np.ndarray, theta: np.ndarray, model: Model) -> dict[str, float]:
    """Where to look for the population: the prior's a and the particles' own median and scatter under it."""
    priors = model.chosen_priors
    most, least = max(flatness.max(), 1e-3), min(flatness.min(), -1e-3)
    a = float(np.clip(priors.a.mean, -0.9 / most, -0.9 / least))
    log_eta = np.log(1 + a * flatness)
    b = latent[:, :3] - log_eta[:, None]
    middle, scatter = np.median(b, axis=0) + log_eta.mean(), np.std(b, axis=0)
    start = dict(zip(model.forms.names, theta.tolist(), strict=True))
    start |= {"a": a, "log_noise_factor": 0.0, "b1": middle[0], "b3": middle[1], "b5": middle[2]}
    start["log_modulus"] = np.median(latent[:, 3] - model.shape_power * log_eta)
    for j, name in enumerate(("tau_C1", "tau_C3", "tau_C5")):
        prior = getattr(priors, name)
        tau = float(np.clip(scatter[j], 0.05 * prior.sd, 2 * prior.sd))
        start[f"{name}_coordinate"] = SpreadCoordinate(prior).coordinate(tau)
    for name in ("modulus_scatter", "shape_scatter"):
        start[f"{name}_coordinate"] = SpreadCoordinate(getattr(priors, name)).coordinate(0.1)
    for v in model.effects:
        start[f"{v.mechanism}_size"] = (v.sign or 1) * start[v.mechanism] / v.plausible[0]
        start[f"tau_{v.mechanism}_coordinate"] = 1.0
    return start


def start_of_effects(point: Point, tests: Tests, noise: Noise, model: Model, blocks: Blocks) -> np.ndarray:
    """Numbers of the effects to start from: of every formula those of its grid whose amplitude, to first order,
    explains most of what particles' own numbers leave. The noise must be small: without what effects explain."""
    forms, grids = model.forms, [v.grid() for v in model.effects]
    theta, best = np.zeros(len(forms.names)), np.full(len(grids), -1.0)
    for k in range(max(map(len, grids))):
        further = [grid[k % len(grid)] for grid in grids]
        here = np.zeros(len(theta))  # amplitudes of 0: no effect changes what another one does
        for v, values, places in zip(model.effects, further, forms.places, strict=True):
            here[list(places[1:])] = [values[n.name] for n in v.nuisances]
        there = replace(point, theta=jnp.asarray(np.broadcast_to(here, (len(tests), len(here)))))
        linear = blocks.all(linearise, (there, tests), forms)
        shared = model.zero_prior[1], model.correlation, model.along
        grams, _ = blocks.all(grams_and_likelihoods, (noise.scale, tests, linear), noise.logs[None], *shared)
        gram = np.asarray(grams)[:, 0].sum(0)
        for i, (v, places) in enumerate(zip(model.effects, forms.places, strict=True)):
            score, amplitude = gram[i, -1], gram[i, -1] / max(gram[i, i], 1e-300)
            gain = score * amplitude if v.sign * amplitude >= 0 else 0.0
            if gain > best[i]:
                best[i] = gain
                size = np.clip(v.sign * amplitude, 0.3 * v.plausible[0], v.plausible[1])
                theta[i] = v.sign * size if v.sign else amplitude
                for n, place in zip(v.nuisances, places[1:], strict=True):
                    low, high = n.plausible
                    edge = 0.01 * (high - low)
                    theta[place] = here[place] if low > 0 else np.clip(here[place], low + edge, high - edge)
    return theta


def checked_settings(
    progress: Progress | None, model: Model | None, threshold_MPa: Any
) -> tuple[Progress, Model, float]:
    """What all calibrations share, with defaults filled in; refuses what is of the wrong kind or out of its range."""
    progress = progress or (lambda _: None)
    threshold = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    return progress, model or Model(), threshold
