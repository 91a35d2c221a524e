"""`mcc-jax simulate`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from .._store import results
from .options import Interval, Levels, Location, Number, law_options, out_option, seed_option
from .session import say, session

POSITIVE, NOT_NEGATIVE = {"least": 0, "above": True}, {"least": 0}


def _number(name: str, unit: str, limits: dict[str, Any], text: str, **settings: Any) -> Any:
    return click.option(
        name, name.lstrip("-").replace("-", "_"), type=Number(**limits, metavar=unit), help=text, **settings
    )


def _zero(name: str, unit: str, text: str) -> Any:
    return _number(name, unit, NOT_NEGATIVE, text, default=0.0, show_default=True)


@click.command(short_help="Test particles in the computer.")
@out_option(required=True)
@click.option(
    "--particles",
    type=Location(),
    metavar="FILE",
    help="CSV table with particle,D1_um,D2_um,D3_um; further columns are kept.  [default: the paper's Table 1]",
)
@click.option("--programme", type=Location(), metavar="FILE", help="TOML file with the steps of the test; see above.")
@click.option("--control", type=click.Choice(["load", "displacement"]), help="Controlled quantity.  [default: load]")
@_number("--rate", "mN/s|um/s", POSITIVE, "Rate in mN/s or, under displacement control, um/s.  [default: 2]")
@click.option("--levels", type=Levels(), help="Peak of each cycle as a share of the particle's peak.  [default: 1]")
@_number("--unload-to", "SHARE", NOT_NEGATIVE, "Share at which reloading starts.  [default: 0]")
@_number("--hold-s", "s", POSITIVE, "Hold at every level.  [default: none]")
@click.option("--points", type=click.IntRange(2, 1_000_000), metavar="N", help="Samples of a test.  [default: 300]")
@_number("--interval-s", "s", POSITIVE, "Time between samples, instead of --points.")
@click.option(
    "--peak-stress",
    type=Interval("MPa|LOW:HIGH"),
    help="Stress at each particle's peak, or a range to draw from.  [default: 7:16]",
)
@click.option(
    "--peak-strain",
    type=Interval("STRAIN|LOW:HIGH"),
    help="Strain displacement/D_e at the peak instead; displacement control only.",
)
@click.option(
    "--shared-material", is_flag=True, help="Give all particles the mean law of Table 2 instead of draws from it."
)
@_number("--C1", "C1", POSITIVE, "Fix C1 for all particles.  [default: drawn from Table 2]")
@_number("--C3", "C3", NOT_NEGATIVE, "Fix C3 likewise.")
@_number("--C5", "C5", POSITIVE, "Fix C5 likewise.")
@_number("--a", "A", {}, "Shape parameter.", default=1.43, show_default=True)
@_number("--effective-modulus", "MPa", POSITIVE, "Effective modulus.", default=16000.0, show_default=True)
@law_options
@click.option(
    "--effect",
    "effects",
    multiple=True,
    metavar="NAME[:VARIANT][=X][,P=V]",
    help="An effect that the law does not contain; repeatable.  [default amplitude: the middle of what is plausible]",
)
@_zero("--noise-um", "um", "Standard deviation of noise on displacement.")
@_zero("--noise-mN", "mN", "Standard deviation of noise on force.")
@_zero("--resolution-um", "um", "Smallest step of displacement.")
@_zero("--resolution-mN", "mN", "Smallest step of force.")
@_zero("--zero-um", "um", "Standard deviation of each test's zero of displacement.")
@seed_option()
def simulate(out: Path, particles: Path | None, unloading: str, strain_scaling: str, seed: int, **options: Any) -> None:
    """Put particles through a test programme in the computer and write the campaign into DIR.

    True coefficients go into the columns true_C1, true_C3, true_C5 of particles.csv, effects into campaign.toml.

    \b
    Examples:
      mcc-jax simulate --out sim --levels 0.5,1 --unload-to 0.1 --hold-s 30
      mcc-jax simulate --out sim --control displacement --rate 1 --peak-strain 0.4
      mcc-jax simulate --out sim --programme steps.toml --noise-um 0.02
      mcc-jax simulate --out sim --hold-s 60 --effect frame_compliance=0.002 --effect creep:logarithmic,tau_s=5

    \b
    Example of a programme file (levels are shares of each particle's peak):
      control = "load"            # or "displacement"
      rate = 2.0                  # mN/s or um/s
      points = 300                # or interval_s = 0.5
      [[step]]
      ramp_to = 1.0
      [[step]]
      hold_s = 60
      [[step]]
      ramp_to = 0.0
      rate = 4.0
    """
    _refuse_contradictions(options)
    with session(3) as tell:
        from ..campaign import write_campaign
        from ..law import StrainScaling, Unloading
        from .simulation import (
            Material,
            hidden_effects,
            particle_sizes,
            peaks_and_programme,
            simulate_particles,
        )

        tell("reading the input")
        sizes = particle_sizes(particles)
        hidden = hidden_effects(options["effects"], sizes)
        material = Material(
            {name: options[name] for name in ("C1", "C3", "C5")},
            options["shared_material"],
            options["a"],
            options["effective_modulus"],
            Unloading(unloading),
            StrainScaling(strain_scaling),
        )
        tell("simulating")
        laws = material.laws(sizes, seed)
        peaks, programme = peaks_and_programme(options, laws, sizes, seed)
        with results(out) as stage:
            campaign = simulate_particles(laws, sizes, peaks, programme, options, hidden, seed)
            tell("writing")
            write_campaign(campaign, stage.folder)
    points = [len(curve) for curve in campaign.curves]
    forces = [curve.force_mN.max() for curve in campaign.curves]
    say(f"Simulated {len(campaign)} particles, {sum(points)} points, {programme.control} control, seed {seed}.")
    say(f"Peak forces {min(forces):.4g} to {max(forces):.4g} mN; the tests take up to {_duration(campaign):.4g} s.")
    for effect in hidden:
        variant = effect.variant
        drawn = " (drawn for each test)" if variant.parameter in effect.random else ""
        amplitude = f"{variant.parameter} {effect.strength:.4g}{drawn}"
        say(f"Hidden effect: {variant.mechanism}, {variant.name}, {amplitude}.")
    falling = [
        name for name, flag in zip(campaign.particles, campaign.columns["true_monotone"], strict=True) if flag == "no"
    ]
    if falling:
        what = "snaps through" if programme.control == "load" else "softens"
        say(f"Warning: the loading curve falls somewhere, and the particle {what}: {', '.join(falling)}.", fg="yellow")
    say(f"Written into {out}: particles.csv, curves.csv, campaign.toml")
    say(f"Next: mcc-jax calibrate {shlex.quote(str(out))} --out fit")


def _duration(campaign: Any) -> float:
    return max(float(curve.time_s[-1]) for curve in campaign.curves)


def _refuse_contradictions(options: dict[str, Any]) -> None:
    """No option is accepted and then ignored.

    Raises:
        UsageError: naming the two that do not go together.
    """

    def given(name: str) -> bool:
        return options[name] is not None

    def refuse(one: str, other: str, why: str) -> None:
        raise click.UsageError(f"--{one} does not go with --{other}: {why}.")

    if given("programme"):
        for name in ("control", "rate", "levels", "unload_to", "hold_s", "points", "interval_s"):
            if given(name):
                refuse(name.replace("_", "-"), "programme", "the programme file says that already")
    if given("points") and given("interval_s"):
        refuse("interval-s", "points", "each says how densely the test is sampled")
    if given("peak_stress") and given("peak_strain"):
        refuse("peak-strain", "peak-stress", "each says where the peak is")
    if given("peak_strain") and not given("programme") and options["control"] != "displacement":
        raise click.UsageError("--peak-strain needs --control displacement.")
    levels = options["levels"] or (1.0,)
    if given("unload_to"):
        if len(levels) < 2:
            raise click.UsageError("--unload-to needs two --levels or more: the last unloading is always complete.")
        if options["unload_to"] >= min(levels[:-1]):
            raise click.UsageError("--unload-to lies not below the --levels it unloads from.")
    if options["shared_material"] and all(given(name) for name in ("C1", "C3", "C5")):
        refuse("shared-material", "C1, --C3 and --C5", "they fix the material already")
