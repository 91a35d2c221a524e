"""`mcc-jax calibrate`."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from .._store import results
from . import options as common
from .printing import say, say_files, say_json, say_next, say_table, sentence
from .session import NOT_CONVERGED, joint_model, provenance, read_without, session, write_result

if TYPE_CHECKING:
    from .._types import Progress
    from ..campaign import Campaign
    from .session import Calibration

RESULT = "calibration.json"
METHODS = ("paper", "least-squares", "bayes")
NO_SETTINGS = ("campaign", "out", "no_figures", "as_json")


class MethodOption(click.Option):
    """An option that only some methods use; its help names them."""

    def __init__(self, names: Sequence[str], methods: Sequence[str], help: str, **settings: Any) -> None:
        super().__init__(names, help=f"{help}  [{', '.join(methods)}]", **settings)
        self.methods = methods


def _of(*methods: str) -> dict[str, Any]:
    return {"cls": MethodOption, "methods": methods}


JOINT, BAYES, SQUARES, PAPER = _of("least-squares", "bayes"), _of("bayes"), _of("least-squares"), _of("paper")


@click.command(short_help="Fit the law to a campaign.")
@common.campaign
@common.out(required=True)
@click.option("--method", type=click.Choice(METHODS), default="bayes", show_default=True, help="How to calibrate.")
@common.leave_out()
@common.threshold(". paper: of the offset step, which 0 leaves out; otherwise: points below it do not count.")
@common.priors(**JOINT)
@click.option("--modulus-scatter", is_flag=True, help="Let every particle have its own modulus.", **JOINT)
@common.effect("MECHANISM[:VARIANT]", "An effect that acts on the law, fitted with it; repeatable.", **JOINT)
@common.option(
    "--varying",
    "MECHANISM",
    str,
    "Such an effect whose amplitude differs from particle to particle; repeatable.",
    multiple=True,
    **JOINT,
)
@click.option("--shape-scatter", is_flag=True, help="Allow the shape parameter a to vary between particles.", **JOINT)
@click.option("--robust", is_flag=True, help="Noise with heavy tails: spikes count for little.", **JOINT)
@common.one_of(
    "--mode", ("fast", "joint"), "Integrate the particles out, or sample everything at once (minutes).", **BAYES
)
@click.option("--chains", type=click.IntRange(1, 64), default=4, show_default=True, help="Chains.", **BAYES)
@click.option(
    "--draws", type=click.IntRange(20, 100_000), default=1000, show_default=True, help="Draws per chain.", **BAYES
)
@common.one_of(
    "--loss",
    ("linear", "soft_l1", "cauchy"),
    "Loss of the residuals; soft_l1 and cauchy are robust to outliers.",
    **SQUARES,
)
@common.one_of(
    "--objective", ("full", "reference"), "Which objective's a the rest is built on; both are reported.", **PAPER
)
@common.option(
    "--reference", "NAME", str, "Reference particle of that objective; by the paper's rule if absent.", **PAPER
)
@common.law
@common.no_figures
@common.seed()
@common.json(RESULT)
@click.pass_context
def calibrate(
    context: click.Context, campaign: Path, out: Path, method: str, no_figures: bool, as_json: bool, **options: Any
) -> None:
    """Fit the law to the tests in the folder CAMPAIGN.

    Writes calibration.json, calibration.msgpack (for mcc_jax.load) and figures/ into DIR, which may be the campaign's
    own folder; with bayes also posterior.nc, the posterior as ArviZ data.

    \b
    Methods:
      bayes          everything at once, with its uncertainty (the default)
      least-squares  everything at once, the best fit and its covariance
      paper          the paper's own steps one after the other, values only

    The exit status is 3 if the calibration did not converge; its files are written all the same.

    \b
    Examples:
      mcc-jax calibrate my-tests --out my-fit
      mcc-jax calibrate my-tests --out my-fit --priors priors.toml --draws 4000
      mcc-jax calibrate my-tests --out my-fit --effect creep:logarithmic
      mcc-jax calibrate my-tests --out my-fit --method paper --threshold-MPa 0.1
    """
    other = [one for one in context.command.params if isinstance(one, MethodOption) and method not in one.methods]
    for option in other:
        if context.get_parameter_source(str(option.name)) is not ParameterSource.DEFAULT:
            right = " or ".join(option.methods)
            raise click.UsageError(f"{option.opts[0]} belongs to --method {right}, not to {method}.")
    without = {*NO_SETTINGS, *(option.name for option in other)}
    with session() as progress:
        data = read_without(campaign, options["leave_out"], progress)
        if options["reference"] is not None:
            data.index(options["reference"])  # refuses a name that is not there before anything is computed
        settings = {name: value for name, value in context.params.items() if name not in without}
        origin = provenance("calibrate", campaign, settings)
        with results(out) as stage:
            calibration = _calibrated(data, method, options, progress)
            content = write_result(calibration, stage, origin=origin, figures=not no_figures, progress=progress)
    if as_json:
        say_json(content)
    else:
        say_calibration(content)
        say_files(out, [*content["figures"], *content["files"], RESULT])
        here, discovery = shlex.quote(str(out)), f"mcc-jax discover {shlex.quote(str(campaign))} --out "
        say_next(
            ("" if options["effects"] else discovery + here, "what the law misses"),
            (f"mcc-jax report {here}", "all of it on one page"),
        )
    if not content["converged"]:
        context.exit(NOT_CONVERGED)


def _calibrated(data: Campaign, method: str, options: dict[str, Any], progress: Progress) -> Calibration:
    from ..calibrate import calibrate_paper, least_squares, sample

    shared = {"threshold_MPa": options["threshold_MPa"], "seed": options["seed"], "progress": progress}
    if method == "paper":
        own = {name: options[name] for name in ("objective", "reference", "unloading", "strain_scaling")}
        return calibrate_paper(data, **own, **shared)
    scatter = {name: options[name] for name in ("modulus_scatter", "shape_scatter")}
    model = joint_model(options, **scatter).with_effects(*options["effects"], varying=options["varying"])
    model = dataclasses.replace(model, robust=options["robust"])
    if method == "least-squares":
        return least_squares(data, model, loss=options["loss"], **shared)
    return sample(data, model, **{name: options[name] for name in ("mode", "chains", "draws")}, **shared)


def say_calibration(content: dict[str, Any], *, numbers: bool = True) -> None:
    """Print how many particles took part, whether the fit converged, its numbers, and what their reader must know."""
    from ..calibrate.estimates import quantities
    from ..campaign import Finding

    used, law = sum(entry["kept"] for entry in content["particles"]), content["law"]
    levels = {str(Finding.from_json(one)): one["level"] for one in content["findings"]}
    bad = {text for text, level in levels.items() if level == "error"}
    state = "NOT converged." if not content["converged"] else "converged."
    if content["converged"] and bad:
        state = "the optimisers converged, but NOT TO BE TRUSTED: see below."
    objective = f"a by the {content['a_objective']} objective, " if "a_objective" in content else ""
    say(
        f"Method {content['method']}: {used} of {len(content['particles'])} particles, {objective}"
        f"unloading {law['unloading']}, strain scaling {law['strain_scaling']}; {state}"
    )
    if numbers:
        say_table(("quantity", "value"), [(one.label, one.text) for one in quantities(content)])
        misfit = content["diagnostics"].get("relative_misfit")
        if misfit is not None:
            missed = f"{100 * misfit:.1f} % of their range (median over particles)"
            say(f"The mean law misses the displacements by {missed}.")
    for warning in sorted(content["warnings"], key=lambda text: text not in bad):
        label = "Note" if levels.get(warning) == "info" else "Warning"
        say(f"{label}: {sentence(warning)}", fg="red" if warning in bad else "yellow", bold=warning in bad)
    for entry in content["particles"]:
        if not entry["kept"]:
            say(f"Not used: particle {entry['particle']}: {entry['why_not']}.", fg="yellow")
