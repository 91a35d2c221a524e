"""What a joint calibration assumes of a campaign, and the fit that both methods start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ... import arguments
from ..._errors import InputError
from ...calibrate.priors import Priors
from ...law import StrainScaling, Unloading
from .noise import Noise, Whitening
from .particle_fit import Particles
from .population import Scatter, Summary
from .transforms import PriorNumbers

BLUR = 0.01
"""Width of a population's mean where nothing scatters, about: only a coordinate's scale."""

ALMOST = 0.98
"""Share of the way to the value of a at which a particle's shape factor would vanish."""


@dataclass(frozen=True)
class Model:
    """What is assumed about a campaign.

    Attributes:
        unloading: form of unloading, to which the modulus belongs.
        strain_scaling: how the shape factor enters unloading.
        modulus_scatter: let the modulus differ from particle to particle.
        shape_scatter: let `a` differ from particle to particle.
        priors: what is believed beforehand.

    Raises:
        InputError: for an unknown form (which may be given as its text), or what is no `Priors`.
    """

    unloading: Unloading
    strain_scaling: StrainScaling
    modulus_scatter: bool
    shape_scatter: bool
    priors: Priors | None

    def __init__(
        self,
        unloading: Unloading | str = Unloading.PRINTED,
        strain_scaling: StrainScaling | str = StrainScaling.RAW,
        modulus_scatter: bool = False,
        shape_scatter: bool = False,
        priors: Priors | None = None,
    ) -> None:
        if priors is not None:
            arguments.instance(priors, Priors, "priors", "Read them with mcc_jax.read_priors(file).")
        fields = {
            "unloading": arguments.member(unloading, Unloading, "unloading"),
            "strain_scaling": arguments.member(strain_scaling, StrainScaling, "strain_scaling"),
            "modulus_scatter": arguments.flag(modulus_scatter, "modulus_scatter"),
            "shape_scatter": arguments.flag(shape_scatter, "shape_scatter"),
            "priors": priors,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def scatter(self) -> Scatter:
        """What scatters, and the power of the strain scaling."""
        return Scatter(self.modulus_scatter, self.shape_scatter, self.shape_power)

    @property
    def shape_power(self) -> float:
        """Power of the shape factor in e: the scaling's, or half of it in the forms that square the modulus."""
        return self.strain_scaling.power / self.unloading.stress_power

    @property
    def chosen_priors(self) -> Priors:
        """The priors given, or the defaults for the form of unloading."""
        return self.priors or Priors.default(self.unloading)

    @property
    def zero_sd(self) -> Array:
        """Standard deviation of the zeros [um]."""
        return jnp.asarray(self.chosen_priors.zero_um.sd)


class JointFit(eqx.Module):
    """Particles, noise and population in agreement: the common starting point of least squares and posterior.

    Attributes:
        individual: every particle on its own.
        noise: the campaign's noise.
        noise_log_sd: standard deviations of the logarithms of its four numbers.
        filters: its filters at the latent vectors.
        latent, zero: most probable latent vectors and zeros [um].
        residual: measured less predicted displacement there [um], 0 where masked.
        summary: quadratic summaries there.
        mode, covariance: of the population in unbounded coordinates, given the summaries.
        numbers: its priors.
        converged: for particles, noise and population in turn.
    """

    individual: Particles
    noise: Noise
    noise_log_sd: Float[Array, " 4"]
    filters: Whitening
    latent: Float[Array, "particles 4"]
    zero: Float[Array, " particles"]
    residual: Float[Array, "particles points"]
    summary: Summary
    mode: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    numbers: PriorNumbers
    converged: Bool[np.ndarray, " 3"]

    def first(self, count: int) -> JointFit:
        """The same of the first `count` particles: without copies that only fill up."""

        def some(tree: Any) -> Any:
            return jax.tree.map(lambda x: x[:count], tree)

        return replace(
            self,
            individual=some(self.individual),
            noise=replace(self.noise, scale=self.noise.scale[:count]),
            filters=some(self.filters),
            latent=self.latent[:count],
            zero=self.zero[:count],
            residual=self.residual[:count],
            summary=some(self.summary),
            numbers=replace(self.numbers, flatness=self.numbers.flatness[:count], weight=None),
        )


def prior_numbers(
    priors: Priors, flatness: Float[Array, " particles"], weight: Float[Array, " particles"] | None = None
) -> PriorNumbers:
    """Priors as arrays; `a` is bounded to where every particle's shape factor is positive."""
    flat = np.asarray(flatness)
    most, least = max(flat.max(), 1e-3), min(flat.min(), -1e-3)
    # The bounds scale a coordinate; they are no belief, and stay far from where data or prior could want to go.
    reach = max(8 * priors.a.sd, 8.0)
    wide = priors.a.mean + np.array([-reach, reach])
    low, high = max(-ALMOST / most, wide[0]), min(-ALMOST / least, wide[1])
    if not (low < high and low < priors.a.mean + 6 * priors.a.sd and high > priors.a.mean - 6 * priors.a.sd):
        raise InputError(
            f"the prior of a ({priors.a.mean:g} +- {priors.a.sd:g}) leaves no value under which every particle's shape "
            f"factor is positive ({-ALMOST / most:.3g} < a < {-ALMOST / least:.3g})",
            remedy="Widen the prior, or check the diameters.",
        )

    def log_pair(prior):
        return jnp.asarray([np.log(prior.median), prior.log_sd])

    spreads = (priors.tau_C1, priors.tau_C3, priors.tau_C5, priors.modulus_scatter, priors.shape_scatter)
    return PriorNumbers(
        a=jnp.asarray([priors.a.mean, priors.a.sd, low, high]),
        log_modulus=log_pair(priors.effective_modulus_MPa),
        mu_1=log_pair(priors.C1),
        mu_5=log_pair(priors.C5),
        softening=log_pair(priors.softening),
        spread=jnp.asarray([[p.sd, 1 / (2 * p.shape)] for p in spreads]),
        log_noise=log_pair(priors.noise_factor),
        centre=jnp.asarray([np.log(priors.C1.median), log_C3(priors), np.log(priors.C5.median)]),
        blur=jnp.asarray(np.full(3, BLUR)),
        flatness=flatness,
        weight=weight,
    )


def log_C3(priors: Priors) -> float:
    """The prior's log C3 at the medians of the others."""
    log_C1, log_C5 = np.log(priors.C1.median), np.log(priors.C5.median)
    return float((np.log(20 / 9) + log_C1 + 5 * log_C5 + np.log(priors.softening.median)) / 6)
