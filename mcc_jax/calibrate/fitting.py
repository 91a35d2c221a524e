"""The fit that least squares, posterior and evidence start from: particles, noise and population in agreement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._memory import make_room
from ..campaign import THRESHOLD_MPA, Campaign, other_material
from .compiling import compiled
from .data import Selection, Tests, point_noise_um, select
from .distributions import SpreadCoordinate
from .fit_result import Fit, population_of
from .forward import Point
from .linearisation import Linearisation, linear_data, start_of_effects
from .marginal import Marginal, summarise
from .mode import LogPosterior, careful_enough, expect, gradients, most_probable
from .model import Model, check_prior_of_a
from .noise import Noise, NoiseFit, estimate_noise, particle_scales, squared_innovations, student_weights
from .particle_fit import ParticleFits, fit_particles, linear_starts
from .priors import Priors
from .settings import FIT
from .sharding import Blocks, Parts, block_size, count_of, filled_up, require_same


def prepare(
    campaign: Campaign,
    model: Model,
    threshold_MPa: float = THRESHOLD_MPA,
    *,
    fill_up: bool = True,
    block: int | None = None,
    tell: Callable[[str], None] = lambda _: None,
    **settings: Any,
) -> tuple[Selection, Fit, int]:
    """What every calibration begins with: points and particles selected, filled up to blocks, and fitted.

    Args:
        model: with priors as `in_own_units` has them.
        fill_up: let copies that count for nothing make up whole blocks; if False, all particles are one block.
        block: particles of a block; by default `block_size` of their number.
        settings: of `fit_tests`.

    Returns:
        What was selected, the fit of the tests with copies that fill up, and the size of a block.

    Raises:
        InputError: if no particle can be used, numbers overflow, or processes were given different tests.
    """
    make_room()
    tell("selecting points")
    selection = select(campaign, threshold_MPa=threshold_MPa)
    require_same(selection.tests)
    size = (block or block_size(len(selection.tests))) if fill_up else len(selection.tests)
    tests = filled_up(selection.tests, size) if fill_up else selection.tests
    read_out = float(np.median([point_noise_um(campaign.curves[i]) for i in selection.kept]))
    found = fit_tests(tests, model, read_out, block=size, tell=tell, **settings)
    parts = (found.point.latent, found.point.zero, found.mode, found.covariance)
    if not all(np.isfinite(np.asarray(part)).all() for part in parts):
        raise beyond_numbers(campaign, selection)
    return selection, found, size


def in_own_units(campaign: Campaign, model: Model) -> tuple[Model, str | None]:
    """The model with priors in the campaign's own stress and strain, if its material is not like cellulose.

    Priors that were given stay.

    Returns:
        The model, and what a reader must know; None where nothing was changed.
    """
    if model.priors is not None:
        return model, None
    material = other_material(campaign)
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
    """The turns of a fit: what stays the same in all of them."""

    def __init__(self, tests: Tests, model: Model, blocks: Blocks, tell: Callable[[str], None]) -> None:
        self.tests, self.model, self.blocks, self.tell = tests, model, blocks, tell
        if model.robust:
            self.tests = replace(tests, reading_weight=jnp.asarray(np.ones(tests.mask.shape)))
        self.count, self.own = count_of(tests), blocks.cut(self.tests)
        self.linear = Linearisation(self.tests, model, blocks)
        self.weighted = self.tests, self.own
        self.flatness = tests.flatness
        self.varying = tuple(k for k, _ in model.scatter.varying)

    def summaries(self, point: Point, linear: Parts, noise: Noise) -> tuple[Marginal, Parts, Array]:
        """All particles' summaries, this process's own filters, and the white noise of equal weight."""
        m, cut = self.model, self.blocks.cut
        kinds = m.zero_prior, m.scatter, m.correlation, m.along
        places = cut(point), cut(self.linear.straight)
        found = self.blocks.each(summarise, *places, self.weighted[1], linear, cut(noise), *kinds)
        marginal, filters, white = (Parts(tuple(wave[k] for wave in found.waves)) for k in range(3))
        return self.blocks.whole(marginal), filters, self.blocks.whole(white)

    def weigh(self, filters: Parts, linear: Parts, noise: Noise) -> None:
        """Weights of the readings under Student noise, anew; `weighted` are the tests as inference takes them."""
        blocks = self.blocks
        squares = np.asarray(
            blocks.whole(blocks.each(squared_innovations, self.weighted[1], filters, linear, blocks.cut(noise)))
        )
        weight, overstated = student_weights(squares, np.asarray(self.tests.mask))
        self.tests = replace(self.tests, reading_weight=jnp.asarray(weight))
        weighted = replace(self.tests, reading_weight=jnp.asarray(weight / overstated))
        self.own, self.weighted = blocks.cut(self.tests), (weighted, blocks.cut(weighted))

    def estimated(self, point: Point, linear: Parts, start: Noise, *, uncertainty: bool) -> NoiseFit:
        """The noise, of very many particles from some of them."""
        self.tell("estimating the noise")
        m, blocks, own = self.model, self.blocks, self.own
        if blocks.number > FIT.noise_blocks:
            rows = np.linspace(0, self.count - 1, FIT.noise_blocks * blocks.size).astype(int)
            blocks = Blocks(len(rows), blocks.size)
            own = blocks.cut(_rows(self.tests, rows))
            linear = blocks.each(linear_data, blocks.cut(_rows(point, rows)), own, m.forms)
            some = replace(start, scale=start.scale[rows])
        else:
            some = start
        prior = m.chosen_priors.noise
        found = estimate_noise(
            own, linear, m.zero_prior[1], prior, some, m.correlation, m.along, uncertainty=uncertainty, blocks=blocks
        )
        return replace(found, noise=replace(found.noise, scale=start.scale))

    def particles(
        self, white: Array | np.ndarray, centre: np.ndarray, width: np.ndarray, theta: Any, starts: Parts
    ) -> ParticleFits:
        """Every particle by itself, all blocks; what is late in many of them goes on in blocks of its own.

        A block takes as long as its slowest particle, and nearly every block has one that is slow.
        """
        self.tell("fitting every particle")
        arrays = tuple(jnp.asarray(np.asarray(v)) for v in (white, centre, width, theta))

        def fit(blocks: Blocks, own: Parts, arrays: Any, starts: Parts, most_steps: int) -> ParticleFits:
            cut = [blocks.cut(v) for v in arrays]
            steps = jnp.asarray(np.asarray(most_steps))
            return blocks.whole(blocks.each(fit_particles, own, *cut, starts, self.model.forms, self.varying, steps))

        if self.blocks.whole_here:
            return fit(self.blocks, self.own, arrays, starts, FIT.steps)
        found = fit(self.blocks, self.own, arrays, starts, FIT.first_steps)
        late = np.flatnonzero(~np.asarray(found.settled))
        if not len(late):
            return found
        rows = np.pad(late, (0, -len(late) % self.blocks.size), mode="edge")
        few = Blocks(len(rows), self.blocks.size)
        ends = few.cut(np.moveaxis(np.asarray(found.ends)[rows], 1, 0), axis=1)
        again = fit(few, few.cut(_rows(self.tests, rows)), _rows(arrays, rows), ends, FIT.steps)
        return jax.tree.map(lambda x, y: x.at[late].set(y[: len(late)]), found, again)

    def alone(self, white: np.ndarray) -> ParticleFits:
        """Every particle on its own, without effects."""
        priors, N = self.model.chosen_priors, len(self.tests)
        middle = np.append(_centre(priors), 0.0)
        centre = np.broadcast_to(middle, (N, 5)).copy()
        centre[:, 4] = np.asarray(self.tests.contact) + priors.zero_um.mean
        width = np.broadcast_to(np.array([FIT.alone] * 4 + [priors.zero_um.sd]), (N, 5))
        starts = self.blocks.each(linear_starts, self.own, jnp.asarray(middle[3]), axis=1)
        if self.varying:
            centre, width = (np.pad(x, ((0, 0), (0, len(self.varying)))) for x in (centre, width))
            width[:, 5:] = 1e-12
            padded = ((0, 0), (0, 0), (0, len(self.varying)))
            starts = Parts(tuple(jnp.pad(wave, padded) for wave in starts.waves), 1)
        theta = np.broadcast_to(self.model.forms.without_effects, (N, len(self.model.forms.names)))
        return self.particles(white, centre, width, theta, starts)

    def together(self, white: Array, before: Point, target: LogPosterior, free: Float[Array, " d"]) -> Point:
        """Every particle under the population, from where it was and where the summaries expect it."""
        expected = expect(free, target)
        width = np.maximum(np.asarray(expected.sd), FIT.narrowest)
        varying = list(self.varying)
        own = np.asarray(expected.theta)[:, varying]
        zero_mean = np.asarray(self.tests.contact) + self.model.chosen_priors.zero_um.mean
        zero_sd = np.full(len(self.tests), self.model.chosen_priors.zero_um.sd)
        spread = np.maximum(np.asarray(expected.theta_sd), 1e-12)
        centre = np.column_stack([expected.mean, zero_mean, np.asarray(expected.theta_mean)])
        widths = np.column_stack([width, zero_sd, spread])
        several = [
            np.column_stack([latent, zero, own])
            for latent, zero in (
                (before.latent, before.zero),
                (expected.latent, expected.zero),
                (expected.mean, before.zero),
            )
        ]
        starts = self.blocks.cut(jnp.asarray(np.stack(several)), axis=1)
        return self.particles(white, centre, widths, expected.theta, starts).point

    def step(
        self, white: Array, noise: Noise, before: Point, target: LogPosterior, ends: tuple[Array, Array]
    ) -> tuple[Point, Parts, Array]:
        """Particles and population after a step of Gauss-Newton, halved while the density, with the tests linearised
        where it ends, is lower than where it begins.

        `ends` are where the step begins and ends, in unbounded coordinates.
        """
        least, share = _density(ends[0], target) - FIT.still, 1.0
        while True:
            free = ends[0] + share * (ends[1] - ends[0])
            point = self.together(white, before, target, free)
            linear = self.linear.at(point)
            marginal = replace(self.summaries(point, linear, noise)[0], scatter=target.marginal.scatter)
            share /= 2
            if _density(free, replace(target, marginal=marginal)) > least or share < 0.5**FIT.halvings:
                return point, linear, free


def fit_tests(
    tests: Tests,
    model: Model,
    read_out_um: float,
    *,
    correlated: bool = True,
    rounds: int = FIT.rounds,
    block: int = 0,
    tell: Callable[[str], None] = lambda _: None,
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
        block: particles of a block (`Blocks`), of which there is a whole number; 0 for all in one.
    """
    N, effects = len(tests), bool(model.effects)
    fitter = _Fitter(tests, model, Blocks(N, block), tell)
    count, blocks, priors = fitter.count, fitter.blocks, model.chosen_priors
    check_prior_of_a(priors, np.asarray(fitter.flatness))
    read_out = max(read_out_um, 1e-4)
    individual = fitter.alone(np.full(N, read_out))
    point = individual.point
    four = [read_out, *np.asarray(priors.noise.median)[1:]]
    noise = NoiseFit.unsure(Noise.of(four, jnp.asarray(np.ones(N))), converged=True)
    start = _start(np.asarray(point.latent)[:count], np.asarray(fitter.flatness)[:count], model)
    if effects:
        sites, theta = start_of_effects(point, tests, fitter.linear.at(point), noise.noise, model, blocks)
        start |= sites
        point = replace(point, theta=jnp.asarray(np.broadcast_to(theta, point.theta.shape)))
    free = None
    turn, uncertainty = 0, True
    linear = fitter.linear.at(point)
    while True:
        last = turn >= (max(rounds, FIT.most_rounds) if effects else rounds)
        if not correlated:
            residual = np.asarray(blocks.whole(Parts(tuple(wave.residual for wave in linear.waves))))[:count]
            width = 1.4826 * np.median(np.abs(residual[np.asarray(tests.mask)[:count]]))
            white_noise = Noise.of([max(width, 1e-9), 0.0, 0.0, 1.0], jnp.asarray(np.ones(N)))
            noise = replace(noise, noise=white_noise)
        elif (turn or not effects) and not last:
            # With effects no round knows that it is the last.
            uncertainty = effects or turn == rounds - 1
            noise = fitter.estimated(point, linear, noise.noise, uncertainty=uncertainty)
        marginal, filtered, white = fitter.summaries(point, linear, noise.noise)
        for _ in range(FIT.student_steps if model.robust and not last and (turn or not effects) else 0):
            fitter.weigh(filtered, linear, noise.noise)
            noise = fitter.estimated(point, linear, noise.noise, uncertainty=uncertainty)
            marginal, filtered, white = fitter.summaries(point, linear, noise.noise)
        if correlated and not last and (turn or not effects):
            old = np.asarray(noise.noise.scale)
            squares = np.asarray(marginal.gram)[:, -1, -1]
            scale = particle_scales(old[:count], squares[:count], np.asarray(marginal.count)[:count] - 4)
            scale = np.pad(scale, (0, N - count), mode="edge")
            if np.any(scale != old):
                noise = replace(noise, noise=replace(noise.noise, scale=jnp.asarray(scale)))
                marginal, filtered, white = fitter.summaries(point, linear, noise.noise)
        tell("fitting the population")
        target = LogPosterior(model, marginal)
        if free is None:
            free = target.unconstrain(start)
        before = free
        target = careful_enough(free, target, count)
        free, covariance, mode_converged = most_probable(free, target)
        if effects and not turn:  # amplitudes of zero tell nothing of further numbers
            free = jnp.where(jnp.asarray(["." in name for name in target.names]), before, free)
        gain = _density(free, target) - _density(before, target) if effects else 0.0
        at_rest = turn >= rounds and (not effects or gain < FIT.still)
        if last or at_rest:
            break
        turn += 1
        if effects and turn > 1:
            point, linear, free = fitter.step(white, noise.noise, point, target, (before, free))
        else:
            point = fitter.together(white, point, target, free)
            linear = fitter.linear.at(point)
    if effects:
        # Once more, with how the law bends over what is still open of the effects' numbers.
        linear = fitter.linear.at(point, _widths(free, covariance, target))
        marginal, filtered, white = fitter.summaries(point, linear, noise.noise)
        target = careful_enough(free, LogPosterior(model, marginal), count)
        free, covariance, mode_converged = most_probable(free, target)
    converged = np.asarray(
        [bool(np.all(np.asarray(individual.converged)[:count])), noise.converged, mode_converged and at_rest]
    )
    filters = blocks.whole(filtered)
    residual = blocks.whole(Parts(tuple(wave.residual for wave in linear.waves)))
    marginal = target.marginal
    return Fit(
        model, fitter.weighted[0], individual, noise, filters, point, residual, marginal, free, covariance, converged
    )


