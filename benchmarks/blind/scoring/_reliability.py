"""Whether stated probabilities and sets are as often right as they say."""

from __future__ import annotations

import numpy as np

from ._table import NO_GATE, interval


def stated(found):
    """(stated probability of the first name, whether it is right) where the solver states one."""
    pairs = []
    for o in found:
        probability = o.found["effects"][0].get("probability") if o.top else None
        if probability is not None:
            pairs.append((float(probability), o.right))
    return pairs


def reliability(pairs, bins=10):
    """Rows (mean stated, share right, number) of the filled bins, and the expected calibration error."""
    if not pairs:
        return [], None
    p, hit = np.array([a for a, _ in pairs]), np.array([b for _, b in pairs], dtype=float)
    place = np.minimum((p * bins).astype(int), bins - 1)
    rows = [
        (float(p[place == b].mean()), float(hit[place == b].mean()), int((place == b).sum())) for b in np.unique(place)
    ]
    return rows, float(sum(n * abs(a - b) for a, b, n in rows) / len(p))


def add_calibration(table, found):
    """Rows: calibration of stated probabilities, coverage of 90 % sets.

    The smallest set of at least 90 % holds more than that, 97 % on the mean, so it must cover more than 94 % if what is
    stated is right. Beside it stands the set of exactly 90 %, of which the last name counts for the share of its
    probability that is needed.
    """
    pairs = stated(found)
    _, ece = reliability(pairs)
    if ece is None:
        table.missing("calibration of the stated probability, ECE", "<=0.07", "<=0.04")
    else:
        draws = np.random.default_rng(0).integers(0, len(pairs), (200, len(pairs)))
        low, high = np.quantile([reliability([pairs[i] for i in row])[1] for row in draws], [0.025, 0.975])
        table.plain(
            "calibration of the stated probability, ECE",
            f"{ece:.3f} (n={len(pairs)})",
            "<=0.07",
            "<=0.04",
            ece <= 0.07,
            f"{low:.3f}-{high:.3f}",
        )
    covered, held, exactly = [], [], []
    for o in found:
        weights = {
            r["mechanism"]: r["probability"] for r in o.found.get("ranking") or [] if r.get("probability") is not None
        }
        if o.failed or not weights:
            continue
        total, kept = 0.0, set()
        for name in sorted(weights, key=weights.get, reverse=True):
            kept.add(name)
            total += weights[name]
            if total >= 0.9:
                break
        covered.append(o.truth[0] in kept)
        held.append(total)
        exactly.append(covered[-1] - (o.truth[0] == name) * (total - 0.9) / weights[name])
    if covered:
        low, high = interval(sum(covered), len(covered))
        share = sum(covered) / len(covered)
        table.plain(
            "coverage of 90% sets (from `probability` in the ranking)",
            f"{100 * share:.1f}% (n={len(covered)})",
            "86-94%",
            "-",
            0.86 <= share <= 0.94,
            f"{100 * low:.1f}-{100 * high:.1f}%",
        )
        table.value("  these sets hold, as stated (mean)", held, NO_GATE, "-")
        table.value("  coverage of sets of exactly 90%, the last name in part", exactly, NO_GATE, "-")
    else:
        table.missing("coverage of 90% sets (from `probability` in the ranking)", "86-94%", "-")
