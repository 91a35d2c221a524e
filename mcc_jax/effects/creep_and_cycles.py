"""Effects of time and cycles: creep, hysteresis of the reload, ratcheting.

Creep has a memory, exact for stress that is piecewise linear in time.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float

from .._types import Scalar, Values
from .effect import AbstractEffect, at_least, pick
from .record import HOLD, RELOAD, UNLOAD, Context, power, reload_progress
from .variant import Need, Nuisance, family, row

REFERENCE_TIME_S = 100.0
SPACING = math.log(10) / 2  # of elements in ln(time): two per decade
HALF_WIDTHS = (np.arange(8) + 0.5) / 16  # of plays, in shares of the peak load
NORM = 27 / 4  # makes the largest value of x (1 - x)^2 one

Elements = Float[Array, " elements"]
Spectrum = tuple[Elements, Elements, Scalar]


class LinearCreep(AbstractEffect):
    r"""Linear viscoelastic strain by Boltzmann's superposition, as a sum of Kelvin-Voigt elements.

    .. math:: \Delta = D_e c \sum_j w_j y_j + D_e c\, w_0 \sigma, \qquad \dot y_j / s_j + y_j = \sigma

    Every completely monotone creep function is such a sum; elements lie half a decade apart. A step during which stress
    is linear in time is integrated exactly, so that the result does not depend on how densely a ramp is sampled. A
    formula gives the rates s_j [1/s], the weights w_j and the instantaneous weight w_0.
    """

    tau_s: Any = None
    exponent: Any = None

    formulas: ClassVar = {
        "kelvin_voigt": lambda e: _one_time(e.tau_s),
        "distributed": lambda e: _distributed(e.tau_s),
        "logarithmic": lambda e: _logarithmic(e.tau_s),
        "power_law": lambda e: _power_law(e.exponent),
    }

    def driver(self, context: Context) -> Values:
        return context.stress

    def start(self, like: Scalar) -> Elements:
        return jnp.zeros(self.of()[0].shape, like.dtype)

    def evolve(self, memory: Elements, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Elements, Elements]:
        rates = self.of()[0]
        h = rates * seconds
        some = h > 1e-6
        decay = jnp.exp(-h)
        mean = jnp.where(some, -jnp.expm1(-h) / jnp.where(some, h, 1.0), 1 - h / 2)
        memory = decay * memory + (mean - decay) * before + (1 - mean) * now
        return memory, memory

    def crept(self, context: Context) -> Values:
        """The stress of the hereditary integral [MPa]."""
        _, weights, instant = self.of()
        weights = weights.reshape((1,) * (context.memory.ndim - 1) + weights.shape)
        return jnp.sum(context.memory * weights, axis=-1) + instant * context.stress

    def inside(self, context: Context) -> Values:
        return self.amplitude * context.particle.displacement(self.crept(context))


class GrowingContact(LinearCreep):
    """Linear viscoelastic creep of a growing contact: d^(3/2), not d, follows the hereditary integral of stress."""

    def inside(self, context: Context) -> Values:
        loaded = context.peak_stress > 1e-6
        ratio = jnp.where(loaded, self.crept(context) / jnp.where(loaded, context.peak_stress, 1.0), 0.0)
        return context.peak_displacement * (jnp.cbrt(at_least(1 + self.amplitude * ratio)) ** 2 - 1)


def _one_time(tau: Scalar) -> Spectrum:
    """J = 1 - exp(-t / tau)."""
    one = jnp.ones_like(tau)[None]
    return one / tau, one, jnp.zeros_like(tau)


def _distributed(tau: Scalar) -> Spectrum:
    """J = mean of 1 - exp(-t / tau'), ln tau' normal about ln tau with standard deviation ln 5."""
    steps = np.arange(-4, 5) * SPACING
    weights = np.exp(-0.5 * (steps / math.log(5)) ** 2)
    factors = jnp.asarray(np.exp(steps), tau.dtype)
    return factors / tau, jnp.asarray(weights / weights.sum(), tau.dtype), jnp.zeros_like(tau)


def _logarithmic(tau: Scalar) -> Spectrum:
    """J = ln(1 + t / tau), the integral of (1 - exp(-s t)) exp(-s tau) over ln s."""
    shares = 30 * np.exp(-SPACING * np.arange(18))
    weights = jnp.asarray(SPACING * np.exp(-shares), tau.dtype)
    return jnp.asarray(shares, tau.dtype) / tau, weights, jnp.zeros_like(tau)


def _power_law(n: Scalar) -> Spectrum:
    """J = (t / 100 s)^n, n / Gamma(1 - n) times the integral of (1 - exp(-s t)) (100 s * s)^-n over ln s."""
    rates = jnp.asarray(1e2 * np.exp(-SPACING * np.arange(19)), n.dtype)
    gamma = jnp.exp(gammaln(1 - n))
    weights = SPACING * n / gamma * (rates * REFERENCE_TIME_S) ** (-n)
    # What is faster than the fastest element follows at once.
    fastest = 1e2 * math.exp(SPACING / 2)
    return rates, weights, (fastest * REFERENCE_TIME_S) ** (-n) / gamma


class ViscousFlow(AbstractEffect):
    """Steady flow, never recovered; the amplitude counts 100 s, the memory is the integral of the driver over time."""

    def driver(self, context: Context) -> Values:
        return context.stress

    def start(self, like: Scalar) -> Scalar:
        return jnp.zeros_like(like)

    def evolve(self, memory: Scalar, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Scalar, Scalar]:
        memory = memory + 0.5 * (before + now) * seconds
        return memory, memory

    def inside(self, context: Context) -> Values:
        return self.amplitude * context.particle.displacement(context.memory / REFERENCE_TIME_S)


class ViscoplasticCreep(ViscousFlow):
    """Permanent creep near the largest load, logarithmic in the time spent there, or with `root` as its cube root."""

    tau_s: Any = None
    root: float = 0.0

    def driver(self, context: Context) -> Values:
        square = context.load_share * context.load_share
        return square * square * square * square  # u^8: unloading by a tenth more than halves the rate

    def inside(self, context: Context) -> Values:
        time = jnp.log1p(context.memory / self.tau_s)
        grown = pick(self.root, jnp.expm1(time / 3), time)
        return self.amplitude * context.particle.displacement(context.peak_stress * grown)


class HoldCreep(AbstractEffect):
    """Creep under constant load only: it begins again with every hold, and what crept stays.

    A formula is the creep function of the time since the hold began, 0 at 0. The memory is what crept in all holds, and
    how long the present one has lasted.
    """

    tau_s: Any = None

    formulas: ClassVar = {
        "hold_logarithmic": lambda e, t: jnp.log1p(t / e.tau_s),
        "hold_kelvin": lambda e, t: -jnp.expm1(-t / e.tau_s),
    }

    def driver(self, context: Context) -> Values:
        return jnp.where(context.record.kind == HOLD, context.stress, 0.0)

    def start(self, like: Scalar) -> tuple[Scalar, Scalar]:
        return jnp.zeros_like(like), jnp.zeros_like(like)

    def evolve(self, memory: tuple[Scalar, Scalar], before: Scalar, now: Scalar, seconds: Scalar) -> Any:
        crept, held = memory
        longer = jnp.where(now > 0, held + seconds, 0.0)
        crept = crept + now * jnp.where(now > 0, self.of(longer) - self.of(held), 0.0)
        return (crept, longer), crept

    def inside(self, context: Context) -> Values:
        return self.amplitude * context.particle.displacement(context.memory)


def _tau(*grid: float) -> Nuisance:
    return Nuisance("tau_s", grid, (0.3, 3000.0), "retardation time")


_HELD = {"make": HoldCreep, "needs": (Need.HOLD,), "helps": (Need.SEVERAL_PEAKS,)}

CREEP = family(LinearCreep, "creep",
    "The particle goes on deforming under constant force; at reversal the displacement still grows for a while.",
    row("kelvin_voigt", "tau dy/dt + y = sigma; d = D_e c y",
        "A spring in parallel with a dashpot: delayed, bounded and fully recovered.",
        _tau(5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0),
        source="Zhupanska et al. (2002), creep and relaxation of MCC; Oyen and Cook (2003), J. Mater. Res. 18, 139"),
    row("growing_contact", "tau dy/dt + y = sigma; d = gamma_P [(1 + c y / sigma_P)^(2/3) - 1]",
        "A Kelvin-Voigt solid under a round contact, which grows while it creeps.", _tau(10.0, 40.0, 160.0),
        source="Lee and Radok (1960), J. Appl. Mech. 27, 438; Ting (1966), J. Appl. Mech. 33, 845", make=GrowingContact,
        formula="kelvin_voigt", parameter="creep_share", unit="-", plausible=(1e-3, 0.3)),
    row("logarithmic", "d = D_e c [ln(1 + t / tau) convolved with d sigma]",
        "Many retardation times: slower and slower, without end.", _tau(1.0, 10.0, 100.0),
        source="Nowick and Berry (1972), ch. 4"),
    row("power_law", "d = D_e c [(t / 100 s)^n convolved with d sigma]", "Creep as a power of time.",
        Nuisance("exponent", (0.2, 0.4), (0.05, 0.8), "power of time"), source="Andrade (1910); Findley et al. (1976)"),
    row("distributed", "d = D_e c [mean of 1 - exp(-t / tau') convolved with d sigma]",
        "Retardation times spread over two decades.", _tau(20.0, 60.0, 200.0, 600.0), source="Ferry (1980), ch. 3"),
    row("viscous_flow", "d = D_e c (integral of sigma dt) / 100 s",
        "Steady flow in proportion to stress; none of it comes back.", source="Maxwell model; Ferry (1980)",
        make=ViscousFlow),
    row("viscoplastic", "d = D_e c sigma_P ln(1 + t_load / tau), t_load = integral of u^8 dt",
        "Permanent creep while the load is near its maximum, logarithmic in the time spent there.",
        _tau(1.0, 10.0, 100.0), source="Oyen and Cook (2003); logarithmic indentation creep", make=ViscoplasticCreep),
    row("viscoplastic_root", "d = D_e c sigma_P [(1 + t_load / tau)^(1/3) - 1], t_load = integral of u^8 dt",
        "Permanent creep while the load is near its maximum, as the cube root of the time spent there.",
        _tau(1.0, 10.0, 100.0), source="Andrade (1910), Proc. R. Soc. A 84, 1", make=ViscoplasticCreep, root=1.0),
    row("hold_logarithmic", "d = D_e c [sum over holds of sigma ln(1 + t_hold / tau)]",
        "Creep under constant load only, logarithmic in the time of each hold; it stays.", _tau(1.0, 10.0, 100.0),
        source="Chudoba and Richter (2001), Surf. Coat. Technol. 148, 191", **_HELD),
    row("hold_kelvin", "d = D_e c [sum over holds of sigma (1 - exp(-t_hold / tau))]",
        "A Kelvin-Voigt element that acts in steps: bounded creep in each hold; it stays.", _tau(5.0, 20.0, 80.0),
        source="Findley, Lai and Onaran (1976), ch. 5", **_HELD),
    parameter="creep_compliance_per_MPa", unit="1/MPa", plausible=(2e-5, 2e-3), needs=(Need.UNLOADING,),
    helps=(Need.HOLD, Need.TWO_RATES),
    check="hold at the largest load, and repeat at a tenth and at ten times the rate",
    coordinates=("time", "since", "load", "peak"),
)  # fmt: skip


class ReloadHysteresis(AbstractEffect):
    r"""Reloading that lags behind unloading: at the same force the displacement is smaller, the loop dissipates.

    The amplitude is a share of the recoverable displacement, for a loop from full release; smaller loops lag less, in
    proportion to their height. Where a reload turns back before the peak, the lag fades on the way down. A formula is
    the lag at a share w of the way from the reload's beginning to the peak, 0 at both ends.
    """

    formulas: ClassVar = {
        "parabolic": lambda e, w: 4 * w * (1 - w),
        "early": lambda e, w: NORM * w * (1 - w) ** 2,
        "late": lambda e, w: NORM * w**2 * (1 - w),
        "slip": lambda e, w: -jnp.expm1(-w / 0.05) * (1 - w),
    }

    def inside(self, context: Context) -> Values:
        record = context.record
        now = reload_progress(record.force, record.reload_from, context.peak_force)
        turned = reload_progress(record.unload_from, record.reload_from, context.peak_force)
        fading = self.of(turned) * reload_progress(record.force, record.reload_from, record.unload_from)
        lag = jnp.where(record.branch == RELOAD, self.of(now), jnp.where(record.branch == UNLOAD, fading, 0.0))
        lag = jnp.where(record.reloads > 0, lag, 0.0)
        return -self.amplitude * context.recoverable * (1 - context.reload_from_share) * lag


class PlayHysteresis(AbstractEffect):
    """A loop by play elements, with return-point memory: an inner loop closes, and the outer one goes on as without it.

    An element of the half width r follows the load share u by a play, p <- min(max(p, u - r), u + r). What counts is
    how far it lags behind its course on unloading from the peak, min(u + r, 1 - r). Widths are evenly distributed up
    to 1/2, so that elements yield one after the other. It dissipates in every loop.
    """

    def driver(self, context: Context) -> Values:
        return context.load_share

    def start(self, like: Scalar) -> Elements:
        return jnp.asarray(1 - HALF_WIDTHS, like.dtype)

    def evolve(self, memory: Elements, before: Scalar, now: Scalar, seconds: Scalar) -> tuple[Elements, Elements]:
        width = jnp.asarray(HALF_WIDTHS, now.dtype)
        memory = jnp.clip(memory, now - width, now + width)
        return memory, memory

    def inside(self, context: Context) -> Values:
        width = jnp.asarray(HALF_WIDTHS, context.memory.dtype)
        width = width.reshape((1,) * (context.memory.ndim - 1) + width.shape)
        behind = jnp.minimum(context.load_share[..., None] + width, 1 - width) - context.memory
        return -self.amplitude * context.recoverable * 4 * jnp.mean(behind, axis=-1)


HYSTERESIS = family(ReloadHysteresis, "reload_hysteresis",
    "Reloading does not retrace unloading: a loop opens that dissipates work at any rate.",
    row("parabolic", "d = -Delta h (1 - u_r) 4 w (1 - w), w = (F - F_r) / (F_P - F_r)",
        "A loop that is widest half way."),
    row("early", "d = -Delta h (1 - u_r) 6.75 w (1 - w)^2", "Widest soon after the reversal."),
    row("late", "d = -Delta h (1 - u_r) 6.75 w^2 (1 - w)", "Widest close to the peak."),
    row("slip", "d = -Delta h (1 - u_r) (1 - exp(-20 w)) (1 - w)", "Friction at the contact is overcome first."),
    row("return_point", "d = -4 Delta h [mean of s_r - p_r over plays of half width r], s_r the p_r of unloading",
        "Friction that is overcome in one place after the other; inner loops close.", make=PlayHysteresis,
        source="Masing (1926); Iwan (1966), J. Appl. Mech. 33, 893; Krasnosel'skii and Pokrovskii (1989)"),
    parameter="lag_share", plausible=(0.01, 0.5),
    source="Kadin, Kligerman and Etsion (2006), Int. J. Solids Struct. 43, 7119; Zait et al. (2010)",
    needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD, Need.TWO_RATES),
    check="reload at two rates: a loop of friction dissipates as much at both", coordinates=("load", "reload", "peak"),
)  # fmt: skip


def _of_size(count):
    """D_e r g(N), from g."""
    return lambda e, c: e.amplitude * c.particle.displacement(count(e, c.cycles))


class Ratcheting(AbstractEffect):
    """Permanent displacement with every reload, in proportion to size, to the peak, or to what is recovered."""

    cycles_to_rest: Any = None
    exponent: Any = None

    formulas: ClassVar = {
        "linear": _of_size(lambda e, n: n),
        "logarithmic": _of_size(lambda e, n: jnp.log1p(n) / jnp.log(2.0)),
        "shakedown": _of_size(lambda e, n: -e.cycles_to_rest * jnp.expm1(-n / e.cycles_to_rest)),
        "power": _of_size(lambda e, n: power(n, e.exponent)),
        "late": _of_size(lambda e, n: jnp.floor(n) + (n - jnp.floor(n)) ** 2),
        "elastic_share": lambda e, c: e.amplitude * c.recoverable * c.cycles,
        "peak_share": lambda e, c: e.amplitude * c.peak_displacement * c.cycles,
    }

    def inside(self, context: Context) -> Values:
        return self.of(context)


_CHABOCHE = "Lemaitre and Chaboche (1990), Mechanics of Solid Materials, ch. 5"

RATCHETING = family(Ratcheting, "ratcheting",
    "Every cycle leaves some more permanent displacement, without any higher load.",
    row("linear", "d = D_e r N", "The same with every reload."),
    row("logarithmic", "d = D_e r ld(1 + N)", "Less with every reload."),
    row("shakedown", "d = D_e r N_0 (1 - exp(-N / N_0))", "It comes to rest.",
        Nuisance("cycles_to_rest", (1.0, 3.0), (0.3, 30.0), "reloads until it rests")),
    row("elastic_share", "d = Delta r N", "In proportion to the recoverable displacement.", parameter="ratchet_share",
        plausible=(5e-3, 0.3)),
    row("power", "d = D_e r N^p", "More with every reload: it does not shake down.",
        Nuisance("exponent", (1.5, 2.0, 3.0), (1.0, 4.0), "power of the number of reloads"),
        source="Monismith, Ogawa and Freeme (1975), Transp. Res. Rec. 537, 1"),
    row("late", "d = D_e r (n + w^2), N = n + w",
        "Most of it close to the peak of a reload, as where stress must exceed a limit that scatters in the particle.",
        source=_CHABOCHE),
    row("peak_share", "d = gamma_P r N", "In proportion to the displacement at the peak.", source=_CHABOCHE,
        parameter="ratchet_share", plausible=(5e-4, 3e-2)),
    parameter="ratchet_strain", plausible=(2e-4, 1e-2), needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD,),
    source="Johnson (1985), Contact Mechanics, sec. 9.2; Kadin, Kligerman and Etsion (2006)",
    check="cycle one particle ten times or more to the same load", coordinates=("cycles", "peak", "reload"),
)  # fmt: skip
