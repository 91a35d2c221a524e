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
from .._memory import make_room
from .._types import Progress
from ..campaign import THRESHOLD_MPA, Campaign, other_material
from .compiling import compiled
from .data import MOST_POINTS, Selection, Tests, longer, point_noise_um, select
from .forward import Point, linearise
from .linearisation import Linearisation, start_of_effects
from .marginal import Marginal, summarise
from .mode import Fit, LogPosterior, careful_enough, expect, log_densities, most_probable, population_of
from .model import Model
from .noise import Noise, NoiseFit, estimate_noise, particle_scales, squared_innovations, student_weights
from .particle_fit import STEPS, ParticleFits, fit_particles, linear_starts
from .population import Population
from .priors import Priors, SpreadCoordinate, check_prior_of_a, population_sites
from .sharding import Blocks, Parts, block_size, count_of, filled_up, require_same

# Found by trial on simulated campaigns (`benchmarks/study_posterior.py`, `study_noise.py`, `bench_scale.py`).
FIRST_STEPS = 10  # that all particles of many blocks take before the unfinished ones go on by themselves
ALONE = 1.5  # standard deviation of the logarithms that a particle by itself is allowed around the prior's centre
NARROWEST = 1e-3  # least such standard deviation under the population: any smaller is badly scaled
NOISE_BLOCKS = 4  # the noise of campaigns of more blocks is estimated from the particles of so many
ROUNDS, MOST_ROUNDS = 2, 20  # turns of noise, population and particles: at least, and at most, with effects
LEAST_GAIN = 0.005  # log density to gain below which effects are not linearised again: a tenth of an sd
HALVINGS = 8  # most halvings of a step of a model with effects until it raises the density
WIDEST = 1.0  # sd of the log of an effect's number over which the bend is taken; beyond, the exact likelihood corrects
STUDENT_STEPS = 4  # how often weights of readings and noise are taken in turn, in each round


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
) -> tuple[Selection, Fit, int]:
    """Select points and particles, pad to whole blocks, and fit: what every calibration begins with.

    The model's priors become the campaign's own where they have to (`in_own_units`). Settings are those of `fit_tests`.

    Returns:
        What was selected, the fit of the tests with padding, and the size of a block.

    Raises:
        InputError: if no particle can be used, numbers overflow, or processes were given different tests.
    """
    make_room()
    model, note = in_own_units(campaign, model)
    progress("selecting points")
    selection = select(campaign, threshold_MPa=threshold_MPa, most_points=most_points)
    selection = selection if note is None else replace(selection, notes=(*selection.notes, note))
    require_same(selection.tests)
    size = block_size(len(selection.tests))
    tests = filled_up(selection.tests, size)
    if start is not None and start.point.theta.shape != (len(selection.kept), len(model.forms.names)):
        raise InputError(
            "start is of other particles or effects", remedy="Give the fit of the same campaign and the same model."
        )
    read_out = float(np.median([point_noise_um(campaign.curves[i]) for i in selection.kept]))
    found = fit_tests(tests, model, read_out, block=size, start=start, progress=progress, **settings)
    parts = (found.point.latent, found.point.zero, found.mode, found.covariance)
    if not all(np.isfinite(np.asarray(part)).all() for part in parts):
        raise beyond_numbers(campaign, selection)
    return selection, found, size


def in_own_units(campaign: Campaign, model: Model) -> tuple[Model, str | None]:
    """The model with priors in the campaign's own stress and strain, if its material is not like cellulose, and what a
    reader must know of it; None where nothing was changed. Priors that were given stay."""
    material = other_material(campaign) if model.priors is None else None
    if material is None:
        return model, None
    priors = Priors.of_scale(material.stress_MPa, material.strain, model.unloading)
    return replace(model, priors=priors), OWN_UNITS.format(material.stress_MPa, material.strain)


OWN_UNITS = (
    "Priors are in this campaign's own units, {:.3g} MPa at a scaled strain of {:.2g}, not in those of "
    "micro-crystalline cellulose"
)


