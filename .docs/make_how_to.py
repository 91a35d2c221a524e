"""A picture for each how-to page: `pages/images/how-to/NAME.png`.

    uv run python .docs/make_how_to.py [NAME ...]

Takes a minute. The tests are simulated, not measured. The report's picture is taken by a browser, if CHROMIUM
names one and REPORT a report.html of the demo.
"""

import json
import os
import sys
from itertools import pairwise
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from make_power import FILE as POWER
from numpyro.infer import Predictive
from PIL import Image

import mcc_jax as mcc
from mcc_jax import dem
from mcc_jax._format import plain
from mcc_jax.effects import AbstractEffect

HERE = Path(__file__).parent
FOLDER = HERE / "pages" / "images" / "how-to"
BLUE, VERMILION, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#E69F00", "#009E73", "0.45"
COLOURS = {"load": BLUE, "hold": ORANGE, "unload": VERMILION, "reload": GREEN}
PARTICLE = mcc.Particle(213.54, 196.07, 186.33)
UM, MN = "displacement / µm", "force / mN"
CYCLES = mcc.Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=20.0, points=400)


def panel(xlabel, ylabel):
    """One picture, half as wide as a page."""
    figure, ax = plt.subplots(figsize=(5.4, 3.0), layout="constrained")
    ax.set(xlabel=xlabel, ylabel=ylabel)
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def legs(*turns):
    """A path [um] through turning points."""
    return jnp.asarray(np.concatenate([np.linspace(a, b, 120) for a, b in pairwise(turns)]))


def cycled(law, peak=330.0):
    """Displacement under two cycles of force, with holds."""
    force = np.concatenate([np.linspace(a, b, 80) for a, b in pairwise([0, peak, peak, 0.3 * peak, peak, peak, 0])])
    time = jnp.arange(len(force)) * 1.0
    times = {"time": time} if law.effects else {}
    return mcc.drive(law, PARTICLE, jnp.asarray(force), control="load", **times).displacement, force


def law():
    """Loading with two reloadings, and its slope."""
    figure, ax = panel(UM, MN)
    path = legs(0, 65, 62, 85, 81.5, 105, 100.5)
    ax.plot(path, mcc.drive(mcc.paper_law(), PARTICLE, path).force, color=BLUE)
    slope = jax.vmap(lambda d: jax.grad(lambda x: mcc.drive(mcc.paper_law(), PARTICLE, x[None]).force[0])(d))
    far = jnp.linspace(5.0, 105.0, 60)
    right = ax.twinx()
    right.plot(far, slope(far), color=ORANGE, ls="--")
    right.set_ylabel("slope of loading, by jax.grad / mN/µm", color=ORANGE)
    right.spines["top"].set_visible(False)
    return figure


def calibrate():
    """Posterior of the shape parameter and the modulus from twenty tests, with the true values."""
    draws = mcc.sample(mcc.paper_campaign(seed=0)).named_population()
    figure, ax = panel("shape parameter a [-]", "effective modulus / GPa")
    ax.plot(draws["a"].ravel(), draws["effective_modulus_MPa"].ravel() / 1e3, ".", ms=2.5, mew=0, alpha=0.5, color=BLUE)
    ax.plot(1.43, 16.0, "+", ms=14, mew=2, color=VERMILION)
    ax.annotate("truth", (1.43, 16.0), (8, 8), textcoords="offset points", color=VERMILION)
    return figure


def segments():
    """An instrument file after reading: a test divided into its segments."""
    campaign = mcc.paper_campaign(0, programme=CYCLES)
    curve = campaign.curves[0]
    figure, ax = panel("time / s", MN)
    for part in mcc.campaign.find_segments(curve):
        rows = slice(part.start, part.stop + 1)
        ax.plot(curve.time_s[rows], curve.force_mN[rows], color=COLOURS.get(part.kind, GREY), lw=2.5)
    for kind, colour in COLOURS.items():
        ax.plot([], [], color=colour, lw=2.5, label=kind)
    ax.legend(frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.18))
    return figure


def checks():
    """A gauge at the end of its range: the force continues, the displacement does not."""
    curve = mcc.paper_campaign(0).curves[1]
    figure, ax = panel(UM, MN)
    end = 0.9 * curve.displacement_um.max()
    ax.plot(curve.displacement_um, curve.force_mN, color=GREY, ls=":", label="what happened")
    ax.plot(
        np.minimum(curve.displacement_um, end), curve.force_mN, ".", ms=4, color=VERMILION, label="what was recorded"
    )
    ax.annotate("the gauge is at its end:\nforce goes on alone", (end, 0.8 * curve.force_mN.max()), (0.25, 0.6),
                textcoords="axes fraction", arrowprops={"arrowstyle": "->", "color": GREY})  # fmt: skip
    ax.legend(frameon=False, loc="upper left")
    return figure


