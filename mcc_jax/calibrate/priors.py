"""What is believed before the data: weakly informative, in physical units, and open to change from a file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from ..campaign import load_toml_file
from ..law import Unloading


class NoisePrior(eqx.Module):
    """Log-normal priors of the four numbers of the noise: medians and standard deviations of the logarithm."""

    median: Float[Array, " 4"]
    log_sd: Float[Array, " 4"]

    def log_density(self, logs: np.ndarray) -> np.ndarray:
        """Log density of the logarithms; shape (..., 4) becomes (...)."""
        sd = np.asarray(self.log_sd)
        away = (logs - np.log(self.median)) / sd
        return np.asarray(-0.5 * np.sum(away**2, -1) - np.sum(np.log(sd * np.sqrt(2 * np.pi))))


@dataclass(frozen=True)
class NormalPrior:
    """A normal distribution.

    Raises:
        InputError: if the mean is not finite or the standard deviation not positive.
    """

    mean: float
    sd: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", arguments.number(self.mean, "the mean of a prior"))
        object.__setattr__(self, "sd", arguments.number(self.sd, "the sd of a prior", above=0))


@dataclass(frozen=True)
class LogNormalPrior:
    """A log-normal distribution: its median, and the standard deviation of the logarithm.

    Raises:
        InputError: if one of them is not positive.
    """

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "median", arguments.number(self.median, "the median of a prior", above=0))
        object.__setattr__(self, "log_sd", arguments.number(self.log_sd, "the log_sd of a prior", above=0))


@dataclass(frozen=True)
class NakagamiPrior:
    r"""A spread :math:`\tau \ge 0` with the density :math:`p(\tau) \propto \tau^{2m - 1} e^{-\tau^2 / (2 s^2)}`.

    That is Nakagami's distribution (1960) with :math:`\Omega = 2 m s^2`; at m = 1/2 it is half-normal.

    Attributes:
        sd: s, beyond which no spread is expected; at m = 1/2 the standard deviation of the normal distribution that is
            cut off below 0.
        shape: m, at most 1/2. At 1/2 all spreads much below s are equally likely, so that one below s/1000 is a thing
            of one in a thousand. At 1/8 even the order of magnitude is open: half of all spreads lie below s/14, one
            in five below s/560, one in ten below s/9000.

    Raises:
        InputError: if s is not positive, or m not between 0 and 1/2 (beyond, no spread could be 0).
    """

    sd: float
    shape: float = 0.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "sd", arguments.number(self.sd, "the scale sd of a spread", above=0))
        shape = arguments.number(self.shape, "the shape of a spread's prior", above=0, most=MAX_SHAPE)
        object.__setattr__(self, "shape", shape)


MAX_SHAPE = 0.5
ALMOST = 0.98
"""Share of the way to the value of a at which a particle's shape factor would vanish."""
CELLULOSE = 11.0, 0.6
"""Peak stress [MPa] and scaled strain there of the paper's tests, about: what the default priors belong to."""


