"""What lies between particle and read-out: the frame, the room's temperature, the platens."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._types import Scalar, Values, scalar
from .context import Context, contact_radius
from .effect import AbstractEffect
from .variant import Mechanism, Need, Nuisance, Variant

REFERENCE_FORCE_MN = 100.0
REFERENCE_TIME_S = 100.0


class FrameCompliance(AbstractEffect):
    """Frame whose displacement is a power of force; the amplitude is the compliance at 100 mN."""

    power: float = eqx.field(static=True, default=1.0)

    def observe(self, context: Context) -> Values:
        """C F (F / 100 mN)^(power - 1); below a hundredth of a mN linear, so that the slope at zero is finite."""
        force = context.force
        if self.power == 1.0:
            return self.amplitude * force
        return self.amplitude * force * ((force + 0.01) / REFERENCE_FORCE_MN) ** (self.power - 1)


class StiffeningFrame(AbstractEffect):
    """Frame with play that closes: compliance C / (1 + F / F_s)."""

    seat_force_mN: Scalar = eqx.field(converter=scalar)

    def observe(self, context: Context) -> Values:
        """C F_s ln(1 + F / F_s)."""
        return self.amplitude * self.seat_force_mN * jnp.log1p(context.force / self.seat_force_mN)


class LinearDrift(AbstractEffect):
    """Displacement that grows in proportion to time."""

    def observe(self, context: Context) -> Values:
        """V t."""
        return self.amplitude * context.record.time


class SettlingDrift(AbstractEffect):
    """Drift that dies out; the amplitude is its initial speed."""

    tau_s: Scalar = eqx.field(converter=scalar)

    def observe(self, context: Context) -> Values:
        """V tau (1 - exp(-t / tau))."""
        return -self.amplitude * self.tau_s * jnp.expm1(-context.record.time / self.tau_s)


class PowerDrift(AbstractEffect):
    """Drift as a power of time; the amplitude is the mean speed over the first 100 s."""

    power: float = eqx.field(static=True, default=0.5)

    def observe(self, context: Context) -> Values:
        """V t (t / 100 s)^(power - 1); within the first hundredth of a second linear."""
        time = context.record.time
        return self.amplitude * time * ((time + 0.01) / REFERENCE_TIME_S) ** (self.power - 1)


class PeriodicDrift(AbstractEffect):
    """A room whose temperature swings; the amplitude is the largest speed."""

    period_s: Scalar = eqx.field(converter=scalar)
    phase_rad: Scalar = eqx.field(converter=scalar)

    def observe(self, context: Context) -> Values:
        """V P / (2 pi) [sin(2 pi t / P + phase) - sin(phase)]."""
        turn = 2 * jnp.pi * context.record.time / self.period_s
        swing = jnp.sin(turn + self.phase_rad) - jnp.sin(self.phase_rad)
        return self.amplitude * self.period_s / (2 * jnp.pi) * swing


class PlatenSinkIn(AbstractEffect):
    """Elastic platens that give way under the contact; the amplitude is 1 / E*_platen."""

    shrinks: bool = eqx.field(static=True, default=False)

    def observe(self, context: Context) -> Values:
        """F / (2 a E*): a rigid flat punch of the contact's radius on a half space (1 GPa = 1 mN/um^2)."""
        return self.amplitude * context.force / (2 * _radius(context, self.shrinks))


class PunchSinkIn(AbstractEffect):
    """The same with a contact that cannot outgrow the punch."""

    punch_radius_um: Scalar = eqx.field(converter=scalar)

    def observe(self, context: Context) -> Values:
        """F / (2 min(a, R_punch) E*)."""
        radius = _radius(context, False)
        return (
            self.amplitude
            * context.force
            / (2 * jnp.where(radius < self.punch_radius_um, radius, self.punch_radius_um))
        )


