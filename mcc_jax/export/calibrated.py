"""From a folder of results to a law for other engines, and a particle to show it on."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import arguments
from .._errors import InputError
from ..calibrate.laws import COEFFICIENTS, entry_of, law_of
from ..calibrate.results import CONTENT, Calibration, OldCalibration, load
from ..campaign import Campaign, read_diameters
from ..geometry import Particle
from ..law import MccLaw
from .origin import Origin, check

PARTICLES = "particles.csv"
SPHERE_UM = 200.0
_AGAIN = "Give a folder that mcc-jax calibrate or discover wrote, or calibrate again"


def read_calibration(
    folder: str | Path,
    *,
    particle: str | None = None,
    diameters: str | None = None,
    allow_not_monotone: bool = False,
) -> tuple[MccLaw, Particle, Origin]:
    """The law that a calibration or a discovery found, for the population or one particle, and a particle for it.

    The population's law has the medians of its coefficients, exp(mean of log C). A discovery's has the effects that
    were added, but for those of the tester.

    Args:
        folder: what `mcc_jax.load` reads.
        particle: take this particle's coefficients.
        diameters: `D1,D2,D3` [um], or a table of particles (its row of that particle, or its mean). If None, those of
            the calibrated campaign or of a `particles.csv` beside it; without one, a sphere of 200 um.
        allow_not_monotone: warn of a loading curve that falls, instead of refusing it.

    Returns:
        The law, the particle, and where they come from.

    Raises:
        InputError: naming the file, what is wrong with it and what to do.
    """
    path = arguments.file_path(folder, "folder")
    if particle is not None:
        arguments.instance(particle, str, "particle", "Give the name of one.")
    found = load(path)
    if isinstance(found, Campaign):
        raise InputError(f"{CONTENT} is missing", file=path, remedy=_AGAIN)
    content = found.to_json()
    file = path / (CONTENT if isinstance(found, Calibration) else "discovery.json")
    try:
        entry = None if particle is None else entry_of(content, particle)
        sizes, geometry = _sizes(found, path, particle, diameters)
        three = np.array([float(d) for d in (sizes.D1, sizes.D2, sizes.D3)])
        law = law_of(content, particle, three) if isinstance(found, OldCalibration) else found.law(particle)
        testers = [effect.name for effect in law.effects if effect.of_tester]
        law = law.of_particle()
        notes = check(law, sizes, allow_not_monotone=allow_not_monotone)
    except InputError as error:
        if error.file is not None:
            raise
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    if testers:
        notes = (*notes, f"{', '.join(testers)} belong to the tester, not to the particle, and are left out")
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
    after = content.get("parameters_after") or content.get("parameters_before")  # of a discovery
    numbers = after or content
    logs = {f"log_{name}": numbers[f"log_{name}"] for name in COEFFICIENTS}
    estimates = {name: numbers[name] for name in ("a", "effective_modulus_MPa")}
    if entry is None:
        estimates |= {name: _median(logs[f"log_{name}"]["mean"]) for name in COEFFICIENTS}
    else:
        estimates |= {name: entry[name] for name in COEFFICIENTS}
        if float(law.a) != numbers["a"]["value"]:
            estimates["a"] = {"value": float(law.a), "sd": None, "interval_95": None}
    told = [f"the calibration of {file.name} did not converge"] if not content.get("converged", True) else []
    told += content.get("warnings", [])
    if entry is None and content.get("modulus_scatter") is not None:
        told.append("moduli scatter between particles in this calibration; this is the population's")
    calibration = {
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None,
        "method": content.get("method", "discover"),
        "converged": content.get("converged", True),
        "seed": content.get("seed"),
    }
    return Origin(estimates, logs, calibration, particle, geometry, (*told, *notes))


def _median(log: Mapping[str, Any]) -> dict[str, Any]:
    value, sd, interval = math.exp(log["value"]), log["sd"], log["interval_95"]
    return {
        "value": value,
        "sd": None if sd is None else value * sd,
        "interval_95": None if interval is None else [math.exp(min(end, 700.0)) for end in interval],
    }


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
