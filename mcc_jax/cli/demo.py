"""`mcc-jax demo`."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

import click

from .._store import results
from .calibrate import main_numbers, say_state, say_warnings, write_calibration
from .discover import DISCOVERY, main_finding, write_discovery
from .options import out_option, seed_option
from .report import REPORT
from .session import beside, import_writers, say, say_table, session
from .shared import provenance, say_files

CAMPAIGN_FILES = ("particles.csv", "curves.csv", "campaign.toml")


@click.command(short_help="The whole job on an embedded campaign.")
@out_option(default="mcc-jax-demo", show_default=True)
@seed_option()
def demo(out: Path, seed: int) -> None:
    """Simulate the paper's 20 particles, calibrate the law on them, ask what it misses, and report.

    The tests are simulated from the paper's tables (Bommireddy et al. 2018): it publishes its measured curves as
    pictures only, not as numbers. DIR gets campaign/, calibration.json, posterior.nc,
    discovery.json, figures/ and report.html, which shows it all in a browser.

    \b
    Example:
      mcc-jax demo --out try --seed 1
    """
    with session(29) as tell:
        from ..calibrate import sample
        from ..campaign import write_campaign
        from ..simulate import paper_campaign

        with results(out) as stage:
            tell("simulating the campaign")
            campaign = paper_campaign(seed)
            write_campaign(campaign, stage.folder / "campaign")
            origin = provenance("demo", stage.folder / "campaign", {"seed": seed}, told="campaign")
            with beside(_import_the_rest):  # compilers leave a core to Python
                calibration = sample(campaign, seed=seed, progress=tell)
            from ..discover import discover
            from ..report import read_results, report_page

            # One core draws while the others compile.
            with beside(lambda: discover(campaign, experiments=False, seed=seed, progress=tell)) as found:
                content = write_calibration(calibration, stage, origin=origin, figures=True, tell=tell)
            missing = write_discovery(found(), stage, origin=origin, figures=True, tell=tell)
            page = report_page(read_results(stage.folder, name=out.resolve().name), seed=seed, progress=tell)
            (stage.folder / REPORT).write_text(page, encoding="utf-8")
    points = sum(len(curve) for curve in campaign.curves)
    say(f"The tests are SIMULATED from the paper's tables, not measured: {len(campaign)} particles, {points} points,")
    say("each with C1, C3 and C5 of its own drawn from Table 2, with noise of 0.02 um and 0.05 mN.")
    say()
    say_state(content)
    rows = [(*row, paper) for row, paper in zip(main_numbers(content), _paper_values(), strict=True)]
    say_table(("quantity", "this run", "the paper"), rows)
    say("After +-: the standard deviation of the posterior. Spreads of 20 particles differ from seed to seed.")
    say_warnings(content)
    say()
    say(f"Discovery ({missing['verdict']}): {main_finding(missing)}.")
    say()
    figures = [*content["figures"], *missing["figures"]]
    files = [*(f"campaign/{name}" for name in CAMPAIGN_FILES), *content["files"], "calibration.json", DISCOVERY, REPORT]
    say_files(out, [*figures, *files])
    say()
    say(f"What next? Open {out / REPORT} in a browser: it shows all of this, and what it means. Then, for example:")
    folder = shlex.quote(str(out / "campaign"))
    for comment, command in (
        (
            "the same particles by the paper's own steps",
            f"calibrate {folder} --out paper --method paper",
        ),
        (
            "one shared material, two cycles with holds",
            "simulate --out sim --shared-material --levels 0.5,1 --hold-s 30",
        ),
        (
            "an effect that the law does not contain, hidden in tests with holds",
            "simulate --out hidden --levels 0.5,1 --hold-s 30 --noise-um 0.02 --effect creep",
        ),
        ("find it", "discover hidden --out found"),
        ("your own tests, from a tester's file", "convert FILE --out tests --diameters 200,190,180"),
    ):
        say(f"  mcc-jax {command}", nl=False)
        say(f"   # {comment}", dim=True)


def _import_the_rest() -> None:
    """What the demo needs after calibrating, seconds to import: discovery, drawing, the page, the posterior's file."""
    from .. import discover, report  # noqa: F401

    import_writers(figures=True, posterior=True)


def _paper_values() -> list[str]:
    """The paper's own numbers, in the order of `main_numbers`."""
    from ..campaign import PAPER_EFFECTIVE_MODULUS_MPA, PAPER_LOG_C, PAPER_SHAPE_PARAMETER

    spreads = [text for mean, sd in PAPER_LOG_C.values() for text in (f"{math.exp(mean):.4g}", f"{sd:.4g}")]
    return [f"{PAPER_SHAPE_PARAMETER:g}", f"{PAPER_EFFECTIVE_MODULUS_MPA / 1e3:g} GPa", *spreads, "0.4085 MPa"]