class LayerSinkIn(AbstractEffect):
    """A thin soft layer on the platens, 10 um thick; the amplitude is 1 / E of the layer."""

    shrinks: bool = eqx.field(static=True, default=False)

    def observe(self, context: Context) -> Values:
        """F h / (pi a^2 E), h = 10 um."""
        radius = _radius(context, self.shrinks)
        return self.amplitude * context.force * 10.0 / (jnp.pi * radius * radius)


class YieldSinkIn(AbstractEffect):
    """The same with a contact whose pressure stays that of first yield; its radius follows the force, up and down."""

    def observe(self, context: Context) -> Values:
        """F / (2 a E*), a = D_e sqrt(c^2 sigma / (C1 eta))."""
        slope = context.law.plastic.C1 * context.law.shape_factor(context.particle)
        radius = contact_radius(context.particle, context.stress / slope)
        return self.amplitude * context.force / (2 * _floored(context, radius))


def _radius(context: Context, shrinks: bool) -> Values:
    """Contact radius now or at the peak [um]."""
    return _floored(context, context.contact_radius if shrinks else context.peak_contact_radius)


def _floored(context: Context, radius: Values) -> Values:
    """A radius [um] not below 1e-3 D_e: there the force has vanished, and a quotient must stay finite."""
    return radius + 1e-3 * context.particle.effective_diameter


_OLIVER = "Oliver and Pharr (1992), J. Mater. Res. 7, 1564; Doerner and Nix (1986), J. Mater. Res. 1, 601"


def _frame(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **more: Any) -> Variant:
    return Variant(
        "frame_compliance", name, make, "compliance_um_per_mN", "um/mN", 1, (2e-4, 1e-2), equation, explanation, source,
        needs=(Need.UNLOADING,), helps=(Need.SEVERAL_SIZES, Need.SEVERAL_PEAKS), **more,
    )  # fmt: skip


FRAME = Mechanism(
    "frame_compliance",
    "The tester's frame, load cell and glue give way under force, and the read-out counts that as the particle's.",
    (
        _frame("linear", FrameCompliance, "d = C F", "A linear spring in series with the particle.", _OLIVER),
        _frame(
            "hertzian_seat", FrameCompliance, "d = C F (F / 100 mN)^(-1/3)",
            "A seat with a rounded contact: stiffer the harder it is pressed, d ~ F^(2/3).",
            "Hertz; Johnson (1985), Contact Mechanics, ch. 4", fixed={"power": 2 / 3},
        ),
        _frame(
            "conical_seat", FrameCompliance, "d = C F (F / 100 mN)^(-1/2)",
            "A seat that bears on rough tips, d ~ F^(1/2).", "Sneddon (1965), Int. J. Eng. Sci. 3, 47",
            fixed={"power": 0.5},
        ),
        _frame(
            "stiffening", StiffeningFrame, "d = C F_s ln(1 + F / F_s)",
            "Play that closes: the compliance falls as 1 / (1 + F / F_s).", "engineering practice of bolted joints",
            nuisances=(
                Nuisance(
                    "seat_force_mN", (10.0, 22.0, 50.0, 110.0, 250.0), (1.0, 2000.0), "force at which it has halved"
                ),
            ),
        ),
        _frame(
            "softening", FrameCompliance, "d = C F (F / 100 mN)^(1/2)",
            "A frame that yields the more the harder it is pressed, d ~ F^(3/2): a loose guide that begins to slip.",
            "our own: the limit opposite to a rounded seat", fixed={"power": 1.5},
        ),
    ),
    ("thermal_drift linear, while force grows at one rate",),
    check="press the punch on the bare platen, without a particle: what gives way there is the frame",
    coordinates=("force",),
)  # fmt: skip


def _drift(name: str, make: type[AbstractEffect], equation: str, explanation: str, **more: Any) -> Variant:
    return Variant(
        "thermal_drift", name, make, "drift_um_per_s", "um/s", 0,
        **{"plausible": (1e-4, 1e-2), **more}, equation=equation, explanation=explanation,
        source="Oliver and Pharr (1992); Feng and Ngan (2002), J. Mater. Res. 17, 660", needs=(Need.UNLOADING,),
        helps=(Need.HOLD, Need.LONG_TIME, Need.TWO_RATES), random_per_test=True,
    )  # fmt: skip


