"""The 40 campaigns of continuous integration: fixed seeds, and the class of verdict each must get.

`cases()` lists them, `expected()` gives for each a set of allowed verdicts, the mechanism that must be named or be in
the first candidate set, or the mechanism that must be called untestable. `check(case, discovery)` says what is wrong,
or None.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace

from benchmarks.blind.generator import tiers

MASTER_SEED = 20_250_601

_NAMED = (
    ("frame_compliance", "P1"),
    ("thermal_drift", "P1"),
    ("creep", "P1"),
    ("rate_dependence", "P2"),
    ("adhesion", "P1"),
    ("damage", "P1"),
    ("densification_stiffening", "P1"),
    ("reload_hysteresis", "P1"),
    ("finite_hardening_exponent", "P0"),
    ("unloading_shape", "P1"),
    ("shape_second_order", "P0"),
    ("pop_in", "P0"),
    ("toe_asperity", "P0"),
    ("platen_friction", "P1"),
    ("misalignment", "P0"),
    ("platen_sink_in", "P1"),
    ("reverse_plasticity", "P1"),
    ("humidity", "P1"),
    ("ratcheting", "P1"),
)
_VARIANTS = (
    "frame_compliance.stiffening-20-P0-0",
    "creep.logarithmic-20-P0-0",
    "adhesion.dugdale-20-P1-1",
    "reverse_plasticity.threshold-20-P0-0",
)
_UNLISTED = ("strain_ripple", "gauge_interpolation", "drive_backlash", "mid_unloading_bump")


def cases():
    """The 40 cases: 8 nulls, 19 exact, 4 variants, 4 unlisted, 3 untestable, 2 struck names."""
    found = {case.id: case for case in tiers.plan()}
    chosen = [found[f"T0-clean-{k}"] for k in range(4)]
    chosen += [
        found[f"T0-{name}-0"] for name in ("heavy_tails", "particle_scale", "long_correlation", "modulus_spread")
    ]
    for name, protocol in _NAMED:
        strength = 10 if protocol == "P2" else 20
        chosen.append(found[f"T1-{name}.exact-{strength}-{protocol}-0"])
    chosen += [found[f"T2-{name}"] for name in _VARIANTS]
    chosen += [found[f"T4-{name}.unlisted-20-P1-1"] for name in _UNLISTED]
    chosen += [found[f"T6-{name}-P0-0"] for name in ("reload_hysteresis", "ratcheting", "finite_punch")]
    chosen += [
        found["T5-reload_hysteresis.exact-20-P1-1"],
        found["T5-adhesion.exact-20-P1-1"],
    ]
    return [replace(case, count=min(case.count, 20)) for case in chosen]


def expected(case):
    """What an answer to this case may be: {"verdicts", "mechanism" or None, "untestable" or None}."""
    named = {"NAMED", "SET"}
    if case.tier == "T0":
        return {"verdicts": {"NO_GAP"}, "mechanism": None, "untestable": None}
    if case.tier in ("T1", "T2"):
        return {"verdicts": named, "mechanism": case.effects[0][0], "untestable": None}
    if case.tier in ("T4", "T5"):
        return {"verdicts": {"UNLISTED"}, "mechanism": None, "untestable": None}
    return {"verdicts": {"NO_GAP"}, "mechanism": None, "untestable": None if case.cell == "finite_punch" else case.cell}


def check(case, discovery):
    """What is wrong with the answer, or None."""
    wanted = expected(case)
    if discovery["verdict"] not in wanted["verdicts"]:
        return f"{case.id}: {discovery['verdict']} instead of {' or '.join(sorted(wanted['verdicts']))}"
    first = {e["mechanism"] for e in discovery["effects"][:1]} | set((discovery.get("candidate_set") or [[]])[0])
    if wanted["mechanism"] and wanted["mechanism"] not in first:
        return f"{case.id}: {', '.join(sorted(first))} does not hold {wanted['mechanism']}"
    silent = {u["mechanism"] for u in discovery.get("untestable", []) if u.get("needs")}
    if wanted["untestable"] and wanted["untestable"] not in silent:
        return f"{case.id}: {wanted['untestable']} is not called untestable"
    return None


def fingerprint():
    """Hash of the list of cases: a change of the smoke test shows."""
    records = [case.record() for case in cases()]
    return hashlib.sha256(json.dumps([MASTER_SEED, records], sort_keys=True).encode()).hexdigest()
