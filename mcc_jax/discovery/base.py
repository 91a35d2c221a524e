"""Where the search begins: the tests, and the base law at its fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
from ..calibrate.forward import Point
from ..calibrate.judgement import numbers_in_reach
from ..calibrate.numpyro_model import Model
from ..calibrate.particle_fit import snaps
from ..calibrate.priors import NakagamiPrior, SpreadCoordinate
from ..calibrate.running import Blocks
from ..campaign import Campaign, find_segments
from ..effects import Mechanism
from ..geometry import Particle
from ..law import Unloading
from .settings import DECISIONS

Library = Mapping[str, Mechanism]
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
    spreads: tuple[NakagamiPrior, ...]  # priors of the spreads of b1, b3, b5 and e
    threshold_MPa: float  # stress below which points do not count
    coarse: bool  # whether few readings of each branch are compared, see `base_fit`
    rms_um: np.ndarray  # residual of each particle's own fit

    @cached_property
    def flatness(self) -> np.ndarray:
        """1 - D3^2/(D1 D2) of every particle [-]."""
        return np.asarray(self.tests.flatness)

    @cached_property
    def population_prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Prior of `State.population`: mean, and factor of the covariance."""
        p = self.model.chosen_priors
        log_modulus, log_C1, log_C5 = (np.log(x.median) for x in (p.effective_modulus_MPa, p.C1, p.C5))
        factor = np.diag([p.a.sd, p.effective_modulus_MPa.log_sd, p.C1.log_sd, p.softening.log_sd / 6, p.C5.log_sd])
        factor[3, 2], factor[3, 4] = p.C1.log_sd / 6, 5 * p.C5.log_sd / 6  # log C3 by the softening, C1 and C5
        return np.array([p.a.mean, log_modulus, log_C1, p.log_C3, log_C5]), factor

    def each(self, function: Callable[..., Any], point: Point, *shared: Any) -> Any:
        """A compiled function of points and tests, block by block: it is compiled once for any number of particles."""
        return Blocks(len(self.tests), BLOCK).all(function, (point, self.tests), *shared)

    @property
    def names(self) -> tuple[str, ...]:
        """The particles of all rows."""
        return tuple(self.campaign.particles[i] for i in self.selection.kept)

    @property
    def snaps(self) -> np.ndarray:
        """Where the law snaps through below a test's largest force: there no displacement belongs to a force."""
        log_force = np.asarray(snaps(self.state.point.latent, self.tests.particle))
        return log_force < np.log(self._largest_force)

    @property
    def _largest_force(self) -> np.ndarray:
        return np.max(np.where(self.tests.mask, self.tests.force, 1e-300), axis=1)

    def in_form(self, unloading: Unloading) -> Base:
        r"""The same tests and the law in another form of unloading, with moduli by which their peaks unload as before.

        .. math:: k' (E'/\sigma_P)^{n'} = k (E/\sigma_P)^n
        """
        model, form, point = self.model, self.model.unloading, self.state.point
        modulus = in_own_units(self.campaign, Model(unloading))[0].chosen_priors.effective_modulus_MPa
        model = replace(model, unloading=unloading, priors=replace(model.chosen_priors, effective_modulus_MPa=modulus))
        log_stress = np.log(jax.vmap(Particle.stress)(self.tests.particle, jnp.asarray(self._largest_force)))
        power = form.stress_power / unloading.stress_power
        constant = np.log(form.constant / unloading.constant) / unloading.stress_power

        def changed(log_modulus: Any, log_stress: Any) -> Any:
            return log_stress + power * (log_modulus - log_stress) + constant

        latent, population = np.array(point.latent), np.array(self.state.population)
        latent[:, 3] = changed(latent[:, 3], log_stress)
        population[1] = changed(population[1], log_stress.mean())
        state = State(replace(point, latent=jnp.asarray(latent)), jnp.asarray(population))
        return replace(self, model=model, state=state)


def base_fit(campaign: Campaign, model: Model, *, threshold_MPa: float, progress: Progress) -> Base:
    """Fit the base law to a campaign; InputError if no particle can be used, or the numbers are beyond arithmetic.

    Of a material that the law does not fit only some readings of each branch are compared: what is left is smooth over
    a good part of a branch, and hundreds of readings would decide by how smooth. That is a coarsened posterior
    (Miller and Dunson 2019, J. Am. Stat. Assoc. 114, 1113).
    """
    with numbers_in_reach(campaign):
        model, foreign = in_own_units(campaign, model)
        selection, fit = prepare(campaign, model, threshold_MPa, progress=progress)
        share = np.median(root_mean_squares(fit.tests, fit.residual) / ranges_um(fit.tests))
        coarse = foreign is not None and bool(share > DECISIONS.foreign_misfit)
        if coarse:
            branches = int(np.median([len(find_segments(curve)) for curve in campaign.curves]))
            most = DECISIONS.readings * branches
            selection, fit = prepare(campaign, model, threshold_MPa, most_points=most, progress=progress)
    p, priors, noise = fit.population, model.chosen_priors, fit.noise.noise
    shift = np.mean(np.log1p(np.asarray(p.a) * np.asarray(fit.tests.flatness)))
    population = jnp.asarray(np.concatenate([[p.a, p.log_modulus], np.asarray(p.mu) + shift]))
    spreads = priors.tau_C1, priors.tau_C3, priors.tau_C5, priors.modulus_scatter
    found = np.maximum([*np.asarray(p.tau), max(float(p.modulus_scatter), 1e-3)], 1e-4)
    x = [float(SpreadCoordinate(prior).coordinate(tau)) for prior, tau in zip(spreads, found.tolist(), strict=True)]
    return Base(
        campaign=campaign,
        selection=selection,
        model=model,
        tests=fit.tests,
        scale=np.asarray(noise.scale),
        state=State(replace(fit.point, theta=jnp.zeros((len(fit.tests), 0))), population),
        # Where a spread is zero its coordinate has no slope: begin a little above it.
        hyperparameters=np.concatenate([np.asarray(noise.logs), np.maximum(x, 0.3)]),
        spreads=spreads,
        threshold_MPa=threshold_MPa,
        coarse=coarse,
        rms_um=root_mean_squares(fit.tests, fit.residual),
    )
