"""Creep: displacement that goes on under constant force. Formulas with memory, exact for piecewise linear loading."""

from __future__ import annotations

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from .._types import Scalar, Values, scalar
from .context import Context
from .effect import AbstractEffect
from .record import HOLD
from .variant import Mechanism, Need, Nuisance, Variant

REFERENCE_TIME_S = 100.0
ELEMENTS_PER_DECADE = 2

Elements = Float[Array, " elements"]


class AbstractLinearCreep(AbstractEffect):
    r"""Linear viscoelastic strain by Boltzmann's superposition, as a sum of Kelvin-Voigt elements.

    .. math:: \Delta = D_e c \sum_j w_j y_j + D_e c\, w_0 \sigma, \qquad \dot y_j / s_j + y_j = \sigma

    Every completely monotone creep function is such a sum; elements lie half a decade apart. A step during which stress
    is linear in time is integrated exactly, so that the result does not depend on how densely a ramp is sampled.
    """

    def spectrum(self) -> tuple[Elements, Elements, Scalar]:
        """Rates s_j [1/s], weights w_j and the instantaneous weight w_0."""
        raise NotImplementedError

    def driver(self, context: Context) -> Values:
        """Stress [MPa]."""
        return context.stress

    def start(self, like: Scalar) -> Elements:
        """All elements at rest."""
        return jnp.zeros(self.spectrum()[0].shape, like.dtype)

    def evolve(self, memory: Elements, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Elements, Elements]:
        """Exact solution for a stress that goes linearly from `before` to `now`."""
        rates = self.spectrum()[0]
        h = rates * seconds
        some = h > 1e-6
        decay = jnp.exp(-h)
        mean = jnp.where(some, -jnp.expm1(-h) / jnp.where(some, h, 1.0), 1 - h / 2)
        memory = decay * memory + (mean - decay) * before + (1 - mean) * now
        return memory, memory

    def inside(self, context: Context) -> Values:
        """Strain of all elements times D_e."""
        _, weights, instant = self.spectrum()
        strain = jnp.sum(context.memory * _like(weights, context.memory), axis=-1) + instant * context.stress
        return self.amplitude * context.particle.displacement(strain)


def _like(weights: Elements, memory: Array) -> Array:
    return weights.reshape((1,) * (memory.ndim - 1) + weights.shape)


class KelvinVoigt(AbstractLinearCreep):
    """One retardation time."""

    tau_s: Scalar = eqx.field(converter=scalar)

    def spectrum(self) -> tuple[Elements, Elements, Scalar]:
        """J = 1 - exp(-t / tau)."""
        one = jnp.ones_like(self.tau_s)[None]
        return one / self.tau_s, one, jnp.zeros_like(self.tau_s)


class DistributedCreep(AbstractLinearCreep):
    """Retardation times spread log-normally over about two decades around one."""

    tau_s: Scalar = eqx.field(converter=scalar)

    def spectrum(self) -> tuple[Elements, Elements, Scalar]:
        """J = mean of 1 - exp(-t / tau'), ln tau' normal about ln tau with standard deviation ln 5."""
        steps = np.arange(-4, 5) / ELEMENTS_PER_DECADE * math.log(10)
        weights = np.exp(-0.5 * (steps / math.log(5)) ** 2)
        factors = jnp.asarray(np.exp(steps), self.tau_s.dtype)
        return factors / self.tau_s, jnp.asarray(weights / weights.sum(), self.tau_s.dtype), jnp.zeros_like(self.tau_s)


class LogarithmicCreep(AbstractLinearCreep):
    """Creep without end, slower and slower."""

    tau_s: Scalar = eqx.field(converter=scalar)

    def spectrum(self) -> tuple[Elements, Elements, Scalar]:
        """J = ln(1 + t / tau), the integral of (1 - exp(-s t)) exp(-s tau) over ln s."""
        span = math.log(10) / ELEMENTS_PER_DECADE
        shares = 30 * np.exp(-span * np.arange(18))
        weights = jnp.asarray(span * np.exp(-shares), self.tau_s.dtype)
        return jnp.asarray(shares, self.tau_s.dtype) / self.tau_s, weights, jnp.zeros_like(self.tau_s)


