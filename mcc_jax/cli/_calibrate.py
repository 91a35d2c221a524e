"""`mcc-jax calibrate`."""

from __future__ import annotations

from pathlib import Path

import click

from ._output import json_text, results
from ._session import say, say_table, session
from ._types import Location, Number, law_options, out_option, seed_option


@click.command(short_help="Fit the law to a campaign.")
@click.argument("campaign", type=Location(), metavar="CAMPAIGN")
@out_option(required=True)
@click.option("--method", type=click.Choice(["paper"]), default="paper", show_default=True, help="How to calibrate.")
@click.option(
    "--threshold-MPa",
    "threshold_MPa",
    type=Number(0, metavar="MPa"),
    default=0.2,
    show_default=True,
    help="Stress of the offset step, below which only surface asperities deform; 0 leaves the step out.",
)
@click.option(
    "--objective",
    type=click.Choice(["full", "reference"]),
    default="full",
    show_default=True,
    help="Which objective's a the rest is built on; both are reported.",
)
@click.option(
    "--reference", metavar="NAME", help="Reference particle of that objective.  [default: by the paper's rule]"
)
@law_options
@click.option("--no-figures", is_flag=True, help="Write calibration.json only.")
@seed_option()
@click.option("--json", "as_json", is_flag=True, help="Print calibration.json instead of a summary.")
def calibrate(
    campaign: Path,
    out: Path,
    method: str,
    threshold_MPa: float,
    objective: str,
    reference: str | None,
    unloading: str,
    strain_scaling: str,
    no_figures: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Fit the law to the tests in the folder CAMPAIGN.

    Writes calibration.json and figures/ into DIR, which may be the campaign's own folder. The paper's method gives
    values without uncertainties; nothing in it is random, so the seed is only recorded.

    \b
    Example:
      mcc-jax calibrate my-tests --out my-fit --threshold-MPa 0.1
    """
    with session(8) as tell:
        from ..calibrate import calibrate_paper
        from ..campaign import read_campaign
        from ..law import StrainScaling, Unloading
        from ._calibration import main_numbers, require_particle, say_files, say_state, say_warnings, write_calibration

        tell("reading the campaign")
        data = read_campaign(campaign)
        require_particle(reference, data.particles, data.source)
        with results(out) as stage:
            calibration = calibrate_paper(
                data,
                threshold_MPa=threshold_MPa,
                objective="reference" if objective == "reference" else "full",
                reference=reference,
                unloading=Unloading(unloading),
                strain_scaling=StrainScaling(strain_scaling),
                seed=seed,
                progress=tell,
            )
            content = write_calibration(calibration, stage, figures=not no_figures, tell=tell)
    if as_json:
        click.echo(json_text(content).encode(), nl=False)  # JSON is UTF-8, whatever the terminal speaks
        return
    say_state(content)
    say_table(("quantity", "value"), main_numbers(content))
    misfit = content["diagnostics"]["relative_misfit"]
    if misfit is not None:
        say(f"The mean law misses the displacements by {100 * misfit:.1f} % of their range (median over particles).")
    say_warnings(content)
    say_files(out, [*content["figures"], "calibration.json"])