def effects():
    """A law with effects, and the law without."""
    figure, ax = panel(UM, MN)
    for one, colour, label in (
        (mcc.paper_law(), GREY, "the law"),
        (
            mcc.paper_law().with_effects("creep:logarithmic", "frame_compliance"),
            BLUE,
            "with creep and frame compliance",
        ),
    ):
        ax.plot(*cycled(one), color=colour, label=label)
    ax.legend(frameon=False)
    return figure


def plan():
    """The detection limit of each effect for a plan, with its plausible range."""
    limits = json.loads(POWER.read_text())["plans"]["rising"]["limits"]
    names = [name for name in limits if name in mcc.LIBRARY][:12]
    figure, ax = plt.subplots(figsize=(5.4, 3.6), layout="constrained")
    for row, name in enumerate(reversed(names)):
        low, high = mcc.LIBRARY[name].variants[0].plausible
        ax.plot([1.0, high / low], [row, row], color=BLUE, lw=6, alpha=0.35, solid_capstyle="butt")
        ax.plot(limits[name] / low, row, "|", ms=12, mew=2.5, color=VERMILION)
    ax.set_yticks(range(len(names)), [plain(name) for name in reversed(names)])
    ax.set_xscale("log")
    ax.set_xlabel("size over the smallest plausible one\nblue: plausible; red: seen from here on")
    ax.spines[["top", "right"]].set_visible(False)
    return figure


def reload():
    """Reloading: by the law back along unloading; with hysteresis in a loop."""
    figure, ax = panel(UM, MN)
    for one, colour, label in (
        (
            mcc.paper_law().with_effects(mcc.effects.find_variant("reload_hysteresis").build(0.4)),
            VERMILION,
            "with hysteresis",
        ),
        (mcc.paper_law(), BLUE, "the law"),
    ):
        um, force = cycled(one)
        ax.plot(um, force, color=colour, label=label)
    ax.set_xlim(90, None)
    ax.legend(frameon=False)
    return figure


def priors():
    """The default prior of a, a narrow one, and the posterior of twenty tests."""
    figure, ax = panel("shape parameter a [-]", "density (each to its height)")
    x = np.linspace(-1, 4, 20_000)
    for mean, sd, colour, label in (
        (mcc.Priors().a.mean, mcc.Priors().a.sd, GREY, "default"),
        (1.0, 0.1, ORANGE, "sure of 1.0 ± 0.1"),
        (1.4289, 0.0012, BLUE, "what twenty tests say"),
    ):
        ax.plot(x, np.exp(-0.5 * ((x - mean) / sd) ** 2), color=colour, label=label)
    ax.set_yticks([])
    ax.legend(frameon=False)
    return figure


def model():
    """Draws from the prior, and a test."""
    campaign = mcc.paper_campaign(seed=0)
    tests = mcc.calibrate.select_tests(campaign)
    drawn = Predictive(mcc.Model(), num_samples=40)(jax.random.key(0), tests.unobserved())
    first, force = np.asarray(drawn["displacement_um"])[:, 0], np.asarray(tests.record.force)[0]
    used = np.isfinite(first).all(axis=0) & (force > 0)
    figure, ax = panel(UM, MN)
    ax.plot(first[:, used].T, force[used], color=BLUE, lw=0.5, alpha=0.5)
    ax.plot(campaign.curves[0].displacement_um, campaign.curves[0].force_mN, color="black", lw=1.6)
    ax.set_xlim(-5, 250)
    ax.set_title("forty draws from the priors, and one test (black)", fontsize=9, loc="left")
    return figure


def single():
    """The curve of one particle, and posterior draws of a user's NumPyro model."""
    campaign = mcc.paper_campaign(0, instrument=mcc.Instrument(force_noise_mN=5.0))
    curve, particle = campaign.curves[0], mcc.Particle(*campaign.diameters_um[0])
    true = [float(campaign.columns[f"true_{name}"][0]) for name in ("C1", "C3", "C5")]
    figure, ax = panel(UM, MN)
    ax.plot(curve.displacement_um, curve.force_mN, ".", ms=3, color=GREY, label="one test, noise of 5 mN")
    one = mcc.MccLaw(mcc.Plastic(*true), 1.43, 16_000.0)
    ax.plot(
        curve.displacement_um,
        mcc.drive(one, particle, jnp.asarray(curve.displacement_um)).force,
        color=BLUE,
        label="the law",
    )
    ax.legend(frameon=False)
    return figure


