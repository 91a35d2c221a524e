"""`mcc-jax simulate`."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from .._errors import InputError
from . import options as common
from .session import say, say_next, session

if TYPE_CHECKING:
    import numpy as np

    from ..campaign import Campaign
    from ..law import MccLaw
    from ..simulate import HiddenEffect, Programme

COEFFICIENTS = ("C1", "C3", "C5")
MAX_ROWS = 10_000_000
LONGEST_S = 1e12


def _option(name: str, unit: str, kind: Callable[[Any], Any] | click.ParamType, text: str, **settings: Any) -> Any:
    variable = name[2:].replace("-", "_")  # click itself would write it in lower case
    return click.option(name, variable, type=kind, metavar=unit, help=text, **settings)


def _zero(name: str, unit: str, text: str) -> Any:
    return _option(name, unit, common.NOT_NEGATIVE, text, default=0.0, show_default=True)


@click.command(short_help="Test particles in the computer.")
@common.out(required=True)
@_option(
    "--particles",
    "FILE",
    common.Location(),
    "CSV table with particle,D1_um,D2_um,D3_um; further columns are kept.  [default: the paper's Table 1]",
)
@_option("--programme", "FILE", common.Location(), "TOML file with the steps of the test; see above.")
@click.option("--control", type=click.Choice(["load", "displacement"]), help="Controlled quantity.  [default: load]")
@_option("--rate", "mN/s|um/s", common.POSITIVE, "Rate in mN/s or, under displacement control, um/s.  [default: 2]")
@_option("--levels", "L1,L2,...", common.levels, "Peak of each cycle as a share of the particle's peak.  [default: 1]")
@_option("--unload-to", "SHARE", common.NOT_NEGATIVE, "Share at which reloading starts.  [default: 0]")
@_option("--hold-s", "s", common.POSITIVE, "Hold at every level.  [default: none]")
@_option("--points", "N", click.IntRange(2, 1_000_000), "Samples of a test.  [default: 300]")
@_option("--interval-s", "s", common.POSITIVE, "Time between samples, instead of --points.")
@_option(
    "--peak-stress",
    "MPa|LOW:HIGH",
    common.interval,
    "Stress at each particle's peak, or a range to draw from.  [default: 7:16]",
)
@_option(
    "--peak-strain",
    "STRAIN|LOW:HIGH",
    common.interval,
    "Strain displacement/D_e at the peak instead; displacement control only.",
)
@click.option(
    "--shared-material", is_flag=True, help="Give all particles the mean law of Table 2 instead of draws from it."
)
@_option("--C1", "C1", common.POSITIVE, "Fix C1 for all particles.  [default: drawn from Table 2]")
@_option("--C3", "C3", common.NOT_NEGATIVE, "Fix C3 likewise.")
@_option("--C5", "C5", common.POSITIVE, "Fix C5 likewise.")
@_option("--a", "A", common.NUMBER, "Shape parameter.", default=1.43, show_default=True)
@_option("--effective-modulus", "MPa", common.POSITIVE, "Effective modulus.", default=16000.0, show_default=True)
@common.law
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
@common.seed()
def simulate(out: Path, **options: Any) -> None:
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
    with session() as progress:
        from ..campaign import write_campaign

        progress("reading the input")
        sizes, hidden = _sizes(options["particles"]), _hidden_effects(options["effects"])
        progress("simulating")
        laws, programme = _laws(options, sizes), _programme(options)
        peaks = _peaks(options, programme, laws, sizes)
        _check_size(programme, peaks, options["programme"])
        campaign = _campaign(laws, sizes, peaks, programme, options, hidden)
        progress("writing")
        write_campaign(campaign, out)
    points = sum(len(curve) for curve in campaign.curves)
    forces = [curve.force_mN.max() for curve in campaign.curves]
    longest = max(float(curve.time_s[-1]) for curve in campaign.curves)
    seed, control = options["seed"], programme.control
    say(f"Simulated {len(campaign)} particles, {points} points, {control} control, seed {seed}.")
    say(f"Peak forces {min(forces):.4g} to {max(forces):.4g} mN; the tests take up to {longest:.4g} s.")
    for effect in hidden:
        variant = effect.variant
        drawn = " (drawn for each test)" if variant.parameter in effect.random else ""
        amplitude = f"{variant.parameter} {effect.strength:.4g}{drawn}"
        say(f"Hidden effect: {variant.mechanism}, {variant.name}, {amplitude}.")
    monotone = zip(campaign.particles, campaign.columns["true_monotone"], strict=True)
    falling = ", ".join(name for name, flag in monotone if flag == "no")
    if falling:
        what = "snaps through" if control == "load" else "softens"
        say(f"Warning: the loading curve falls somewhere, and the particle {what}: {falling}.", fg="yellow")
    say(f"Written into {out}: particles.csv, curves.csv, campaign.toml")
    say_next((f"mcc-jax calibrate {shlex.quote(str(out))} --out fit", "the law and its uncertainty"))


def _refuse_contradictions(options: dict[str, Any]) -> None:
    """No option is accepted and then ignored."""
    replaced = ("control", "rate", "levels", "unload_to", "hold_s", "points", "interval_s")
    for one, other, why in (
        *((name, "programme", "the programme file says that already") for name in replaced),
        ("interval_s", "points", "each says how densely the test is sampled"),
        ("peak_strain", "peak_stress", "each says where the peak is"),
    ):
        if options[one] is not None and options[other] is not None:
            names = (name.replace("_", "-") for name in (one, other))
            raise click.UsageError(f"--{' does not go with --'.join(names)}: {why}.")
    if options["peak_strain"] and not options["programme"] and options["control"] != "displacement":
        raise click.UsageError("--peak-strain needs --control displacement.")
    levels, unload_to = options["levels"] or (1.0,), options["unload_to"]
    if unload_to is not None and len(levels) < 2:
        raise click.UsageError("--unload-to needs two --levels or more: the last unloading is always complete.")
    if unload_to is not None and unload_to >= min(levels[:-1]):
        raise click.UsageError("--unload-to lies not below the --levels it unloads from.")
    if options["shared_material"] and all(options[name] is not None for name in COEFFICIENTS):
        both = "--shared-material does not go with --C1, --C3 and --C5"
        raise click.UsageError(f"{both}: they fix the material already.")


class Sizes(NamedTuple):
    """Particles to simulate: names, diameters [um] of shape (N, 3), further columns, and the file they are from."""

    names: tuple[str, ...]
    diameters_um: np.ndarray
    columns: Mapping[str, tuple[str, ...]]
    file: Path | None


def _sizes(file: Path | None) -> Sizes:
    """The particles of a table, or of the paper's Table 1."""
    from ..campaign import PAPER_DIAMETERS_UM, read_particles

    if file is None:
        return Sizes(tuple(str(i + 1) for i in range(len(PAPER_DIAMETERS_UM))), PAPER_DIAMETERS_UM, {}, None)
    names, diameters, columns = read_particles(file)
    # What an earlier simulation called the truth is not that of this one.
    return Sizes(names, diameters, {k: v for k, v in columns.items() if not k.startswith("true_")}, file)


