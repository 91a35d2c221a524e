"""From the folder of a calibration to a law: `calibration.json`, and the sizes beside it."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from .. import arguments
from .._errors import InputError
from .._text import check_text
from ..campaign import read_diameters
from ..files import LIMITS, read_regular
from ..geometry import Particle
from ..law import MccLaw, Plastic, StrainScaling, Unloading
from .origin import Origin, check

CALIBRATION, PARTICLES = "calibration.json", "particles.csv"
SPHERE_UM = 200.0
COEFFICIENTS = ("C1", "C3", "C5")
_AGAIN = "Give a folder that mcc-jax calibrate wrote, or calibrate again"


def read_calibration(
    folder: str | Path,
    *,
    particle: str | None = None,
    diameters: str | None = None,
    allow_not_monotone: bool = False,
) -> tuple[MccLaw, Particle, Origin]:
    """The law that a calibration found, for the population or one particle, and a particle to show it on.

    The population's law has the medians of its coefficients, exp(mean of log C).

    Args:
        folder: holds `calibration.json`, of any method.
        particle: take this particle's coefficients.
        diameters: `D1,D2,D3` [um], or a table of particles (its row of that particle, or its mean). If None, the
            `particles.csv` beside the calibration or in its folder `campaign`; without one, a sphere of 200 um.
        allow_not_monotone: warn of a loading curve that falls, instead of refusing it.

    Returns:
        The law, the particle, and where they come from.

    Raises:
        InputError: naming the file, what is wrong with it and what to do.
    """
    folder = arguments.file_path(folder, "folder")
    if particle is not None:
        arguments.instance(particle, str, "particle", "Give the name of one.")
    file = folder / CALIBRATION
    content, checksum = _read(file)
    form, scaling = _forms(content, file)
    entry = None if particle is None else _entry(content, particle, file)
    sizes, geometry = _sizes(Path(folder), particle, diameters)
    estimates = {
        "a": _estimate(content, ("a",), file),
        "effective_modulus_MPa": _estimate(content, ("effective_modulus_MPa",), file),
    }
    logs = {f"log_{name}": _log(content, name, file) for name in COEFFICIENTS}
    notes = [f"the calibration of {file.name} did not converge"] if not content.get("converged") else []
    told = content.get("warnings")
    notes += [w for w in told if isinstance(w, str)] if isinstance(told, list) else []
    if entry is None:
        estimates |= {name: _median(logs[f"log_{name}"]["mean"]) for name in COEFFICIENTS}
    else:
        estimates |= {name: _estimate(entry, (name,), file) for name in COEFFICIENTS}
        if content.get("shape_scatter") is not None:
            estimates["a"] = _own_shape(entry, sizes, estimates["a"], file)
        if content.get("modulus_scatter") is not None:
            notes.append("moduli scatter between particles in this calibration; this is the population's")
    try:
        law = MccLaw(
            Plastic(*(estimates[name]["value"] for name in COEFFICIENTS)),
            estimates["a"]["value"],
            estimates["effective_modulus_MPa"]["value"],
            form,
            scaling,
        )
        notes += check(law, sizes, allow_not_monotone=allow_not_monotone)
    except InputError as error:
        raise InputError(error.problem, file=file, remedy=error.remedy) from error
    calibration = {
        "file": file.name,
        "sha256": checksum,
        **{key: content.get(key) for key in ("method", "converged", "seed")},
    }
    return law, sizes, Origin(estimates, logs, calibration, particle, geometry, tuple(notes))


def _read(file: Path) -> tuple[dict[str, Any], str]:
    if not file.parent.is_dir():
        raise InputError("no such folder", file=file.parent, remedy=_AGAIN)
    if not os.path.lexists(file):
        raise InputError(f"{file.name} is missing", file=file.parent, remedy=_AGAIN)
    raw = read_regular(file, LIMITS.result_bytes, _AGAIN)
    try:
        content = json.loads(raw, parse_float=_finite, parse_constant=_finite)
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON: {error.msg}", file=file, row=error.lineno, remedy=_AGAIN) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", file=file, remedy=_AGAIN) from error
    check_text(content, file, _AGAIN)
    if not isinstance(content, dict) or content.get("schema") != 1:
        raise InputError("is no calibration.json of schema 1", file=file, remedy=_AGAIN)
    return content, hashlib.sha256(raw).hexdigest()


def _finite(text: str) -> float:
    """A number that JSON can hold again: Python also reads NaN and 1e400, and would write neither."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} is no number")
    return number