def beyond_numbers(campaign: Campaign, selection: Selection) -> InputError:
    """The error of tests whose fit ends in no numbers, with the ranges that it was asked to describe."""
    tests = selection.tests
    size = np.asarray(tests.effective_diameter)[:, None]
    stress = 1e3 * np.asarray(tests.force) / (np.pi * size**2 / 4)
    strain = np.abs(np.asarray(tests.displacement) - np.asarray(tests.contact)[:, None]) / size
    top, deepest = (np.where(np.asarray(tests.mask), x, 0.0).max(1) for x in (stress, strain))
    most, deep = int(np.argmax(top)), int(np.argmax(deepest))
    names = [repr(campaign.particles[i]) for i in selection.kept]
    return InputError(
        "the law cannot be fitted to these tests: their numbers overflow; the largest stress is "
        f"{top[most]:.3g} MPa (particle {names[most]}), the largest displacement {deepest[deep]:.3g} times the size "
        f"(particle {names[deep]})",
        file=campaign.source or None,
        remedy="Check the units of force, displacement and diameters, or leave that particle out.",
    )


class _Fitter:
    """A fit under way: particles, noise and summaries at the current point, as attributes.

    `own` are this process's tests, `weighted` all and its own tests with the weights that inference takes.
    """

    def __init__(self, tests: Tests, model: Model, blocks: Blocks, progress: Progress) -> None:
        self.model, self.blocks, self.progress = model, blocks, progress
        self.tests, self.count = tests, count_of(tests)
        if model.robust:
            self.tests = replace(tests, reading_weight=jnp.asarray(np.ones(tests.mask.shape)))
        self.own = blocks.cut(self.tests)
        self.weighted = self.tests, self.own
        self.linearisation = Linearisation(self.own, self.count, model, blocks)
        self.varying = tuple(k for k, _ in model.scatter.varying)

    def begin_at(self, start: Start) -> dict[str, Any]:
        """Particles and noise of another fit, and its values of the model's sites."""
        N = len(self.tests)
        point, scale = longer((start.point, start.noise.scale), N)
        self.point, self.noise = point, NoiseFit.unsure(replace(start.noise, scale=scale), converged=True)
        own = np.column_stack([point.latent, point.zero, np.asarray(point.theta)[:, list(self.varying)]])
        white = np.exp(np.asarray(start.noise.logs)[0]) * np.asarray(scale)
        self.individual = self.alone(white, point.theta, own[None])
        self.linear = self.linearisation.at(point)
        one = jax.tree.map(lambda x: np.asarray(x)[None], start.population)
        values = population_sites(self.model, np.asarray(self.tests.flatness), one).values
        return {name: float(value[0]) for name, value in values.items()}

    def begin(self, read_out_um: float) -> dict[str, float]:
        """Every particle on its own, and from which values of the model's sites to look for the population."""
        model, N = self.model, len(self.tests)
        theta = np.broadcast_to(model.forms.without_effects, (N, len(model.forms.names)))
        self.individual = self.alone(np.full(N, read_out_um), theta)
        self.point = self.individual.point
        noise = Noise.of([read_out_um, *np.asarray(model.chosen_priors.noise.median)[1:]], jnp.asarray(np.ones(N)))
        self.noise = NoiseFit.unsure(noise, converged=True)
        latent, flatness = (np.asarray(v)[: self.count] for v in (self.point.latent, self.tests.flatness))
        start = _start(latent, flatness, model)
        self.linear = self.linearisation.at(self.point)
        if model.effects:
            sites, theta = start_of_effects(self.point, self.own, self.count, self.linear, noise, model, self.blocks)
            start |= sites
            self.point = replace(self.point, theta=jnp.asarray(np.broadcast_to(theta, self.point.theta.shape)))
            self.linear = self.linearisation.at(self.point)
        return start

    @property
    def residual(self) -> Array:
        """Measured less predicted displacement at the point [um]."""
        return self.blocks.whole(self.linear.map(lambda wave: wave.residual))

    # ---- noise -------------------------------------------------------------------------------------------------------

    def summaries(self, point: Point, linear: Parts) -> tuple[Marginal, Parts, Array]:
        """`marginal`, `filters` and `white` of any point."""
        m, cut = self.model, self.blocks.cut
        kinds = m.zero_prior, m.scatter, m.correlation, m.along
        places = cut(point), cut(self.linearisation.straight)
        found = self.blocks.each(summarise, *places, self.weighted[1], linear, cut(self.noise.noise), *kinds)
        marginal, filters, white = (found.map(lambda wave, k=k: wave[k]) for k in range(3))
        return self.blocks.whole(marginal), filters, self.blocks.whole(white)

    def summarise(self) -> None:
        """Summarise the tests at the point, under the noise."""
        self.marginal, self.filters, self.white = self.summaries(self.point, self.linear)

    def take_noise(self, *, uncertainty: bool) -> None:
        """The noise of what the particles leave, with weights of readings and the particles' own scales; summaries
        under it."""
        self.estimate_noise(uncertainty)
        self.summarise()
        for _ in range(STUDENT_STEPS if self.model.robust else 0):
            self.weigh()
            self.estimate_noise(uncertainty)
            self.summarise()
        old, count = np.asarray(self.noise.noise.scale), self.count
        squares, points = np.asarray(self.marginal.gram)[:, -1, -1], np.asarray(self.marginal.count)
        scale = particle_scales(old[:count], squares[:count], points[:count] - 4)
        scale = np.pad(scale, (0, len(old) - count), mode="edge")
        if np.any(scale != old):
            self.noise = replace(self.noise, noise=replace(self.noise.noise, scale=jnp.asarray(scale)))
            self.summarise()

    def take_white_noise(self) -> None:
        """White noise of the residuals' median modulus, which outliers do not move; summaries under it."""
        residual, mask = np.asarray(self.residual)[: self.count], np.asarray(self.tests.mask)[: self.count]
        width = max(1.4826 * np.median(np.abs(residual[mask])), 1e-9)
        noise = Noise.of([width, 0.0, 0.0, 1.0], jnp.asarray(np.ones(len(self.tests))))
        self.noise = replace(self.noise, noise=noise)
        self.summarise()

    def estimate_noise(self, uncertainty: bool) -> None:
        """The four numbers of the noise, of very many particles from some of them."""
        self.progress("estimating the noise")
        m, blocks, own, linear, start = self.model, self.blocks, self.own, self.linear, self.noise.noise
        if blocks.number > NOISE_BLOCKS:
            rows = np.linspace(0, self.count - 1, NOISE_BLOCKS * blocks.size).astype(int)
            blocks = Blocks(len(rows), blocks.size)
            own = blocks.cut(_rows(self.tests, rows))
            linear = blocks.each(linearise, blocks.cut(_rows(self.point, rows)), own, m.forms)
            start = replace(start, scale=start.scale[rows])
        prior = m.chosen_priors.noise
        found = estimate_noise(
            own, linear, m.zero_prior[1], prior, start, m.correlation, m.along, uncertainty=uncertainty, blocks=blocks
        )
        self.noise = replace(found, noise=replace(found.noise, scale=self.noise.noise.scale))

    def weigh(self) -> None:
        """New weights of the readings under Student noise."""
        blocks, noise = self.blocks, self.blocks.cut(self.noise.noise)
        squares = np.asarray(blocks.all(squared_innovations, self.weighted[1], self.filters, self.linear, noise))
        weight, overstated = student_weights(squares, np.asarray(self.tests.mask))
        self.tests = replace(self.tests, reading_weight=jnp.asarray(weight))
        weighted = replace(self.tests, reading_weight=jnp.asarray(weight / overstated))
        self.own, self.weighted = blocks.cut(self.tests), (weighted, blocks.cut(weighted))

    # ---- particles ---------------------------------------------------------------------------------------------------

    def particles(
        self, white: Array | np.ndarray, centre: np.ndarray, width: np.ndarray, theta: Any, starts: Parts
    ) -> ParticleFits:
        """Every particle by itself, all blocks; what is unfinished in many of them goes on in blocks of its own.

        A block takes as long as its slowest particle, and nearly every block has one that is slow.
        """
        self.progress("fitting every particle")
        arrays = tuple(jnp.asarray(np.asarray(v)) for v in (white, centre, width, theta))

        def fit(blocks: Blocks, own: Parts, arrays: Any, starts: Parts, most_steps: int) -> ParticleFits:
            cut = [blocks.cut(v) for v in arrays]
            return blocks.all(fit_particles, own, *cut, starts, self.model.forms, self.varying, most_steps)

        if self.blocks.whole_here:
            return fit(self.blocks, self.own, arrays, starts, STEPS)
        found = fit(self.blocks, self.own, arrays, starts, FIRST_STEPS)
        unfinished = np.flatnonzero(~np.asarray(found.settled))
        if not len(unfinished):
            return found
        rows = np.pad(unfinished, (0, -len(unfinished) % self.blocks.size), mode="edge")
        few = Blocks(len(rows), self.blocks.size)
        ends = few.cut(np.moveaxis(np.asarray(found.ends)[rows], 1, 0), axis=1)
        again = fit(few, few.cut(_rows(self.tests, rows)), _rows(arrays, rows), ends, STEPS)
        return jax.tree.map(lambda x, y: x.at[unfinished].set(y[: len(unfinished)]), found, again)

    def alone(self, white: np.ndarray, theta: Any, starts: np.ndarray | None = None) -> ParticleFits:
        """Every particle on its own, the effects' numbers held."""
        priors, N, varying = self.model.chosen_priors, len(self.tests), len(self.varying)
        middle = np.append(_centre(priors), 0.0)
        centre = np.broadcast_to(middle, (N, 5)).copy()
        centre[:, 4] = self.zero_mean
        width = np.broadcast_to(np.array([ALONE] * 4 + [priors.zero_um.sd]), (N, 5))
        width = np.pad(width, ((0, 0), (0, varying)), constant_values=1e-12)
        centre = np.concatenate([centre, np.asarray(theta)[:, list(self.varying)]], 1)
        if starts is None:
            starts = np.pad(linear_starts(self.tests, middle[3]), ((0, 0), (0, 0), (0, varying)))
        return self.particles(white, centre, width, theta, self.blocks.cut(jnp.asarray(starts), axis=1))

    def together(self, target: LogPosterior, free: Float[Array, " d"]) -> Point:
        """Every particle under the population, from where it was and where the summaries expect it."""
        before, expected, varying = self.point, expect(free, target), list(self.varying)
        width = np.maximum(np.asarray(expected.sd), NARROWEST)
        zero_sd = np.full(len(self.tests), self.model.chosen_priors.zero_um.sd)
        spread = np.maximum(np.asarray(expected.theta_sd), 1e-12)
        centre = np.column_stack([expected.mean, self.zero_mean, np.asarray(expected.theta_mean)])
        widths = np.column_stack([width, zero_sd, spread])
        own = np.asarray(expected.theta)[:, varying]
        places = (before.latent, before.zero), (expected.latent, expected.zero), (expected.mean, before.zero)
        several = np.stack([np.column_stack([latent, zero, own]) for latent, zero in places])
        starts = self.blocks.cut(jnp.asarray(several), axis=1)
        return self.particles(self.white, centre, widths, expected.theta, starts).point

    @property
    def zero_mean(self) -> np.ndarray:
        """Where the zeros of displacement are expected [um]."""
        return np.asarray(self.tests.contact) + self.model.chosen_priors.zero_um.mean

    def step(self, target: LogPosterior, before: Array, after: Array) -> Array:
        """A step of Gauss-Newton of population and particles, halved while the density, with the tests linearised where
        it ends, is lower than where it begins; where the population then is."""
        least, share = _density(before, target) - LEAST_GAIN, 1.0
        while True:
            free = before + share * (after - before)
            point = self.together(target, free)
            linear = self.linearisation.at(point)
            marginal = replace(self.summaries(point, linear)[0], scatter=target.marginal.scatter)
            share /= 2
            if _density(free, replace(target, marginal=marginal)) > least or share < 0.5**HALVINGS:
                self.point, self.linear = point, linear
                return free