def _hidden_effects(texts: Sequence[str]) -> list[HiddenEffect]:
    """The effects of the option --effect. Raises `InputError` naming the valid choices."""
    from ..simulate import read_effect

    hidden = []
    for text in texts:
        try:
            hidden.append(read_effect(text))
        except ValueError as error:
            raise InputError(f"--effect {text}: {error}") from error
    return hidden


def _laws(options: Mapping[str, Any], sizes: Sizes) -> MccLaw:
    """One law per particle, of fixed or drawn coefficients."""
    import equinox as eqx
    import jax.numpy as jnp

    from ..campaign import of_each_particle
    from ..geometry import plastic_shape_factor
    from ..law import StrainScaling, Unloading
    from ..simulate import law_for_each
    from ..simulate.campaign import draw_plastic

    count, a = len(sizes.names), options["a"]
    plastic = draw_plastic(count, options["seed"], shared=options["shared_material"])
    for name in COEFFICIENTS:
        if options[name] is not None:
            plastic = eqx.tree_at(lambda p, n=name: getattr(p, n), plastic, jnp.full(count, options[name]))
    eta = of_each_particle(sizes.diameters_um, lambda p: plastic_shape_factor(p, a))
    if not (eta > 0).all():
        worst = int(eta.argmin())
        problem = f"the shape factor of particle {sizes.names[worst]!r} is {eta[worst]:.4g} with a = {a:g}"
        remedy = "Give an --a nearer to zero: shape factors must be positive"
        raise InputError(problem, file=sizes.file, remedy=remedy)
    form, scaling = Unloading(options["unloading"]), StrainScaling(options["strain_scaling"])
    return law_for_each(plastic, a, options["effective_modulus"], form, scaling)