class PowerLawCreep(AbstractLinearCreep):
    """Andrade-like creep; the amplitude is the compliance at 100 s."""

    exponent: Scalar = eqx.field(converter=scalar)

    def spectrum(self) -> tuple[Elements, Elements, Scalar]:
        """J = (t / 100 s)^n, n / Gamma(1 - n) times the integral of (1 - exp(-s t)) (100 s * s)^-n over ln s."""
        n = self.exponent
        span = math.log(10) / ELEMENTS_PER_DECADE
        rates = jnp.asarray(1e2 * np.exp(-span * np.arange(19)), n.dtype)
        gamma = jnp.exp(gammaln(1 - n))
        weights = span * n / gamma * (rates * REFERENCE_TIME_S) ** (-n)
        # What is faster than the fastest element follows at once.
        fastest = 1e2 * math.exp(span / 2)
        return rates, weights, (fastest * REFERENCE_TIME_S) ** (-n) / gamma


class AbstractIntegral(AbstractEffect):
    """A memory of the driver's integral over time."""

    def start(self, like: Scalar) -> Scalar:
        """Nothing yet."""
        return jnp.zeros_like(like)

    def evolve(self, memory: Scalar, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Scalar, Scalar]:
        """Integral of the driver over time."""
        memory = memory + 0.5 * (before + now) * seconds
        return memory, memory


class ViscousFlow(AbstractIntegral):
    """Steady flow: strain rate in proportion to stress, never recovered; the amplitude counts 100 s."""

    def driver(self, context: Context) -> Values:
        """Stress [MPa]."""
        return context.stress

    def inside(self, context: Context) -> Values:
        """D_e c (integral of sigma dt) / 100 s."""
        return self.amplitude * context.particle.displacement(context.memory / REFERENCE_TIME_S)


class ViscoplasticCreep(AbstractIntegral):
    """Permanent creep, only near the largest load: logarithmic in the time spent there, or its cube root."""

    tau_s: Scalar = eqx.field(converter=scalar)
    root: bool = eqx.field(static=True, default=False, kw_only=True)

    def driver(self, context: Context) -> Values:
        """u^8: unloading by a tenth more than halves it."""
        square = context.load_share * context.load_share
        return square * square * square * square

    def inside(self, context: Context) -> Values:
        """D_e c sigma_P ln(1 + t_load / tau), or sigma_P [(1 + t_load / tau)^(1/3) - 1]."""
        time = jnp.log1p(context.memory / self.tau_s)
        grown = jnp.expm1(time / 3) if self.root else time
        return self.amplitude * context.particle.displacement(context.peak_stress * grown)


class AbstractHoldCreep(AbstractEffect):
    """Creep under constant load only: it begins anew with every hold, and what crept stays."""

    tau_s: Scalar = eqx.field(converter=scalar)

    def grown(self, seconds: Values) -> Values:
        """Creep function at a time since the hold began, 0 at 0."""
        raise NotImplementedError

    def driver(self, context: Context) -> Values:
        """Stress [MPa] where the load is held, else 0."""
        return jnp.where(context.record.kind == HOLD, context.stress, 0.0)

    def start(self, like: Scalar) -> tuple[Scalar, Scalar]:
        """Nothing has crept, nothing is held."""
        return jnp.zeros_like(like), jnp.zeros_like(like)

    def evolve(
        self, memory: tuple[Scalar, Scalar], before: Scalar, now: Scalar, seconds: Scalar
    ) -> tuple[tuple[Scalar, Scalar], Scalar]:
        """What crept in all holds, and how long the present one has lasted."""
        crept, held = memory
        longer = jnp.where(now > 0, held + seconds, 0.0)
        crept = crept + now * jnp.where(now > 0, self.grown(longer) - self.grown(held), 0.0)
        return (crept, longer), crept

    def inside(self, context: Context) -> Values:
        """D_e c times the sum over holds of sigma J(t_hold)."""
        return self.amplitude * context.particle.displacement(context.memory)


class LogarithmicHold(AbstractHoldCreep):
    """Slower and slower in each hold."""

    def grown(self, seconds: Values) -> Values:
        """ln(1 + t / tau)."""
        return jnp.log1p(seconds / self.tau_s)


