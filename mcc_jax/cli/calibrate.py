"""`mcc-jax calibrate`."""

from __future__ import annotations

import dataclasses
import functools
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from .._extras import extra
from .._store import Stage, results
from . import options as common
from .session import (
    NOT_CONVERGED,
    joint_model,
    listed,
    provenance,
    read_without,
    require_particle,
    say,
    say_files,
    say_json,
    say_next,
    say_table,
    sentence,
    session,
    write_figures,
)

if TYPE_CHECKING:
    from .._types import Progress
    from ..calibrate import LeastSquares, PaperCalibration, Posterior
    from ..campaign import Campaign

    type Calibration = PaperCalibration | LeastSquares | Posterior

RESULT, POSTERIOR, ARCHIVE = "calibration.json", "posterior.nc", "calibration.msgpack"
METHODS = ("paper", "least-squares", "bayes")
JOINT = ("least-squares", "bayes")
BELONGS = {
    **dict.fromkeys(("objective", "reference"), ("paper",)),
    "loss": ("least-squares",),
    **dict.fromkeys(("mode", "chains", "draws"), ("bayes",)),
    **dict.fromkeys(("priors", "modulus_scatter", "shape_scatter", "robust", "effects", "varying"), JOINT),
}
"""Which methods an option belongs to; given with another one it would be ignored, so it is refused."""
NO_SETTINGS = ("campaign", "out", "no_figures", "as_json")


@click.command(short_help="Fit the law to a campaign.")
@common.campaign()
@common.out(required=True)
@click.option("--method", type=click.Choice(METHODS), default="bayes", show_default=True, help="How to calibrate.")
@common.leave_out
@common.threshold(". paper: of the offset step, which 0 leaves out; otherwise: points below it do not count.")
@common.priors("  [least-squares, bayes]")
@click.option(
    "--modulus-scatter", is_flag=True, help="Let every particle have its own modulus.  [least-squares, bayes]"
)
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="MECHANISM[:VARIANT]",
    help="An effect that acts on the law, fitted with it; repeatable.  [least-squares, bayes]",
)
@click.option(
    "--varying",
    multiple=True,
    metavar="MECHANISM",
    help="Such an effect whose amplitude differs from particle to particle; repeatable.  [least-squares, bayes]",
)
@click.option(
    "--shape-scatter",
    is_flag=True,
    help="Allow the shape parameter a to vary between particles.  [least-squares, bayes]",
)
@click.option("--robust", is_flag=True, help="Noise with heavy tails: spikes count for little.  [least-squares, bayes]")
@common.one_of(
    "--mode", ("fast", "joint"), "Integrate the particles out, or sample everything at once (minutes).  [bayes]"
)
@click.option("--chains", type=click.IntRange(1, 64), default=4, show_default=True, help="Chains.  [bayes]")
@click.option(
    "--draws", type=click.IntRange(20, 100_000), default=1000, show_default=True, help="Draws per chain.  [bayes]"
)
@common.one_of(
    "--loss",
    ("linear", "soft_l1", "cauchy"),
    "Loss of the residuals; soft_l1 and cauchy are robust to outliers.  [least-squares]",
)
@common.one_of(
    "--objective", ("full", "reference"), "Which objective's a the rest is built on; both are reported.  [paper]"
)
@click.option(
    "--reference", metavar="NAME", help="Reference particle of that objective; by the paper's rule if absent.  [paper]"
)
@common.law
@common.no_figures
@common.seed()
@common.json(RESULT)
@click.pass_context
def calibrate(
    context: click.Context, campaign: Path, out: Path, method: str, no_figures: bool, as_json: bool, **options: Any
) -> int | None:
    """Fit the law to the tests in the folder CAMPAIGN.

    Writes calibration.json, calibration.msgpack (for mcc_jax.load) and figures/ into DIR, which may be the campaign's
    own folder; with bayes also posterior.nc, the posterior as ArviZ data.

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
      mcc-jax calibrate my-tests --out my-fit --effect creep:logarithmic
      mcc-jax calibrate my-tests --out my-fit --method paper --threshold-MPa 0.1
    """
    for name, methods in BELONGS.items():
        given = context.get_parameter_source(name) not in (ParameterSource.DEFAULT, None)
        if given and method not in methods:
            option = "--effect" if name == "effects" else "--" + name.replace("_", "-")
            raise click.UsageError(f"{option} belongs to --method {' or '.join(methods)}, not to {method}.")
    with session(12) as progress:
        data = read_without(campaign, options["leave_out"], progress)
        if options["reference"] is not None:
            require_particle(options["reference"], data, "--reference")
        # What says how a result of this method comes about.
        settings = {
            n: v for n, v in context.params.items() if n not in NO_SETTINGS and method in BELONGS.get(n, METHODS)
        }
        origin = provenance("calibrate", campaign, settings)
        with results(out) as stage:
            calibration = _calibrated(data, method, options, progress)
            content = write_calibration(calibration, stage, origin=origin, figures=not no_figures, progress=progress)
    from ..calibrate.estimates import quantities

    if as_json:
        say_json(content)
    else:
        say_state(content)
        say_table(("quantity", "value"), [(one.label, one.text) for one in quantities(content)])
        misfit = content["diagnostics"].get("relative_misfit")
        if misfit is not None:
            say(
                f"The mean law misses the displacements by {100 * misfit:.1f} % of their range (median over particles)."
            )
        say_warnings(content)
        say_files(out, [*content["figures"], *content["files"], RESULT])
        here = shlex.quote(str(out))
        say_next(
            (
                "" if options["effects"] else f"mcc-jax discover {shlex.quote(str(campaign))} --out {here}",
                "what the law misses",
            ),
            (f"mcc-jax report {here}", "all of it on one page"),
        )
    return None if content["converged"] else NOT_CONVERGED


