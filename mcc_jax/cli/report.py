"""`mcc-jax report`."""

from __future__ import annotations

from pathlib import Path

import click

from .._store import results
from . import options as common
from .session import say, session

REPORT = "report.html"


@click.command(short_help="One page that shows all results.")
@click.argument("folder", type=common.Location(), metavar="DIR")
@common.out()
@click.option(
    "--campaign", type=common.Location(), metavar="CAMPAIGN", help="Folder of the tests, if the results do not know it."
)
@common.seed("For the record: nothing here is random.")
def report(folder: Path, out: Path | None, campaign: Path | None, seed: int) -> None:
    """Write one self-contained HTML page from what is in the folder DIR: a campaign, calibration.json with
    posterior.nc, discovery.json, or any of them.

    Writes report.html into DIR, or into the folder given by --out. It needs no network, opens in any browser, and can
    be sent or printed. The tests are looked for in DIR, in DIR/campaign, and where calibration or discovery found them.

    \b
    Examples:
      mcc-jax report mcc-jax-demo
      mcc-jax report my-fit --campaign my-tests --out for-my-colleague
    """
    with session(4) as progress:
        from ..report import read_results, report_page

        progress("reading the results")
        found = read_results(folder, campaign)
        page = report_page(found, seed=seed, progress=progress)
        with results(out or folder) as stage:
            (stage.folder / REPORT).write_text(page, encoding="utf-8")
    for text in found.cautions:
        say(f"Caution: {text}.", fg="yellow")
    for text in found.missing:
        say(f"Not in the report: {text}.", fg="yellow")
    say(f"Written: {(out or folder) / REPORT} ({len(page.encode()) / 1e6:.1f} MB). Open it in a browser.")
