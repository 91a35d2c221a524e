"""Effects on the elastic branch: its shape, adhesion, reverse plasticity."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from ..formulas import PUNCH_AREA, recovery, stress_ratio
from .context import Context, contact_of, positive
from .effect import AbstractEffect
from .record import RELOAD, reload_progress
from .variant import Mechanism, Need, Nuisance, Variant

_NORM = 27 / 4
BISECTIONS = 50
LAST_CONTACT = 0.3  # radius over that at the peak: there, at 1 % of the load, half of a constant pull is left


# ---- shape of unloading ----------------------------------------------------------------------------------------------


class AbstractBow(AbstractEffect):
    """A bow on the elastic branch, its ends fixed; the amplitude is a share of the recoverable displacement."""

    def bow(self, share: Values) -> Values:
        """Height of the bow at u = F / F_P, 0 at both ends, 1 at most."""
        raise NotImplementedError

    def inside(self, context: Context) -> Values:
        """Delta k g(u)."""
        return self.amplitude * context.recoverable * self.bow(context.load_share)


class SymmetricBow(AbstractBow):
    """The same at half load."""

    def bow(self, share: Values) -> Values:
        """4 u (1 - u)."""
        return 4 * share * (1 - share)


class TailBow(AbstractBow):
    """Most at a third of the load."""

    def bow(self, share: Values) -> Values:
        """6.75 u (1 - u)^2."""
        return _NORM * share * (1 - share) ** 2


class OnsetBow(AbstractBow):
    """Most at two thirds of the load."""

    def bow(self, share: Values) -> Values:
        """6.75 u^2 (1 - u)."""
        return _NORM * share**2 * (1 - share)


class PowerLawBow(AbstractBow):
    """From the arcsine towards a power law of what is still to recover, as indentation records are reduced by."""

    exponent: Scalar = eqx.field(converter=scalar)

    def bow(self, share: Values) -> Values:
        """s(u) - (1 - u^(1/m))."""
        some = share > 0
        power = jnp.exp(jnp.log(jnp.where(some, share, 1.0)) / self.exponent)
        return jnp.where(some, recovery(share) - (1 - power), 0.0)


class RecoveryExponent(AbstractEffect):
    """Another exponent of the recovered share."""

    def inside(self, context: Context) -> Values:
        """Delta (s - s^(1 + k))."""
        s = context.recovered_share
        some = s > 0
        power = jnp.exp(self.amplitude * jnp.log(jnp.where(some, s, 1.0)))
        return context.recoverable * jnp.where(some, s * (1 - power), 0.0)


def _bow(
    name: str,
    make: type[AbstractEffect],
    equation: str,
    explanation: str,
    *,
    parameter: str = "bow",
    plausible: tuple[float, float] = (0.01, 0.3),
    nuisances: tuple[Nuisance, ...] = (),
) -> Variant:
    return Variant(
        "unloading_shape", name, make, parameter, "-", 0, plausible, equation, explanation,
        "Oliver and Pharr (1992); Etsion, Kligerman and Kadin (2005), Int. J. Solids Struct. 42, 3716",
        nuisances=nuisances, needs=(Need.UNLOADING,),
    )  # fmt: skip


SHAPE_OF_UNLOADING = Mechanism(
    "unloading_shape",
    "The unloading curve has another shape than the arcsine, with the same two ends.",
    (
        _bow("symmetric_bow", SymmetricBow, "d = Delta k 4 u (1 - u)", "Bent most at half load."),
        _bow("tail_bow", TailBow, "d = Delta k 6.75 u (1 - u)^2", "Bent most towards release."),
        _bow("onset_bow", OnsetBow, "d = Delta k 6.75 u^2 (1 - u)", "Bent most near the peak."),
        _bow("recovery_exponent", RecoveryExponent, "d = Delta (s - s^(1 + k))", "Another exponent of recovery."),
        _bow("power_law", PowerLawBow, "d = Delta k (s - 1 + u^(1/m))",
             "In part a power law, F ~ (d - d_0)^m, as indentation records are reduced by: m = 1 for a flat contact, "
             "2 for a cone; with m = 3/2 it is nearly the arcsine.",
             parameter="power_law_share", plausible=(0.05, 1.0),
             nuisances=(Nuisance("exponent", (1.2, 2.0), (1.0, 3.0), "exponent of the power law"),)),
    ),
    check="unload slowly to zero under control of displacement, with a point for every percent of load",
    coordinates=("load", "peak"),
)  # fmt: skip


# ---- adhesion --------------------------------------------------------------------------------------------------------


class AbstractAdhesion(AbstractEffect):
    r"""Attraction over the contact while the particle is unloaded; it vanishes at the onset and with the contact.

    The law's branch carries what the tester measures plus the attraction, :math:`u' = u + \kappa g(s(u'))`, with
    :math:`\kappa = 4 c^2 \epsilon_P s_{ad} / \sigma_P`, the stress over the contact's area at the peak, or
    :math:`\kappa = s_{ad} / \sigma_P` if it is counted over the particle's section as all stresses of the law are. Of
    its solutions the largest is stable. Derivatives follow from the implicit-function rule.

    Attributes:
        over_section: whether the stress is counted over the section.
    """

    over_section: bool = eqx.field(static=True, default=False, kw_only=True)

    def attraction(self, recovered: Values) -> Values:
        """Attraction over its strength, at the recovered share s."""
        raise NotImplementedError

    def inside(self, context: Context) -> Values:
        """Delta [s(u) - s(u')]."""
        share = context.load_share
        carries = context.peak_stress > 1e-6
        share_of_section = 1.0 if self.over_section else 4 * PUNCH_AREA * context.peak_strain
        area = share_of_section / jnp.where(carries, context.peak_stress, 1.0)
        strength = self.amplitude * jnp.where(carries, area, 0.0)
        frozen, fixed = jax.lax.stop_gradient(share), jax.lax.stop_gradient(strength)

        def excess(value: Values, share: Values, strength: Values) -> Values:
            return value - share - strength * self.attraction(recovery(value))

        def halve(_: Any, bracket: tuple[Values, Values]) -> tuple[Values, Values]:
            low, high = bracket
            middle = 0.5 * (low + high)
            below = excess(middle, frozen, fixed) <= 0
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        high = jnp.where(frozen + positive(fixed) < 1, frozen + positive(fixed), 1.0)
        low, _ = jax.lax.fori_loop(0, BISECTIONS, halve, (frozen, high))
        slope = jax.jvp(lambda v: excess(v, frozen, fixed), (low,), (jnp.ones_like(low),))[1]
        slope = jnp.where(slope > 0.05, slope, 0.05)
        value = low - excess(low, share, strength) / slope
        value = jnp.where(value < 1, value, 1.0)
        return context.recoverable * (recovery(share) - recovery(value))


class JkrAdhesion(AbstractAdhesion):
    """Force of a crack that closes in from the edge."""

    def attraction(self, recovered: Values) -> Values:
        """phi^1.5 s, phi = a / a_P."""
        phi = contact_of(recovered)
        return phi * jnp.sqrt(phi + 1e-12) * recovered


class BondAdhesion(AbstractAdhesion):
    """Stress of bonds over the contact that is left."""

    def attraction(self, recovered: Values) -> Values:
        """phi^2 s."""
        return (1 - recovered) * (1 + recovered) * recovered


class TailAdhesion(AbstractAdhesion):
    """Bridges that are stretched before they pull."""

    def attraction(self, recovered: Values) -> Values:
        """phi^1.5 s^4."""
        phi = contact_of(recovered)
        return phi * jnp.sqrt(phi + 1e-12) * recovered**4


class MobilisedAdhesion(AbstractAdhesion):
    """Attraction that is there in full once the contact has opened a little."""

    mobilised_share: Scalar = eqx.field(converter=scalar)

    def attraction(self, recovered: Values) -> Values:
        """phi^1.5 s^2 / (s^2 + s_0^2)."""
        phi = contact_of(recovered)
        opened = recovered**2
        return phi * jnp.sqrt(phi + 1e-12) * opened / (opened + self.mobilised_share**2)


class ConstantPull(AbstractAdhesion):
    """A pull that does not fade with unloading and is gone with the last of the contact."""

    def attraction(self, recovered: Values) -> Values:
        """(1 - u') phi^2 / (phi^2 + 0.3^2): what counts is how far the law's own force has fallen."""
        contact = (1 - recovered) * (1 + recovered)
        return (1 - stress_ratio(recovered)) * contact / (contact + LAST_CONTACT**2)


def _adhesion(
    name: str,
    make: type[AbstractEffect],
    equation: str,
    explanation: str,
    source: str,
    *,
    over_section: bool = False,
    nuisances: tuple[Nuisance, ...] = (),
) -> Variant:
    return Variant(
        "adhesion", name, make, "adhesive_stress_MPa", "MPa", 1, (0.02, 2.0), equation, explanation, source,
        needs=(Need.UNLOADING,), helps=(Need.SEVERAL_PEAKS,), fixed={"over_section": over_section}, nuisances=nuisances,
    )  # fmt: skip


_SECTION = "phi = a/a_P, u' = u + s_ad / sigma_P g, d = Delta [s(u) - s(u')]"
_GENERAL = "phi = a/a_P, u' = u + 4 c^2 eps_P s_ad / sigma_P g, d = Delta [s(u) - s(u')]"

_COHESIVE = "Needleman (1987), J. Appl. Mech. 54, 525; Olsson and Larsson (2013)"
_MOBILISED = Nuisance("mobilised_share", (0.25, 0.4, 0.6), (0.05, 1.0), "recovered share at which half of it pulls")

ADHESION = Mechanism(
    "adhesion",
    "The particle sticks to the platens: on unloading it recovers less at the same force.",
    (
        _adhesion("jkr_nominal", JkrAdhesion, f"g = phi^1.5 s; {_SECTION}",
                  "A crack closes in from the contact's edge; the stress is counted over the particle's section.",
                  "Johnson, Kendall and Roberts (1971); Mesarovic and Johnson (2000), J. Mech. Phys. Solids 48, 2009",
                  over_section=True),
        _adhesion("jkr", JkrAdhesion, f"g = phi^1.5 s; {_GENERAL}",
                  "The same with the stress of the contact itself: larger contacts stick more strongly.",
                  "Johnson, Kendall and Roberts (1971)"),
        _adhesion("bond", BondAdhesion, f"g = phi^2 s; {_GENERAL}", "Bonds over the area of contact that is left.",
                  "Olsson and Larsson (2013); Gonzalez (2019), J. Mech. Phys. Solids"),
        _adhesion("stretched_tail", TailAdhesion, f"g = phi^1.5 s^4; {_GENERAL}",
                  "Bridges or fibres that pull only once they are stretched, close to release.", "liquid bridges"),
        _adhesion("mobilised_nominal", MobilisedAdhesion, f"g = phi^1.5 s^2 / (s^2 + s_0^2); {_SECTION}",
                  "A cohesive zone that pulls in full once the contact has opened a little, counted over the section.",
                  _COHESIVE, over_section=True, nuisances=(_MOBILISED,)),
        _adhesion("mobilised", MobilisedAdhesion, f"g = phi^1.5 s^2 / (s^2 + s_0^2); {_GENERAL}",
                  "The same with the stress of the contact itself.", _COHESIVE, nuisances=(_MOBILISED,)),
        _adhesion("bond_nominal", BondAdhesion, f"g = phi^2 s; {_SECTION}", "As bond, counted over the section.",
                  "Gonzalez (2019)", over_section=True),
        _adhesion("constant_nominal", ConstantPull, f"g = (1 - u') phi^2 / (phi^2 + 0.3^2); {_SECTION}",
                  "A pull that stays the same until the last of the contact opens, counted over the section.",
                  "Derjaguin, Muller and Toporov (1975), J. Colloid Interface Sci. 53, 314", over_section=True),
    ),
    check="pull off under control of displacement, and repeat with a dry punch that does not stick",
    coordinates=("load", "peak"),
)  # fmt: skip


# ---- reverse plasticity ----------------------------------------------------------------------------------------------


class AbstractReversal(AbstractEffect):
    """Extra recovery towards release, from the compressed core that yields backwards.

    Attributes:
        of: what the amplitude is a share of: the particle's size D_e ("size"), the displacement at the peak gamma_P
            ("peak"), or what the law recovers, Delta ("recovery").
    """

    of: str = eqx.field(static=True, default="peak", kw_only=True)

    def tail(self, share: Values) -> Values:
        """1 on full release, 0 at the peak."""
        raise NotImplementedError

    def whole(self, context: Context) -> Values:
        """L: D_e, gamma_P or Delta [um]."""
        if self.of == "size":
            return context.particle.effective_diameter
        return context.recoverable if self.of == "recovery" else context.peak_displacement

    def inside(self, context: Context) -> Values:
        """-L c g(u)."""
        return -self.amplitude * self.whole(context) * self.tail(context.load_share)


class PowerReversal(AbstractReversal):
    """A power of what is unloaded."""

    power: int = eqx.field(static=True, default=4)

    def tail(self, share: Values) -> Values:
        """(1 - u)^power."""
        return (1 - share) ** self.power


class ThresholdReversal(AbstractReversal):
    """Reverse yield that begins at a share of the load."""

    onset_share: Scalar = eqx.field(converter=scalar)

    def tail(self, share: Values) -> Values:
        """((u_0 - u) / u_0)^2 below u_0."""
        return (positive(self.onset_share - share) / self.onset_share) ** 2


class ExponentialReversal(AbstractReversal):
    """Reverse flow that grows exponentially towards release."""

    decay_share: Scalar = eqx.field(converter=scalar)

    def tail(self, share: Values) -> Values:
        """(exp(-u / w) - exp(-1 / w)) / (1 - exp(-1 / w))."""
        end = jnp.exp(-1 / self.decay_share)
        return (jnp.exp(-share / self.decay_share) - end) / (1 - end)


class StayingReversal(AbstractReversal):
    """Reverse yield that a reload takes back only in proportion to force."""

    power: int = eqx.field(static=True, default=4, kw_only=True)

    def tail(self, share: Values) -> Values:
        """(1 - u)^4, or ^2."""
        return (1 - share) ** self.power

    def inside(self, context: Context) -> Values:
        """On a reload g(u_r) (1 - u) / (1 - u_r)."""
        share = context.load_share
        start = context.reload_from_share
        back = 1 - reload_progress(share, start, jnp.ones_like(share))
        tail = jnp.where(context.record.branch == RELOAD, self.tail(start) * back, self.tail(share))
        return -self.amplitude * self.whole(context) * tail


_REVERSED = {
    "size": ("reverse_strain", (2e-4, 1e-2)),
    "peak": ("reverse_share", (5e-4, 3e-2)),
    "recovery": ("recovery_share", (1e-2, 0.5)),
}
"""Name of the amplitude and its plausible range, by what it is a share of."""


def _reversal(
    name: str, make: type[AbstractEffect], equation: str, explanation: str, *, of: str = "peak", **more: Any
) -> Variant:
    parameter, plausible = _REVERSED[of]
    return Variant(
        "reverse_plasticity", name, make, parameter, "-", 1, plausible, equation, explanation,
        "Palomaki et al. (2015), Int. J. Pharm. (seen in MCC); Kadin, Kligerman and Etsion (2006)",
        needs=(Need.UNLOADING,), helps=(Need.RELOAD,), **{**more, "fixed": {"of": of, **more.get("fixed", {})}},
    )  # fmt: skip


REVERSAL = Mechanism(
    "reverse_plasticity",
    "Close to release the compressed core yields backwards: the particle recovers more than elastically.",
    (
        _reversal("quartic_strain", PowerReversal, "d = -D_e c (1 - u)^4",
                  "Most of it close to release, the same strain for every particle.", of="size"),
        _reversal("quartic", PowerReversal, "d = -gamma_P c (1 - u)^4", "Most of it close to release."),
        _reversal("quartic_recovery", PowerReversal, "d = -Delta c (1 - u)^4",
                  "Most of it close to release, in proportion to what recovers elastically.", of="recovery"),
        _reversal("threshold_recovery", ThresholdReversal, "d = -Delta c ((u_0 - u) / u_0)^2 below u_0",
                  "Reverse yield begins at a share of the peak load, in proportion to what recovers elastically.",
                  of="recovery",
                  nuisances=(Nuisance("onset_share", (0.35, 0.5, 0.65, 0.8), (0.05, 0.95), "share of the peak load"),)),
        _reversal("quadratic", PowerReversal, "d = -gamma_P c (1 - u)^2", "All along the branch.", fixed={"power": 2}),
        _reversal("threshold", ThresholdReversal, "d = -gamma_P c ((u_0 - u) / u_0)^2 below u_0",
                  "Reverse yield begins at a share of the peak load.",
                  nuisances=(Nuisance("onset_share", (0.25, 0.35, 0.5, 0.7), (0.05, 0.95), "share of the peak load"),)),
        _reversal("exponential", ExponentialReversal, "d = -gamma_P c (exp(-u / w) - e) / (1 - e), e = exp(-1 / w)",
                  "Reverse flow with an exponential tail.",
                  nuisances=(Nuisance("decay_share", (0.05, 0.1, 0.2, 0.4), (0.01, 1.0), "share of the peak load"),)),
        _reversal("staying", StayingReversal, "d = -gamma_P c (1 - u)^4; on a reload (1 - u_r)^4 (1 - u) / (1 - u_r)",
                  "As the quartic form, but a reload does not retrace it."),
        _reversal("staying_quadratic", StayingReversal,
                  "d = -gamma_P c (1 - u)^2; on a reload (1 - u_r)^2 (1 - u) / (1 - u_r)",
                  "As the quadratic form, but a reload does not retrace it.", fixed={"power": 2}),
    ),
    check="unload, hold close to zero load, reload and unload once more",
    coordinates=("load", "peak", "reload"),
)  # fmt: skip