DRIFT = Mechanism(
    "thermal_drift",
    "The tester warms up or cools down during the test: the read-out moves with time, whatever the force.",
    (
        _drift("linear", LinearDrift, "d = v t", "A constant speed, another one in every test."),
        _drift(
            "settling", SettlingDrift, "d = v tau (1 - exp(-t / tau))",
            "A temperature that settles after the sample was placed.",
            nuisances=(
                Nuisance(
                    "tau_s",
                    (10.0, 16.0, 25.0, 40.0, 63.0, 100.0, 160.0),
                    (2.0, 2000.0),
                    "time in which it settles",
                ),
            ),
        ),
        _drift("sqrt_time", PowerDrift, "d = v t (t / 100 s)^(-1/2)", "Heat that diffuses into a thick body.",
               fixed={"power": 0.5}),
        _drift("accelerating", PowerDrift, "d = v t (t / 100 s)", "A room that warms up faster and faster.",
               fixed={"power": 2.0}, plausible=(2e-5, 2e-3)),
        _drift(
            "periodic", PeriodicDrift, "d = v P / (2 pi) [sin(2 pi t / P + phase) - sin(phase)]",
            "Air conditioning that switches on and off.",
            nuisances=(
                Nuisance("period_s", (120.0, 400.0), (20.0, 3600.0), "time between two switchings"),
                Nuisance("phase_rad", (0.0, 1.5707963267948966), (-3.15, 3.15), "where in its swing the test began",
                         random_per_test=True),
            ),
        ),
    ),
    ("frame_compliance linear, while force grows at one rate",),
    check="hold for a minute close to zero load before and after each test: what moves there is drift",
    coordinates=("time",),
)  # fmt: skip


def _sink(name: str, make: type[AbstractEffect], equation: str, explanation: str, source: str, **more: Any) -> Variant:
    return Variant(
        "platen_sink_in", name, make, "inverse_modulus_per_GPa", "1/GPa", 1,
        **{"plausible": (0.01, 1.0), **more}, equation=equation, explanation=explanation, source=source,
        needs=(Need.UNLOADING,), helps=(Need.SEVERAL_SIZES, Need.HOLD),
    )  # fmt: skip


_SNEDDON = "Sneddon (1965), Int. J. Eng. Sci. 3, 47; Johnson (1985), Contact Mechanics, ch. 3"

SINK_IN = Mechanism(
    "platen_sink_in",
    "The platens are no rigid planes: the contact sinks into them.",
    (
        _sink("flat", PlatenSinkIn, "d = F / (2 a_P E*)", "The contact presses like a punch of its widest radius.",
              _SNEDDON),
        _sink("current_contact", PlatenSinkIn, "d = F / (2 a E*)", "The same with the radius left on unloading.",
              _SNEDDON, fixed={"shrinks": True}),
        _sink("yield_pressure", YieldSinkIn, "d = F / (2 a E*), a = D_e sqrt(c^2 sigma / (C1 eta))",
              "The radius follows the force at the pressure of first yield.", _SNEDDON),
        _sink("layer", LayerSinkIn, "d = F h / (pi a_P^2 E), h = 10 um", "A thin soft layer, dust or glue.",
              "Johnson (1985), sec. 5.8", plausible=(0.3, 30.0)),
        _sink(
            "finite_punch", PunchSinkIn, "d = F / (2 min(a_P, R_punch) E*)",
            "The contact grows until it is as wide as the punch.", _SNEDDON,
            nuisances=(Nuisance("punch_radius_um", (50.0, 100.0), (20.0, 500.0), "radius of the flat punch"),),
        ),
    ),
    ("the width of the punch, as long as no contact is wider",),
    check="repeat on a platen of diamond or sapphire",
    coordinates=("peak", "load", "size"),
)  # fmt: skip
