"""`mcc-jax discover`."""

from __future__ import annotations

import functools
from pathlib import Path

import click

from .._store import json_text, results
from .options import (
    CampaignFolder,
    exclude_option,
    law_options,
    leave_out_option,
    out_option,
    priors_option,
    seed_option,
    threshold_option,
)
from .session import beside, import_writers, say, session


@click.command(short_help="Find, name and add what the law misses.")
@click.argument("campaign", type=CampaignFolder(), metavar="CAMPAIGN")
@out_option(required=True)
@exclude_option
@leave_out_option
@threshold_option(default=0.0)
@priors_option()
@law_options
@click.option(
    "--no-held-out", is_flag=True, help="Do not repeat the search without each particle: no gap on unseen particles."
)
@click.option("--no-experiments", is_flag=True, help="Do not work out which further test would tell more.")
@click.option(
    "--no-posterior", is_flag=True, help="Do not sample the law with effects: standard errors of its fit instead."
)
@click.option("--no-figures", is_flag=True, help="Draw no figures.")
@seed_option("Seed of the bootstrap.")
@click.option("--json", "as_json", is_flag=True, help="Print discovery.json instead of a summary.")
def discover(
    campaign: Path,
    out: Path,
    exclude: tuple[str, ...],
    leave_out: tuple[str, ...],
    threshold_MPa: float,
    priors: Path | None,
    unloading: str,
    strain_scaling: str,
    no_held_out: bool,
    no_experiments: bool,
    no_posterior: bool,
    no_figures: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Find where the law and the tests in the folder CAMPAIGN disagree, name what is missing, add it to the law, and
    show on particles that took no part that the gap is closed.

    Writes discovery.json and figures/ into DIR, which may be the folder of the campaign or of a calibration.

    \b
    Verdicts, all of them answers (exit status 0):
      NO_GAP             law and tests agree within the noise
      NAMED              one mechanism explains the gap, or several together
      SET                these data cannot tell several mechanisms apart
      UNLISTED           no listed mechanism explains it; a formula does
      FIT_NOT_CONVERGED  the law cannot be fitted well enough to ask

    \b
    Examples:
      mcc-jax discover my-tests --out found
      mcc-jax discover my-tests --out found --exclude thermal_drift --unloading punch
    """
    with session(20) as tell:
        from ..campaign import read_campaign
        from ..discover import discover as find
        from .calibration import joint_model, left_out, say_files
        from .discovery import require_mechanisms, say_discovery, write_discovery
        from .provenance import provenance

        require_mechanisms(exclude)
        tell("reading the campaign")
        data = left_out(read_campaign(campaign), leave_out)
        settings = {
            "exclude": exclude,
            "leave_out": leave_out,
            "threshold_MPa": threshold_MPa,
            "priors": priors,
            "unloading": unloading,
            "strain_scaling": strain_scaling,
            "held_out": not no_held_out,
            "experiments": not no_experiments,
            "posterior": not no_posterior,
            "seed": seed,
        }
        origin = provenance("discover", campaign, settings)
        writers = functools.partial(import_writers, figures=not no_figures, posterior=False)
        with results(out) as stage, beside(writers):
            found = find(
                data,
                exclude=exclude,
                model=joint_model(unloading, strain_scaling, True, False, priors),
                threshold_MPa=threshold_MPa,
                confirm=not no_held_out,
                experiments=not no_experiments,
                posterior=not no_posterior,
                seed=seed,
                progress=tell,
            )
            content = write_discovery(found, stage, origin=origin, figures=not no_figures, tell=tell)
    if as_json:
        click.echo(json_text(content).encode(), nl=False)  # JSON is UTF-8, whatever the terminal speaks
        return
    say_discovery(content)
    say()
    say_files(out, [*content["figures"], "discovery.json"])