def _widths(free: Array, covariance: Array, target: LogPosterior) -> np.ndarray:
    """Standard deviations of the effects' numbers that all particles share, each within half of a number that is not
    0; of the logarithm of a positive one, up to `FIT.widest`."""
    slope = np.asarray(theta_slope(free, target))
    sd = np.sqrt(np.maximum(np.einsum("kd,de,ke->k", slope, np.asarray(covariance), slope), 1e-300))
    middle = np.abs(np.asarray(population_of(free, target).theta))
    width = np.minimum(sd, np.where(middle > 0, 0.5 * middle, np.inf))
    for k, _ in target.marginal.scatter.positive:
        width[k] = min(sd[k] / middle[k], FIT.widest)
    return width


@compiled
def theta_slope(free: Float[Array, " d"], target: LogPosterior) -> Float[Array, "numbers d"]:
    """Derivatives of the effects' numbers by the unbounded coordinates."""
    return jax.jacfwd(lambda x: target.population(x).theta)(free)


def _density(free: Array, target: LogPosterior) -> float:
    return -float(gradients(np.asarray(free)[None], target)[0][0])


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
    progress: Callable[[str], None] | None, model: Model | None, threshold_MPa: Any, block: int | None
) -> tuple[Callable[[str], None], Model, float]:
    """What all calibrations share, with defaults filled in; refuses what is of the wrong kind or out of its range."""
    tell = arguments.teller(progress)
    if model is not None:
        arguments.instance(model, Model, "model", "Make one with mcc_jax.Model().")
    if block is not None:
        arguments.whole(block, "block", least=1)
    threshold = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    return tell, model or Model(), threshold
