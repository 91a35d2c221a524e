"""The one place that knows how the solver is called and what of its answer is kept.

A solver is a function solve(folder, *, seed=0) -> dictionary of `discovery.json`.
"""

from __future__ import annotations

import importlib
import inspect
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .settings import SETTINGS

Solver = Callable[..., dict[str, Any]]

VERDICTS = ("NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED")
KEPT = (
    "verdict", "summary", "effects", "candidate_set", "ranking", "where", "closure", "leads", "gap", "parameters_after",
    "p_anything_missing", "findings", "notes", "runtime_s",
)  # fmt: skip
"""Keys of `discovery.json` that an outcome keeps."""


def quick(folder: Path, *, seed: int = 0) -> dict[str, Any]:
    """`in_process` without held-out search and posterior: names and places, a third of the time, no gap."""
    return in_process(folder, seed=seed, confirm=False, posterior=False)


def confirmed(folder: Path, *, seed: int = 0) -> dict[str, Any]:
    """`in_process` without a posterior: the gap on held-out particles, and whether they contradict what was found."""
    return in_process(folder, seed=seed, posterior=False)


def in_process(folder: Path, *, seed: int = 0, **options: Any) -> dict[str, Any]:
    """`mcc_jax.discovery.discover` in this process: campaigns share what is compiled."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from mcc_jax.campaign import read_campaign

    discover = importlib.import_module("mcc_jax.discovery").discover
    wanted = {"seed": seed, "experiments": False, **options}
    offered = inspect.signature(discover).parameters
    found = discover(read_campaign(folder), **{name: value for name, value in wanted.items() if name in offered})
    data = found.to_json()
    data = json.loads(data if isinstance(data, str) else json.dumps(data))
    if data.get("closure") is not None and hasattr(found, "correction_um"):
        corrections = found.correction_um(held_out=True)
        data["closure"]["held_out_correction_um"] = {name: thinned(values) for name, values in corrections.items()}
    return data


def thinned(values: Any) -> list[float]:
    """Every few readings of a correction, nil where there is none."""
    stride = SETTINGS.running.closure_stride
    return [round(float(v), 4) if math.isfinite(v) else 0.0 for v in values[::stride]]


def find(name: str) -> Solver:
    """A solver by name: "inprocess", "module:function", or "checkout:FOLDER" for the library of another checkout."""
    if name == "inprocess":
        return in_process
    module, _, function = name.partition(":")
    if module == "checkout":
        sys.path.insert(0, function)
        return in_process
    if not function:
        raise ValueError(f"no solver {name!r}: say inprocess, module:function or checkout:FOLDER")
    return getattr(importlib.import_module(module), function)


def problem(discovery: Any) -> str | None:
    """What makes this no valid answer, or None."""
    if not isinstance(discovery, dict):
        return "no dictionary"
    if discovery.get("verdict") not in VERDICTS:
        return f"verdict {discovery.get('verdict')!r}"
    effects = discovery.get("effects")
    if not isinstance(effects, list) or any(not isinstance(e, dict) or "mechanism" not in e for e in effects):
        return "effects are not a list of named effects"
    if discovery["verdict"] in ("NAMED", "SET") and not effects:
        return f"{discovery['verdict']} without an effect"
    if discovery["verdict"] == "NO_GAP" and effects:
        return "NO_GAP with effects"
    if not isinstance(discovery.get("candidate_set", []), list):
        return "candidate_set is no list"
    return None


def kept(discovery: Any) -> dict[str, Any]:
    """What an outcome keeps of an answer."""
    return {key: discovery[key] for key in KEPT if key in discovery} if isinstance(discovery, dict) else {}
