"""Every format into a folder, with its golden table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .. import arguments
from .._errors import InputError
from ..geometry import Particle
from ..law import MccLaw
from .c_header import c_header, lammps_recipe, yade_recipe
from .card import card
from .golden import golden_pair_table, golden_table
from .jax_artefact import jax_artefact, signatures
from .origin import Origin, checked
from .tables import curve_tables

Files = Iterator[tuple[str, Any]]
"""Names of files, and what each of them holds: text, bytes, a table, or what JSON can."""


def _json(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    yield "parameters.json", card(law, particle, origin=origin)
    yield "parameters_golden.csv", golden_table(law, particle, seed=seed)


def _csv(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    tables = curve_tables(law, particle)
    yield "master_curve.csv", tables.loading
    yield "unloading_curve.csv", tables.unloading
    p = law.strain_scaling.power
    use = {
        "loading": "stress from scaled strain eta_p eps, linearly between rows",
        "unloading": "stress = peak stress * stress_share at recovered_share = (eps_P - eps) / delta",
        "delta": f"recovered_strain_formula_at_eta_1 at eta_p eps_P, times eta_p^({(1 - p) / 2:g}), "
        "but at most the smaller of eps_P and (3 pi/8) stress_MPa / (eta_p tangent_MPa) there, so that no cycle gains "
        "energy; the second only where tangent_MPa > 0. With eta_p = 1, a sphere's, it is recovered_strain_at_eta_1",
        **({"effects": "these tables hold for the particle of this file alone"} if law.effects else {}),
        "largest_error": tables.error,
        "error_of": "linear interpolation, as a share of each column's largest value",
    }
    yield "master_curve.json", {**card(law, particle, origin=origin), "tables": use}
    yield "master_curve_golden.csv", golden_table(law, particle, seed=seed)


def _jax(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    files = {}
    for dtype in ("float64", "float32"):
        for which in signatures(law):
            artefact = jax_artefact(law, particle, which, dtype=dtype)
            name = f"mcc_{artefact.name}.jax_export"
            files[name] = artefact.signature
            yield name, artefact.content
    use = "jax.export.deserialize(bytearray(Path(file).read_bytes())).call(...), with the packages jax and flatbuffers"
    artefacts = {"use": use, "files": files}
    yield "mcc_jax_export.json", {**card(law, particle, origin=origin), "artefacts": artefacts}
    yield "mcc_jax_export_golden.csv", golden_table(law, particle, seed=seed)


def _c(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    yield "mcc_law.h", c_header(law, particle, origin=origin)
    yield "mcc_law_golden.csv", golden_table(law, particle, seed=seed, units="SI")
    yield "mcc_law_pair_golden.csv", golden_pair_table(law, particle, seed=seed, units="SI")


def _lammps(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    yield "lammps.md", lammps_recipe(law, particle, origin=origin)
    yield from _c(law, particle, origin, seed)


def _yade(law: MccLaw, particle: Particle, origin: Origin, seed: int) -> Files:
    yield "yade.md", yade_recipe(law, particle, origin=origin)
    yield from _c(law, particle, origin, seed)


_FILES: dict[str, Callable[[MccLaw, Particle, Origin, int], Files]] = {
    "json": _json, "csv": _csv, "jax": _jax, "c": _c, "lammps": _lammps, "yade": _yade,
}  # fmt: skip
FORMATS = tuple(_FILES)
"""What `write_export` writes: parameter card, tables, JAX artefacts, C header, recipes for LAMMPS and Yade."""


def write_export(
    format: str, law: MccLaw, particle: Particle, folder: str | Path, *, origin: Origin | None = None, seed: int = 0
) -> list[str]:
    """Write a law in a format of `FORMATS`, and the golden table that goes with it, into a folder that exists.

    Files of the same names are replaced. The particle is that of the golden table, whose random paths the seed decides;
    its size is part of `jax` artefacts.

    Returns:
        Names of the files.

    Raises:
        InputError: for a format that does not exist, a law or particle that is not usable, or a folder that is not
            there.
    """
    arguments.choice(format, FORMATS, "format")
    origin = checked(law, particle, origin)
    place = arguments.file_path(folder, "folder")
    if not place.is_dir():
        raise InputError("no such folder", file=place, remedy="Make it first.")
    names = []
    for name, content in _FILES[format](law, particle, origin, arguments.seed(seed)):
        names.append(name)
        if isinstance(content, bytes):
            (place / name).write_bytes(content)
        elif name.endswith(".csv"):
            content.to_csv(place / name, index=False, float_format="%.17g", lineterminator="\n")
        else:
            text = content if isinstance(content, str) else _as_json(content)
            (place / name).write_text(text, encoding="utf-8")
    return names


def _as_json(content: Any) -> str:
    return json.dumps(content, allow_nan=False, indent=2, ensure_ascii=False) + "\n"
