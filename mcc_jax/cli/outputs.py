"""`mcc-jax report` and `mcc-jax export`: results for people, and for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .._store import results
from . import options as common
from .printing import say, say_files, sentence
from .session import session

REPORT = "report.html"
FORMATS = ("json", "csv", "jax", "c", "lammps", "yade")


@click.command(short_help="One page that shows all results.")
@click.argument("folder", type=common.Location(), metavar="DIR")
@common.out()
@common.option("--campaign", "CAMPAIGN", common.Location(), "Folder of the tests, if the results do not know it.")
@common.no_seed
def report(folder: Path, out: Path | None, campaign: Path | None) -> None:
    """Write one self-contained HTML page from what is in the folder DIR: a campaign, calibration.json with
    posterior.nc, discovery.json, or any of them.

    Writes report.html into DIR, or into the folder given by --out. It needs no network, opens in any browser, and can
    be sent or printed. The tests are looked for in DIR, in DIR/campaign, and where calibration or discovery found them.

    \b
    Examples:
      mcc-jax report mcc-jax-demo
      mcc-jax report my-fit --campaign my-tests --out for-my-colleague
    """
    with session() as progress:
        from ..report import read_results, report_page

        progress("reading the results")
        found = read_results(folder, campaign)
        page = report_page(found, progress=progress)
        with results(out or folder) as stage:
            (stage.folder / REPORT).write_text(page, encoding="utf-8")
    for text in found.cautions:
        say(f"Caution: {text}.", fg="yellow")
    for text in found.missing:
        say(f"Not in the report: {text}.", fg="yellow")
    say(f"Written: {(out or folder) / REPORT} ({len(page.encode()) / 1e6:.1f} MB). Open it in a browser.")


@click.command(short_help="Hand the calibrated law to other engines.")
@click.argument("directory", type=common.Location(), metavar="DIR")
@click.option("--format", "form", type=click.Choice(FORMATS), required=True, help="What to write; see below.")
@common.out(required=True)
@common.option("--particle", "NAME", str, "Take this particle's coefficients instead of the population's.")
@common.diameters(
    "Diameters in um of the particle that the golden table shows, or a table of particles (its row of that particle, "
    "or its mean).  [default: the particles of the calibrated campaign]"
)
@click.option(
    "--allow-not-monotone", is_flag=True, help="Export a law whose stress falls on loading, instead of refusing it."
)
@common.seed("Seed of the random paths in the golden table.")
def export(directory: Path, form: str, out: Path, seed: int, **options: Any) -> None:
    """Write the law that a calibration of any method, or a discovery, wrote into DIR, for use in other engines.

    Takes the population's law, each coefficient at its median exp(mean of log C), or one particle's. Next to every
    artefact lies a golden table: paths with force and tangent to check an implementation against.

    \b
    Formats:
      json    parameter card: values, units, uncertainty, formulae, validity, provenance
      csv     master curve and unloading curve as tables for linear interpolation
      jax     functions of many contacts that need jax and flatbuffers only
      c       a C99 header, also C++: one particle between platens, and pairs
      lammps  a normal model for LAMMPS around that header
      yade    material and functors for Yade around that header

    \b
    Examples:
      mcc-jax export fit --format c --out law
      mcc-jax export fit --format json --out law --particle 7 --diameters tests/particles.csv
    """
    with session() as progress:
        from ..export import read_calibration, write_export

        progress("reading the calibration")
        law, shown, origin = read_calibration(directory, **options)
        progress("writing")
        with results(out) as stage:
            files = write_export(form, law, shown, stage.folder, origin=origin, seed=seed)
    whose = "the population" if options["particle"] is None else f"particle {options['particle']}"
    say(
        f"Law of {whose}: unloading {law.unloading.value}, strain scaling {law.strain_scaling.value}, "
        f"C1 {float(law.plastic.C1):.4g}, C3 {float(law.plastic.C3):.4g}, C5 {float(law.plastic.C5):.4g}, "
        f"a {float(law.a):.4g}, effective modulus {float(law.effective_modulus) / 1e3:.4g} GPa."
    )
    sizes = " x ".join(f"{float(d):.4g}" for d in (shown.D1, shown.D2, shown.D3))
    say(f"Golden table of a particle of {sizes} um ({origin.geometry}).")
    for warning in origin.warnings:
        say(f"Warning: {sentence(warning)}", fg="yellow")
    say_files(out, files)
