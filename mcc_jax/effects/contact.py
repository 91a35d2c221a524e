"""Displacement that appears on first loading: asperities, tilted platens, sudden breaks."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from .context import Context, positive
from .effect import AbstractEffect
from .variant import Mechanism, Need, Nuisance, Variant


class AbstractToe(AbstractEffect):
    """Asperities that are flattened at low stress; the amplitude is their height over D_e.

    Attributes:
        stress_scale_MPa: stress that flattens most of them.
        springs: whether they spring back on unloading; else they stay flat.
    """

    stress_scale_MPa: Scalar = eqx.field(converter=scalar)
    springs: bool = eqx.field(static=True, default=False, kw_only=True)

    def flattened(self, stress_share: Values) -> Values:
        """Share flattened at a stress over the scale."""
        raise NotImplementedError

    def inside(self, context: Context) -> Values:
        """D_e d g(sigma_P / s), or with the stress of now."""
        stress = context.stress if self.springs else context.peak_stress
        share = self.flattened(stress / self.stress_scale_MPa)
        return self.amplitude * context.particle.displacement(share)


class ExponentialToe(AbstractToe):
    """Exponential approach."""

    def flattened(self, stress_share: Values) -> Values:
        """1 - exp(-x)."""
        return -jnp.expm1(-stress_share)


class HyperbolicToe(AbstractToe):
    """Slow approach."""

    def flattened(self, stress_share: Values) -> Values:
        """x / (1 + x)."""
        return stress_share / (1 + stress_share)


class LogarithmicToe(AbstractToe):
    """Asperities of all heights: no end."""

    def flattened(self, stress_share: Values) -> Values:
        """ln(1 + x) / ln 10: the amplitude is the height flattened per decade of stress."""
        return jnp.log1p(stress_share) / jnp.log(10.0)


class PowerToe(AbstractToe):
    """A soft layer: a small power of stress, no end."""

    def flattened(self, stress_share: Values) -> Values:
        """((1 + x)^(1/4) - 1) / (10^(1/4) - 1), 1 at x = 9 as the logarithmic form."""
        return jnp.expm1(0.25 * jnp.log1p(stress_share)) / (10**0.25 - 1)


_FLATTENING = (0.05, 0.1, 0.18, 0.3, 0.55, 1.0, 3.0)
"""Stresses [MPa]: rough cellulose up to 1, ceramic pebbles 3 and more, a twelfth of what crushes them."""


def _toe(
    name: str,
    make: type[AbstractEffect],
    equation: str,
    explanation: str,
    source: str = "Greenwood and Williamson (1966), Proc. R. Soc. A 295, 300",
    **fixed: Any,
) -> Variant:
    return Variant(
        "toe_asperity", name, make, "toe_strain", "-", 1, (5e-4, 2e-2), equation, explanation, source, fixed=fixed,
        nuisances=(
            Nuisance("stress_scale_MPa", _FLATTENING, (0.01, 20.0), "stress that flattens most of them"),
        ),
        needs=(Need.LOW_LOAD,), helps=(Need.RELOAD,),
    )  # fmt: skip


TOE = Mechanism(
    "toe_asperity",
    "Asperities are flattened before the particle itself carries load: a soft toe at the beginning.",
    (
        _toe("exponential", ExponentialToe, "d = D_e d_t (1 - exp(-sigma_P / s))",
             "Asperities of exponentially distributed height; once flat they stay flat."),
        _toe("hyperbolic", HyperbolicToe, "d = D_e d_t x / (1 + x), x = sigma_P / s", "The toe ends slowly."),
        _toe("logarithmic", LogarithmicToe, "d = D_e d_t lg(1 + sigma_P / s)", "Asperities of all heights."),
        _toe("power", PowerToe, "d = D_e d_t ((1 + sigma_P / s)^(1/4) - 1) / (10^(1/4) - 1)",
             "A soft layer that gives way further and further, as a small power of stress.",
             "Archard (1957), Proc. R. Soc. A 243, 190"),
        _toe("elastic", ExponentialToe, "d = D_e d_t (1 - exp(-sigma / s))",
             "The asperities spring back on unloading.", springs=True),
        _toe("elastic_hyperbolic", HyperbolicToe, "d = D_e d_t x / (1 + x), x = sigma / s",
             "A rough joint that closes and opens again, as the joints of rock do.",
             "Bandis, Lumsden and Barton (1983), Int. J. Rock Mech. Min. Sci. 20, 249", springs=True),
        _toe("elastic_logarithmic", LogarithmicToe, "d = D_e d_t lg(1 + sigma / s)",
             "Asperities of all heights that spring back.", "Persson (2007), Phys. Rev. Lett. 99, 125502",
             springs=True),
    ),
    ("zero of displacement, where the toe lies below all data",),
    check="measure how rough particles and platens are; on a reload asperities stay flat",
    coordinates=("peak", "load"),
)  # fmt: skip


class Tilt(AbstractEffect):
    """Platens that are not parallel: the contact begins at one edge."""

    shrinks: bool = eqx.field(static=True, default=False)

    def inside(self, context: Context) -> Values:
        """Alpha a."""
        return self.amplitude * (context.contact_radius if self.shrinks else context.peak_contact_radius)


class LevellingTilt(AbstractEffect):
    """Tilt that the rising force takes out: the edge gap closes at a contact of given size."""

    radius_share: Scalar = eqx.field(converter=scalar)
    shrinks: bool = eqx.field(static=True, default=False, kw_only=True)

    def inside(self, context: Context) -> Values:
        """Alpha a_c (1 - exp(-a_P / a_c)), a_c = share D_e, or with the contact of now."""
        size = self.radius_share * context.particle.effective_diameter
        radius = context.contact_radius if self.shrinks else context.peak_contact_radius
        return -self.amplitude * size * jnp.expm1(-radius / size)


def _tilt(name: str, make: type[AbstractEffect], equation: str, explanation: str, **more: Any) -> Variant:
    return Variant(
        "misalignment", name, make, "tilt_rad", "rad", 1, (2e-3, 5e-2), equation, explanation,
        "Zhang et al. (2006), Scripta Mater. 54, 181; Kiener, Motz and Dehm (2009), Mater. Sci. Eng. A 505, 79",
        needs=(Need.LOW_LOAD,), **more,
    )  # fmt: skip


_LEVELLED = (Nuisance("radius_share", (0.1, 0.3), (0.02, 2.0), "radius of levelling over D_e"),)

MISALIGNMENT = Mechanism(
    "misalignment",
    "The platens are tilted against each other: the contact first closes a wedge.",
    (
        _tilt("edge", Tilt, "d = alpha a_P", "The wedge under the contact's radius at the peak."),
        _tilt("elastic", Tilt, "d = alpha a", "The wedge opens again as the contact shrinks.", fixed={"shrinks": True}),
        _tilt("levelling", LevellingTilt, "d = alpha a_c (1 - exp(-a_P / a_c)), a_c = share D_e",
              "The force levels the platens.",
              nuisances=_LEVELLED),
        _tilt("elastic_levelling", LevellingTilt, "d = alpha a_c (1 - exp(-a / a_c)), a_c = share D_e",
              "Platens levelled by the force tilt back as the contact shrinks.", nuisances=_LEVELLED,
              fixed={"shrinks": True}),
    ),
    check="turn the punch by 90 degrees, level the platens, and repeat",
    coordinates=("peak", "load", "size"),
)  # fmt: skip


class PopIn(AbstractEffect):
    """A sudden jump when stress first reaches a level; it never comes back."""

    location_MPa: Scalar = eqx.field(converter=scalar)
    width: float = eqx.field(static=True, default=0.02)
    per_diameter: bool = eqx.field(static=True, default=False)
    softening: float = eqx.field(static=True, default=0.0)

    def inside(self, context: Context) -> Values:
        """J S((sigma_P - sigma_j) / w sigma_j), S a smooth step; then J c (sigma_P / sigma_j - 1)."""
        beyond = context.peak_stress / self.location_MPa - 1
        share = beyond / self.width + 0.5
        share = jnp.where(share < 1, positive(share), 1.0)
        jump = share * share * (3 - 2 * share)
        if self.softening:
            jump = jump + self.softening * positive(beyond)
        return self.amplitude * (context.particle.displacement(jump) if self.per_diameter else jump)


def _pop(
    name: str, parameter: str, unit: str, plausible: tuple[float, float], equation: str, explanation: str, **fixed: Any
) -> Variant:
    return Variant(
        "pop_in", name, PopIn, parameter, unit, 1, plausible, equation, explanation,
        "Antonyuk et al. (2005), Granular Matter 7, 29; Jonsson and Frenning (2016); Cooper et al. (2020)",
        nuisances=(
            Nuisance("location_MPa", (1.0, 2.0, 4.0, 7.0), (0.3, 16.0), "stress at which it breaks",
                     random_per_test=True),
        ),
        fixed=fixed,
    )  # fmt: skip


POP_IN = Mechanism(
    "pop_in",
    "Something breaks inside the particle at a certain load: the platen drops by a step, anywhere in a test.",
    (
        _pop("sharp", "jump_um", "um", (0.1, 5.0), "d = J H(sigma_P - sigma_j)",
             "A jump, in some tests or all, at a stress of its own in each."),
        _pop("gradual", "jump_um", "um", (0.1, 5.0), "d = J S(sigma_P; sigma_j -+ 15 %)", "A break that takes a while.",
             width=0.3),
        _pop("strain", "jump_strain", "-", (5e-4, 2e-2), "d = J D_e H(sigma_P - sigma_j)",
             "A jump in proportion to the particle's size.", per_diameter=True),
        _pop("with_softening", "jump_um", "um", (0.1, 5.0),
             "d = J [H(sigma_P - sigma_j) + 0.5 (sigma_P / sigma_j - 1)+]",
             "A break after which the particle is softer.", softening=0.5),
    ),
    ("the law's own snap-through, where a loading curve is not monotone",),
    check="watch the particle from the side, or listen to it, while the step occurs",
    coordinates=(),
    sudden=True,
)  # fmt: skip
