"""Where the search begins: the tests, and the base law at its fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Progress
from ..calibrate.data import Selection, Tests, ranges_um, root_mean_squares
from ..calibrate.fitting import in_own_units, prepare
from ..calibrate.forward import Forms, Point, snap
from ..calibrate.judgement import numbers_in_reach
from ..calibrate.model import Model
from ..calibrate.priors import SpreadCoordinate
from ..calibrate.sharding import Blocks
from ..campaign import Campaign, find_segments
from .settings import DECISIONS

BLOCK = 8  # particles that are linearised at once: one program for any number of them


class State(eqx.Module):
    """Where a hypothesis is linearised."""

    point: Point  # every particle's numbers, its zero, and those of the effects
    population: Float[Array, " 5"]  # a, log modulus, and the means of b1, b3, b5 at the campaign's average shape

    def with_numbers(self, numbers: np.ndarray) -> State:
        """The same with numbers of effects, the same for all particles."""
        shape = (len(self.point.zero), len(numbers))
        return State(replace(self.point, theta=jnp.asarray(np.broadcast_to(numbers, shape))), self.population)


@dataclass(frozen=True)
class Base:
    """The tests that take part, what is assumed, and the base law at its fit."""

    campaign: Campaign
    selection: Selection  # which points of the tests
    model: Model  # without effects; the modulus may scatter between particles
    tests: Tests
    scale: np.ndarray  # each particle's own factor on the noise [-]
    state: State  # where the base law fits
    hyperparameters: np.ndarray  # logs of the noise's four numbers, coordinates of the spreads of b1, b3, b5 and e
    converged: bool  # whether noise and population did
    threshold_MPa: float  # stress below which points do not count
    coarse: bool  # whether few readings of each branch are compared, see `base_fit`
    rms_um: np.ndarray  # residual of each particle's own fit
    range_um: np.ndarray  # of the displacement of every test

    @property
    def forms(self) -> Forms:
        """Formulas of the base law."""
        return Forms(self.model.unloading)

    @property
    def holds_out(self) -> bool:
        """Whether there are particles enough to hold one out."""
        return len(self.tests) > 2

    @property
    def readings(self) -> int:
        """How many readings are compared."""
        return int(np.sum(np.asarray(self.tests.mask)))

    @property
    def spreads(self) -> tuple[Any, ...]:
        """Priors of the spreads of b1, b3, b5 and e."""
        p = self.model.chosen_priors
        return p.tau_C1, p.tau_C3, p.tau_C5, p.modulus_scatter

    @cached_property
    def flatness(self) -> np.ndarray:
        """1 - D3^2/(D1 D2) of every particle [-]."""
        return np.asarray(self.tests.flatness)

    @cached_property
    def zero_prior(self) -> np.ndarray:
        """Mean and standard deviation of the zeros, from the recorded contact [um]."""
        return np.asarray(self.model.zero_prior)

    @cached_property
    def population_prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Prior of `State.population`: mean, and factor of the covariance."""
        p = self.model.chosen_priors
        mean, factor = np.zeros(5), np.zeros((5, 5))
        mean[0], factor[0, 0] = p.a.mean, p.a.sd
        mean[1], factor[1, 1] = np.log(p.effective_modulus_MPa.median), p.effective_modulus_MPa.log_sd
        mean[2], factor[2, 2] = np.log(p.C1.median), p.C1.log_sd
        mean[4], factor[4, 4] = np.log(p.C5.median), p.C5.log_sd
        # The softening 9 C3^6 / (20 C1 C5^5) has a prior of its own.
        mean[3] = (np.log(20 / 9) + mean[2] + 5 * mean[4] + np.log(p.softening.median)) / 6
        factor[3, 2], factor[3, 4], factor[3, 3] = factor[2, 2] / 6, 5 * factor[4, 4] / 6, p.softening.log_sd / 6
        return mean, factor

    def each(self, function: Callable[..., Any], point: Point, *shared: Any) -> Any:
        """A compiled function of points and tests, block by block: it is compiled once for any number of particles."""
        return Blocks(len(self.tests), BLOCK).all(function, (point, self.tests), *shared)

    def name_of(self, row: int) -> str:
        """The particle of a row of the tests."""
        return self.campaign.particles[self.selection.kept[row]]

    @property
    def snaps(self) -> np.ndarray:
        """Where the law snaps through below a test's largest force: there no displacement belongs to a force."""
        log_force = np.asarray(jax.vmap(snap)(self.state.point.latent, self.tests.particle))
        return log_force < np.log(np.max(np.where(self.tests.mask, self.tests.force, 1e-300), axis=1))

    @property
    def snapping(self) -> tuple[str, ...]:
        """The particles of those tests."""
        return tuple(name for name, low in zip(self.names, self.snaps, strict=True) if low)

    @property
    def names(self) -> tuple[str, ...]:
        """The particles of all rows."""
        return tuple(map(self.name_of, range(len(self.tests))))


def base_fit(campaign: Campaign, model: Model, *, threshold_MPa: float, progress: Progress) -> Base:
    """Fit the base law to a campaign.

    Of a material that the law was not made for, and does not fit, only some readings of each branch are compared: what
    is left is every particle's own over a good part of its branch, so that neighbouring readings agree, and
    hundreds of them would decide by how smooth they are. That is a coarsened posterior (Miller and Dunson 2019, J. Am.
    Stat. Assoc. 114, 1113).

    Raises:
        InputError: if no particle can be used, or the numbers are beyond arithmetic.
    """
    with numbers_in_reach(campaign):
        model, foreign = in_own_units(campaign, model)
        selection, fit, _ = prepare(campaign, model, threshold_MPa, progress=progress)
        share = np.median(root_mean_squares(fit.tests, fit.residual) / ranges_um(fit.tests))
        coarse = foreign is not None and bool(share > DECISIONS.foreign_misfit)
        if coarse:
            branches = int(np.median([len(find_segments(curve)) for curve in campaign.curves]))
            most = DECISIONS.readings * branches
            selection, fit, _ = prepare(campaign, model, threshold_MPa, most_points=most, progress=progress)
    p = fit.population
    shift = float(jnp.mean(jnp.log1p(p.a * fit.tests.flatness)))
    population = jnp.concatenate([jnp.stack([p.a, p.log_modulus]), p.mu + shift])
    point = replace(fit.point, theta=jnp.zeros((len(fit.tests), 0)))
    spreads = [*np.asarray(p.tau), max(float(p.modulus_scatter), 1e-3)]
    base = Base(
        campaign,
        selection,
        model,
        fit.tests,
        np.asarray(fit.noise.noise.scale),
        State(point, population),
        np.zeros(0),
        bool(np.all(np.asarray(fit.converged)[1:])),
        threshold_MPa,
        coarse,
        root_mean_squares(fit.tests, fit.residual),
        ranges_um(fit.tests),
    )
    x = [
        float(SpreadCoordinate(prior).coordinate(max(float(tau), 1e-4)))
        for prior, tau in zip(base.spreads, spreads, strict=True)
    ]
    # Where a spread is zero its coordinate has no slope: begin a little above it.
    logs = np.asarray(fit.noise.noise.logs)
    return replace(base, hyperparameters=np.concatenate([logs, np.maximum(x, 0.3)]))
