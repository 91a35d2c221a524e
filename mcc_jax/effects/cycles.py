"""Effects that need a reload: hysteresis of the reload, ratcheting."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from .context import Context
from .effect import AbstractEffect
from .record import RELOAD, UNLOAD, reload_progress
from .variant import Mechanism, Need, Nuisance, Variant

_NORM = 27 / 4
"""What makes the largest value of x (1 - x)^2 one."""


# ---- hysteresis of the reload ----------------------------------------------------------------------------------------


class AbstractLag(AbstractEffect):
    r"""Reloading that lags behind unloading: at the same force the displacement is smaller, the loop dissipates.

    The amplitude is a share of the recoverable displacement, for a loop from full release; smaller loops lag less, in
    proportion to their height. Where a reload turns back before the peak, the lag fades on the way down.
    """

    def lag(self, progress: Values) -> Values:
        """Lag at a share of the way from the reload's beginning to the peak, 0 at both ends."""
        raise NotImplementedError

    def inside(self, context: Context) -> Values:
        """-Delta h (1 - u_r) g(w)."""
        record = context.record
        now = reload_progress(record.force, record.reload_from, context.peak_force)
        turned = reload_progress(record.unload_from, record.reload_from, context.peak_force)
        fading = self.lag(turned) * reload_progress(record.force, record.reload_from, record.unload_from)
        lag = jnp.where(record.branch == RELOAD, self.lag(now), jnp.where(record.branch == UNLOAD, fading, 0.0))
        lag = jnp.where(record.reloads > 0, lag, 0.0)
        return -self.amplitude * context.recoverable * (1 - context.reload_from_share) * lag


class ParabolicLag(AbstractLag):
    """Symmetric loop."""

    def lag(self, progress: Values) -> Values:
        """4 w (1 - w)."""
        return 4 * progress * (1 - progress)


class EarlyLag(AbstractLag):
    """Loop that is widest soon after the reload began."""

    def lag(self, progress: Values) -> Values:
        """6.75 w (1 - w)^2."""
        return _NORM * progress * (1 - progress) ** 2


class LateLag(AbstractLag):
    """Loop that is widest close to the peak."""

    def lag(self, progress: Values) -> Values:
        """6.75 w^2 (1 - w)."""
        return _NORM * progress**2 * (1 - progress)


class SlipLag(AbstractLag):
    """Friction that is overcome first, then a constant ratio."""

    def lag(self, progress: Values) -> Values:
        """(1 - exp(-w / 0.05)) (1 - w)."""
        return -jnp.expm1(-progress / 0.05) * (1 - progress)


def _lag(name: str, make: type[AbstractEffect], equation: str, explanation: str) -> Variant:
    return Variant(
        "reload_hysteresis", name, make, "lag_share", "-", 1, (0.01, 0.5), equation, explanation,
        "Kadin, Kligerman and Etsion (2006), Int. J. Solids Struct. 43, 7119; Zait et al. (2010)",
        needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD, Need.TWO_RATES),
    )  # fmt: skip


HYSTERESIS = Mechanism(
    "reload_hysteresis",
    "Reloading does not retrace unloading: a loop opens that dissipates work at any rate.",
    (
        _lag("parabolic", ParabolicLag, "d = -Delta h (1 - u_r) 4 w (1 - w), w = (F - F_r) / (F_P - F_r)",
             "A loop that is widest half way."),
        _lag("early", EarlyLag, "d = -Delta h (1 - u_r) 6.75 w (1 - w)^2", "Widest soon after the reversal."),
        _lag("late", LateLag, "d = -Delta h (1 - u_r) 6.75 w^2 (1 - w)", "Widest close to the peak."),
        _lag("slip", SlipLag, "d = -Delta h (1 - u_r) (1 - exp(-20 w)) (1 - w)",
             "Friction at the contact is overcome first."),
    ),
    check="reload at two rates: a loop of friction dissipates as much at both",
    coordinates=("load", "reload", "peak"),
)  # fmt: skip


# ---- ratcheting ------------------------------------------------------------------------------------------------------


class AbstractRatchet(AbstractEffect):
    """Permanent displacement with every reload; it comes in while reloading."""

    def count(self, cycles: Values) -> Values:
        """What so many reloads make."""
        raise NotImplementedError

    def inside(self, context: Context) -> Values:
        """D_e r g(N)."""
        return self.amplitude * context.particle.displacement(self.count(context.cycles))


