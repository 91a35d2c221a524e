"""`mcc-jax convert`."""

from __future__ import annotations

import shlex
from collections import Counter
from dataclasses import replace
from pathlib import Path

import click

from ._output import results
from ._session import say, say_table, session
from ._types import Location, out_option, seed_option

SHOWN = 24
KINDS = ("approach", "load", "hold", "unload", "reload")


@click.command(short_help="Turn a tester's file into a campaign.")
@click.argument("file", type=Location(), metavar="FILE")
@out_option(required=True)
@click.option(
    "--diameters",
    metavar="D1,D2,D3|FILE",
    help="Diameters in um of all tests, or a CSV table with particle,D1_um,D2_um,D3_um; D3 lies along the compression.",
)
@click.option(
    "--mapping",
    type=Location(),
    metavar="FILE",
    help="TOML file that says what stands where in FILE, for any other text table.",
)
@seed_option("Recorded in campaign.toml; converting itself draws no random number.")
def convert(file: Path, out: Path, diameters: str | None, mapping: Path | None, seed: int) -> None:
    """Turn FILE, a tester's export, into a campaign.

    Known formats: Fischer HM, Hysitron hld, Hysitron load-control text, Micro Materials text or zip; they are told
    apart by content. Any other text table needs a mapping file. Units are converted; nothing is shifted or smoothed.

    \b
    Example of a mapping file (--mapping):
      delimiter = "semicolon"       # comma, semicolon, tab, space
      decimal_mark = ","
      skip_rows = 3                 # rows above the header
      tests = "column"              # a column names the test; leave out if the file is one test
      [columns]
      test = { column = "Sample" }
      time = { column = "t", unit = "s" }
      force = { column = "Load", unit = "N" }
      displacement = { column = "Depth", unit = "nm", sign = -1 }
    """
    if diameters is not None and not diameters.strip():
        raise click.BadParameter("it is empty.", param_hint="--diameters")
    with session(3) as tell:
        from ..campaign import (
            campaign_findings,
            check_plausibility,
            check_tests,
            find_segments,
            read_diameters,
            read_tester_file,
            write_campaign,
        )

        tell("reading the file")
        sizes = None if diameters is None else read_diameters(diameters)
        campaign = read_tester_file(file, diameters_um=sizes, mapping=mapping)
        tell("finding the segments")
        segments = [Counter(part.kind for part in find_segments(curve)) for curve in campaign.curves]
        tell("writing")
        metadata = replace(campaign.metadata, other={**campaign.metadata.other, "conversion": {"seed": seed}})
        with results(out) as stage:
            write_campaign(replace(campaign, metadata=metadata), stage.folder)
    points = sum(len(curve) for curve in campaign.curves)
    say(f"{len(campaign)} tests, {points} points ({campaign.metadata.provenance}).")
    rows = [
        (
            name,
            str(len(curve)),
            f"{curve.force_mN.max():.4g}",
            f"{curve.displacement_um.max():.4g}",
            *(str(found[kind]) for kind in KINDS),
        )
        for name, curve, found in zip(campaign.particles, campaign.curves, segments, strict=True)
    ]
    say_table(("test", "points", "max force mN", "max displ um", *KINDS), rows[:SHOWN])
    if len(rows) > SHOWN:
        say(f"  ... and {len(rows) - SHOWN} more")
    total = sum(segments, Counter())
    say("Segments in all: " + ", ".join(f"{total[kind]} {kind}" for kind in KINDS) + ".")
    for one in (*check_plausibility(campaign), *campaign_findings(check_tests(campaign))):
        say(f"{'Warning' if one.level != 'told' else 'Note'}: {one}", fg="red" if one.level == "bad" else "yellow")
    say(f"Written into {out}: particles.csv, curves.csv, campaign.toml")
    say(f"Next: mcc-jax calibrate {shlex.quote(str(out))} --out fit")
