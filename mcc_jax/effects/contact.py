"""Displacement that appears on first loading: asperities, tilted platens, sudden breaks."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from .._types import Scalar, Values
from .effect import AbstractEffect, pick
from .record import Context, positive
from .variant import Need, Nuisance, family, row


class Toe(AbstractEffect):
    """Asperities that are flattened at low stress; the amplitude is their height over D_e.

    A formula is the share flattened at x = stress over the scale that flattens most of them. Those without an end are 1
    at x = 9: their amplitude is the height flattened per decade of stress. On unloading asperities stay flat, or spring
    back with `springs`.
    """

    stress_scale_MPa: Scalar
    springs: float = 0.0

    formulas: ClassVar = {
        "exponential": lambda e, x: -jnp.expm1(-x),
        "hyperbolic": lambda e, x: x / (1 + x),
        "logarithmic": lambda e, x: jnp.log1p(x) / jnp.log(10.0),
        "power": lambda e, x: jnp.expm1(0.25 * jnp.log1p(x)) / (10**0.25 - 1),
    }

    def inside(self, context: Context) -> Values:
        stress = pick(self.springs, context.stress, context.peak_stress)
        return self.amplitude * context.particle.displacement(self.of(stress / self.stress_scale_MPa))


_FLATTENING = (0.05, 0.1, 0.18, 0.3, 0.55, 1.0, 3.0)
"""Stresses [MPa]: rough cellulose up to 1, ceramic pebbles 3 and more, a twelfth of what crushes them."""

TOE = family(Toe, "toe_asperity",
    "Asperities are flattened before the particle itself carries load: a soft toe at the beginning.",
    row("exponential", "d = D_e d_t (1 - exp(-sigma_P / s))",
        "Asperities of exponentially distributed height; once flat they stay flat."),
    row("hyperbolic", "d = D_e d_t x / (1 + x), x = sigma_P / s", "The toe ends slowly."),
    row("logarithmic", "d = D_e d_t lg(1 + sigma_P / s)", "Asperities of all heights."),
    row("power", "d = D_e d_t ((1 + sigma_P / s)^(1/4) - 1) / (10^(1/4) - 1)",
        "A soft layer that gives way further and further, as a small power of stress.",
        source="Archard (1957), Proc. R. Soc. A 243, 190"),
    row("elastic", "d = D_e d_t (1 - exp(-sigma / s))", "The asperities spring back on unloading.",
        formula="exponential", springs=1.0),
    row("elastic_hyperbolic", "d = D_e d_t x / (1 + x), x = sigma / s",
        "A rough joint that closes and opens again, as the joints of rock do.",
        source="Bandis, Lumsden and Barton (1983), Int. J. Rock Mech. Min. Sci. 20, 249", formula="hyperbolic",
        springs=1.0),
    row("elastic_logarithmic", "d = D_e d_t lg(1 + sigma / s)", "Asperities of all heights that spring back.",
        source="Persson (2007), Phys. Rev. Lett. 99, 125502", formula="logarithmic", springs=1.0),
    parameter="toe_strain", plausible=(5e-4, 2e-2), needs=(Need.LOW_LOAD,), helps=(Need.RELOAD,),
    source="Greenwood and Williamson (1966), Proc. R. Soc. A 295, 300",
    nuisances=(Nuisance("stress_scale_MPa", _FLATTENING, (0.01, 20.0), "stress that flattens most of them"),),
    equivalences=("zero of displacement, where the toe lies below all data",),
    check="measure how rough particles and platens are; on a reload asperities stay flat", coordinates=("peak", "load"),
)  # fmt: skip


class Tilt(AbstractEffect):
    """Platens that are not parallel: the contact begins at one edge, and with `radius_share` the force levels them."""

    radius_share: Any = None
    shrinks: float = 0.0

    def inside(self, context: Context) -> Values:
        radius = pick(self.shrinks, context.contact_radius, context.peak_contact_radius)
        if self.radius_share is None:
            return self.amplitude * radius
        size = self.radius_share * context.particle.effective_diameter
        return -self.amplitude * size * jnp.expm1(-radius / size)


_LEVELLED = Nuisance("radius_share", (0.1, 0.3), (0.02, 2.0), "radius of levelling over D_e")

MISALIGNMENT = family(Tilt, "misalignment",
    "The platens are tilted against each other: the contact first closes a wedge.",
    row("edge", "d = alpha a_P", "The wedge under the contact's radius at the peak."),
    row("elastic", "d = alpha a", "The wedge opens again as the contact shrinks.", shrinks=1.0),
    row("levelling", "d = alpha a_c (1 - exp(-a_P / a_c)), a_c = share D_e", "The force levels the platens.",
        _LEVELLED),
    row("elastic_levelling", "d = alpha a_c (1 - exp(-a / a_c)), a_c = share D_e",
        "Platens levelled by the force tilt back as the contact shrinks.", _LEVELLED, shrinks=1.0),
    parameter="tilt_rad", unit="rad", plausible=(2e-3, 5e-2), needs=(Need.LOW_LOAD,),
    source="Zhang et al. (2006), Scripta Mater. 54, 181; Kiener, Motz and Dehm (2009), Mater. Sci. Eng. A 505, 79",
    check="turn the punch by 90 degrees, level the platens, and repeat", coordinates=("peak", "load", "size"),
)  # fmt: skip


class PopIn(AbstractEffect):
    """A sudden jump when stress first reaches a level; it never comes back."""

    location_MPa: Scalar
    gradual: float = 0.0
    per_diameter: float = 0.0
    softens: float = 0.0

    def inside(self, context: Context) -> Values:
        beyond = context.peak_stress / self.location_MPa - 1
        share = beyond / pick(self.gradual, 0.3, 0.02) + 0.5
        share = jnp.where(share < 1, positive(share), 1.0)
        jump = share * share * (3 - 2 * share)
        jump = pick(self.softens, jump + 0.5 * positive(beyond), jump)
        return self.amplitude * pick(self.per_diameter, context.particle.displacement(jump), jump)


POP_IN = family(PopIn, "pop_in",
    "Something breaks inside the particle at a certain load: the platen drops by a step, anywhere in a test.",
    row("sharp", "d = J H(sigma_P - sigma_j)", "A jump, in some tests or all, at a stress of its own in each."),
    row("gradual", "d = J S(sigma_P; sigma_j -+ 15 %)", "A break that takes a while.", gradual=1.0),
    row("strain", "d = J D_e H(sigma_P - sigma_j)", "A jump in proportion to the particle's size.",
        parameter="jump_strain", unit="-", plausible=(5e-4, 2e-2), per_diameter=1.0),
    row("with_softening", "d = J [H(sigma_P - sigma_j) + 0.5 (sigma_P / sigma_j - 1)+]",
        "A break after which the particle is softer.", softens=1.0),
    parameter="jump_um", unit="um", plausible=(0.1, 5.0),
    source="Antonyuk et al. (2005), Granular Matter 7, 29; Jonsson and Frenning (2016); Cooper et al. (2020)",
    nuisances=(Nuisance("location_MPa", (1.0, 2.0, 4.0, 7.0), (0.3, 16.0), "stress at which it breaks",
                        random_per_test=True),),
    equivalences=("the law's own snap-through, where a loading curve is not monotone",),
    check="watch the particle from the side, or listen to it, while the step occurs", coordinates=(), sudden=True,
)  # fmt: skip