def devices():
    """Time and memory of a posterior by the number of particles, as measured."""
    runs = json.loads((HERE.parent / "benchmarks" / "results" / "scale.json").read_text())["Runs"]
    count = [run["particles"] for run in runs]
    figure, ax = panel("particles in one campaign", "first run / s")
    ax.loglog(count, [run["first run [s]"] for run in runs], "o-", color=BLUE)
    right = ax.twinx()
    right.loglog(count, [run["peak memory [GiB]"] for run in runs], "s--", color=ORANGE)
    right.set_ylabel("peak memory / GiB", color=ORANGE)
    right.set_ylim(0.5, 20)
    return figure


def pair():
    """Two half contacts in series: equal ones, and a small particle on a large one."""
    path = 1e-6 * legs(0, 30, 28.5, 36, 34)
    before = jnp.maximum.accumulate(jnp.concatenate([jnp.zeros(1), path[:-1]]))
    sides = {d: dem.half_contact(mcc.paper_law(), mcc.Particle(d, d, d)) for d in (200.0, 80.0)}
    force = jax.jit(jax.vmap(dem.pair_force, (None, None, 0, 0)))
    figure, ax = panel("overlap / µm", MN)
    for other, colour in ((200.0, BLUE), (80.0, VERMILION)):
        ax.plot(
            1e6 * path,
            1e3 * force(sides[200.0], sides[other], before, path),
            color=colour,
            label=f"200 µm on {other:.0f} µm",
        )
    ax.legend(frameon=False)
    return figure


def export():
    """The two curves of every export: loading, and unloading from a peak."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(5.4, 2.6), layout="constrained")
    plastic = mcc.paper_law().plastic
    strain, s = np.linspace(0, 0.67, 200), np.linspace(0, 1, 200)
    left.plot(strain, jax.vmap(plastic.stress)(jnp.asarray(strain)), color=BLUE)
    left.set(xlabel="scaled strain [-]", ylabel="stress / MPa", title="loading")
    right.plot(s, 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2)), color=VERMILION)
    right.set(xlabel="released share s [-]", ylabel="stress over peak stress [-]", title="unloading")
    for ax in (left, right):
        ax.spines[["top", "right"]].set_visible(False)
    return figure


class Dimple(AbstractEffect):
    """The effect of the page."""

    def observe(self, context):
        """Displacement [um] that is added."""
        return self.amplitude * (1 + jnp.tanh(context.peak_stress - 5.0)) / 2


def effect():
    """The law, and the law in a dimple of the platen."""
    figure, ax = panel(UM, MN)
    for one, colour, label in (
        (mcc.paper_law(), GREY, "the law"),
        (mcc.paper_law().with_effects(Dimple(3.0)), BLUE, "a dimple of 3 µm gives way"),
    ):
        ax.plot(*cycled(one), color=colour, label=label)
    ax.legend(frameon=False)
    return figure


def report(file):
    """The first screen of a report, as a browser shows it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=os.environ["CHROMIUM"], args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1440, "height": 760})
        tab.goto(Path(os.environ["REPORT"]).resolve().as_uri())
        tab.wait_for_selector("#interactive[data-ready]")
        tab.screenshot(path=file)
        browser.close()
    with Image.open(file) as whole:
        whole.convert("RGB").quantize(96, dither=Image.Dither.NONE).save(file, optimize=True)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    asked = sys.argv[1:]
    pictures = (
        law,
        calibrate,
        segments,
        checks,
        effects,
        plan,
        reload,
        priors,
        model,
        single,
        devices,
        pair,
        export,
        effect,
    )
    for picture in pictures:
        if not asked or picture.__name__ in asked:
            file = FOLDER / f"{picture.__name__}.png"
            picture().savefig(file, dpi=110, metadata={"Software": None})
            plt.close("all")
            print(file.name, file.stat().st_size // 1000, "kB", flush=True)
    if {"CHROMIUM", "REPORT"} <= set(os.environ) and (not asked or "report" in asked):
        report(FOLDER / "report.png")
