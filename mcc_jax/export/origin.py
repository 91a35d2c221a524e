"""Where exported values come from: a folder of results, estimates, what a user of them must know."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .. import arguments
from .._errors import InputError
from .._format import described
from ..calibrate.estimates import entry_of, exponential
from ..calibrate.population import COEFFICIENTS
from ..calibrate.results import ARCHIVE, load
from ..campaign import Campaign, read_diameters
from ..geometry import Particle
from ..law import MccLaw

PARTICLES = "particles.csv"
SPHERE_UM = 200.0
_AGAIN = "Give a folder that mcc-jax calibrate or discover wrote, or calibrate again"


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
    C = law.plastic
    values = {"C1": C.C1, "C3": C.C3, "C5": C.C5, "a": law.a, "effective_modulus_MPa": law.effective_modulus}
    return {name: float(value) for name, value in values.items()}


HUGE = 1e44
"""Above every median that a log_C may have (exp 100), and small enough for C1 C5^5 and C3^6 to be finite."""


def checked(law: Any, particle: Any, origin: Any = None, *, needed: bool = True) -> Origin:
    """The origin, or an empty one, of a law that can be exported and a particle that it carries, if one is `needed`.

    Raises:
        InputError: without a particle that is needed, for a batch of laws, or a law or particle that is not usable.
    """
    if needed and particle is None:
        raise InputError("particle must be given", remedy="Make one with mcc_jax.Particle(D1, D2, D3), in um.")
    if law.plastic.C1.ndim or law.a.ndim or (particle is not None and particle.D3.ndim):
        raise InputError("a batch of laws or particles cannot be exported", remedy="Export one law.")
    sphere = Particle(1.0, 1.0, 1.0)  # every law carries it
    check(law, sphere if particle is None else particle, allow_not_monotone=True)
    return origin or Origin()


def check(law: MccLaw, particle: Particle, *, allow_not_monotone: bool = False) -> tuple[str, ...]:
    """Warnings about a law for other engines.

    Raises:
        InputError: if a parameter is out of its range, the particle carries no stress, or the loading curve falls and
            that is not allowed.
    """
    if not bool(law.is_valid) or not all(abs(number) < HUGE for number in numbers(law).values()):
        raise InputError(
            f"the law is not usable: {numbers(law)}",
            remedy=f"C1, C5 and the modulus must be positive, and all below {HUGE:g}",
        )
    if not bool(law.carries_stress(particle)):
        sizes = ", ".join(f"{float(d):g}" for d in jax.tree.leaves(particle))
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


# ---- from a folder of results ----------------------------------------------------------------------------------------


def read_calibration(
    folder: str | Path, *, particle: str | None = None, diameters: str | None = None, allow_not_monotone: bool = False
) -> tuple[MccLaw, Particle, Origin]:
    """The law that a calibration or a discovery found, for the population or one particle, and a particle for it.

    The population's law has the medians of its coefficients, exp(mean of log C). A discovery's has the effects that
    were added, except those of the instrument.

    Args:
        folder: what `mcc_jax.load` reads.
        particle: take this particle's coefficients.
        diameters: `D1,D2,D3` [um], or a table of particles (its row of that particle, or its mean). If None, those of
            the calibrated campaign or of a `particles.csv` next to it; without one, a sphere of 200 um.
        allow_not_monotone: warn of a loading curve that falls, instead of refusing it.

    Returns:
        The law, the particle, and where they come from.

    Raises:
        InputError: naming the file, what is wrong with it and what to do.
    """
    path = arguments.file_path(folder, "folder")
    found = load(path)
    if isinstance(found, Campaign):
        raise InputError(f"{ARCHIVE} is missing", file=path, remedy=_AGAIN)
    content = found.to_json()
    file = path / found.content_file
    try:
        entry = None if particle is None else entry_of(content, particle)
        sizes, geometry = _sizes(found, path, particle, diameters)
        law = found.law(particle)
        observed = [effect.name for effect in law.effects if effect.of_instrument]
        law = law.of_particle()
        notes = check(law, sizes, allow_not_monotone=allow_not_monotone)
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    if observed:
        notes = (*notes, f"{', '.join(observed)} belong to the instrument, not to the particle, and are left out")
    return law, sizes, _origin(content, entry, law, file, particle, geometry, notes)


def _origin(
    content: Mapping[str, Any],
    entry: Mapping[str, Any] | None,
    law: MccLaw,
    file: Path,
    particle: str | None,
    geometry: str,
    notes: tuple[str, ...],
) -> Origin:
    numbers = content.get("parameters_after") or content.get("parameters_before") or content  # of a discovery
    logs = {f"log_{name}": numbers[f"log_{name}"] for name in COEFFICIENTS}
    estimates = {name: numbers[name] for name in ("a", "effective_modulus_MPa")}
    if entry is None:
        estimates |= {name: exponential(logs[f"log_{name}"]["mean"]) for name in COEFFICIENTS}
    else:
        estimates |= {name: entry[name] for name in COEFFICIENTS}
        if float(law.a) != numbers["a"]["value"]:
            estimates["a"] = {"value": float(law.a), "sd": None, "interval_95": None}
    warnings = [] if content.get("converged", True) else [f"the calibration of {file.name} did not converge"]
    warnings += content.get("warnings", [])
    if entry is None and content.get("modulus_scatter") is not None:
        warnings.append("moduli scatter between particles in this calibration; this is the population's")
    calibration = {
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None,
        "method": content.get("method", "discover"),
        "converged": content.get("converged", True),
        "seed": content.get("seed"),
    }
    return Origin(estimates, logs, calibration, particle, geometry, (*warnings, *notes))


def _sizes(found: Any, folder: Path, particle: str | None, diameters: str | None) -> tuple[Particle, str]:
    table = next((t for t in (folder / PARTICLES, folder / "campaign" / PARTICLES) if os.path.lexists(t)), None)
    campaign = getattr(found, "campaign", None)
    if diameters is None and table is None and campaign is None:
        if particle is not None:
            raise InputError(
                f"the size of particle {particle!r} is not known",
                file=folder,
                remedy="Give --diameters D1,D2,D3 in um, or the campaign's particles.csv",
            )
        return Particle(SPHERE_UM, SPHERE_UM, SPHERE_UM), f"a sphere of {SPHERE_UM:g} um: no diameters were given"
    source = str(table) if diameters is None else diameters
    if diameters is None and campaign is not None:
        source, given = "the calibrated campaign", dict(zip(campaign.particles, campaign.diameters_um, strict=True))
    else:
        given = read_diameters(source)
    if not isinstance(given, Mapping):
        return Particle(*given), "given"
    if particle is None:
        D1, D2, D3 = np.array([list(triple) for triple in given.values()]).mean(axis=0).tolist()
        return Particle(D1, D2, D3), f"mean diameters of the {len(given)} particles of {Path(source).name}"
    if particle not in given:
        raise InputError(f"there is no particle {particle!r}", file=source, remedy="Give --diameters D1,D2,D3 in um")
    D1, D2, D3 = (float(d) for d in given[particle])
    return Particle(D1, D2, D3), f"particle {particle} of {Path(source).name}"
