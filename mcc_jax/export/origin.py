"""Where exported values come from: a folder of results, estimates, what a user of them must know."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from ..calibrate.curves import entry_of
from ..calibrate.estimates import exponential
from ..calibrate.population import COEFFICIENTS
from ..calibrate.results import ARCHIVE, load
from ..campaign import Campaign, read_diameters
from ..effects import LIBRARY
from ..geometry import Particle
from ..law import MccLaw

HUGE = 1e44  # above every median that a log_C may have (exp 100), and small enough for C1 C5^5 and C3^6 to be finite
_AGAIN = "Give a folder that mcc-jax calibrate or discover wrote, or calibrate again"
_FALLING = "the loading curve is not monotone (9 C3^6 > 20 C1 C5^5): stress falls over part of the loading"


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

    estimates: dict[str, dict[str, Any]] = field(default_factory=dict)
    population: dict[str, dict[str, Any]] | None = None
    calibration: dict[str, Any] | None = None
    particle: str | None = None
    geometry: str = "given"
    warnings: tuple[str, ...] = ()

    __repr__ = described()


UNKNOWN = Origin()


def numbers(law: MccLaw) -> dict[str, float]:
    """The five numbers of a law by name, as Python floats."""
    C = law.plastic
    values = {"C1": C.C1, "C3": C.C3, "C5": C.C5, "a": law.a, "effective_modulus_MPa": law.effective_modulus}
    return {name: float(value) for name, value in values.items()}


def effects_of(law: MccLaw) -> list[dict[str, Any]]:
    """The effects of a law: name, equation, the amplitude's unit where it is known, and numbers by name."""
    effects = []
    for effect in law.effects:
        mechanism, _, name = effect.name.partition(":")
        known = next((v for v in LIBRARY.get(mechanism, ()) if v.name == name), None)
        values = {one.name: getattr(effect, one.name) for one in fields(effect)}
        values = {name: float(value) for name, value in values.items() if eqx.is_inexact_array(value)}
        if known is None:
            more = {"equation": (inspect.getdoc(effect) or "").partition("\n")[0]}
        else:
            more = {"equation": known.equation, "unit": known.unit}
            values = {known.parameter: values.pop("amplitude"), **values}
        effects.append({"name": effect.name, **more, "numbers": values})
    return effects


def check(law: MccLaw, particle: Particle, *, monotone: bool = False) -> None:
    """Raise `InputError` for a law or a particle that cannot be exported."""
    if law.plastic.C1.ndim or law.a.ndim or particle.D3.ndim:
        raise InputError("a batch of laws or particles cannot be exported", remedy="Export one law.")
    if not bool(law.is_valid) or not all(abs(number) < HUGE for number in numbers(law).values()):
        remedy = f"C1, C5 and the modulus must be positive, and all below {HUGE:g}"
        raise InputError(f"the law is not usable: {numbers(law)}", remedy=remedy)
    if not bool(law.carries_stress(particle)):
        sizes, eta = ", ".join(f"{float(d):g}" for d in jax.tree.leaves(particle)), float(law.shape_factor(particle))
        problem = f"the shape factor of a particle of {sizes} um is {eta:.4g} with a = {float(law.a):.4g}"
        raise InputError(problem, remedy="Give --diameters of a rounder particle: shape factors must be positive")
    if monotone and not bool(law.is_monotone):
        remedy = "Take the population or another particle, or give --allow-not-monotone to export it as it is"
        raise InputError(_FALLING, remedy=remedy)


def read_calibration(
    folder: str | Path, *, particle: str | None = None, diameters: str | None = None, allow_not_monotone: bool = False
) -> tuple[MccLaw, Particle, Origin]:
    """The law that a calibration or a discovery found, and a particle for it.

    The population's law has the medians of its coefficients, exp(mean of log C). A discovery's has the effects that
    were added, except those of the instrument.

    Args:
        folder: what `mcc_jax.load` reads.
        particle: the one whose coefficients are taken; those of the population if None.
        diameters: `D1,D2,D3` [um], or a table of particles; those of the calibrated campaign if None. Of several, that
            particle's own, or the mean.
        allow_not_monotone: warn of a loading curve that falls, instead of refusing it.

    Raises:
        InputError: naming the file, what is wrong with it and what to do.
    """
    path = arguments.file_path(folder, "folder")
    found = load(path)
    if isinstance(found, Campaign):
        raise InputError(f"{ARCHIVE} is missing", file=path, remedy=_AGAIN)
    file = path / found.content_file
    try:
        whole = found.law(particle)
        law = whole.of_particle()
        shown, geometry = _sizes(found, particle, diameters)
        check(law, shown, monotone=not allow_not_monotone)
    except InputError as error:
        raise error.changed(file=error.file or file) from error
    content = found.to_json()
    converged = content.get("converged", True)
    values = content.get("parameters_after") or content.get("parameters_before") or content  # of a discovery
    if particle is not None and values is not content:
        values = found.posterior.to_json()
    logs = {f"log_{name}": values[f"log_{name}"] for name in COEFFICIENTS}
    estimates = {name: values[name] for name in ("a", "effective_modulus_MPa")}
    if particle is None:
        estimates |= {name: exponential(logs[f"log_{name}"]["mean"]) for name in COEFFICIENTS}
    else:
        estimates |= {name: entry_of(values, particle)[name] for name in COEFFICIENTS}
        if float(law.a) != values["a"]["value"]:
            estimates["a"] = {"value": float(law.a), "sd": None, "interval_95": None}
    warnings = [] if converged else [f"the calibration of {file.name} did not converge"]
    warnings += content.get("warnings", [])
    if particle is None and content.get("modulus_scatter") is not None:
        warnings.append("moduli scatter between particles in this calibration; this is the population's")
    if not bool(law.is_monotone):
        warnings.append(f"{_FALLING}; load control snaps through, and a pair of such contacts has several solutions")
    if observed := [effect.name for effect in whole.effects if effect.of_instrument]:
        warnings.append(f"{', '.join(observed)} belong to the instrument, not to the particle, and are left out")
    calibration = {
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None,
        "method": content.get("method", "discover"),
        "converged": converged,
        "seed": content.get("seed"),
    }
    return law, shown, Origin(estimates, logs, calibration, particle, geometry, tuple(warnings))


def _sizes(found: Any, particle: str | None, diameters: str | None) -> tuple[Particle, str]:
    """The particle that is shown, and where its diameters are from."""
    if diameters is None:
        campaign = getattr(found, "base", found).campaign
        source, given = "the calibrated campaign", dict(zip(campaign.particles, campaign.diameters_um, strict=True))
    else:
        source, given = Path(diameters).name, read_diameters(diameters)
    if not isinstance(given, Mapping):
        return Particle(*given), "given"
    if particle is None:
        D1, D2, D3 = np.array(list(given.values())).mean(axis=0).tolist()
        return Particle(D1, D2, D3), f"mean diameters of the {len(given)} particles of {source}"
    if particle not in given:
        raise InputError(f"there is no particle {particle!r}", file=diameters, remedy="Give --diameters D1,D2,D3 in um")
    return Particle(*map(float, given[particle])), f"particle {particle} of {source}"