def _calibrated(data: Campaign, method: str, options: dict[str, Any], progress: Progress) -> Calibration:
    from ..calibrate import calibrate_paper, least_squares, sample

    def chosen(*names: str) -> dict[str, Any]:
        return {name: options[name] for name in (*names, "threshold_MPa", "seed")} | {"progress": progress}

    if method == "paper":
        return calibrate_paper(data, **chosen("objective", "reference", "unloading", "strain_scaling"))
    scatter = {name: options[name] for name in ("modulus_scatter", "shape_scatter")}
    model = joint_model(options, **scatter).with_effects(*options["effects"], varying=options["varying"])
    model = dataclasses.replace(model, robust=options["robust"])
    if method == "bayes":
        return sample(data, model, **chosen("mode", "chains", "draws"))
    return least_squares(data, model, **chosen("loss"))


def write_calibration(
    calibration: Calibration, stage: Stage, *, origin: Mapping[str, Any], figures: bool, progress: Progress
) -> dict[str, Any]:
    """Write the calibration, the figures and, if there is one, the posterior into the stage.

    Files that an earlier calibration lists as its own, and this one does not write, become stale: they would contradict
    what is next to them now. `origin` is what `provenance` gives. Returns the contents of `calibration.json`.
    """
    from ..calibrate import Posterior

    names = write_figures(stage, RESULT, functools.partial(_draw, calibration) if figures else None, progress)
    files = [ARCHIVE]
    if isinstance(calibration, Posterior):
        progress("writing the posterior")
        with extra("netcdf"):
            import h5netcdf  # noqa: F401
            import h5py  # noqa: F401
        calibration.to_arviz(seed=calibration.seed).to_netcdf(stage.folder / POSTERIOR, engine="h5netcdf")
        files.append(POSTERIOR)
    ours = "|".join((POSTERIOR, ARCHIVE))
    stage.stale += [name for name in listed(stage.directory / RESULT, "files", ours) if name not in files]
    return calibration.write(stage.folder, figures=names, files=files, provenance=dict(origin))


def _draw(calibration: Calibration) -> Mapping[str, Any]:
    from ..plots import least_squares_figures, paper_figures, posterior_figures

    draw: dict[str, Callable[[Any], Mapping[str, Any]]]
    draw = {"paper": paper_figures, "least-squares": least_squares_figures, "bayes": posterior_figures}
    return draw[calibration.to_json()["method"]](calibration)


def say_state(content: dict[str, Any]) -> None:
    """Print how many particles took part, whether the fit converged, and whether its numbers can be true."""
    used, law = sum(entry["kept"] for entry in content["particles"]), content["law"]
    objective = f"a by the {content['a_objective']} objective, " if "a_objective" in content else ""
    state = "converged."
    if not content["converged"]:
        state = "NOT converged."
    elif any(one["level"] == "error" for one in content["findings"]):
        state = "the optimisers converged, but NOT TO BE TRUSTED: see below."
    say(
        f"Method {content['method']}: {used} of {len(content['particles'])} particles, {objective}"
        f"unloading {law['unloading']}, strain scaling {law['strain_scaling']}; {state}"
    )


def say_warnings(content: dict[str, Any]) -> None:
    """Print what a reader of the numbers must know."""
    from ..campaign import Finding

    bad = {str(Finding.from_json(one)) for one in content["findings"] if one["level"] == "error"}
    for warning in sorted(content["warnings"], key=lambda text: text not in bad):
        colour = "red" if warning in bad else "yellow"
        say(f"Warning: {sentence(warning)}", fg=colour, bold=warning in bad)
    for entry in content["particles"]:
        if not entry["kept"]:
            say(f"Not used: particle {entry['particle']}: {entry['why_not']}.", fg="yellow")