class LinearRatchet(AbstractRatchet):
    """The same with every reload."""

    def count(self, cycles: Values) -> Values:
        """N."""
        return cycles


class LogarithmicRatchet(AbstractRatchet):
    """Less and less, without end."""

    def count(self, cycles: Values) -> Values:
        """ln(1 + N) / ln 2."""
        return jnp.log1p(cycles) / jnp.log(2.0)


class ShakedownRatchet(AbstractRatchet):
    """Less and less, to an end."""

    cycles_to_rest: Scalar = eqx.field(converter=scalar)

    def count(self, cycles: Values) -> Values:
        """N_0 (1 - exp(-N / N_0))."""
        return -self.cycles_to_rest * jnp.expm1(-cycles / self.cycles_to_rest)


class PowerRatchet(AbstractRatchet):
    """More with every reload, as where each one breaks something."""

    exponent: Scalar = eqx.field(converter=scalar)

    def count(self, cycles: Values) -> Values:
        """N^p."""
        some = cycles > 0
        power = jnp.exp(self.exponent * jnp.log(jnp.where(some, cycles, 1.0)))
        return jnp.where(some, power, 0.0)


class LateRatchet(AbstractRatchet):
    """Most of it close to the peak, as where stress must exceed a limit that scatters within the particle."""

    def count(self, cycles: Values) -> Values:
        """n + w^2, of whole reloads n and the share w of one more."""
        whole = jnp.floor(cycles)
        return whole + (cycles - whole) ** 2


class PeakRatchet(AbstractRatchet):
    """The same share of the displacement at the peak with every reload."""

    def inside(self, context: Context) -> Values:
        """gamma_P r N."""
        return self.amplitude * context.peak_displacement * context.cycles


class ElasticRatchet(AbstractRatchet):
    """The same share of the recoverable displacement with every reload."""

    def inside(self, context: Context) -> Values:
        """Delta r N."""
        return self.amplitude * context.recoverable * context.cycles


_SHAKEDOWN = "Johnson (1985), Contact Mechanics, sec. 9.2; Kadin, Kligerman and Etsion (2006)"


def _ratchet(name: str, make: type[AbstractEffect], equation: str, explanation: str, **more: Any) -> Variant:
    return Variant(
        "ratcheting", name, make,
        **{"parameter": "ratchet_strain", "unit": "-", "plausible": (2e-4, 1e-2), "source": _SHAKEDOWN, **more},
        sign=1, equation=equation, explanation=explanation,
        needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD,),
    )  # fmt: skip


RATCHETING = Mechanism(
    "ratcheting",
    "Every cycle leaves some more permanent displacement, without any higher load.",
    (
        _ratchet("linear", LinearRatchet, "d = D_e r N", "The same with every reload."),
        _ratchet("logarithmic", LogarithmicRatchet, "d = D_e r ld(1 + N)", "Less with every reload."),
        _ratchet("shakedown", ShakedownRatchet, "d = D_e r N_0 (1 - exp(-N / N_0))", "It comes to rest.",
                 nuisances=(Nuisance("cycles_to_rest", (1.0, 3.0), (0.3, 30.0), "reloads until it rests"),)),
        _ratchet("elastic_share", ElasticRatchet, "d = Delta r N", "In proportion to the recoverable displacement.",
                 parameter="ratchet_share", plausible=(5e-3, 0.3)),
        _ratchet("power", PowerRatchet, "d = D_e r N^p", "More with every reload: it does not shake down.",
                 source="Monismith, Ogawa and Freeme (1975), Transp. Res. Rec. 537, 1",
                 nuisances=(Nuisance("exponent", (1.5, 2.0, 3.0), (1.0, 4.0), "power of the number of reloads"),)),
        _ratchet("late", LateRatchet, "d = D_e r (n + w^2), N = n + w",
                 "Most of it close to the peak of a reload.",
                 source="Lemaitre and Chaboche (1990), Mechanics of Solid Materials, ch. 5"),
        _ratchet("peak_share", PeakRatchet, "d = gamma_P r N", "In proportion to the displacement at the peak.",
                 source="Lemaitre and Chaboche (1990), Mechanics of Solid Materials, ch. 5",
                 parameter="ratchet_share", plausible=(5e-4, 3e-2)),
    ),
    ("creep, as long as there is one reload only and no hold",),
    check="cycle one particle ten times or more to the same load",
    coordinates=("cycles", "peak", "reload"),
)  # fmt: skip