class KelvinHold(AbstractHoldCreep):
    """A Kelvin-Voigt element under each step of constant load."""

    def grown(self, seconds: Values) -> Values:
        """1 - exp(-t / tau)."""
        return -jnp.expm1(-seconds / self.tau_s)


def _creep(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **more: Any) -> Variant:
    return Variant(
        "creep", name, make, "creep_compliance_per_MPa", "1/MPa", 1, (2e-5, 2e-3), equation, explanation, source,
        **{"needs": (Need.UNLOADING,), "helps": (Need.HOLD, Need.TWO_RATES), **more},
    )  # fmt: skip


def _tau(*grid: float) -> tuple[Nuisance, ...]:
    return (Nuisance("tau_s", grid, (0.3, 3000.0), "retardation time"),)


_MCC = "Zhupanska et al. (2002), creep and relaxation of MCC; Oyen and Cook (2003), J. Mater. Res. 18, 139"

CREEP = Mechanism(
    "creep",
    "The particle goes on deforming under constant force; at reversal the displacement still grows for a while.",
    (
        _creep("kelvin_voigt", KelvinVoigt, "tau dy/dt + y = sigma; d = D_e c y",
               "A spring with a dashpot beside it: delayed, bounded and fully recovered.", _MCC,
               nuisances=_tau(5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0)),
        _creep("logarithmic", LogarithmicCreep, "d = D_e c [ln(1 + t / tau) convolved with d sigma]",
               "Many retardation times: slower and slower, without end.", "Nowick and Berry (1972), ch. 4",
               nuisances=_tau(1.0, 10.0, 100.0)),
        _creep("power_law", PowerLawCreep, "d = D_e c [(t / 100 s)^n convolved with d sigma]",
               "Creep as a power of time.", "Andrade (1910); Findley et al. (1976)",
               nuisances=(Nuisance("exponent", (0.2, 0.4), (0.05, 0.8), "power of time"),)),
        _creep("distributed", DistributedCreep, "d = D_e c [mean of 1 - exp(-t / tau') convolved with d sigma]",
               "Retardation times spread over two decades.", "Ferry (1980), ch. 3",
               nuisances=_tau(20.0, 60.0, 200.0, 600.0)),
        _creep("viscous_flow", ViscousFlow, "d = D_e c (integral of sigma dt) / 100 s",
               "Steady flow in proportion to stress; none of it comes back.", "Maxwell model; Ferry (1980)"),
        _creep("viscoplastic", ViscoplasticCreep, "d = D_e c sigma_P ln(1 + t_load / tau), t_load = integral of u^8 dt",
               "Permanent creep while the load is near its maximum, logarithmic in the time spent there.",
               "Oyen and Cook (2003); logarithmic indentation creep", nuisances=_tau(1.0, 10.0, 100.0)),
        _creep("viscoplastic_root", ViscoplasticCreep,
               "d = D_e c sigma_P [(1 + t_load / tau)^(1/3) - 1], t_load = integral of u^8 dt",
               "Permanent creep while the load is near its maximum, as the cube root of the time spent there.",
               "Andrade (1910), Proc. R. Soc. A 84, 1", nuisances=_tau(1.0, 10.0, 100.0), fixed={"root": True}),
        _creep("hold_logarithmic", LogarithmicHold, "d = D_e c [sum over holds of sigma ln(1 + t_hold / tau)]",
               "Creep under constant load only, logarithmic in the time of each hold; it stays.",
               "Chudoba and Richter (2001), Surf. Coat. Technol. 148, 191", needs=(Need.HOLD,),
               helps=(Need.SEVERAL_PEAKS,), nuisances=_tau(1.0, 10.0, 100.0)),
        _creep("hold_kelvin", KelvinHold, "d = D_e c [sum over holds of sigma (1 - exp(-t_hold / tau))]",
               "A Kelvin-Voigt element that acts in steps: bounded creep in each hold; it stays.",
               "Findley, Lai and Onaran (1976), ch. 5", needs=(Need.HOLD,), helps=(Need.SEVERAL_PEAKS,),
               nuisances=_tau(5.0, 20.0, 80.0)),
    ),
    check="hold at the largest load, and repeat at a tenth and at ten times the rate",
    coordinates=("time", "since", "load", "peak"),
)  # fmt: skip
