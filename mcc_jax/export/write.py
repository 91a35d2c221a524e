"""Every format into a folder, with its golden table."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import arguments
from .._errors import InputError
from ..geometry import Particle
from ..law import MccLaw
from .c_header import c_header
from .card import card
from .golden import golden_pair_table, golden_table
from .jax_artefact import jax_artefact, signatures
from .origin import Origin, checked
from .recipes import lammps_recipe, yade_recipe
from .tables import curve_tables

Write = Callable[[MccLaw, Particle, Origin, Path, int], list[str]]


def _json(law: MccLaw, particle: Particle, origin: Origin, folder: Path, seed: int) -> list[str]:
    _dump(folder / "parameters.json", card(law, particle, origin=origin))
    return ["parameters.json", *_golden(law, particle, folder, seed, "parameters")]


def _csv(law: MccLaw, particle: Particle, origin: Origin, folder: Path, seed: int) -> list[str]:
    tables = curve_tables(law, particle)
    _table(folder / "master_curve.csv", tables.loading)
    _table(folder / "unloading_curve.csv", tables.unloading)
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
    _dump(folder / "master_curve.json", {**card(law, particle, origin=origin), "tables": use})
    names = ["master_curve.csv", "unloading_curve.csv", "master_curve.json"]
    return [*names, *_golden(law, particle, folder, seed, "master_curve")]


def _jax(law: MccLaw, particle: Particle, origin: Origin, folder: Path, seed: int) -> list[str]:
    names, told = [], {}
    for dtype in ("float64", "float32"):
        for which in signatures(law):
            artefact = jax_artefact(law, particle, which, dtype=dtype)
            name = f"mcc_{artefact.name}.jax_export"
            (folder / name).write_bytes(artefact.content)
            told[name] = artefact.signature
            names.append(name)
    use = "jax.export.deserialize(bytearray(Path(file).read_bytes())).call(...), with the packages jax and flatbuffers"
    _dump(
        folder / "mcc_jax_export.json",
        {**card(law, particle, origin=origin), "artefacts": {"use": use, "files": told}},
    )
    return [*names, "mcc_jax_export.json", *_golden(law, particle, folder, seed, "mcc_jax_export")]


def _c(law: MccLaw, particle: Particle, origin: Origin, folder: Path, seed: int) -> list[str]:
    (folder / "mcc_law.h").write_text(c_header(law, particle, origin=origin), encoding="utf-8")
    _table(folder / "mcc_law_golden.csv", golden_table(law, particle, seed=seed, units="SI"))
    _table(folder / "mcc_law_pair_golden.csv", golden_pair_table(law, particle, seed=seed, units="SI"))
    return ["mcc_law.h", "mcc_law_golden.csv", "mcc_law_pair_golden.csv"]


def _recipe(recipe: Callable[..., str], name: str) -> Write:
    def write(law: MccLaw, particle: Particle, origin: Origin, folder: Path, seed: int) -> list[str]:
        (folder / name).write_text(recipe(law, particle, origin=origin), encoding="utf-8")
        return [name, *_c(law, particle, origin, folder, seed)]

    return write


_WRITERS: dict[str, Write] = {
    "json": _json,
    "csv": _csv,
    "jax": _jax,
    "c": _c,
    "lammps": _recipe(lammps_recipe, "lammps.md"),
    "yade": _recipe(yade_recipe, "yade.md"),
}
FORMATS = tuple(_WRITERS)
"""What `write_export` writes: parameter card, tables, JAX artefacts, C header, recipes for LAMMPS and Yade."""


def write_export(
    format: str, law: MccLaw, particle: Particle, folder: str | Path, *, origin: Origin | None = None, seed: int = 0
) -> list[str]:
    """Write a law in a format of `FORMATS`, and the golden table that goes with it, into a folder that exists.

    Args:
        format: one of `FORMATS`.
        law: the law.
        particle: the particle of the golden table, whose size is part of `jax` artefacts.
        folder: where to write; files of the same names are replaced.
        origin: where the law comes from.
        seed: of the golden table's random paths.

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
    return _WRITERS[format](law, particle, origin, place, arguments.seed(seed))


def _golden(law: MccLaw, particle: Particle, folder: Path, seed: int, stem: str) -> list[str]:
    _table(folder / f"{stem}_golden.csv", golden_table(law, particle, seed=seed))
    return [f"{stem}_golden.csv"]


def _table(file: Path, table: Any) -> None:
    table.to_csv(file, index=False, float_format="%.17g", lineterminator="\n")


def _dump(file: Path, content: Any) -> None:
    file.write_text(json.dumps(content, allow_nan=False, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
