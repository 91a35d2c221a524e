"""The gap that is closed, the correction, and the parameters that come back."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from benchmarks.blind import adapter

from ._table import NO_GATE, interval

# Mechanisms beside which the base law's parameters keep their meaning, so that their recovery can be judged.
KEEPS_MEANING = (
    "frame_compliance",
    "thermal_drift",
    "creep",
    "adhesion",
    "reload_hysteresis",
    "ratcheting",
    "pop_in",
    "toe_asperity",
    "misalignment",
    "platen_sink_in",
    "reverse_plasticity",
)


def add_closure(table, unlisted):
    """Rows: how well a formula's correction meets what was hidden."""
    curves, errors = [], []
    for o in unlisted:
        closure = o.found.get("closure") or {}
        if o.answer["effects"][0]["lambda"] < 18.0:
            continue
        if closure.get("held_out_correction_um"):
            curves.append(curve_error(o.answer, closure["held_out_correction_um"]))
        if closure.get("correction_um"):
            errors.append(closure_error(o.answer, closure["correction_um"]))
    table.value(
        "closure, T4, lambda>=20: NRMSE of the correction on held-out particles (median)",
        curves,
        "<=10%",
        "<=5%",
        at_most=0.10,
        of=np.median,
    )
    table.value("  the same, whitened, over its own length (median)", errors, NO_GATE, "-", of=np.median)


def _corrections(answer, correction):
    """Projection of a case, and true and given change of the displacement, (particles, samples), um."""
    from benchmarks.blind.generator import campaigns, tiers
    from benchmarks.blind.generator.strength import Projection

    drawn, _ = campaigns.design(tiers.from_record(answer["case"]), answer["master_seed"])
    projection = Projection(drawn.particles, drawn.path, drawn.noise, drawn.scale)
    pairs = [p for e, kept in zip(drawn.effects, answer["effects"], strict=True) for p in e(abs(kept["amplitude"]))]
    given = np.stack([np.asarray(correction[str(i + 1)], dtype=float) for i in range(len(drawn.scale))])
    return projection, projection.change(tuple(pairs)), given


def curve_error(answer, correction):
    """Root mean square error of a correction over the range of the true one, both as far as the base law, refitted,
    cannot take them up.

    correction: {particle: displacement in um at every row of the file}.
    """
    projection, truth, given = _corrections(answer, correction)
    truth, given = projection.unexplained(truth), projection.unexplained(given)
    return float(np.sqrt(np.mean((given - truth) ** 2)) / (truth.max() - truth.min()))


def closure_error(answer, correction):
    """Length of a correction's error over that of the true one, whitened, beyond what the base law can take up."""
    projection, truth, given = _corrections(answer, correction)
    truth = projection.project(truth)
    return float(np.linalg.norm(projection.project(given) - truth) / np.linalg.norm(truth))


def add_gap(table, listed, nulls):
    """Rows: the gap on held-out particles."""
    strong = [o for o in listed if o.strength == 20.0]
    closed = [(o.found.get("gap") or {}).get("closed_fraction") for o in strong if not o.failed]
    closed += [0.0 for o in strong if o.failed]
    table.value("held-out gap closed, lambda>=20 (mean share)", closed, ">=0.80", ">=0.95", at_least=0.80)
    flags = []
    for o in strong:
        gap = o.found.get("gap") or {}
        if o.failed:
            flags.append(False)
        elif gap.get("steps") and gap.get("floor") is not None:
            points = 260 * o.case["count"]
            flags.append(abs(gap["steps"][-1]["chi2_per_dof"] - gap["floor"]) <= 1.96 * np.sqrt(2.0 / points))
    table.rate("chi2/dof within the 95% interval of the floor, lambda>=20", flags, ">=90%", "95%", at_least=0.90)
    worse = []
    for o in nulls:
        steps = (o.found.get("gap") or {}).get("steps") or []
        if o.failed or len(steps) < 2:  # where nothing was added, the law predicts as before
            worse.append(not o.failed and (len(steps) == 1 or o.found.get("verdict") == "NO_GAP"))
            continue
        loss = (steps[0].get("elpd") or 0.0) - (steps[-1].get("elpd") or 0.0)
        worse.append(loss <= (steps[-1].get("elpd_se") or 0.0))
    table.rate("not worse when nothing is missing: ELPD loss <= 1 SE", worse, ">=95%", "-", at_least=0.95)


def _estimate(parameters, *path):
    """An estimate {"value", "sd", "interval_95"} under a path of keys, or None."""
    for key in path:
        parameters = parameters.get(key) if isinstance(parameters, dict) else None
    return parameters if isinstance(parameters, dict) and parameters.get("value") is not None else None


_BASE = {"effective_modulus_MPa": ("effective_modulus_MPa",), "log_C1": ("log_C1", "mean"), "a": ("a",)}


def add_recovery(table, exact):
    """Rows: intervals and bias of the law's parameters and of the effect's amplitude."""
    good = [o for o in exact if o.right and o.truth[0] in KEEPS_MEANING and (o.strength or 0.0) >= 10.0]
    for name, path in _BASE.items():
        covered, pull, errors = [], [], defaultdict(list)
        for o in good:
            after = _estimate(o.found.get("parameters_after"), *path)
            before = _estimate(o.found.get("parameters_before"), *path)
            truth = o.answer["truth"][name]
            if after and after.get("interval_95"):
                low, high = after["interval_95"]
                covered.append(low <= truth <= high)
            if after and after.get("sd"):
                pull.append((after["value"] - truth) / after["sd"])
            # By how much the effect has moved an estimate, not by how much a few particles differ from the population.
            here = o.answer["truth"].get(f"{name}_drawn", truth)
            if after and before and after.get("sd"):
                errors[o.truth[0]].append((before["value"] - here, after["value"] - here, after["sd"]))
        share = np.mean(covered) if covered else 0.0
        if covered:
            low, high = interval(sum(covered), len(covered))
            table.plain(
                f"95% interval covers {name}",
                f"{100 * share:.1f}% (n={len(covered)})",
                "92-98%",
                "94-96%",
                0.92 <= share <= 0.98,
                f"{100 * low:.1f}-{100 * high:.1f}%",
            )
        else:
            table.missing(f"95% interval covers {name}", "92-98%", "94-96%")
        table.value(
            f"bias of {name}, in SE (absolute mean)", pull, "<=0.2", "-", at_most=0.2, of=lambda v: abs(np.mean(v))
        )
        if name == "a":
            continue
        cut = [
            1.0 - abs(np.mean(v[:, 1])) / abs(np.mean(v[:, 0]))
            for v in (np.array(rows) for rows in errors.values())
            if abs(np.mean(v[:, 0])) > np.mean(v[:, 2])
        ]
        table.value(
            f"bias of {name} cut by adding the effect (mean over mechanisms biased by more than 1 SE)",
            cut,
            ">=0.80",
            "-",
            at_least=0.80,
        )
    hits = []
    for o in good:
        effect, true = o.found["effects"][0], o.answer["effects"][0]
        estimate = _estimate(effect.get("parameters"), adapter.PARAMETERS.get(o.truth[0], ""))
        if estimate and estimate.get("interval_95"):
            hits.append(estimate["interval_95"][0] <= true["amplitude"] <= estimate["interval_95"][1])
    table.rate(
        f"95% interval covers the effect's amplitude ({', '.join(adapter.PARAMETERS)})",
        hits,
        ">=92%",
        "94-96%",
        at_least=0.92,
    )
