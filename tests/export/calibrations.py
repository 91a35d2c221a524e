"""Contents of calibration.json as the three methods write it, without running them."""

import json
import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from asserting import estimate

from mcc_jax import load
from mcc_jax.calibrate.results import Calibration

SIZES = {"A": (200, 190, 160), "b c": (150, 140, 130), "falling": (150, 140, 130), "out": (100, 90, 80)}
POPULATION = {"C1": (math.log(6.7), 0.3), "C3": (math.log(3.0), 0.0), "C5": (math.log(2.66), 0.08)}


def entry(name, C1, C3, C5, kept=True):
    values = zip(("C1", "C3", "C5"), (C1, C3, C5), strict=True)
    return {
        "particle": name,
        "eta_p": estimate(1.3 if kept else None),
        **{k: estimate(v if kept else None, 0.1 if kept else None) for k, v in values},
        "zero_um": estimate(0.0 if kept else None),
        "rms_um": 0.02 if kept else None,
        "kept": kept,
        "why_not": None if kept else "burst at 3 mN",
    }


def content(**changes):
    """A calibration of four particles: 'A', 'b c', a falling one and one that took no part."""
    return {
        "schema": 1,
        "method": "bayes",
        "converged": True,
        "runtime_s": 1.0,
        "seed": 5,
        "law": {"unloading": "punch", "strain_scaling": "contact"},
        "a": estimate(1.4, 0.05),
        "effective_modulus_MPa": estimate(400.0, 10.0),
        **{f"log_{k}": {"mean": estimate(mean, 0.05), "sd": estimate(sd)} for k, (mean, sd) in POPULATION.items()},
        "particles": [
            entry("A", 6.0, 2.9, 2.7),
            entry("b c", 9.0, 3.1, 2.5),
            entry("falling", 4.0, 3.0, 2.4),
            entry("out", None, None, None, kept=False),
        ],
        "warnings": [],
        "noise": {},
        "diagnostics": {"rhat_max": None, "ess_bulk_min": None, "divergences": None, "pareto_k_max": None},
    } | changes


def write(folder, **changes):
    """A folder with that calibration; returns it."""
    folder.mkdir(exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps(content(**changes)))
    return folder


def campaign():
    return SimpleNamespace(particles=tuple(SIZES), diameters_um=np.array(list(SIZES.values()), float))


@dataclass(frozen=True, repr=False)
class Numbers(Calibration):
    """Stands in for a saved calibration: what `write` wrote."""

    content: dict
    campaign: Any = field(default_factory=campaign, kw_only=True)


def stand_in(folder):
    """What `load` gives in these tests."""
    file = folder / "calibration.json"
    return Numbers(json.loads(file.read_text())) if file.is_file() else load(folder)