def _forms(content: Mapping[str, Any], file: Path) -> tuple[Unloading, StrainScaling]:
    law = content.get("law")
    law = law if isinstance(law, dict) else {}
    try:
        return Unloading(law.get("unloading")), StrainScaling(law.get("strain_scaling"))
    except ValueError as error:
        raise InputError(f"law: {error}", file=file, remedy=_AGAIN) from error


def _estimate(content: Mapping[str, Any], keys: tuple[str, ...], file: Path) -> dict[str, Any]:
    """An estimate whose value is a finite number; what is not known of its uncertainty is None."""
    name = ".".join(keys)
    found: Any = content
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    value = found.get("value") if isinstance(found, dict) else None
    if value is None and keys == ("effective_modulus_MPa",):
        raise InputError(
            "holds no effective modulus", file=file, remedy="Calibrate on tests that unload: engines need it"
        )
    if not _is_number(value):
        raise InputError(f"{name} has no value", file=file, remedy=_AGAIN)
    sd, interval = found.get("sd"), found.get("interval_95")
    ends = interval if isinstance(interval, list) and len(interval) == 2 and all(map(_is_number, interval)) else None
    return {"value": float(value), "sd": float(sd) if _is_number(sd) else None, "interval_95": ends}


def _is_number(value: Any) -> TypeGuard[float]:
    # The bounds and not `math.isfinite`, which fails at an integer of more than 308 digits.
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e300 <= value <= 1e300


def _log(content: Mapping[str, Any], name: str, file: Path) -> dict[str, Any]:
    mean = _estimate(content, (f"log_{name}", "mean"), file)
    if abs(mean["value"]) > 100:
        raise InputError(f"log_{name}.mean = {mean['value']:g} is no sensible value", file=file, remedy=_AGAIN)
    try:
        sd = _estimate(content, (f"log_{name}", "sd"), file)
    except InputError:  # one particle alone says nothing of it
        sd = {"value": None, "sd": None, "interval_95": None}
    return {"mean": mean, "sd": sd}


def _median(log: Mapping[str, Any]) -> dict[str, Any]:
    value, sd, interval = math.exp(log["value"]), log["sd"], log["interval_95"]
    return {
        "value": value,
        "sd": None if sd is None else value * sd,
        "interval_95": None if interval is None else [math.exp(min(end, 700.0)) for end in interval],
    }


def _entry(content: Mapping[str, Any], name: str, file: Path) -> dict[str, Any]:
    entries = content.get("particles")
    entries = [e for e in entries if isinstance(e, dict)] if isinstance(entries, list) else []
    names = [str(e.get("particle")) for e in entries]
    if name not in names:
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        raise InputError(f"there is no particle {name!r}", file=file, remedy=f"--particle takes one of: {shown}")
    entry = entries[names.index(name)]
    if not entry.get("kept"):
        raise InputError(
            f"particle {name!r} took no part in the calibration: {entry.get('why_not')}",
            file=file,
            remedy="Take another particle or, without --particle, the population",
        )
    return entry


def _own_shape(entry: Mapping[str, Any], sizes: Particle, shared: dict[str, Any], file: Path) -> dict[str, Any]:
    """Where a differs between particles, the one that gives this particle its own shape factor."""
    flatness = float(sizes.flatness)
    if abs(flatness) < 1e-3:  # of a round particle the shape factor is 1, whatever a
        return shared
    eta = _estimate(entry, ("eta_p",), file)["value"]
    return {"value": (eta - 1) / flatness, "sd": None, "interval_95": None}


def _sizes(folder: Path, particle: str | None, diameters: str | None) -> tuple[Particle, str]:
    table = next((t for t in (folder / PARTICLES, folder / "campaign" / PARTICLES) if os.path.lexists(t)), None)
    if diameters is None and table is None:
        if particle is not None:
            raise InputError(
                f"the size of particle {particle!r} is not known",
                file=folder,
                remedy="Give --diameters D1,D2,D3 in um, or the campaign's particles.csv",
            )
        return Particle(SPHERE_UM, SPHERE_UM, SPHERE_UM), f"a sphere of {SPHERE_UM:g} um: no diameters were given"
    source = str(table) if diameters is None else diameters
    found = read_diameters(source)
    if not isinstance(found, Mapping):
        D1, D2, D3 = found
        return Particle(D1, D2, D3), "given"
    if particle is None:
        D1, D2, D3 = np.array([list(triple) for triple in found.values()]).mean(axis=0).tolist()
        return Particle(D1, D2, D3), f"mean diameters of the {len(found)} particles of {Path(source).name}"
    if particle not in found:
        raise InputError(
            f"there is no particle {particle!r}",
            file=source,
            remedy="Give --diameters D1,D2,D3 in um",
        )
    D1, D2, D3 = found[particle]
    return Particle(D1, D2, D3), f"particle {particle} of {Path(source).name}"
