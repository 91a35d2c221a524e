"""The three pictures of README and the front page, from the paper's law and campaigns simulated from it.

uv run python .docs/make_pictures.py

Takes about three minutes; equal code gives equal pictures.
"""

from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mcc_jax as mcc
from mcc_jax.discover import discover
from mcc_jax.effects import find_variant

FOLDER = Path(__file__).parent / "pages" / "images"
BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "0.55"


def panel(title, xlabel, ylabel):
    """One picture, all three of one size."""
    figure, ax = plt.subplots(figsize=(4.2, 3.4), layout="constrained")
    ax.set_title(title, fontsize=11, loc="left")
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def law():
    """One particle: loading, a little unloading and reloading, and back."""
    particle, law = mcc.Particle(213.54, 196.07, 186.33), mcc.paper_law()
    turns = [0.0, 70.0, 66.8, 90.0, 86.2, 105.0, 99.0]
    path = np.concatenate([np.linspace(a, b, 150) for a, b in zip(turns, turns[1:], strict=False)])
    curve = mcc.drive(law, particle, jnp.asarray(path))
    figure, ax = panel("The law: loading, unloading, reloading", "displacement / µm", "force / mN")
    ax.plot(curve.displacement, curve.force, color=BLUE, lw=1.8)
    ax.annotate("plastic loading", (58, 62), (14, 120), arrowprops={"arrowstyle": "-", "color": GREY})
    ax.annotate("elastic unloading\nand reloading", (88.3, 150), (34, 220), arrowprops={"arrowstyle": "-", "color": GREY})
    return figure


def posterior(calibration):
    """The shape parameter beside the mean of log C3: what the tests know together better than apart."""
    draws = {name: np.asarray(v).ravel() for name, v in calibration.named_population().items()}
    figure, ax = panel("A posterior: what 20 tests leave open", "shape parameter a", "C3 of the median particle")
    ax.plot(draws["a"], np.exp(draws["mu_C3"]), ".", ms=2, color=BLUE, alpha=0.4, rasterized=True)
    ax.plot(1.43, np.exp(mcc.paper_population().C3.mean), "+", ms=14, mew=2, color=VERMILION)
    ax.annotate("truth", (1.43, float(np.exp(mcc.paper_population().C3.mean))), (8, 8), textcoords="offset points", color=VERMILION)
    return figure


def discovery(found):
    """How well each mechanism explains the gap."""
    return found


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    law().savefig(FOLDER / "law.png", dpi=150)