def fit_tests(
    tests: Tests,
    model: Model,
    read_out_um: float,
    *,
    correlated: bool = True,
    rounds: int = ROUNDS,
    block: int = 0,
    start: Start | None = None,
    progress: Progress = lambda _: None,
) -> Fit:
    """Fit particles, noise and population.

    Particles come first, each on its own. Then, in turns: the noise from residuals linear in the particles' numbers,
    the most probable population under the summaries, the most probable particles under that population. The noise is
    what is left under the model at hand: with effects it is not estimated before they are in, and every further step is
    halved until the tests are more probable where it ends (`_Fitter.step`).

    Args:
        read_out_um: noise of displacement from point to point, a first guess [um].
        correlated: estimate the whole noise; if False, white noise of the residuals' median modulus, which outliers do
            not move.
        rounds: how often noise, population and particles take turns, at least.
        block: particles of a block, of which there is a whole number; 0 for all in one.
        start: where to begin; the last turn is then the only one, unless the tests want more.
    """
    check_prior_of_a(model.chosen_priors, np.asarray(tests.flatness))
    N, effects, count = len(tests), bool(model.effects), count_of(tests)
    fitter = _Fitter(tests, model, Blocks(N, block), progress)
    first = fitter.begin(max(read_out_um, 1e-4)) if start is None else fitter.begin_at(start)
    begun = 0 if start is None else rounds
    free, turn = None, begun
    while True:
        last = turn >= (max(rounds, MOST_ROUNDS) if effects else rounds)
        if not correlated:
            fitter.take_white_noise()
        elif (last and turn > begun) or (effects and not turn):
            fitter.summarise()
        else:  # with effects no round knows that it is the last
            fitter.take_noise(uncertainty=effects or turn >= rounds - 1)
        progress("fitting the population")
        target = LogPosterior(model, fitter.marginal)
        before = target.unconstrain(first) if free is None else free
        target = careful_enough(before, target, count)
        free, covariance, mode_converged = most_probable(before, target)
        if effects and not turn:  # amplitudes of zero say nothing about further numbers
            free = jnp.where(jnp.asarray(["." in name for name in target.names]), before, free)
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
        target = careful_enough(free, LogPosterior(model, fitter.marginal), count)
        free, covariance, mode_converged = most_probable(free, target)
    alone = bool(np.all(np.asarray(fitter.individual.converged)[:count]))
    return Fit(
        model,
        fitter.weighted[0],
        fitter.individual,
        fitter.noise,
        fitter.blocks.whole(fitter.filters),
        fitter.point,
        fitter.residual,
        target.marginal,
        free,
        covariance,
        np.asarray([alone, fitter.noise.converged, mode_converged and finished]),
    )


