"""`mcc-jax convert`."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path

import click

from . import options as common
from .printing import say, say_next
from .session import session

KINDS = ("approach", "load", "hold", "unload", "reload")


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
        from .._format import span
        from ..campaign import (
            campaign_findings,
            check_plausibility,
            check_tests,
            find_segments,
            read_diameters,
            read_instrument_file,
            write_campaign,
        )

        progress("reading")
        sizes = None if diameters is None else read_diameters(diameters)
        given = [*mapping, *([] if diameters is None else [Path(diameters)])]
        leave_out += tuple(path.name for path in given if _lies_in(path, file) and path.name not in leave_out)
        campaign = read_instrument_file(file, diameters_um=sizes, mapping=mapping or None, skip=leave_out)
        progress("finding the segments")
        segments = Counter(part.kind for curve in campaign.curves for part in find_segments(curve))
        progress("writing")
        write_campaign(campaign, out)
    points = sum(len(curve) for curve in campaign.curves)
    source = (campaign.metadata.provenance or "").partition(";")[0]
    say(f"{len(campaign)} test{'s' if len(campaign) > 1 else ''}, {points} points ({source}).")
    force = [float(curve.force_mN.max()) for curve in campaign.curves]
    displacement = [float(curve.displacement_um.max()) for curve in campaign.curves]
    say(f"Max force {span(force, 'mN')}, max displacement {span(displacement, 'um')}.")
    say("Segments: " + ", ".join(f"{segments[kind]} {kind}" for kind in KINDS) + ".")
    for finding in campaign.metadata.other.get("conversion", {}).get("findings", ()):
        say(f"Note: {finding['sentence']}." + (f" {finding['remedy']}." if finding["remedy"] else ""))
    for one in (*check_plausibility(campaign), *campaign_findings(check_tests(campaign))):
        say(f"{'Warning' if one.level != 'info' else 'Note'}: {one}", fg="red" if one.level == "error" else "yellow")
    say(f"Written into {out}: particles.csv, curves.csv, campaign.toml")
    say_next((f"mcc-jax calibrate {shlex.quote(str(out))} --out fit", "the law and its uncertainty"))


def _lies_in(path: Path, folder: Path) -> bool:
    """Whether a file given by another option lies among the tests, which is then none of them."""
    from ..campaign.readers.folder import passed_over

    try:
        inside = folder.is_dir() and path.is_file() and path.resolve().parent == folder.resolve()
    except (OSError, ValueError):  # three long numbers are no name of a file
        return False
    return inside and not passed_over(path.name)
