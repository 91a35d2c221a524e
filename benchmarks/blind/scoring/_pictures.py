"""Confusion matrix, reliability diagram and power curves."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from benchmarks.blind.generator.effects import MECHANISMS

from ._reliability import reliability, stated
from ._summaries import confusion
from ._table import interval


def pictures(found, place, prefix):
    """Confusion matrix, reliability diagram and power curves as files PREFIX_*.png in `place`; returns their names."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    place.mkdir(parents=True, exist_ok=True)
    made = []

    def save(figure, what):
        name = f"{prefix}_{what}.png"
        figure.savefig(place / name, dpi=110)
        plt.close(figure)
        made.append(name)

    counts = confusion(found)
    if counts:
        columns = [*MECHANISMS, "UNLISTED", "NO_GAP", "failed"]
        matrix = np.array([[row[c] for c in columns] for row in counts.values()], dtype=float)
        campaigns = matrix.sum(axis=1)
        matrix /= np.maximum(campaigns, 1.0)[:, None]
        figure, axes = plt.subplots(figsize=(10, 8.5), layout="constrained")
        image = axes.imshow(matrix, cmap="Blues", vmin=0, vmax=1)
        axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
        rows = [f"{name.replace('_', ' ')} ({n:.0f})" for name, n in zip(counts, campaigns, strict=True)]
        axes.set_yticks(range(len(counts)), rows)
        axes.set(
            xlabel="named first",
            ylabel="hidden (campaigns)",
            title="Exact formulas, lambda 10 and 20: per cent of campaigns",
        )
        for i, j in zip(*np.nonzero(matrix), strict=True):
            axes.text(
                j,
                i,
                f"{100 * matrix[i, j]:.0f}",
                ha="center",
                va="center",
                fontsize=7,
                color="w" if matrix[i, j] > 0.5 else "k",
            )
        figure.colorbar(image, shrink=0.7)
        save(figure, "confusion")
    rows, ece = reliability(stated([o for o in found if o.tier in ("T1", "T2")]))
    if rows:
        figure, axes = plt.subplots(figsize=(5, 5), layout="constrained")
        axes.plot([0, 1], [0, 1], "--", color="0.6")
        spreads = np.array([interval(round(hit * n), n) for _, hit, n in rows])
        middle = np.array([hit for _, hit, _ in rows])
        errors = np.maximum(0.0, np.abs(spreads.T - middle))
        axes.errorbar([stated for stated, _, _ in rows], middle, errors, fmt="o", capsize=3)
        axes.set(xlabel="stated probability", ylabel="share right", title=f"ECE {ece:.3f}", xlim=(0, 1), ylim=(0, 1))
        save(figure, "reliability")
    power = defaultdict(lambda: defaultdict(list))
    for o in found:
        if o.tier == "T1" and o.strength:
            power[o.truth[0]][o.strength].append(o.right)
    if power:
        figure, grid = plt.subplots(4, 5, figsize=(13, 9), sharex=True, sharey=True, layout="constrained")
        for axes, name in zip(grid.flat, MECHANISMS, strict=True):
            curve = sorted(power[name].items())
            axes.set_title(name.replace("_", " "), fontsize=9)
            axes.set(xscale="log", ylim=(-0.05, 1.05))
            axes.set_xticks([3, 5, 10, 20], ["3", "5", "10", "20"])
            axes.minorticks_off()
            if curve:
                share = np.array([np.mean(flags) for _, flags in curve])
                spreads = np.array([interval(sum(flags), len(flags)) for _, flags in curve]).T
                axes.errorbar(
                    [v for v, _ in curve], share, np.maximum(0.0, np.abs(spreads - share)), fmt="o-", ms=4, capsize=2
                )
        figure.supxlabel("lambda = |theta| / SE")
        figure.supylabel("share named first")
        save(figure, "power")
    return made