def _widths(free: Array, covariance: Array, target: LogPosterior) -> np.ndarray:
    """Standard deviations of the effects' numbers that all particles share, each within half of a number that is not
    0; of the logarithm of a positive one, up to `WIDEST`."""
    slope = np.asarray(theta_slope(free, target))
    sd = np.sqrt(np.maximum(np.einsum("kd,de,ke->k", slope, np.asarray(covariance), slope), 1e-300))
    middle = np.abs(np.asarray(population_of(free, target).theta))
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


def _rows(tree: Any, rows: np.ndarray) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), tree)


def _centre(priors: Priors) -> np.ndarray:
    """Centre of b1, b3, b5, e for what a curve alone does not say: the prior's, at the paper's typical shape factor."""
    log_eta = np.log(1.4)
    C = np.array([np.log(priors.C1.median), priors.log_C3, np.log(priors.C5.median)])
    return np.append(C + log_eta, np.log(priors.effective_modulus_MPa.median))


def _start(latent: np.ndarray, flatness: np.ndarray, model: Model) -> dict[str, float]:
    """Where to look for the population: the prior's a and the particles' own median and scatter under it."""
    priors = model.chosen_priors
    most, least = max(flatness.max(), 1e-3), min(flatness.min(), -1e-3)
    a = float(np.clip(priors.a.mean, -0.9 / most, -0.9 / least))
    log_eta = np.log(1 + a * flatness)
    b = latent[:, :3] - log_eta[:, None]
    middle = np.median(b, axis=0) + log_eta.mean()
    start = {
        "a": a,
        "log_modulus": float(np.median(latent[:, 3] - model.shape_power * log_eta)),
        "log_noise_factor": 0.0,
    }
    for j, name in enumerate(("C1", "C3", "C5")):
        prior = getattr(priors, f"tau_{name}")
        tau = float(np.clip(np.std(b[:, j]), 0.05 * prior.sd, 2 * prior.sd))
        start |= {
            f"b{2 * j + 1}": float(middle[j]),
            f"tau_{name}_coordinate": float(SpreadCoordinate(prior).coordinate(tau)),
        }
    for name in ("modulus_scatter", "shape_scatter"):
        start[f"{name}_coordinate"] = float(SpreadCoordinate(getattr(priors, name)).coordinate(0.1))
    return start


def checked_settings(
    progress: Progress | None, model: Model | None, threshold_MPa: Any
) -> tuple[Progress, Model, float]:
    """What all calibrations share, with defaults filled in; refuses what is of the wrong kind or out of its range."""
    progress = progress or (lambda _: None)
    threshold = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    return progress, model or Model(), threshold
