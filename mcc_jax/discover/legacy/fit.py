"""The joint fit that both methods share: particles, noise, population, and their best compromise."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._errors import InputError
from ..._memory import make_room
from ...calibrate.paper.prediction import point_noise_um
from ...calibrate.priors import Priors
from ...campaign import Campaign
from ...law import Unloading
from .compiling import compiled
from .data import Selection, Tests, select_tests
from .linearise import careful_enough, expected_latent, linear_data, summarise
from .model import JointFit, Model, log_C3, prior_numbers
from .noise import Noise, estimate_noise, particle_scales
from .particle_fit import FIRST_STEPS, MAX_STEPS, Particles, fit_particles, linear_starts
from .population import Population, Scatter, Summary
from .settings import noise_prior
from .sharding import Blocks, Parts, block_size, count_of, filled_up, require_same
from .transforms import LogPosterior, PriorNumbers, constrain, most_probable, recentred, unconstrain

WIDE = 1.5
"""Standard deviation of the logarithms that a particle by itself is allowed, around the prior's centre: no more than
what keeps a coefficient finite about which its curve says nothing."""

MIN_WIDTH = 1e-3
"""Least such standard deviation under the population: any smaller and the problem is badly scaled."""

NOISE_BLOCKS = 4
"""The noise of campaigns of more blocks is estimated from the particles of so many, spread evenly over the campaign:
fifty thousand points say enough about four numbers."""

ROUNDS = 2
"""Noise, population and particles depend on each other a little: how often they are taken in turn."""


def prepare(
    campaign: Campaign,
    model: Model,
    threshold_MPa: float,
    *,
    fill_up: bool = True,
    block: int | None = None,
    meanwhile: Callable[[Tests, int], None] | None = None,
    tell: Callable[[str], None] = lambda _: None,
    **settings: Any,
) -> tuple[Selection, Tests, JointFit, int]:
    """What every joint calibration begins with: points and particles selected, filled up to blocks, and fitted.

    Args:
        campaign: the tests.
        model: what is assumed.
        threshold_MPa: points below this stress on loading do not count [MPa].
        fill_up: let copies that count for nothing make up whole blocks; if False, all particles are one block.
        block: particles of a block; by default `block_size` of their number.
        meanwhile: called with the tests and the size of a block in a thread of its own while the fit runs.
        tell: called with the name of each step.
        settings: of `fit_joint`.

    Returns:
        What was selected, the tests with copies that fill up, their fit, and the size of a block.

    Raises:
        InputError: if no particle can be used, numbers overflow, or processes were given different tests.
        ValueError: for blocks of no particles.
    """
    if block is not None and block < 1:
        raise ValueError(f"a block must have at least one particle, got {block}")
    make_room()
    tell("selecting points")
    selection = select_tests(campaign, threshold_MPa=threshold_MPa)
    require_same(selection.tests)
    size = (block or block_size(len(selection.tests))) if fill_up else len(selection.tests)
    tests = filled_up(selection.tests, size) if fill_up else selection.tests
    read_out = float(np.median([point_noise_um(campaign.curves[i]) for i in selection.kept]))
    aside = None
    if meanwhile is not None:
        # No daemon: a compiler must not outlive the interpreter. Who interrupts the fit need not wait for it here.
        aside = threading.Thread(target=meanwhile, args=(tests, size))
        aside.start()
    fit = fit_joint(tests, model, read_out, block=size, tell=tell, **settings)
    if aside is not None:
        aside.join()
    if not all(np.isfinite(np.asarray(part)).all() for part in (fit.latent, fit.zero, fit.mode, fit.covariance)):
        raise beyond_numbers(campaign, selection)
    return selection, tests, fit, size


def beyond_numbers(campaign: Campaign, selection: Selection) -> InputError:
    """The error of tests whose fit ends in no numbers, with the ranges that it was asked to describe."""
    tests = selection.tests
    mask = np.asarray(tests.mask)
    stress = 1e3 * np.asarray(tests.force) / (np.pi * np.asarray(tests.effective_diameter)[:, None] ** 2 / 4)
    strain = np.asarray(tests.displacement) - np.asarray(tests.contact)[:, None]
    strain = np.abs(strain) / np.asarray(tests.effective_diameter)[:, None]
    top = np.where(mask, stress, 0.0).max(1)
    deepest = np.where(mask, strain, 0.0).max(1)
    names = [repr(campaign.particles[i]) for i in selection.kept]
    most = int(np.argmax(top))
    deep = int(np.argmax(deepest))
    return InputError(
        "the law cannot be fitted to these tests: their numbers overflow; the largest stress is "
        f"{top[most]:.3g} MPa (particle {names[most]}), the largest displacement {deepest[deep]:.3g} times the size "
        f"(particle {names[deep]})",
        file=campaign.source or None,
        remedy="Check the units of force, displacement and diameters, or leave that particle out.",
    )


def fit_joint(
    tests: Tests,
    model: Model,
    read_out_um: float,
    *,
    correlated: bool = True,
    rounds: int = ROUNDS,
    block: int = 0,
    tell: Callable[[str], None] = lambda _: None,
) -> JointFit:
    """Fit particles, noise and population.

    Particles come first, each on its own. Then, in turns: the noise from residuals linear in the particles' parameters,
    the most probable population under the quadratic summaries, the most probable particles under that population.

    Args:
        tests: the measurements.
        model: what is assumed.
        read_out_um: noise of displacement from point to point, a first guess [um].
        correlated: estimate the whole noise; if False, white noise of the residuals' median modulus, which outliers do
            not move.
        rounds: how often noise, population and particles take turns.
        block: particles of a block (`Blocks`), of which there is a whole number; 0 for all in one.
        tell: called with the name of each step.
    """
    zero_sd, priors = model.zero_sd, model.chosen_priors
    flatness = tests.flatness
    numbers = prior_numbers(priors, flatness, tests.weight)
    read_out = max(read_out_um, 1e-4)
    tell("fitting every particle")
    N = len(tests)
    count = count_of(tests)
    centre = np.broadcast_to(_centre(priors), (N, 4))
    blocks = Blocks(N, block)
    own = blocks.cut(tests)

    def fitted(sizes: Any, middle: Any, width: Any, starts: Parts) -> Particles:
        arrays = (jnp.asarray(sizes), jnp.asarray(middle), jnp.asarray(width))
        return _fitted(blocks, tests, own, arrays, zero_sd, starts, model.unloading)

    starts = blocks.each(linear_starts, own, jnp.asarray(centre[0, 3]), axis=1)
    individual = fitted(np.full(N, read_out), centre, np.full((N, 4), WIDE), starts)
    latent, zero = individual.latent, individual.zero
    four = [read_out, *np.asarray(noise_prior(priors).median)[1:]]
    noise = Noise.of(four, jnp.asarray(np.ones(len(tests))))
    log_sd, noise_converged = jnp.asarray(np.full(4, np.nan)), True
    numbers, free = _start(np.asarray(latent)[:count], np.asarray(flatness)[:count], model, numbers)

    def summarised(at: tuple[Parts, Parts], data: Parts, noise: Noise) -> tuple[Summary, Parts, Array]:
        """All particles' summaries, this process's own filters, and the white noise of equal weight."""
        found = blocks.each(summarise, *at, own, data, blocks.cut(noise), zero_sd)
        summaries, filters, white = (Parts(tuple(wave[k] for wave in found.waves)) for k in range(3))
        return blocks.whole(summaries), filters, blocks.whole(white)

    turn = 0
    while True:
        at = blocks.cut(latent), blocks.cut(zero)
        data = blocks.each(linear_data, *at, own, zero_sd, model.unloading)
        if not correlated:
            residual = np.asarray(blocks.whole(Parts(tuple(wave.residual for wave in data.waves))))[:count]
            width = 1.4826 * np.median(np.abs(residual[np.asarray(tests.mask)[:count]]))
            none = jnp.asarray(0.0)
            noise = Noise(jnp.asarray(max(width, 1e-9)), none, none, jnp.asarray(1.0), jnp.asarray(np.ones(N)))
        elif turn < rounds:
            tell("estimating the noise")
            chosen, some, start = blocks, data, noise
            if blocks.number > NOISE_BLOCKS:
                rows = np.linspace(0, count - 1, NOISE_BLOCKS * blocks.size).astype(int)
                chosen, start = Blocks(len(rows), blocks.size), replace(noise, scale=noise.scale[rows])
                at_rows = (chosen.cut(v) for v in _rows((latent, zero, tests), rows))
                some = chosen.each(linear_data, *at_rows, zero_sd, model.unloading)
            four, log_sd, noise_converged = estimate_noise(
                some, noise_prior(priors), start, uncertainty=turn == rounds - 1, blocks=chosen
            )
            noise = replace(four, scale=noise.scale)
        summary, filtered, white = summarised(at, data, noise)
        if correlated and turn < rounds:
            old = np.asarray(noise.scale)
            parts = (old, np.asarray(summary.squares), np.asarray(summary.count) - 4)
            scale = np.pad(particle_scales(*(part[:count] for part in parts)), (0, N - count), mode="edge")
            if np.any(scale != old):
                noise = eqx.tree_at(lambda n: n.scale, noise, jnp.asarray(scale))
                summary, filtered, white = summarised(at, data, noise)
        tell("fitting the population")
        if turn:
            numbers, free = recentred(numbers, free)
        target = LogPosterior(numbers, summary, model.scatter)
        target = replace(target, scatter=careful_enough(free, target, count))
        free, covariance, mode_converged = most_probable(free, target)
        if turn == rounds:
            break
        turn += 1
        tell("fitting every particle")
        expected = expected_latent(free, target)
        several = (latent, zero), (expected.latent, expected.zero), (expected.mean, zero)
        # By NumPy, here and wherever a handful of numbers is put together once: JAX would compile every operation.
        starts = jnp.asarray(np.stack([np.column_stack([np.asarray(w), np.asarray(z)]) for w, z in several]))
        width = np.maximum(np.asarray(expected.sd), MIN_WIDTH)
        found = fitted(white, expected.mean, width, blocks.cut(starts, axis=1))
        latent, zero = found.latent, found.zero
    converged = np.asarray([bool(np.all(np.asarray(individual.converged)[:count])), noise_converged, mode_converged])
    filters, residual = blocks.whole(filtered), blocks.whole(Parts(tuple(wave.residual for wave in data.waves)))
    return JointFit(
        individual, noise, log_sd, filters, latent, zero, residual, summary, free, covariance, numbers, converged
    )


def _rows(tree: Any, rows: np.ndarray) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[rows]), tree)


def _fitted(
    blocks: Blocks,
    tests: Tests,
    own: Parts,
    arrays: tuple[Array, Array, Array],
    zero_sd: Array,
    starts: Parts,
    unloading: Unloading,
) -> Particles:
    """Every particle by itself, all blocks; what is late in many of them goes on in blocks of its own.

    A block takes as long as its slowest particle, and nearly every block has one that is slow.

    Args:
        blocks: how the particles are cut.
        tests: of all particles.
        own: of this process.
        arrays: noise, centre and width, as in `fit_particles`.
        zero_sd, starts, unloading: as there.
    """

    def fit(blocks: Blocks, own: Parts, arrays: Iterable[Array], starts: Parts, most_steps: int) -> Particles:
        cut = (blocks.cut(v) for v in arrays)
        steps = jnp.asarray(np.asarray(most_steps))
        return blocks.whole(blocks.each(fit_particles, own, *cut, zero_sd, starts, unloading, steps))

    if blocks.whole_here:
        return fit(blocks, own, arrays, starts, MAX_STEPS)
    found = fit(blocks, own, arrays, starts, FIRST_STEPS)
    late = np.flatnonzero(~np.asarray(found.settled))
    if not len(late):
        return found
    rows = np.pad(late, (0, -len(late) % blocks.size), mode="edge")
    few = Blocks(len(rows), blocks.size)
    ends = few.cut(np.moveaxis(np.asarray(found.ends)[rows], 1, 0), axis=1)
    again = fit(few, few.cut(_rows(tests, rows)), _rows(arrays, rows), ends, MAX_STEPS)
    return jax.tree.map(lambda x, y: x.at[late].set(y[: len(late)]), found, again)


def _centre(priors: Priors) -> np.ndarray:
    """Centre of b1, b3, b5, e for what a curve alone does not say: the prior's, at the paper's typical shape factor."""
    log_eta = np.log(1.4)
    C = np.array([np.log(priors.C1.median), log_C3(priors), np.log(priors.C5.median)])
    return np.append(C + log_eta, np.log(priors.effective_modulus_MPa.median))


@compiled
def population_at(free: Float[Array, " d"], numbers: PriorNumbers, scatter: Scatter) -> Population:
    """The population at unbounded coordinates."""
    return constrain(free, numbers, scatter)[0]


@compiled
def populations(free: Float[Array, "draws d"], numbers: PriorNumbers, scatter: Scatter) -> Population:
    """Populations of many unbounded coordinates, every field with a leading axis."""
    return jax.vmap(lambda f: constrain(f, numbers, scatter)[0])(free)


def _start(
    latent: np.ndarray, flatness: np.ndarray, model: Model, numbers: PriorNumbers
) -> tuple[PriorNumbers, Float[Array, " d"]]:
    """Where to look for the population, the prior's a and the particles' own median and scatter under it; and the
    coordinates centred there."""
    priors = model.chosen_priors
    low, high = np.asarray(numbers.a)[2:]
    a = float(np.clip(priors.a.mean, 0.9 * low, 0.9 * high))
    log_eta = np.log(1 + a * flatness)
    b = latent[:, :3] - log_eta[:, None]
    log_modulus = float(np.median(latent[:, 3] - model.shape_power * log_eta))
    scales = np.array([priors.tau_C1.sd, priors.tau_C3.sd, priors.tau_C5.sd])
    tau = np.clip(np.std(b, axis=0), 0.05 * scales, 2 * scales)
    numbers = eqx.tree_at(lambda n: n.centre, numbers, jnp.asarray(np.median(latent[:, :3], axis=0)))
    return numbers, unconstrain(a, log_modulus, np.median(b, axis=0), tau, numbers, model.scatter)
