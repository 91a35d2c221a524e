"""Where exported values come from: estimates, calibration, what a user of them must know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .. import arguments
from .._errors import InputError
from .._format import described
from ..geometry import Particle
from ..law import MccLaw


@dataclass(frozen=True)
class Origin:
    """Where a law comes from; everything is optional, and what is not known is not claimed.

    Attributes:
        estimates: `{"value", "sd", "interval_95"}` of C1, C3, C5, a, effective_modulus_MPa, by name.
        population: `{"mean", "sd"}` of log_C1, log_C3, log_C5, each again an estimate.
        calibration: file, checksum, method, seed and state of the calibration.
        particle: the particle whose coefficients these are; None for those of the population.
        geometry: where the diameters are from, in words.
        warnings: what a user of the values must know.
    """

    estimates: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    population: Mapping[str, Mapping[str, Any]] | None = None
    calibration: Mapping[str, Any] | None = None
    particle: str | None = None
    geometry: str = "given"
    warnings: tuple[str, ...] = ()

    __repr__ = described()


def numbers(law: MccLaw) -> dict[str, float]:
    """The five numbers of a law by name, as Python floats."""
    return {
        "C1": float(law.plastic.C1),
        "C3": float(law.plastic.C3),
        "C5": float(law.plastic.C5),
        "a": float(law.a),
        "effective_modulus_MPa": float(law.effective_modulus),
    }


HUGE = 1e44
"""Above every median that a log_C may have (exp 100), and small enough for C1 C5^5 and C3^6 to be finite."""


def checked(law: Any, particle: Any, origin: Any = None, *, needed: bool = True) -> Origin:
    """The origin, or an empty one, once law and particle are known to be what can be exported.

    Args:
        law: the law.
        particle: a particle that it must carry, or None.
        origin: where the law comes from, or None.
        needed: whether there must be a particle.

    Raises:
        InputError: for one of another kind, a batch of laws, or a law or particle that is not usable.
    """
    arguments.instance(law, MccLaw, "law", "Take mcc_jax.paper_law(), or the law of a calibration.")
    if particle is not None or needed:
        arguments.instance(particle, Particle, "particle", "Make one with mcc_jax.Particle(D1, D2, D3), in um.")
    if law.plastic.C1.ndim or law.a.ndim or (particle is not None and particle.D3.ndim):
        raise InputError("a batch of laws or particles cannot be exported", remedy="Export one law.")
    if origin is not None:
        arguments.instance(origin, Origin, "origin", "Take what mcc_jax.export.read_calibration gives.")
    sphere = Particle(1.0, 1.0, 1.0)  # every law carries it
    check(law, sphere if particle is None else particle, allow_not_monotone=True)
    return origin or Origin()


def check(law: MccLaw, particle: Particle, *, allow_not_monotone: bool = False) -> tuple[str, ...]:
    """Refuse a law that other engines could not use.

    Args:
        law: the law.
        particle: a particle that it must carry.
        allow_not_monotone: warn of a loading curve that falls, instead of refusing it.

    Returns:
        Warnings.

    Raises:
        InputError: if a parameter is out of its range, the particle carries no stress, or the curve falls.
    """
    if not bool(law.is_valid) or not all(abs(number) < HUGE for number in numbers(law).values()):
        raise InputError(
            f"the law is not usable: {numbers(law)}",
            remedy=f"C1, C5 and the modulus must be positive, and all below {HUGE:g}",
        )
    if not bool(law.carries_stress(particle)):
        sizes = ", ".join(f"{float(d):g}" for d in (particle.D1, particle.D2, particle.D3))
        raise InputError(
            f"the shape factor of a particle of {sizes} um is {float(law.shape_factor(particle)):.4g} "
            f"with a = {float(law.a):.4g}",
            remedy="Give --diameters of a rounder particle: shape factors must be positive",
        )
    if bool(law.is_monotone):
        return ()
    problem = "the loading curve is not monotone (9 C3^6 > 20 C1 C5^5): stress falls over part of the loading"
    if not allow_not_monotone:
        raise InputError(
            problem,
            remedy="Take the population or another particle, or give --allow-not-monotone to export it as it is",
        )
    return (f"{problem}; under load control it snaps through, and a pair of such contacts has several solutions",)