@dataclass(frozen=True)
class Priors:
    r"""Priors of the joint calibration.

    Attributes:
        a: shape parameter [-], cut off where any particle's shape factor would not be positive. Dense bodies want
            negative values, porous irregular ones 1 to 2.
        effective_modulus_MPa: Ebar [MPa]; its default depends on the form of unloading, to which it belongs.
        C1: median of C1 over the particles [-], the initial slope of the master curve in MPa.
        C5: median of C5 over the particles [-].
        softening: :math:`9 C_3^6 / (20 C_1 C_5^5)` of the median particle [-], 0.33 in the paper: the share of the
            initial slope that is lost at the curve's bend. It replaces C3, whose median follows. At 1 the curve is flat
            there, beyond 1 its stress falls; most powders stay well below, single particles need not.
        tau_C1, tau_C3, tau_C5: standard deviation of log C over the particles. That of C3 is open in its order of
            magnitude: the paper's 20 particles show none at all (Table 2), and the smaller it is, the better a and the
            means are known.
        modulus_scatter: standard deviation of the logarithm of the modulus over the particles, if it may scatter.
        shape_scatter: standard deviation of a over the particles, if it may scatter.
        zero_um: how far the true zero of displacement may lie from the recorded contact [um].
        noise_displacement_um, noise_force_mN, noise_correlated_um, noise_length: see `Noise`.
        noise_factor: common factor on the noise as estimated beforehand.
    """

    a: NormalPrior = NormalPrior(1.0, 1.0)
    effective_modulus_MPa: LogNormalPrior = LogNormalPrior(10_000.0, 1.0)
    C1: LogNormalPrior = LogNormalPrior(6.0, 0.5)
    C5: LogNormalPrior = LogNormalPrior(2.7, 0.3)
    softening: LogNormalPrior = LogNormalPrior(0.33, 0.6)
    tau_C1: NakagamiPrior = NakagamiPrior(0.5)
    tau_C3: NakagamiPrior = NakagamiPrior(0.05, shape=0.125)
    tau_C5: NakagamiPrior = NakagamiPrior(0.15)
    modulus_scatter: NakagamiPrior = NakagamiPrior(0.3)
    shape_scatter: NakagamiPrior = NakagamiPrior(0.3)
    zero_um: NormalPrior = NormalPrior(0.0, 5.0)
    noise_displacement_um: LogNormalPrior = LogNormalPrior(0.02, 1.5)
    noise_force_mN: LogNormalPrior = LogNormalPrior(0.05, 1.0)
    noise_correlated_um: LogNormalPrior = LogNormalPrior(0.01, 1.5)
    noise_length: LogNormalPrior = LogNormalPrior(0.2, 1.0)
    noise_factor: LogNormalPrior = LogNormalPrior(1.0, 0.5)
    changed: tuple[str, ...] = field(default=(), compare=False)

    __repr__ = described()

    @classmethod
    def default(cls, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
        """The defaults; the modulus of a punch form is some twenty times smaller than that of the printed one."""
        unloading = arguments.member(unloading, Unloading, "unloading")
        if unloading is Unloading.PRINTED:
            return cls()
        return cls(effective_modulus_MPa=LogNormalPrior(500.0, 1.0))

    @classmethod
    def of_scale(cls, stress_MPa: float, strain: float, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
        r"""Priors in a campaign's own stress and strain, for a material that is not like micro-crystalline cellulose.

        Under a change of units of stress and strain the coefficients go as :math:`C_1 \sim \sigma/\epsilon`,
        :math:`C_5 \sim \sigma^{1/5}/\epsilon` and the modulus as :math:`\sigma/\epsilon^3` (printed form) or
        :math:`\sigma/\epsilon^{3/2}` (punch forms), so medians move with the median peak; widths are twice those for
        cellulose, since a shape of curve that is known for one material is a guess for another. The length of
        correlated noise is held near its median: noise that hangs together over several branches is a curve of every
        test's own, which would describe any test.

        Args:
            stress_MPa: at the median test's peak.
            strain: at the same peak.
            unloading: form of unloading.
        """
        base = cls.default(unloading)
        up, along = stress_MPa / CELLULOSE[0], strain / CELLULOSE[1]
        power = 3.0 if arguments.member(unloading, Unloading, "unloading").stress_power == 1 else 1.5

        def moved(prior: LogNormalPrior, factor: float) -> LogNormalPrior:
            return LogNormalPrior(prior.median * factor, 2 * prior.log_sd)

        def wider(prior: NakagamiPrior) -> NakagamiPrior:
            return NakagamiPrior(2 * prior.sd, prior.shape)

        return dataclasses.replace(
            base,
            C1=moved(base.C1, up / along),
            C5=moved(base.C5, up**0.2 / along),
            softening=moved(base.softening, 1.0),
            effective_modulus_MPa=moved(base.effective_modulus_MPa, up / along**power),
            tau_C1=wider(base.tau_C1),
            tau_C3=wider(base.tau_C3),
            tau_C5=wider(base.tau_C5),
            noise_length=LogNormalPrior(base.noise_length.median, 0.25),
        )

    @property
    def log_C3(self) -> float:
        """log C3 at the medians of the others."""
        log_C1, log_C5 = np.log(self.C1.median), np.log(self.C5.median)
        return float((np.log(20 / 9) + log_C1 + 5 * log_C5 + np.log(self.softening.median)) / 6)

    @property
    def noise(self) -> NoisePrior:
        """The four priors of the noise together."""
        four = (self.noise_displacement_um, self.noise_force_mN, self.noise_correlated_um, self.noise_length)
        return NoisePrior(jnp.asarray([p.median for p in four]), jnp.asarray([p.log_sd for p in four]))

    def to_json(self) -> dict[str, Any]:
        """Every prior with its numbers."""
        content = {}
        for name, prior in self._entries():
            content[name] = {"distribution": _NAMES[type(prior)], **dataclasses.asdict(prior)}
        return content

    def _entries(self) -> list[tuple[str, Any]]:
        return [(f.name, getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "changed"]


def bounds_of_a(flatness: Any) -> tuple[Any, Any]:
    """Between which values of `a` every particle's shape factor is positive, of NumPy's or JAX's arrays."""
    return -ALMOST / flatness.max().clip(1e-3), -ALMOST / flatness.min().clip(None, -1e-3)


def check_prior_of_a(priors: Priors, flatness: np.ndarray) -> None:
    """Make sure that the prior of `a` leaves values under which every particle's shape factor is positive.

    Raises:
        InputError: if it does not.
    """
    low, high = bounds_of_a(flatness)
    if not (low < priors.a.mean + 6 * priors.a.sd and high > priors.a.mean - 6 * priors.a.sd):
        raise InputError(
            f"the prior of a ({priors.a.mean:g} +- {priors.a.sd:g}) leaves no value under which every particle's shape "
            f"factor is positive ({low:.3g} < a < {high:.3g})",
            remedy="Widen the prior, or check the diameters.",
        )


_NAMES = {NormalPrior: "normal", LogNormalPrior: "log-normal", NakagamiPrior: "nakagami"}


def read_priors(file: str | Path, unloading: Unloading | str = Unloading.PRINTED) -> Priors:
    """Read priors from a TOML file; what it does not name keeps its default.

    The file holds one table per prior, with the fields of its distribution::

        [a]
        mean = 1.4
        sd = 0.3

    Raises:
        InputError: naming table, entry and what is allowed.
    """
    file = arguments.file_path(file, "file")
    priors = Priors.default(unloading)
    known = dict(priors._entries())
    changes: dict[str, Any] = {}
    content = load_toml_file(file, "a TOML file of priors")
    for name, entry in content.items():
        if name not in known:
            raise InputError(
                f"there is no prior {name!r}", file=file, remedy=f"Known priors: {', '.join(sorted(known))}."
            )
        fields = [f.name for f in dataclasses.fields(known[name])]
        if not isinstance(entry, dict) or not set(entry) <= set(fields):
            wrong = (
                "must be a table" if not isinstance(entry, dict) else f"has no entry {min(set(entry) - set(fields))!r}"
            )
            remedy = f"Write [{name}] and its {', '.join(fields)}."
            raise InputError(f"prior {name!r} {wrong}", file=file, remedy=remedy)
        try:
            numbers = {key: arguments.number(value, f"{name}.{key}") for key, value in entry.items()}
            changes[name] = dataclasses.replace(known[name], **numbers)
        except InputError as error:
            raise InputError(error.problem, file=file, column=name, remedy="Correct the entry.") from None
    return dataclasses.replace(priors, **changes, changed=tuple(changes))
