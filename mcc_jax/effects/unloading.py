"""Effects on the elastic branch: its shape, adhesion, reverse plasticity."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Values
from ..formulas import PUNCH_AREA, recovery, stress_ratio
from .creep_and_cycles import NORM
from .effect import AbstractEffect, pick
from .record import RELOAD, Context, contact_of, positive, power, reload_progress, root
from .variant import Need, Nuisance, family, row

BISECTIONS = 36  # leave 1.5e-11 of the peak force, which the step of Newton's method behind them squares
LAST_CONTACT = 0.3  # radius over that at the peak: there, at 1 % of the load, half of a constant pull is left


class Bow(AbstractEffect):
    """A bow on the elastic branch, its ends fixed; the amplitude is a share of the recoverable displacement.

    A formula is the height of the bow at u = F / F_P, 0 at both ends, 1 at most.
    """

    exponent: Any = None

    formulas: ClassVar = {
        "symmetric_bow": lambda e, u: 4 * u * (1 - u),
        "tail_bow": lambda e, u: NORM * u * (1 - u) ** 2,
        "onset_bow": lambda e, u: NORM * u**2 * (1 - u),
        # From the arcsine towards a power law of what is still to recover.
        "power_law": lambda e, u: recovery(u) - (1 - power(u, 1 / e.exponent)),
    }

    def inside(self, context: Context) -> Values:
        return self.amplitude * context.recoverable * self.of(context.load_share)


class RecoveryExponent(AbstractEffect):
    """Another exponent of the recovered share."""

    def inside(self, context: Context) -> Values:
        s = context.recovered_share
        return context.recoverable * s * (1 - power(s, self.amplitude))


SHAPE_OF_UNLOADING = family(Bow, "unloading_shape",
    "The unloading curve has another shape than the arcsine, with the same two ends.",
    row("symmetric_bow", "d = Delta k 4 u (1 - u)", "Bent most at half load."),
    row("tail_bow", "d = Delta k 6.75 u (1 - u)^2", "Bent most towards release."),
    row("onset_bow", "d = Delta k 6.75 u^2 (1 - u)", "Bent most near the peak."),
    row("recovery_exponent", "d = Delta (s - s^(1 + k))", "Another exponent of recovery.", make=RecoveryExponent),
    row("power_law", "d = Delta k (s - 1 + u^(1/m))",
        "In part a power law, F ~ (d - d_0)^m, as indentation records are reduced by: m = 1 for a flat contact, "
        "2 for a cone; with m = 3/2 it is nearly the arcsine.",
        Nuisance("exponent", (1.2, 2.0), (1.0, 3.0), "exponent of the power law"), parameter="power_law_share",
        plausible=(0.05, 1.0)),
    parameter="bow", sign=0, plausible=(0.01, 0.3), needs=(Need.UNLOADING,),
    source="Oliver and Pharr (1992); Etsion, Kligerman and Kadin (2005), Int. J. Solids Struct. 42, 3716",
    check="unload slowly to zero under control of displacement, with a point for every percent of load",
    coordinates=("load", "peak"),
)  # fmt: skip


def _peeled(recovered: Values) -> Values:
    """phi^1.5, phi = a / a_P: the force of a crack that closes in from the edge, at the recovered share s."""
    phi = contact_of(recovered)
    return phi * jnp.sqrt(phi + 1e-12)


def _constant(e: Adhesion, s: Values) -> Values:
    """(1 - u') phi^2 / (phi^2 + 0.3^2): what counts is how far the law's own force has fallen."""
    contact = (1 - s) * (1 + s)
    return (1 - stress_ratio(s)) * contact / (contact + LAST_CONTACT**2)


class Adhesion(AbstractEffect):
    r"""Attraction over the contact while the particle is unloaded; it vanishes at the onset and with the contact.

    The law's branch carries what the instrument measures plus the attraction, :math:`u' = u + \kappa g(s(u'))`, with
    :math:`\kappa = 2 c^2 \epsilon_P s_{ad} / \sigma_P`, the stress over the contact's area at the peak, or
    :math:`\kappa = s_{ad} / \sigma_P` if it is counted `over_section` as all stresses of the law are, or
    :math:`\kappa = 2 \sqrt{\pi} a_P^{3/2} K_c / (\pi R_e^2 \sigma_P)` for a toughness of the contact's `edge`. Of its
    solutions the largest is stable; there is none below the pull-off force, the least :math:`u' - \kappa g`, and there
    the displacement stays where the contact broke. Derivatives follow from the implicit-function rule; those of the
    place where it broke are left out. A formula is g, attraction over its strength at the recovered share s.
    """

    over_section: float = 0.0
    edge: float = 0.0
    mobilised_share: Any = None

    formulas: ClassVar = {
        "jkr": lambda e, s: _peeled(s) * s,
        "bond": lambda e, s: (1 - s) * (1 + s) * s,
        "stretched_tail": lambda e, s: _peeled(s) * s**4,
        "mobilised": lambda e, s: _peeled(s) * s**2 / (s**2 + e.mobilised_share**2),
        "constant": _constant,
    }

    def inside(self, context: Context) -> Values:
        share = context.pulled_share
        carries = context.peak_stress > 1e-6
        radius = context.peak_contact_radius
        crack = 2 * jnp.sqrt(jnp.pi) * radius * root(radius) / context.particle.effective_area
        in_contact = 2 * PUNCH_AREA * context.peak_strain
        share_of_section = pick(self.edge, crack, pick(self.over_section, 1.0, in_contact))
        area = share_of_section / jnp.where(carries, context.peak_stress, 1.0)
        strength = self.amplitude * jnp.where(carries, area, 0.0)
        frozen, fixed = jax.lax.stop_gradient(share), jax.lax.stop_gradient(strength)

        def excess(value: Values, share: Values, strength: Values) -> Values:
            return value - share - strength * self.of(recovery(value))

        def with_slope(value: Values) -> tuple[Values, Values]:
            return jax.jvp(lambda v: excess(v, frozen, fixed), (value,), (jnp.ones_like(value),))

        def halve(_: Any, bracket: tuple[Values, Values]) -> tuple[Values, Values]:
            low, high = bracket
            middle = 0.5 * (low + high)
            over, slope = with_slope(middle)
            below = (over <= 0) | (slope < 0)  # of the largest solution, or of the place where the contact breaks
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        least = positive(frozen)
        high = jnp.where(least + positive(fixed) < 1, least + positive(fixed), 1.0)
        low, _ = jax.lax.fori_loop(0, BISECTIONS, halve, (least, high))
        over, slope = with_slope(low)
        slope = jnp.where(slope > 0.05, slope, 0.05)
        holds = (frozen >= 0) | (over <= 0)
        value = low - jnp.where(holds, excess(low, share, strength), 0.0) / slope
        value = jnp.where(value < 1, value, 1.0)
        return context.recoverable * (context.recovered_share - recovery(value))


_SECTION = "phi = a/a_P, u' = u + s_ad / sigma_P g, d = Delta [s(u) - s(u')]"
_GENERAL = "phi = a/a_P, u' = u + 2 c^2 eps_P s_ad / sigma_P g, d = Delta [s(u) - s(u')]"
_COHESIVE = "Needleman (1987), J. Appl. Mech. 54, 525; Olsson and Larsson (2013)"
_MOBILISED = Nuisance("mobilised_share", (0.25, 0.4, 0.6), (0.05, 1.0), "recovered share at which half of it pulls")

ADHESION = family(Adhesion, "adhesion",
    "The particle sticks to the platens: on unloading it recovers less at the same force.",
    row("jkr_nominal", f"g = phi^1.5 s; {_SECTION}",
        "A crack closes in from the contact's edge; the stress is counted over the particle's section.",
        source="Johnson, Kendall and Roberts (1971); Mesarovic and Johnson (2000), J. Mech. Phys. Solids 48, 2009",
        formula="jkr", over_section=1.0),
    row("jkr", f"g = phi^1.5 s; {_GENERAL}",
        "The same with the stress of the contact itself: larger contacts stick more strongly.",
        source="Johnson, Kendall and Roberts (1971)"),
    row("kendall", "phi = a/a_P, u' = u + 2 sqrt(pi) a_P^1.5 K_c / F_P phi^1.5 s, d = Delta [s(u) - s(u')]",
        "A rigid flat punch that peels off from its edge: K_c = sqrt(2 E* w) with the work of adhesion w.",
        source="Kendall (1971), J. Phys. D 4, 1186; Maugis and Barquins (1978), J. Phys. D 11, 1989", formula="jkr",
        edge=1.0, parameter="toughness_MPa_sqrt_um", unit="MPa um^0.5", plausible=(0.2, 20.0)),
    row("bond", f"g = phi^2 s; {_GENERAL}", "Bonds over the area of contact that is left.",
        source="Olsson and Larsson (2013); Gonzalez (2019), J. Mech. Phys. Solids"),
    row("stretched_tail", f"g = phi^1.5 s^4; {_GENERAL}",
        "Bridges or fibres that pull only once they are stretched, close to release."),
    row("mobilised_nominal", f"g = phi^1.5 s^2 / (s^2 + s_0^2); {_SECTION}",
        "A cohesive zone that pulls in full once the contact has opened a little, counted over the section.",
        _MOBILISED, source=_COHESIVE, formula="mobilised", over_section=1.0),
    row("mobilised", f"g = phi^1.5 s^2 / (s^2 + s_0^2); {_GENERAL}", "The same with the stress of the contact itself.",
        _MOBILISED, source=_COHESIVE),
    row("bond_nominal", f"g = phi^2 s; {_SECTION}", "As bond, counted over the section.", source="Gonzalez (2019)",
        formula="bond", over_section=1.0),
    row("constant_nominal", f"g = (1 - u') phi^2 / (phi^2 + 0.3^2); {_SECTION}",
        "A pull that stays the same until the last of the contact opens, counted over the section.",
        source="Derjaguin, Muller and Toporov (1975), J. Colloid Interface Sci. 53, 314", formula="constant",
        over_section=1.0),
    parameter="adhesive_stress_MPa", unit="MPa", plausible=(0.02, 2.0), needs=(Need.UNLOADING,),
    helps=(Need.SEVERAL_PEAKS,),
    check="pull off under control of displacement, and repeat with a dry punch that does not stick",
    coordinates=("load", "peak"),
)  # fmt: skip


def _exponential(e: Reversal, u: Values) -> Values:
    """Reverse flow that grows exponentially towards release."""
    end = jnp.exp(-1 / e.decay_share)
    return (jnp.exp(-u / e.decay_share) - end) / (1 - end)


class Reversal(AbstractEffect):
    """Extra recovery towards release, from the compressed core that yields backwards.

    The amplitude is a share of the displacement at the peak, of the particle's size (`of_size`), or of what the law
    recovers (`of_recovery`). A formula is its course, 1 on full release, 0 at the peak. If it `stays`, a reload takes
    it back only in proportion to force.
    """

    of_size: float = 0.0
    of_recovery: float = 0.0
    quadratic: float = 0.0
    stays: bool = eqx.field(static=True, default=False, kw_only=True)
    onset_share: Any = None
    decay_share: Any = None

    formulas: ClassVar = {
        "power": lambda e, u: pick(e.quadratic, (1 - u) ** 2, (1 - u) ** 4),
        "threshold": lambda e, u: (positive(e.onset_share - u) / e.onset_share) ** 2,
        "exponential": _exponential,
    }

    def inside(self, context: Context) -> Values:
        share = context.load_share
        whole = pick(self.of_recovery, context.recoverable, context.peak_displacement)
        whole = pick(self.of_size, context.particle.effective_diameter, whole)
        tail = self.of(share)
        if self.stays:
            start = context.reload_from_share
            back = 1 - reload_progress(share, start, jnp.ones_like(share))
            tail = jnp.where(context.record.branch == RELOAD, self.of(start) * back, tail)
        return -self.amplitude * whole * tail


_OF_SIZE = {"of_size": 1.0, "parameter": "reverse_strain", "plausible": (2e-4, 1e-2)}
_OF_RECOVERY = {"of_recovery": 1.0, "parameter": "recovery_share", "plausible": (1e-2, 0.5)}

REVERSAL = family(Reversal, "reverse_plasticity",
    "Close to release the compressed core yields backwards: the particle recovers more than elastically.",
    row("quartic_strain", "d = -D_e c (1 - u)^4", "Most of it close to release, the same strain for every particle.",
        formula="power", **_OF_SIZE),
    row("quartic", "d = -gamma_P c (1 - u)^4", "Most of it close to release.", formula="power"),
    row("quartic_recovery", "d = -Delta c (1 - u)^4",
        "Most of it close to release, in proportion to what recovers elastically.", formula="power", **_OF_RECOVERY),
    row("threshold_recovery", "d = -Delta c ((u_0 - u) / u_0)^2 below u_0",
        "Reverse yield begins at a share of the peak load, in proportion to what recovers elastically.",
        Nuisance("onset_share", (0.35, 0.5, 0.65, 0.8), (0.05, 0.95), "share of the peak load"), formula="threshold",
        **_OF_RECOVERY),
    row("quadratic", "d = -gamma_P c (1 - u)^2", "All along the branch.", formula="power", quadratic=1.0),
    row("threshold", "d = -gamma_P c ((u_0 - u) / u_0)^2 below u_0",
        "Reverse yield begins at a share of the peak load.",
        Nuisance("onset_share", (0.25, 0.35, 0.5, 0.7), (0.05, 0.95), "share of the peak load")),
    row("exponential", "d = -gamma_P c (exp(-u / w) - e) / (1 - e), e = exp(-1 / w)",
        "Reverse flow with an exponential tail.",
        Nuisance("decay_share", (0.05, 0.1, 0.2, 0.4), (0.01, 1.0), "share of the peak load")),
    row("staying", "d = -gamma_P c (1 - u)^4; on a reload (1 - u_r)^4 (1 - u) / (1 - u_r)",
        "As the quartic form, but a reload does not retrace it.", formula="power", stays=True),
    row("staying_quadratic", "d = -gamma_P c (1 - u)^2; on a reload (1 - u_r)^2 (1 - u) / (1 - u_r)",
        "As the quadratic form, but a reload does not retrace it.", formula="power", stays=True, quadratic=1.0),
    parameter="reverse_share", plausible=(5e-4, 3e-2), needs=(Need.UNLOADING,), helps=(Need.RELOAD,),
    source="Palomaki et al. (2015), Int. J. Pharm. (seen in MCC); Kadin, Kligerman and Etsion (2006)",
    check="unload, hold close to zero load, reload and unload once more", coordinates=("load", "peak", "reload"),
)  # fmt: skip
