"""What lies between particle and read-out: the frame, the temperature around it, the platens."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp

from .._types import Scalar, Values
from .effect import AbstractEffect, pick
from .record import Context, contact_radius
from .variant import Need, Nuisance, family, row

REFERENCE_FORCE_MN = 100.0
REFERENCE_TIME_S = 100.0
LAYER_UM = 10.0

_SNEDDON = "Sneddon (1965), Int. J. Eng. Sci. 3, 47"


class _Observed(AbstractEffect):
    """A formula of displacement that the read-out adds."""

    def observe(self, context: Context) -> Values:
        return self.of(context)


def _power(amplitude: Scalar, x: Values, reference: float, power: float) -> Values:
    """A x (x / reference)^(power - 1); below x = 0.01 linear, so that the slope at zero is finite."""
    return amplitude * x * ((x + 0.01) / reference) ** (power - 1)


class FrameCompliance(_Observed):
    """Displacement of the frame under a force; the amplitude is its compliance, at 100 mN where it depends on force."""

    seat_force_mN: Any = None

    formulas: ClassVar = {
        "linear": lambda e, c: e.amplitude * c.force,
        "hertzian_seat": lambda e, c: _power(e.amplitude, c.force, REFERENCE_FORCE_MN, 2 / 3),
        "conical_seat": lambda e, c: _power(e.amplitude, c.force, REFERENCE_FORCE_MN, 0.5),
        "stiffening": lambda e, c: e.amplitude * e.seat_force_mN * jnp.log1p(c.force / e.seat_force_mN),
        "softening": lambda e, c: _power(e.amplitude, c.force, REFERENCE_FORCE_MN, 1.5),
    }


_SEATS = (10.0, 22.0, 50.0, 110.0, 250.0)

FRAME = family(FrameCompliance, "frame_compliance",
    "The frame, load cell and glue of the instrument give way under force, and the read-out counts that as the "
    "particle's.",
    row("linear", "d = C F", "A linear spring in series with the particle.",
        source="Oliver and Pharr (1992), J. Mater. Res. 7, 1564; Doerner and Nix (1986), J. Mater. Res. 1, 601"),
    row("hertzian_seat", "d = C F (F / 100 mN)^(-1/3)",
        "A seat with a rounded contact: stiffer the harder it is pressed, d ~ F^(2/3).",
        source="Hertz; Johnson (1985), Contact Mechanics, ch. 4"),
    row("conical_seat", "d = C F (F / 100 mN)^(-1/2)", "A seat that bears on rough tips, d ~ F^(1/2).",
        source=_SNEDDON),
    row("stiffening", "d = C F_s ln(1 + F / F_s)", "Play that closes: the compliance falls as 1 / (1 + F / F_s).",
        Nuisance("seat_force_mN", _SEATS, (1.0, 2000.0), "force at which it has halved")),
    row("softening", "d = C F (F / 100 mN)^(1/2)",
        "A frame that yields the more the harder it is pressed, d ~ F^(3/2): a loose guide that begins to slip."),
    parameter="compliance_um_per_mN", unit="um/mN", plausible=(2e-4, 1e-2), needs=(Need.UNLOADING,),
    helps=(Need.SEVERAL_SIZES, Need.SEVERAL_PEAKS),
    check="press the punch on the bare platen, without a particle: what gives way there is the frame",
    coordinates=("force",),
)  # fmt: skip


def _periodic(e: ThermalDrift, c: Context) -> Values:
    turn = 2 * jnp.pi * c.record.time / e.period_s
    swing = jnp.sin(turn + e.phase_rad) - jnp.sin(e.phase_rad)
    return e.amplitude * e.period_s / (2 * jnp.pi) * swing


class ThermalDrift(_Observed):
    """Displacement that grows with time; the amplitude is a speed: the first, the largest, or the mean over 100 s."""

    tau_s: Any = None
    period_s: Any = None
    phase_rad: Any = None

    formulas: ClassVar = {
        "linear": lambda e, c: e.amplitude * c.record.time,
        "logarithmic": lambda e, c: e.amplitude * e.tau_s * jnp.log1p(c.record.time / e.tau_s),
        "settling": lambda e, c: -e.amplitude * e.tau_s * jnp.expm1(-c.record.time / e.tau_s),
        "sqrt_time": lambda e, c: _power(e.amplitude, c.record.time, REFERENCE_TIME_S, 0.5),
        "accelerating": lambda e, c: _power(e.amplitude, c.record.time, REFERENCE_TIME_S, 2.0),
        "periodic": _periodic,
    }


_SETTLING = (10.0, 16.0, 25.0, 40.0, 63.0, 100.0, 160.0)

DRIFT = family(ThermalDrift, "thermal_drift",
    "The instrument warms up or cools down during the test: the read-out moves with time, whatever the force.",
    row("linear", "d = v t", "A constant speed, another one in every test."),
    row("settling", "d = v tau (1 - exp(-t / tau))", "A temperature that settles after the sample was placed.",
        Nuisance("tau_s", _SETTLING, (2.0, 2000.0), "time in which it settles")),
    row("logarithmic", "d = v tau ln(1 + t / tau)", "Glue or a load train that settles slower and slower.",
        Nuisance("tau_s", (10.0, 40.0, 160.0), (2.0, 2000.0), "time after which it slows down"),
        source="Nowick and Berry (1972), ch. 4"),
    row("sqrt_time", "d = v t (t / 100 s)^(-1/2)", "Heat that diffuses into a thick body."),
    row("accelerating", "d = v t (t / 100 s)", "A room that warms up faster and faster.", plausible=(2e-5, 2e-3)),
    row("periodic", "d = v P / (2 pi) [sin(2 pi t / P + phase) - sin(phase)]",
        "Air conditioning that switches on and off.",
        Nuisance("period_s", (120.0, 400.0), (20.0, 3600.0), "time between two switchings"),
        Nuisance("phase_rad", (0.0, 1.5707963267948966), (-3.15, 3.15), "where in its swing the test began",
                 random_per_test=True)),
    parameter="drift_um_per_s", unit="um/s", sign=0, plausible=(1e-4, 1e-2), random_per_test=True,
    source="Oliver and Pharr (1992); Feng and Ngan (2002), J. Mater. Res. 17, 660", needs=(Need.UNLOADING,),
    helps=(Need.HOLD, Need.LONG_TIME, Need.TWO_RATES),
    check="hold for a minute close to zero load before and after each test: what moves there is drift",
    coordinates=("time",),
)  # fmt: skip


def _floored(context: Context, radius: Values) -> Values:
    """A radius [um] not below 1e-3 D_e: there the force has vanished, and a quotient must stay finite."""
    return radius + 1e-3 * context.particle.effective_diameter


def _flat(e: PlatenSinkIn, c: Context) -> Values:
    radius = _floored(c, pick(e.shrinks, c.contact_radius, c.peak_contact_radius))
    if e.punch_radius_um is not None:
        radius = jnp.where(radius < e.punch_radius_um, radius, e.punch_radius_um)
    return e.amplitude * c.force / (2 * radius)


def _yield_pressure(e: PlatenSinkIn, c: Context) -> Values:
    slope = c.law.plastic.C1 * c.law.shape_factor(c.particle)
    return e.amplitude * c.force / (2 * _floored(c, contact_radius(c.particle, c.stress / slope)))


def _layer(e: PlatenSinkIn, c: Context) -> Values:
    radius = _floored(c, c.peak_contact_radius)
    return e.amplitude * c.force * LAYER_UM / (jnp.pi * radius * radius)


class PlatenSinkIn(_Observed):
    """Elastic platens that give way under the contact, as a half space does under a rigid flat punch of its radius.

    The amplitude is 1 / E* of the platens, or 1 / E of a layer on them (1 GPa = 1 mN/um^2). The radius is that at the
    peak, or with `shrinks` that of now.
    """

    shrinks: float = 0.0
    punch_radius_um: Any = None

    formulas: ClassVar = {"flat": _flat, "yield_pressure": _yield_pressure, "layer": _layer}


SINK_IN = family(PlatenSinkIn, "platen_sink_in",
    "The platens are no rigid planes: the contact sinks into them.",
    row("flat", "d = F / (2 a_P E*)", "The contact presses like a punch of its widest radius."),
    row("current_contact", "d = F / (2 a E*)", "The same with the radius left on unloading.", formula="flat",
        shrinks=1.0),
    row("yield_pressure", "d = F / (2 a E*), a = D_e sqrt(c^2 sigma / (2 C1 eta))",
        "The radius follows the force at the pressure of first yield."),
    row("layer", "d = F h / (pi a_P^2 E), h = 10 um", "A thin soft layer, dust or glue.",
        source="Johnson (1985), sec. 5.8", plausible=(0.3, 30.0)),
    row("finite_punch", "d = F / (2 min(a_P, R_punch) E*)", "The contact grows until it is as wide as the punch.",
        Nuisance("punch_radius_um", (50.0, 100.0), (20.0, 500.0), "radius of the flat punch"), formula="flat"),
    parameter="inverse_modulus_per_GPa", unit="1/GPa", plausible=(0.01, 1.0),
    source=f"{_SNEDDON}; Johnson (1985), Contact Mechanics, ch. 3", needs=(Need.UNLOADING,),
    helps=(Need.SEVERAL_SIZES, Need.HOLD),
    check="repeat on a platen of diamond or sapphire", coordinates=("peak", "load", "size"),
)  # fmt: skip
