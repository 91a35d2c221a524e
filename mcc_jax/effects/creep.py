"""Creep: displacement that goes on under constant force. Formulas with memory, exact for piecewise linear loading."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from .._types import Scalar, Values
from .context import Context
from .effect import AbstractEffect, AbstractFormulas, Further, further, pick, switch
from .record import HOLD
from .variant import Need, Nuisance, family, row

REFERENCE_TIME_S = 100.0
ELEMENTS_PER_DECADE = 2

Elements = Float[Array, " elements"]
Spectrum = tuple[Elements, Elements, Scalar]


class LinearCreep(AbstractFormulas):
    r"""Linear viscoelastic strain by Boltzmann's superposition, as a sum of Kelvin-Voigt elements.

    .. math:: \Delta = D_e c \sum_j w_j y_j + D_e c\, w_0 \sigma, \qquad \dot y_j / s_j + y_j = \sigma

    Every completely monotone creep function is such a sum; elements lie half a decade apart. A step during which stress
    is linear in time is integrated exactly, so that the result does not depend on how densely a ramp is sampled. A
    formula gives the rates s_j [1/s], the weights w_j and the instantaneous weight w_0.
    """

    tau_s: Further = further()
    exponent: Further = further()

    formulas: ClassVar = {
        "kelvin_voigt": lambda e: _one_time(e.tau_s),
        "distributed": lambda e: _distributed(e.tau_s),
        "logarithmic": lambda e: _logarithmic(e.tau_s),
        "power_law": lambda e: _power_law(e.exponent),
    }

    def driver(self, context: Context) -> Values:
        """Stress [MPa]."""
        return context.stress

    def start(self, like: Scalar) -> Elements:
        """All elements at rest."""
        return jnp.zeros(self.of()[0].shape, like.dtype)

    def evolve(self, memory: Elements, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Elements, Elements]:
        """Exact solution for a stress that goes linearly from `before` to `now`."""
        rates = self.of()[0]
        h = rates * seconds
        some = h > 1e-6
        decay = jnp.exp(-h)
        mean = jnp.where(some, -jnp.expm1(-h) / jnp.where(some, h, 1.0), 1 - h / 2)
        memory = decay * memory + (mean - decay) * before + (1 - mean) * now
        return memory, memory

    def inside(self, context: Context) -> Values:
        """Strain of all elements times D_e."""
        _, weights, instant = self.of()
        weights = weights.reshape((1,) * (context.memory.ndim - 1) + weights.shape)
        strain = jnp.sum(context.memory * weights, axis=-1) + instant * context.stress
        return self.amplitude * context.particle.displacement(strain)


def _one_time(tau: Scalar) -> Spectrum:
    """J = 1 - exp(-t / tau)."""
    one = jnp.ones_like(tau)[None]
    return one / tau, one, jnp.zeros_like(tau)


def _distributed(tau: Scalar) -> Spectrum:
    """J = mean of 1 - exp(-t / tau'), ln tau' normal about ln tau with standard deviation ln 5."""
    steps = np.arange(-4, 5) / ELEMENTS_PER_DECADE * math.log(10)
    weights = np.exp(-0.5 * (steps / math.log(5)) ** 2)
    factors = jnp.asarray(np.exp(steps), tau.dtype)
    return factors / tau, jnp.asarray(weights / weights.sum(), tau.dtype), jnp.zeros_like(tau)


def _logarithmic(tau: Scalar) -> Spectrum:
    """J = ln(1 + t / tau), the integral of (1 - exp(-s t)) exp(-s tau) over ln s."""
    span = math.log(10) / ELEMENTS_PER_DECADE
    shares = 30 * np.exp(-span * np.arange(18))
    weights = jnp.asarray(span * np.exp(-shares), tau.dtype)
    return jnp.asarray(shares, tau.dtype) / tau, weights, jnp.zeros_like(tau)


def _power_law(n: Scalar) -> Spectrum:
    """J = (t / 100 s)^n, n / Gamma(1 - n) times the integral of (1 - exp(-s t)) (100 s * s)^-n over ln s."""
    span = math.log(10) / ELEMENTS_PER_DECADE
    rates = jnp.asarray(1e2 * np.exp(-span * np.arange(19)), n.dtype)
    gamma = jnp.exp(gammaln(1 - n))
    weights = span * n / gamma * (rates * REFERENCE_TIME_S) ** (-n)
    # What is faster than the fastest element follows at once.
    fastest = 1e2 * math.exp(span / 2)
    return rates, weights, (fastest * REFERENCE_TIME_S) ** (-n) / gamma


class ViscousFlow(AbstractEffect):
    """Steady flow: strain rate in proportion to stress, never recovered; the amplitude counts 100 s."""

    def driver(self, context: Context) -> Values:
        """Stress [MPa]."""
        return context.stress

    def start(self, like: Scalar) -> Scalar:
        """Nothing yet."""
        return jnp.zeros_like(like)

    def evolve(self, memory: Scalar, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Scalar, Scalar]:
        """Integral of the driver over time."""
        memory = memory + 0.5 * (before + now) * seconds
        return memory, memory

    def inside(self, context: Context) -> Values:
        """D_e c (integral of sigma dt) / 100 s."""
        return self.amplitude * context.particle.displacement(context.memory / REFERENCE_TIME_S)


class ViscoplasticCreep(ViscousFlow):
    """Permanent creep, only near the largest load: logarithmic in the time spent there, or its cube root."""

    tau_s: Scalar = further()
    root: float = switch()

    def driver(self, context: Context) -> Values:
        """u^8: unloading by a tenth more than halves it."""
        square = context.load_share * context.load_share
        return square * square * square * square

    def inside(self, context: Context) -> Values:
        """D_e c sigma_P ln(1 + t_load / tau), or sigma_P [(1 + t_load / tau)^(1/3) - 1]."""
        time = jnp.log1p(context.memory / self.tau_s)
        grown = pick(self.root, jnp.expm1(time / 3), time)
        return self.amplitude * context.particle.displacement(context.peak_stress * grown)


class HoldCreep(AbstractFormulas):
    """Creep under constant load only: it begins again with every hold, and what crept stays.

    A formula is the creep function of the time since the hold began, 0 at 0.
    """

    tau_s: Scalar = further()

    formulas: ClassVar = {
        "logarithmic": lambda e, t: jnp.log1p(t / e.tau_s),
        "kelvin": lambda e, t: -jnp.expm1(-t / e.tau_s),
    }

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
        crept = crept + now * jnp.where(now > 0, self.of(longer) - self.of(held), 0.0)
        return (crept, longer), crept

    def inside(self, context: Context) -> Values:
        """D_e c times the sum over holds of sigma J(t_hold)."""
        return self.amplitude * context.particle.displacement(context.memory)


def _tau(*grid: float) -> dict[str, Any]:
    return {"nuisances": (Nuisance("tau_s", grid, (0.3, 3000.0), "retardation time"),)}


_MCC = "Zhupanska et al. (2002), creep and relaxation of MCC; Oyen and Cook (2003), J. Mater. Res. 18, 139"
_HELD = {"make": HoldCreep, "needs": (Need.HOLD,), "helps": (Need.SEVERAL_PEAKS,)}

CREEP = family(
    LinearCreep,
    "creep",
    "The particle goes on deforming under constant force; at reversal the displacement still grows for a while.",
    row("kelvin_voigt", "tau dy/dt + y = sigma; d = D_e c y",
        "A spring in parallel with a dashpot: delayed, bounded and fully recovered.", source=_MCC,
        **_tau(5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0)),
    row("logarithmic", "d = D_e c [ln(1 + t / tau) convolved with d sigma]",
        "Many retardation times: slower and slower, without end.", source="Nowick and Berry (1972), ch. 4",
        **_tau(1.0, 10.0, 100.0)),
    row("power_law", "d = D_e c [(t / 100 s)^n convolved with d sigma]", "Creep as a power of time.",
        source="Andrade (1910); Findley et al. (1976)",
        nuisances=(Nuisance("exponent", (0.2, 0.4), (0.05, 0.8), "power of time"),)),
    row("distributed", "d = D_e c [mean of 1 - exp(-t / tau') convolved with d sigma]",
        "Retardation times spread over two decades.", source="Ferry (1980), ch. 3", **_tau(20.0, 60.0, 200.0, 600.0)),
    row("viscous_flow", "d = D_e c (integral of sigma dt) / 100 s",
        "Steady flow in proportion to stress; none of it comes back.", source="Maxwell model; Ferry (1980)",
        make=ViscousFlow),
    row("viscoplastic", "d = D_e c sigma_P ln(1 + t_load / tau), t_load = integral of u^8 dt",
        "Permanent creep while the load is near its maximum, logarithmic in the time spent there.",
        source="Oyen and Cook (2003); logarithmic indentation creep", **_tau(1.0, 10.0, 100.0), make=ViscoplasticCreep),
    row("viscoplastic_root", "d = D_e c sigma_P [(1 + t_load / tau)^(1/3) - 1], t_load = integral of u^8 dt",
        "Permanent creep while the load is near its maximum, as the cube root of the time spent there.",
        source="Andrade (1910), Proc. R. Soc. A 84, 1", **_tau(1.0, 10.0, 100.0), make=ViscoplasticCreep, root=True),
    row("hold_logarithmic", "d = D_e c [sum over holds of sigma ln(1 + t_hold / tau)]",
        "Creep under constant load only, logarithmic in the time of each hold; it stays.",
        source="Chudoba and Richter (2001), Surf. Coat. Technol. 148, 191", **_tau(1.0, 10.0, 100.0), **_HELD,
        formula="logarithmic"),
    row("hold_kelvin", "d = D_e c [sum over holds of sigma (1 - exp(-t_hold / tau))]",
        "A Kelvin-Voigt element that acts in steps: bounded creep in each hold; it stays.",
        source="Findley, Lai and Onaran (1976), ch. 5", **_tau(5.0, 20.0, 80.0), **_HELD, formula="kelvin"),
    parameter="creep_compliance_per_MPa", unit="1/MPa", plausible=(2e-5, 2e-3), needs=(Need.UNLOADING,),
    helps=(Need.HOLD, Need.TWO_RATES),
    check="hold at the largest load, and repeat at a tenth and at ten times the rate",
    coordinates=("time", "since", "load", "peak"),
)  # fmt: skip