def _programme(options: Mapping[str, Any]) -> Programme:
    """What the instrument does."""
    from ..simulate import Programme, read_programme

    if options["programme"] is not None:
        return read_programme(options["programme"])
    names = ("control", "rate", "levels", "unload_to", "hold_s", "interval_s", "points")
    return Programme.cycles(**{name: options[name] for name in names if options[name] is not None})


def _peaks(options: Mapping[str, Any], programme: Programme, laws: MccLaw, sizes: Sizes) -> np.ndarray:
    """Each particle's peak [mN or um], shape (N,). Raises `InputError` if the programme is unfit for what was given."""
    import equinox as eqx
    import numpy as np

    from ..campaign import particle_batch
    from ..geometry import Particle
    from ..simulate import PAPER_PEAK_STRESS_MPA
    from ..simulate.campaign import draw_evenly, peaks_at_stress

    strained = options["peak_strain"] is not None
    if strained and programme.control != "displacement":
        problem = "the programme runs under load control, where --peak-strain has no meaning"
        raise InputError(problem, file=options["programme"], remedy="Give --peak-stress")
    between = options["peak_strain"] or options["peak_stress"] or PAPER_PEAK_STRESS_MPA
    drawn = draw_evenly(between, len(sizes.names), options["seed"])
    particles = particle_batch(sizes.diameters_um)
    if strained:
        return np.asarray(eqx.filter_vmap(Particle.displacement)(particles, drawn))
    return peaks_at_stress(laws, particles, drawn, programme.control)


def _check_size(programme: Programme, peaks: np.ndarray, file: Path | None) -> None:
    """Refuse what would fill memory or disk."""
    import numpy as np

    from ..simulate import Ramp

    moving = holding = level = 0.0  # moving: the time of the ramps for a peak of 1
    for step in programme.steps:
        if isinstance(step, Ramp):
            moving += abs(step.to - level) / step.rate
            level = step.to
        else:
            holding += step.seconds
    durations = moving * peaks + holding
    if not durations.max() < LONGEST_S:
        raise InputError(f"a test would take {durations.max():.4g} s", file=file, remedy="Give a higher rate")
    rows, steps = np.full(peaks.shape, programme.points or 0.0), len(programme.steps)
    if programme.interval_s:
        rows = np.ceil(durations / programme.interval_s)
    if np.sum(rows + steps) > MAX_ROWS or rows.max() * steps > 10 * MAX_ROWS:
        problem = f"the campaign would have more than {MAX_ROWS} rows, or too many steps for its points"
        raise InputError(problem, file=file, remedy="Take fewer points, a longer interval or a higher rate")


def _campaign(
    laws: MccLaw,
    sizes: Sizes,
    peaks: np.ndarray,
    programme: Programme,
    options: Mapping[str, Any],
    effects: Sequence[HiddenEffect],
) -> Campaign:
    """The campaign, with the further columns of the particles' table.

    Raises `InputError` if the law or the programme give no usable curves.
    """
    from ..campaign import check_campaign
    from ..campaign.record import humidity_column
    from ..simulate import Instrument, simulate_campaign

    instrument = Instrument(
        displacement_noise_um=options["noise_um"],
        force_noise_mN=options["noise_mN"],
        displacement_resolution_um=options["resolution_um"],
        force_resolution_mN=options["resolution_mN"],
        zero_um=options["zero_um"],
    )
    humidity = humidity_column(sizes.names, sizes.columns, str(sizes.file or "")) if effects else None
    try:
        campaign = simulate_campaign(
            laws,
            sizes.diameters_um,
            peaks,
            programme,
            instrument=instrument,
            particles=sizes.names,
            effects=effects,
            relative_humidity_percent=humidity,
            seed=options["seed"],
            provenance=f"simulated by mcc-jax simulate, seed {options['seed']}; not a measurement",
        )
        campaign = dataclasses.replace(campaign, columns={**sizes.columns, **campaign.columns})
        return check_campaign(campaign, file="")
    except ValueError as error:
        problem = error.problem if isinstance(error, InputError) else str(error)
        remedy = "Choose less extreme values"
        raise InputError(problem, file=options["programme"] or sizes.file, remedy=remedy) from error
