"""The picture of README (`found`), and the three of the front page: the law, a posterior, a discovery.

    uv run python .docs/make_pictures.py [NAME ...]

The tests are simulated from the paper's tables, not measured. Takes about three minutes.
"""

import sys
from itertools import pairwise
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mcc_jax as mcc
from mcc_jax._format import plain
from mcc_jax.discovery import discover
from mcc_jax.effects import find_variant
from mcc_jax.report.story import draw_enlarged, draw_left_over, most_informative_test

FOLDER = Path(__file__).parent / "pages" / "images"
BLUE, VERMILION, ORANGE, GREY = "#0072B2", "#D55E00", "#E69F00", "0.45"
NOISE = mcc.Instrument(displacement_noise_um=0.02, force_noise_mN=0.05)


def panel(title, xlabel, ylabel):
    """One picture; all have the same size, to be shown side by side."""
    figure, ax = plt.subplots(figsize=(4.3, 3.5), layout="constrained")
    ax.set_title(title, fontsize=11, loc="left")
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def law():
    """One particle, loaded further and further, with a little unloading between."""
    turns = [0.0, 65.0, 62.0, 85.0, 81.5, 105.0, 100.5]
    legs = [np.linspace(a, b, 150) for a, b in pairwise(turns)]
    curve = mcc.drive(mcc.paper_law(), mcc.Particle(213.54, 196.07, 186.33), jnp.asarray(np.concatenate(legs)))
    figure, ax = panel("The law", "displacement of the platen / µm", "force / mN")
    ax.plot(curve.displacement, curve.force, color=BLUE, lw=1.6)
    line = {"arrowstyle": "-", "color": GREY}
    ax.annotate("plastic loading", (50, 62), (12, 130), arrowprops=line)
    ax.annotate("elastic unloading\nand reloading", (82.4, 95), (36, 215), arrowprops=line)
    return figure


def posterior():
    """Posterior of the shape parameter and C3 from twenty tests, which determine a combination better than each."""
    draws = mcc.sample(mcc.paper_campaign(seed=0, instrument=NOISE)).named_population()
    a, C3 = draws["a"].ravel(), np.exp(draws["mu_C3"].ravel())
    true_C3 = float(np.exp(mcc.simulate.paper_population().C3.mean))
    figure, ax = panel("A posterior", "shape parameter a [-]", "C3 of the median particle [-]")
    ax.plot(a, C3, ".", ms=2.5, mew=0, color=BLUE, alpha=0.5)
    ax.plot([], [], ".", ms=8, mew=0, color=BLUE, label="draws")  # in the legend larger, or nobody sees them
    ax.plot(1.43, true_C3, "+", ms=15, mew=2.2, color=VERMILION, label="truth")
    ax.legend(frameon=False, markerscale=1.0)
    return figure


def discovery():
    """Creep hidden in twenty tests: the residuals of one of them, before and after the effect is found."""
    programme = mcc.Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=30.0, points=150)
    hidden = mcc.HiddenEffect(find_variant("creep"))
    campaign = mcc.paper_campaign(seed=0, instrument=NOISE, programme=programme, effects=(hidden,))
    found = discover(campaign, confirm=False, experiments=False, posterior=False)
    print(found.summary)
    left = found.residuals
    gain = np.sum(left.white_before**2 - left.white_after**2, axis=1)
    i = int(np.argsort(gain)[len(gain) // 2])  # the particle in the middle, not the best one
    used, time = left.used[i], left.time_s[i]
    name = " or ".join(plain(n) for n in found.candidate_set[0])
    figure, ax = panel(f"A discovery: {name}", "time / s", "measured less predicted / µm")
    show = {key: np.where(used, getattr(left, key)[i], np.nan) for key in ("before", "after", "noise")}
    ax.fill_between(time, -show["noise"], show["noise"], color=ORANGE, alpha=0.5, lw=0, label="noise")
    ax.plot(time, show["before"], color=VERMILION, lw=1.1, label="law alone")
    ax.plot(time, show["after"], color=BLUE, lw=1.1, label="with what was found")
    # At first contact the residual of the law alone is several times larger than later: stated, not plotted.
    largest = np.nanmax(np.abs(show["before"]))
    reach = 3.5 * np.nanstd(show["before"][len(time) // 10 :])
    ax.set_ylim(-reach, reach)
    if largest > reach:
        ax.text(
            0.03, 0.03, f"first points of the law alone: up to {largest:.1f} µm", transform=ax.transAxes, fontsize=8
        )
    ax.legend(frameon=False, fontsize=8, loc="upper right", ncols=3, columnspacing=1.0, handlelength=1.2)
    return figure


def found():
    """Creep hidden in eight tests: one test, the law, the law with the effect found, and the residuals of each."""
    programme = mcc.Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=20.0, points=150)
    hidden = mcc.HiddenEffect(find_variant("creep"), 5e-4)
    campaign = mcc.paper_campaign(seed=2, instrument=NOISE, programme=programme, effects=(hidden,))
    answer = discover(campaign.select(np.arange(20) < 8), experiments=False, posterior=False)
    print(answer.summary)
    before, after = (step["chi2_per_dof"] for step in answer.gap()["steps"])
    proposed = most_informative_test(answer)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.9), layout="constrained")
    handles = draw_enlarged(left, proposed)
    text = "A simulated particle with creep put in, pressed three times:\nthe contact law alone misses the loop"
    left.set_title(text, fontsize=9, loc="left")
    noise = draw_left_over(right, proposed)[0]
    gap = f"(χ² per point {before:.0f} → {after:.1f}; 1 is noise)"
    text = f"The whole test over time: with creep added only noise is left\n{gap}"
    right.set_title(text, fontsize=9, loc="left")
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    figure.legend(handles=[*handles, noise], loc="outside lower center", ncols=4, frameon=False)
    return figure


if __name__ == "__main__":
    for picture in (law, posterior, discovery, found):
        if len(sys.argv) > 1 and picture.__name__ not in sys.argv[1:]:
            continue
        file = FOLDER / f"{picture.__name__}.png"
        picture().savefig(file, dpi=140, metadata={"Software": None})
        print(file.name, file.stat().st_size // 1000, "kB")
