"""`mcc-jax calibrate`."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from .._store import json_text, results
from .group import NOT_CONVERGED
from .options import (
    CampaignFolder,
    law_options,
    leave_out_option,
    out_option,
    priors_option,
    seed_option,
    threshold_option,
)
from .session import beside, import_writers, say, say_table, session

METHODS = ("paper", "least-squares", "bayes")
# Which methods an option belongs to; given with another one it would be ignored, so it is refused.
BELONGS = {
    "objective": ("paper",),
    "reference": ("paper",),
    "loss": ("least-squares",),
    "mode": ("bayes",),
    "chains": ("bayes",),
    "draws": ("bayes",),
    "priors": ("least-squares", "bayes"),
    "modulus_scatter": ("least-squares", "bayes"),
    "shape_scatter": ("least-squares", "bayes"),
}
NO_SETTINGS = ("campaign", "out", "no_figures", "as_json")


def _applies(name: str, method: str) -> bool:
    """Whether an option says how a result of this method comes about."""
    return name not in NO_SETTINGS and method in BELONGS.get(name, METHODS)


@click.command(short_help="Fit the law to a campaign.")
@click.argument("campaign", type=CampaignFolder(), metavar="CAMPAIGN")
@out_option(required=True)
@click.option("--method", type=click.Choice(METHODS), default="bayes", show_default=True, help="How to calibrate.")
@leave_out_option
@threshold_option(". paper: of the offset step, which 0 leaves out; otherwise: points below it do not count.")
@priors_option("  [least-squares, bayes]")
@click.option(
    "--modulus-scatter", is_flag=True, help="Let every particle have its own modulus.  [least-squares, bayes]"
)
@click.option("--shape-scatter", is_flag=True, help="Let a differ from particle to particle.  [least-squares, bayes]")
@click.option(
    "--mode",
    type=click.Choice(["fast", "joint"]),
    default="fast",
    show_default=True,
    help="Integrate the particles out, or sample everything at once (minutes).  [bayes]",
)
@click.option("--chains", type=click.IntRange(1, 64), default=4, show_default=True, help="Chains.  [bayes]")
@click.option(
    "--draws", type=click.IntRange(20, 100_000), default=1000, show_default=True, help="Draws per chain.  [bayes]"
)
@click.option(
    "--loss",
    type=click.Choice(["linear", "soft_l1", "cauchy"]),
    default="linear",
    show_default=True,
    help="Loss of the residuals; all but linear bear outliers.  [least-squares]",
)
@click.option(
    "--objective",
    type=click.Choice(["full", "reference"]),
    default="full",
    show_default=True,
    help="Which objective's a the rest is built on; both are reported.  [paper]",
)
@click.option(
    "--reference", metavar="NAME", help="Reference particle of that objective; by the paper's rule if absent.  [paper]"
)
@law_options
@click.option("--no-figures", is_flag=True, help="Draw no figures.")
@seed_option()
@click.option("--json", "as_json", is_flag=True, help="Print calibration.json instead of a summary.")
@click.pass_context
def calibrate(
    context: click.Context,
    campaign: Path,
    out: Path,
    method: str,
    leave_out: tuple[str, ...],
    threshold_MPa: float,
    priors: Path | None,
    modulus_scatter: bool,
    shape_scatter: bool,
    mode: str,
    chains: int,
    draws: int,
    loss: str,
    objective: str,
    reference: str | None,
    unloading: str,
    strain_scaling: str,
    no_figures: bool,
    seed: int,
    as_json: bool,
) -> int | None:
    """Fit the law to the tests in the folder CAMPAIGN.

    Writes calibration.json and figures/ into DIR, which may be the campaign's own folder; with bayes also posterior.nc,
    the posterior as ArviZ data.

    \b
    Methods:
      bayes          everything at once, with honest uncertainty (the default)
      least-squares  everything at once, the best fit and its covariance
      paper          the paper's own steps one after the other, values only

    The exit status is 3 if the calibration did not converge; its files are written all the same.

    \b
    Examples:
      mcc-jax calibrate my-tests --out my-fit
      mcc-jax calibrate my-tests --out my-fit --priors priors.toml --draws 4000
      mcc-jax calibrate my-tests --out my-fit --method paper --threshold-MPa 0.1
    """
    for name, methods in BELONGS.items():
        given = context.get_parameter_source(name) not in (ParameterSource.DEFAULT, None)
        if given and method not in methods:
            option = "--" + name.replace("_", "-")
            raise click.UsageError(f"{option} belongs to --method {' or '.join(methods)}, not to {method}.")
    with session(12) as tell:
        from ..campaign import read_campaign
        from .calibration import (
            left_out,
            main_numbers,
            require_particle,
            say_files,
            say_state,
            say_warnings,
            write_calibration,
        )
        from .provenance import provenance

        tell("reading the campaign")
        data = left_out(read_campaign(campaign), leave_out)
        require_particle(reference, data.particles, data.source)
        settings: dict[str, Any] = {"threshold_MPa": threshold_MPa, "seed": seed, "progress": tell}
        origin = provenance("calibrate", campaign, {n: v for n, v in context.params.items() if _applies(n, method)})
        writers = functools.partial(import_writers, figures=not no_figures, posterior=method == "bayes")
        with results(out) as stage, beside(writers):
            if method == "paper":
                from ..calibrate import calibrate_paper
                from ..law import StrainScaling, Unloading

                calibration = calibrate_paper(
                    data,
                    objective="reference" if objective == "reference" else "full",
                    reference=reference,
                    unloading=Unloading(unloading),
                    strain_scaling=StrainScaling(strain_scaling),
                    **settings,
                )
            else:
                from ..calibrate import calibrate_bayes, calibrate_least_squares
                from .calibration import joint_model

                model = joint_model(unloading, strain_scaling, modulus_scatter, shape_scatter, priors)
                if method == "bayes":
                    calibration = calibrate_bayes(data, model=model, mode=mode, chains=chains, draws=draws, **settings)  # pyright: ignore[reportArgumentType]  # click has checked the words
                else:
                    calibration = calibrate_least_squares(data, model=model, loss=loss, **settings)  # pyright: ignore[reportArgumentType]
            content = write_calibration(calibration, stage, origin=origin, figures=not no_figures, tell=tell)
    if as_json:
        click.echo(json_text(content).encode(), nl=False)  # JSON is UTF-8, whatever the terminal speaks
        return None if content["converged"] else NOT_CONVERGED
    say_state(content)
    say_table(("quantity", "value"), main_numbers(content))
    misfit = content["diagnostics"].get("relative_misfit")
    if misfit is not None:
        say(f"The mean law misses the displacements by {100 * misfit:.1f} % of their range (median over particles).")
    say_warnings(content)
    say_files(out, [*content["figures"], *content["files"], "calibration.json"])
    return None if content["converged"] else NOT_CONVERGED
