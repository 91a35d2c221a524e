"""The one place that knows how the solver is called and what its experiments are called.

A solver is a function solve(folder, *, exclude=(), seed=0, options=None) -> dictionary of `discovery.json`, plus the
key "options_not_offered" with the names of options it has not.
"""

from __future__ import annotations

import importlib
import inspect
import json
import subprocess
import sys
import tempfile
from pathlib import Path

VERDICTS = ("NO_GAP", "NAMED", "SET", "UNLISTED", "FIT_NOT_CONVERGED")

# Mechanism: name of the parameter in discovery.json that means what the exact formula's amplitude means, for recovery.
PARAMETERS = {"frame_compliance": "compliance_um_per_mN"}


def in_process(folder, *, exclude=(), seed=0, options=None):
    """`mcc_jax.discover.discover` in this process: many campaigns share one compilation."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from mcc_jax.campaign import read_campaign

    discover = importlib.import_module("mcc_jax.discover").discover
    offered = inspect.signature(discover).parameters
    wanted = {"seed": seed, **({"exclude": tuple(exclude)} if exclude else {}), **(options or {})}
    missing = sorted(name for name in wanted if name not in offered)
    if "exclude" in missing:
        raise TypeError("the solver cannot strike a name from its library")
    result = discover(read_campaign(folder), **{name: value for name, value in wanted.items() if name in offered})
    data = result.to_json()
    data = json.loads(data) if isinstance(data, str) else json.loads(json.dumps(data))
    if data.get("closure") is not None:
        for key, held_out in (("correction_um", False), ("held_out_correction_um", True)):
            # Without NaN: rows that took no part are not corrected.
            found = result.correction_um(held_out=held_out)
            data["closure"][key] = {name: [v if v == v else 0.0 for v in map(float, um)] for name, um in found.items()}
    return {**data, "options_not_offered": [name for name in missing if name != "seed"]}


def by_command(folder, *, exclude=(), seed=0, options=None):
    """`mcc-jax discover` as a user calls it, a process of its own."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        command = [sys.executable, "-m", "mcc_jax", "discover", str(folder), "--out", str(out), "--seed", str(seed)]
        for name in exclude:
            command += ["--exclude", name]
        for name, value in (options or {}).items():
            command += [f"--{name.replace('_', '-')}", str(value)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"exit status {done.returncode}: {done.stderr.strip()[-500:]}")
        return {**json.loads((out / "discovery.json").read_text()), "options_not_offered": []}


def find(name):
    """A solver by name: "inprocess", "command" or "module:function"."""
    if name == "inprocess":
        return in_process
    if name == "command":
        return by_command
    module, _, function = name.partition(":")
    if not function:
        raise ValueError(f"no solver {name!r}: say inprocess, command or module:function")
    return getattr(importlib.import_module(module), function)


def problem(discovery):
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


def follow_up_of(experiments, case):
    """What the first proposed experiment changes in the case, or None where there is none that the generator can do."""
    if not experiments:
        return None
    text = json.dumps(experiments[0].get("experiment", "")).lower()
    if "rate" in text:
        protocol = "P2"
    elif any(word in text for word in ("hold", "reload", "cycle")):
        protocol = "P1" if case["protocol"] == "P0" else case["protocol"]
    elif any(word in text for word in ("more particles", "more of the same", "repeat")):
        protocol = case["protocol"]
    else:
        return None
    count = experiments[0].get("particles", case["count"])
    changes = {} if protocol == case["protocol"] else {"protocol": protocol}
    if count != case["count"]:
        changes |= {"count": count, "resample": True}
    return changes
