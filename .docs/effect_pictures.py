"""Pictures of what each effect does to a test, for the gallery."""

import io
import math
from dataclasses import replace
from functools import cache

from mcc_jax._format import plain

BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "0.45"
DIAMETERS_UM, HUMIDITY_PERCENT, PEAK_STRESS_MPA = (213.5, 196.1, 150.0), 75.0, 8.0
"""The particle of all pictures: flat, not of 200 um, in humid air, so that no effect of size, shape or water hides."""

STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}
LARGEST_SHARE = 0.12
"""Of the largest displacement: an effect that adds more is drawn weaker than its largest plausible strength."""


@cache
def _programme():
    import jax

    jax.config.update("jax_enable_x64", True)
    import mcc_jax as mcc

    return mcc.Programme.cycles(levels=(0.6, 1.0), unload_to=0.1, hold_s=40.0, points=240)


def _test(effects=()):
    """Time [s], force [mN] and displacement [um] of one particle under the programme of all pictures."""
    import jax
    import numpy as np

    programme = _programme()
    import mcc_jax as mcc

    law = mcc.paper_law()
    laws = mcc.simulate.law_for_each(
        plastic=jax.tree.map(lambda x: x[None], law.plastic), a=law.a, effective_modulus_MPa=law.effective_modulus
    )
    particle = mcc.Particle(*DIAMETERS_UM)
    peak = PEAK_STRESS_MPA * math.pi * float(particle.effective_diameter) ** 2 / 4e3
    campaign = mcc.simulate_campaign(
        laws,
        np.array([DIAMETERS_UM]),
        np.array([peak]),
        programme,
        effects=effects,
        relative_humidity_percent=np.array([HUMIDITY_PERCENT]),
    )
    return campaign.curves[0]


def _shown(variant):
    """A strength to draw, and the test with it."""
    import numpy as np

    import mcc_jax as mcc

    # No draw by test: every test of the picture is the same.
    same = replace(variant, random_per_test=False)
    middle = {n.name: n.middle for n in variant.nuisances}
    law = _law_alone()
    strength = (variant.sign or 1) * variant.plausible[1]
    while True:
        curve = _test((mcc.HiddenEffect(same, strength, middle),))
        added = np.max(np.abs(curve.displacement_um - law.displacement_um))
        if added <= LARGEST_SHARE * law.displacement_um.max() or abs(strength) <= variant.plausible[0]:
            return strength, curve
        strength /= 2


@cache
def _law_alone():
    return _test()


def picture(mechanism):
    """Strength, most it adds or takes away [um], and three pictures of a mechanism's first formula.

    One test with holds and a reload: the whole curve, and what is added to it, two, so that a phone shows one below the
    other; the latter small, too.
    """
    import numpy as np
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    law, (strength, curve) = _law_alone(), _shown(mechanism.variants[0])
    with rc_context(STYLE):
        figures = [Figure(figsize=size, layout="constrained") for size in ((3.8, 2.7), (3.8, 2.7), (1.6, 1.1))]
        left = figures[0].subplots()
        right, small = (figure.subplots(2, 1, sharex=True, height_ratios=(4, 1)) for figure in figures[1:])
        # Broad and pale below narrow and dark: dashes of a path that goes back on itself would fill each other's gaps.
        left.plot(law.displacement_um, law.force_mN, color=VERMILION, alpha=0.6, lw=2.8, label="law alone")
        left.plot(curve.displacement_um, curve.force_mN, color=BLUE, lw=1.3, label="with the effect")
        left.set(xlabel="displacement / µm", ylabel="force / mN")
        left.legend(frameon=False, fontsize=8, loc="upper left")
        added = curve.displacement_um - law.displacement_um
        for axes in (right, small):
            _draw_added(*axes, law, added)
        right[0].set(ylabel="added\ndisplacement / µm")
        right[1].set(xlabel="time / s", ylabel="force")
        for ax in small:
            ax.set(xticks=[], yticks=[])
            ax.spines[:].set_visible(False)
        drawn = [png(figure) for figure in figures]
    return strength, float(added[np.abs(added).argmax()]), *drawn


def png(figure, dpi=140):
    """The bytes of a figure's picture."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def _draw_added(above, below, law, added):
    """What an effect adds to the displacement, over time; below it the force in grey."""
    above.plot(law.time_s, added, color=BLUE, lw=1.3)
    above.axhline(0, color=GREY, lw=0.6)
    above.margins(y=0.08)
    below.fill_between(law.time_s, law.force_mN, color="0.75", lw=0)
    below.set_ylim(0, 1.05 * law.force_mN.max())
    below.set_yticks([])


@cache
def pictures():
    """Of every mechanism: the strength that is drawn, and its pictures."""
    from mcc_jax.effects import LIBRARY

    return {name: picture(mechanism) for name, mechanism in LIBRARY.items()}


EXAMPLE = "creep"


def how_to_read():
    """The picture of one effect with words in it, for those who see such pictures for the first time."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from mcc_jax.campaign import find_segments
    from mcc_jax.effects import LIBRARY

    law, (_, curve) = _law_alone(), _shown(LIBRARY[EXAMPLE].variants[0])
    added = curve.displacement_um - law.displacement_um
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.4), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        _draw_added(above, below, law, added)
        above.set(title=f"how to read the small pictures: {plain(EXAMPLE)}", ylabel="added\ndisplacement / µm")
        below.set(xlabel="time / s", ylabel="force")
        top = int(added.argmax())
        most = signed(added[top])
        above.annotate(
            f"at most {most[1:]} µm more than\nby the law alone: {most} µm\nis printed below the small picture",
            (law.time_s[top], added[top]), (0.02, 0.97), textcoords="axes fraction", va="top",
            arrowprops={"arrowstyle": "->", "color": GREY},
        )  # fmt: skip
        above.text(law.time_s[-1], 0.0, "the law alone (below this line: less displacement)", ha="right", va="bottom")
        words = {"load": "loaded", "hold": "held", "unload": "unloaded", "reload": "reloaded"}
        for part in find_segments(law, control="load"):
            middle = (law.time_s[part.start] + law.time_s[part.stop - 1]) / 2
            below.text(middle, 0.06 * law.force_mN.max(), words[part.kind], ha="center", va="bottom", fontsize=8)
        return png(figure)


def tension():
    """Force over displacement where a particle that sticks is pulled off, by several formulas."""
    import numpy as np
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    import mcc_jax as mcc

    path = np.concatenate([np.linspace(0.0, 15.0, 60), np.linspace(15.0, 11.1, 700)])
    with rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.0), layout="constrained")
        ax = figure.subplots()
        for name, strength in {"law alone": 0.0, "jkr": 0.3, "kendall": 3.0, "bond": 0.3, "mobilised": 0.3}.items():
            sticks = mcc.LIBRARY["adhesion"]["jkr" if strength == 0 else name].build(strength)
            law, time = mcc.paper_law().with_effects(sticks), np.arange(float(len(path)))
            test = mcc.drive(law, mcc.Particle(*DIAMETERS_UM), path, time=time)
            style = {"lw": 2.8, "color": VERMILION} if strength == 0 else {"lw": 1.3}
            ax.plot(path[60:], test.force[60:], label=plain(name), **style)
        ax.axhline(0, color=GREY, lw=0.6)
        ax.set(xlabel="displacement / µm", ylabel="force / mN", ylim=(-0.4, 0.8), xlim=(11.2, 11.8))
        ax.legend(frameon=False, fontsize=8, loc="upper left")
        return png(figure)


def signed(value):
    """A number with its sign, as people write it."""
    return f"{value:+.2g}".replace("-", "\N{MINUS SIGN}")
