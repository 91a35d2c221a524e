"""`mcc-jax convert`."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import click

from . import options as common
from .printing import say, say_next
from .session import session


@click.command(short_help="Turn an instrument's file, or a folder of them, into a campaign.")
@click.argument("file", type=common.Location(), metavar="FILE|FOLDER")
@common.out(required=True)
@common.diameters(
    "Diameters in um of all tests, or a table (CSV or xlsx) with particle,D1_um,D2_um,D3_um, in which particles are "
    "called like tests or files; D3 lies along the compression."
)
@common.option(
    "--mapping",
    "FILE",
    common.Location(),
    "TOML file that describes the columns, for any other text table or Excel workbook; repeatable, for a FOLDER of "
    "several kinds of files: each is read by the one that fits.",
    multiple=True,
)
@common.leave_out('A file of FOLDER to leave out; may hold "*" and "?"; repeatable.')
@common.no_seed
def convert(
    file: Path, out: Path, diameters: str | None, mapping: tuple[Path, ...], leave_out: tuple[str, ...]
) -> None:
    """Turn FILE, an instrument's export, or all exports of FOLDER into a campaign.

    Known formats: Fischer HM, Hysitron hld, Hysitron load-control text, Micro Materials text or zip, recognised by
    content. Any other text table, or Excel workbook, needs a mapping file. Units are converted; nothing is shifted or
    smoothed.

    Of a folder every file is read, in natural order, but for hidden files, READMEs, licences, pictures, documents and
    settings (.md, .pdf, .png, .toml, .ini, .db, ...) and folders in it; they are counted. A test is called like its
    file; a file that cannot be read stops all, until it is left out with --leave-out.

    \b
    Example of a mapping file (--mapping):
      delimiter = "semicolon"       # comma, semicolon, tab, space
      decimal_mark = ","
      thousands = "point"           # if 1.000,0 is a thousand
      skip_rows = 3                 # rows above the header; or begin = "t": how it begins
      end = "Maximum"               # how the first row below the samples begins
      missing = ["NaN", ""]         # rows with such a cell are dropped and counted
      tests = "column"              # a column names the test; leave out if the file is one test
      [columns]
      test = { column = "Sample" }
      time = { column = "t", unit = "s" }     # or { speed = 0.05, unit = "mm/s" }
      force = { column = "Load", unit = "N" }
      displacement = { column = "Depth", unit = "nm", sign = -1 }
      [diameters]                   # if a row above the samples gives the diameter
      header = "Gage length"
    """
    with session() as progress:
        from .. import campaign
        from .._format import counted, span

        progress("reading")
        sizes = None if diameters is None else campaign.read_diameters(diameters)
        tables = [Path(str(diameters))] if isinstance(sizes, Mapping) else []
        # Files given by other options may lie among the tests, and are none of them.
        leave_out += tuple(path.name for path in (*mapping, *tables) if path.resolve().parent == file.resolve())
        tests = campaign.read_instrument_file(file, diameters_um=sizes, mapping=mapping or None, skip=leave_out)
        progress("finding the segments")
        segments = Counter(part.kind for curve in tests for part in campaign.find_segments(curve))
        progress("writing")
        campaign.write_campaign(tests, out)
    points = sum(len(curve) for curve in tests)
    source = (tests.metadata.provenance or "").partition(";")[0]
    say(f"{counted(len(tests), 'test')}, {points} points ({source}).")
    force = [float(curve.force_mN.max()) for curve in tests]
    displacement = [float(curve.displacement_um.max()) for curve in tests]
    say(f"Max force {span(force, 'mN')}, max displacement {span(displacement, 'um')}.")
    say("Segments: " + ", ".join(f"{segments[kind]} {kind}" for kind in get_args(campaign.SegmentKind)) + ".")
    noted = map(campaign.Finding.from_json, tests.metadata.other.get("conversion", {}).get("findings", ()))
    found = campaign.campaign_findings(campaign.check_tests(tests))
    for one in (*noted, *campaign.check_plausibility(tests), *found):
        say(f"{'Warning' if one.level != 'info' else 'Note'}: {one}", fg="red" if one.level == "error" else "yellow")
    say(f"Written into {out}: particles.csv, curves.csv, campaign.toml")
    say_next((f"mcc-jax calibrate {shlex.quote(str(out))} --out fit", "the law and its uncertainty"))
