"""Tables beside the acceptance table: by mechanism, noise, tier."""

from __future__ import annotations

from collections import Counter, defaultdict

import numpy as np

from benchmarks.blind.generator.effects import MECHANISMS


def by_mechanism(found):
    """Share named first by mechanism, lambda and protocol, exact formulas, with what an ideal score test would get."""
    rows = []
    for name in MECHANISMS:
        mine = [o for o in found if o.tier == "T1" and o.truth[0] == name]
        row = {"mechanism": name}
        for strength in (3.0, 5.0, 10.0, 20.0):
            for protocol in ("P0", "P1"):
                cell = [o for o in mine if o.strength == strength and o.case["protocol"] == protocol]
                row[f"{strength:g} {protocol}"] = f"{sum(o.right for o in cell)}/{len(cell)}" if cell else "-"
        variants = [o for o in found if o.tier == "T2" and o.truth[0] == name and o.strength]
        row["variants"] = f"{sum(o.right for o in variants)}/{len(variants)}" if variants else "-"
        ideal = [
            o.answer["oracle"]["best"] == name for o in mine if o.strength and o.strength >= 5 and name != "pop_in"
        ]
        row["ideal, >=5"] = f"{sum(ideal)}/{len(ideal)}" if ideal else "-"
        row["in set, >=5"] = _share([name in o.first_set for o in mine if (o.strength or 0) >= 5])
        row["off strength"] = sum(o.strength is None for o in mine)
        row["plausible"] = _share([o.answer["effects"][0]["plausible"] for o in mine])
        if mine or variants:
            rows.append(row)
    return rows


def _share(flags):
    return f"{sum(flags)}/{len(flags)}" if flags else "-"


def against_ideal(found):
    """Named first by tier, lambda and protocol, beside a score test with the true covariance and the exact formulas.

    That test knows everything but the answer, so it is a ceiling for exact formulas; its set holds whatever lies
    within 6 of the largest squared statistic. `pop_in` has no single signature and is left out on both sides.
    """
    groups = defaultdict(list)
    for o in found:
        if o.tier in ("T1", "T2") and o.strength and o.truth[0] != "pop_in":
            groups[o.tier, o.strength, o.case["protocol"]].append(o)
    rows = []
    for (tier, strength, protocol), cell in sorted(groups.items()):
        ideal = []
        for o in cell:
            squares = {name: value**2 for name, value in o.answer["oracle"]["statistics"].items()}
            ideal.append({name for name, value in squares.items() if value > max(squares.values()) - 6.0})
        rows.append(
            {
                "tier": tier,
                "lambda": strength,
                "protocol": protocol,
                "named first": _share([o.right for o in cell]),
                "ideal": _share([o.answer["oracle"]["best"] == o.truth[0] for o in cell]),
                "in set": _share([o.truth[0] in o.first_set for o in cell]),
                "in ideal set": _share([o.truth[0] in names for o, names in zip(cell, ideal, strict=True)]),
                "set size": float(np.mean([len(o.first_set) for o in cell])),
                "ideal set size": float(np.mean([len(names) for names in ideal])),
            }
        )
    return rows


def by_noise(found):
    """Top-1 of T1 and T2 by the kind of noise and number of particles."""
    groups = defaultdict(list)
    for o in found:
        if o.tier in ("T1", "T2") and (o.strength or 0) >= 5:
            groups[o.tier, "rough" if o.case["noise"]["scale_sd"] else "clean", o.case["count"]].append(o.right)
    return [
        {"tier": tier, "noise": noise, "particles": count, "named first": _share(flags), "share": float(np.mean(flags))}
        for (tier, noise, count), flags in sorted(groups.items())
    ]


def confusion(found, strengths=(10.0, 20.0)):
    """Counts: true mechanism by what was answered first, exact formulas."""
    counts = defaultdict(Counter)
    for o in found:
        if o.tier == "T1" and o.strength in strengths:
            counts[o.truth[0]][o.label] += 1
    return {name: counts[name] for name in MECHANISMS if name in counts}


def gaps(found):
    """Held-out chi2/dof before and after, its floor, systematic gap and closed share, by tier and strength."""
    groups = defaultdict(list)
    for o in found:
        gap = o.found.get("gap") or {}
        if not o.failed and gap.get("steps"):
            groups[o.tier, o.strength or 0.0].append(gap)
    rows = []
    for (tier, strength), entries in sorted(groups.items()):

        def mean(get, entries=entries):
            values = [value for value in map(get, entries) if value is not None]
            return float(np.mean(values)) if values else "-"

        rows.append(
            {
                "tier": tier,
                "lambda": strength or "-",
                "campaigns": len(entries),
                "chi2/dof before": mean(lambda g: g["steps"][0].get("chi2_per_dof")),
                "after": mean(lambda g: g["steps"][-1].get("chi2_per_dof")),
                "floor": mean(lambda g: g.get("floor")),
                "systematic before, um": mean(lambda g: g["steps"][0].get("systematic_um")),
                "after, um": mean(lambda g: g["steps"][-1].get("systematic_um")),
                "closed": mean(lambda g: g.get("closed_fraction")),
            }
        )
    return rows


def failures(found):
    """One row per kind of failure."""
    kinds = Counter((o.result["status"], (o.result.get("error") or o.verdict)[:90]) for o in found if o.failed)
    first = {}
    for o in found:
        first.setdefault((o.result["status"], (o.result.get("error") or o.verdict)[:90]), o.case["id"])
    return [{"status": s, "what": e, "campaigns": n, "first": first[s, e]} for (s, e), n in kinds.most_common(40)]


def confusion_rows(counts):
    """The counts as rows of a table."""
    columns = [*MECHANISMS, "UNLISTED", "NO_GAP", "failed"]
    used = [c for c in columns if any(row[c] for row in counts.values())]
    return [{"true \\ named": name, **{c: row[c] or "" for c in used}} for name, row in counts.items()]
