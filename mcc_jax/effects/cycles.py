"""Effects that need a reload: hysteresis of the reload, ratcheting."""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp

from .._types import Values
from .context import Context
from .effect import AbstractFormulas, Further, further
from .record import RELOAD, UNLOAD, reload_progress
from .variant import Need, Nuisance, family, row

NORM = 27 / 4
"""What makes the largest value of x (1 - x)^2 one."""


# ---- hysteresis of the reload ----------------------------------------------------------------------------------------


class ReloadHysteresis(AbstractFormulas):
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
        """-Delta h (1 - u_r) g(w)."""
        record = context.record
        now = reload_progress(record.force, record.reload_from, context.peak_force)
        turned = reload_progress(record.unload_from, record.reload_from, context.peak_force)
        fading = self.of(turned) * reload_progress(record.force, record.reload_from, record.unload_from)
        lag = jnp.where(record.branch == RELOAD, self.of(now), jnp.where(record.branch == UNLOAD, fading, 0.0))
        lag = jnp.where(record.reloads > 0, lag, 0.0)
        return -self.amplitude * context.recoverable * (1 - context.reload_from_share) * lag


HYSTERESIS = family(
    ReloadHysteresis,
    "reload_hysteresis",
    "Reloading does not retrace unloading: a loop opens that dissipates work at any rate.",
    row("parabolic", "d = -Delta h (1 - u_r) 4 w (1 - w), w = (F - F_r) / (F_P - F_r)",
        "A loop that is widest half way."),
    row("early", "d = -Delta h (1 - u_r) 6.75 w (1 - w)^2", "Widest soon after the reversal."),
    row("late", "d = -Delta h (1 - u_r) 6.75 w^2 (1 - w)", "Widest close to the peak."),
    row("slip", "d = -Delta h (1 - u_r) (1 - exp(-20 w)) (1 - w)", "Friction at the contact is overcome first."),
    parameter="lag_share", plausible=(0.01, 0.5),
    source="Kadin, Kligerman and Etsion (2006), Int. J. Solids Struct. 43, 7119; Zait et al. (2010)",
    needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD, Need.TWO_RATES),
    check="reload at two rates: a loop of friction dissipates as much at both",
    coordinates=("load", "reload", "peak"),
)  # fmt: skip


# ---- ratcheting ------------------------------------------------------------------------------------------------------


def _of_size(count):
    """D_e r g(N), from g."""
    return lambda e, c: e.amplitude * c.particle.displacement(count(e, c.cycles))


def _power(e: Ratcheting, cycles: Values) -> Values:
    some = cycles > 0
    power = jnp.exp(e.exponent * jnp.log(jnp.where(some, cycles, 1.0)))
    return jnp.where(some, power, 0.0)


class Ratcheting(AbstractFormulas):
    """Permanent displacement with every reload, in proportion to size, to the peak, or to what is recovered."""

    cycles_to_rest: Further = further()
    exponent: Further = further()

    formulas: ClassVar = {
        "linear": _of_size(lambda e, n: n),
        "logarithmic": _of_size(lambda e, n: jnp.log1p(n) / jnp.log(2.0)),
        "shakedown": _of_size(lambda e, n: -e.cycles_to_rest * jnp.expm1(-n / e.cycles_to_rest)),
        "power": _of_size(_power),
        "late": _of_size(lambda e, n: jnp.floor(n) + (n - jnp.floor(n)) ** 2),
        "elastic_share": lambda e, c: e.amplitude * c.recoverable * c.cycles,
        "peak_share": lambda e, c: e.amplitude * c.peak_displacement * c.cycles,
    }

    def inside(self, context: Context) -> Values:
        """The formula: it comes in while reloading."""
        return self.of(context)


_CHABOCHE = "Lemaitre and Chaboche (1990), Mechanics of Solid Materials, ch. 5"

RATCHETING = family(
    Ratcheting,
    "ratcheting",
    "Every cycle leaves some more permanent displacement, without any higher load.",
    row("linear", "d = D_e r N", "The same with every reload."),
    row("logarithmic", "d = D_e r ld(1 + N)", "Less with every reload."),
    row("shakedown", "d = D_e r N_0 (1 - exp(-N / N_0))", "It comes to rest.",
        nuisances=(Nuisance("cycles_to_rest", (1.0, 3.0), (0.3, 30.0), "reloads until it rests"),)),
    row("elastic_share", "d = Delta r N", "In proportion to the recoverable displacement.",
        parameter="ratchet_share", plausible=(5e-3, 0.3)),
    row("power", "d = D_e r N^p", "More with every reload: it does not shake down.",
        source="Monismith, Ogawa and Freeme (1975), Transp. Res. Rec. 537, 1",
        nuisances=(Nuisance("exponent", (1.5, 2.0, 3.0), (1.0, 4.0), "power of the number of reloads"),)),
    row("late", "d = D_e r (n + w^2), N = n + w",
        "Most of it close to the peak of a reload, as where stress must exceed a limit that scatters in the particle.",
        source=_CHABOCHE),
    row("peak_share", "d = gamma_P r N", "In proportion to the displacement at the peak.", source=_CHABOCHE,
        parameter="ratchet_share", plausible=(5e-4, 3e-2)),
    parameter="ratchet_strain", plausible=(2e-4, 1e-2), needs=(Need.RELOAD,), helps=(Need.SECOND_RELOAD,),
    source="Johnson (1985), Contact Mechanics, sec. 9.2; Kadin, Kligerman and Etsion (2006)",
    equivalences=("creep, as long as there is one reload only and no hold",),
    check="cycle one particle ten times or more to the same load",
    coordinates=("cycles", "peak", "reload"),
)  # fmt: skip
