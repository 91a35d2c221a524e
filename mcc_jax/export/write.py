"""The parameter card, and every format into a folder with its golden table."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from .. import arguments
from .._errors import InputError
from .._store import json_text
from .._version import __version__
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw
from .c_header import c_header, lammps_recipe, yade_recipe
from .jax_artefact import jax_artefact, signatures
from .origin import UNKNOWN, Origin, check, effects_of, numbers
from .tables import curve_tables, golden_pair_table, golden_table

FORMATS = ("json", "csv", "jax", "c", "lammps", "yade")
"""What `write_export` writes: parameter card, tables, JAX artefacts, C header, recipes for LAMMPS and Yade."""

FORMULAE = {
    "effective_diameter": "D_e = D1 D2 / D3, D3 along the compression",
    "strain": "eps = displacement / D_e",
    "stress": "sigma = force / (pi D_e^2 / 4); 1 MPa um^2 = 1e-3 mN",
    "shape_factor": "eta_p = 1 + a (1 - D3^2 / (D1 D2))",
    "loading": "sigma / MPa = C1 x - (C3 x)^3 + (C5 x)^5 with x = eta_p eps, for eps >= eps_P",
    "history": "eps_P is the largest strain so far, sigma_P the loading stress there",
    "recovered_strain": "delta^2 = (sigma_P / E)^n / (k eta_p^p eps_P), but delta no larger than recovery_limit",
    "recovery_limit": "the smaller of eps_P and (3 pi/8) sigma_P / (d sigma/d eps at eps_P on loading): no cycle gains "
    "energy; it holds where the formula would create some (printed form: peak strains below about 0.01), elsewhere the "
    "formula is untouched",
    "unloading": "sigma = sigma_P g(s), g(s) = (2/pi) (acos s - s sqrt(1 - s^2)), s = (eps_P - eps) / delta, "
    "for eps < eps_P; 0 for s >= 1; reloading retraces it",
    "unloading_slope": "dg/ds = -(4/pi) sqrt(1 - s^2)",
    "monotone": "stress never falls on loading if 9 C3^6 <= 20 C1 C5^5",
    "pair_of_particles": "each of two half contacts takes a share d_i of the overlap, F_i = force of a platen test at "
    "displacement 2 d_i; F_1 = F_2 on loading; F = F_P g(q), q = (overlap_P - overlap) / (recovered_1 + recovered_2) "
    "on unloading, recovered_i half that of the platen test, each with its own limit",
}


def card(law: MccLaw, particle: Particle, *, origin: Origin = UNKNOWN) -> dict[str, Any]:
    """The parameter card of a law, ready for `json.dump`.

    It has parameters with unit and uncertainty, form of the law, its effects with equation and numbers, validity,
    formulae in words (Bommireddy et al. 2018, eqs. 13, 16, 23, 24), provenance, warnings and a checksum (SHA-256) over
    the law and its numbers; of the golden table's particle size and shape factor. Uncertainty and provenance are those
    of `origin`.
    """
    check(law, particle)
    unloading, scaling = law.unloading, law.strain_scaling
    form = {"unloading": unloading.value, "strain_scaling": scaling.value}
    form |= {"k": unloading.constant, "n": unloading.stress_power, "p": scaling.power}
    effects = {"effects": effects_of(law)} if law.effects else {}
    signed = json.dumps({"law": form, "values": numbers(law), **effects}, sort_keys=True, separators=(",", ":"))
    parameters = {}
    for name, value in numbers(law).items():
        unit = "MPa" if name.endswith("_MPa") else "1"
        known = origin.estimates.get(name, {})
        parameters[name] = {"sd": None, "interval_95": None, **known, "value": value, "unit": unit}
    K1, K3, K5 = (float(K) for K in law.plastic.polynomial)
    diameter, eta = particle.effective_diameter, law.shape_factor(particle)
    return {
        "schema": 1,
        "what": "loading-unloading contact law of microcrystalline cellulose particles",
        "coefficients_of": "the population: exp(mean of log C)" if origin.particle is None else origin.particle,
        "law": form,
        "parameters": parameters,
        **effects,
        "uncertainty": "sd and interval_95 are those of the estimate; scatter between particles is in population.sd",
        "polynomial_MPa": {"K1": K1, "K3": K3, "K5": K5, "formula": "sigma = K1 x - K3 x^3 + K5 x^5"},
        "population": origin.population,
        "is_monotone": bool(law.is_monotone),
        "particle": {
            **{f"{name}_um": float(getattr(particle, name)) for name in ("D1", "D2", "D3")},
            "effective_diameter_um": float(diameter),
            "effective_area_um2": float(particle.effective_area),
            "eta_p": float(eta),
            "displacement_valid_um": TESTED_STRAIN * float(diameter / eta),
            "from": origin.geometry,
        },
        "validity": {
            "scaled_strain_max": TESTED_STRAIN,
            "stress_there_MPa": TESTED_STRAIN * (K1 - TESTED_STRAIN**2 * (K3 - TESTED_STRAIN**2 * K5)),
            "words": f"single particles between platens, along D3, eta_p eps up to {TESTED_STRAIN}; rate independent, "
            "no adhesion, no friction; contacts of one particle do not know of each other"
            + ("; all but what the effects say, which act on the numbers given here" if law.effects else ""),
        },
        "formulae": FORMULAE,
        "units": {"stress": "MPa", "length": "um", "force": "mN"},
        "provenance": {
            "software": "mcc_jax",
            "version": __version__,
            "calibration": origin.calibration,
            "reference": "Bommireddy, Agarwal, Yettella, Tomar, Gonzalez (2018), arXiv:1812.06173",
        },
        "warnings": list(origin.warnings),
        "sha256": hashlib.sha256(signed.encode()).hexdigest(),
    }


def write_export(
    format: str, law: MccLaw, particle: Particle, folder: str | Path, *, origin: Origin = UNKNOWN, seed: int = 0
) -> list[str]:
    """Write a law in a format of `FORMATS`, and the golden table that goes with it, into a folder that exists.

    Files of the same names are replaced; their names are returned. The particle is that of the golden table, whose
    random paths the seed decides; its size is part of `jax` artefacts.

    Raises:
        InputError: for a format or a folder that does not exist, or a law or particle that is not usable.
    """
    arguments.choice(format, FORMATS, "format")
    seed = arguments.seed(seed)
    place = arguments.file_path(folder, "folder")
    if not place.is_dir():
        raise InputError("no such folder", file=place, remedy="Make it first.")
    files = _files(format, law, particle, origin, seed)
    for name, content in files.items():
        if isinstance(content, bytes):
            (place / name).write_bytes(content)
        elif name.endswith(".csv"):
            content.to_csv(place / name, index=False, float_format="%.17g", lineterminator="\n")
        else:
            text = content if isinstance(content, str) else json_text(content)
            (place / name).write_text(text, encoding="utf-8")
    return list(files)


def _files(format: str, law: MccLaw, particle: Particle, origin: Origin, seed: int) -> dict[str, Any]:
    """What each file holds: text, bytes, a table, or what JSON can."""
    files: dict[str, Any] = {}
    if format in ("c", "lammps", "yade"):
        if format != "c":
            recipe = lammps_recipe if format == "lammps" else yade_recipe
            files[f"{format}.md"] = recipe(law, particle, origin=origin)
        files["mcc_law.h"] = c_header(law, particle, origin=origin)
        files["mcc_law_golden.csv"] = golden_table(law, particle, seed=seed, units="SI")
        files["mcc_law_pair_golden.csv"] = golden_pair_table(law, particle, seed=seed, units="SI")
        return files
    name, more = "parameters", {}
    if format == "csv":
        name, tables = "master_curve", curve_tables(law, particle)
        files = {"master_curve.csv": tables.loading, "unloading_curve.csv": tables.unloading}
        more = {"tables": _use_of_tables(law, tables.error)}
    elif format == "jax":
        name, signed = "mcc_jax_export", {}
        for dtype in ("float64", "float32"):
            for which in signatures(law):
                artefact = jax_artefact(law, particle, which, dtype=dtype)
                files[f"mcc_{artefact.name}.jax_export"] = artefact.content
                signed[f"mcc_{artefact.name}.jax_export"] = artefact.signature
        use = "jax.export.deserialize(bytearray(Path(file).read_bytes())).call(...)"
        more = {"artefacts": {"use": f"{use}, with the packages jax and flatbuffers", "files": signed}}
    files[f"{name}.json"] = {**card(law, particle, origin=origin), **more}
    files[f"{name}_golden.csv"] = golden_table(law, particle, seed=seed)
    return files


def _use_of_tables(law: MccLaw, error: float) -> dict[str, Any]:
    """How to interpolate the tables, in words."""
    p = law.strain_scaling.power
    return {
        "loading": "stress from scaled strain eta_p eps, linearly between rows",
        "unloading": "stress = peak stress * stress_share at recovered_share = (eps_P - eps) / delta",
        "delta": f"recovered_strain_formula_at_eta_1 at eta_p eps_P, times eta_p^({(1 - p) / 2:g}), "
        "but at most the smaller of eps_P and (3 pi/8) stress_MPa / (eta_p tangent_MPa) there, so that no cycle gains "
        "energy; the second only where tangent_MPa > 0. With eta_p = 1, a sphere's, it is recovered_strain_at_eta_1",
        **({"effects": "these tables hold for the particle of this file alone"} if law.effects else {}),
        "largest_error": error,
        "error_of": "linear interpolation, as a share of each column's largest value",
    }
