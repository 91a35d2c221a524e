"""`mcc-jax simulate`."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._errors import InputError
from . import options as common
from .options import NOT_NEGATIVE, NUMBER, POSITIVE, Location, interval, levels, option
from .printing import say, say_next
from .session import session

if TYPE_CHECKING:
    import numpy as np

    from ..campaign import Campaign
    from ..law import MccLaw
    from ..simulate import HiddenEffect, Programme

COEFFICIENTS = ("C1", "C3", "C5")
MAX_ROWS = 10_000_000
LONGEST_S = 1e12


def _read_out(name: str, unit: str, field: str, text: str) -> Any:
    """An option for a field of `Instrument`."""
    return option(name, unit, NOT_NEGATIVE, text, variable=field, default=0.0, show_default=True)


@click.command(short_help="Test particles in the computer.")
@common.out(required=True)
@option(
    "--particles",
    "FILE",
    Location(),
    "CSV table with particle,D1_um,D2_um,D3_um; further columns are kept.  [default: the paper's Table 1]",
)
@option("--programme", "FILE", Location(), "TOML file with the steps of the test; see above.")
@click.option("--control", type=click.Choice(["load", "displacement"]), help="Controlled quantity.  [default: load]")
@option("--rate", "mN/s|um/s", POSITIVE, "Rate in mN/s or, under displacement control, um/s.  [default: 2]")
@option("--levels", "L1,L2,...", levels, "Peak of each cycle as a share of the particle's peak.  [default: 1]")
@option("--unload-to", "SHARE", NOT_NEGATIVE, "Share at which reloading starts.  [default: 0]")
@option("--hold-s", "s", POSITIVE, "Hold at every level.  [default: none]")
@option("--points", "N", click.IntRange(2, 1_000_000), "Samples of a test.  [default: 300]")
@option("--interval-s", "s", POSITIVE, "Time between samples, instead of --points.")
@option(
    "--peak-stress",
    "MPa|LOW:HIGH",
    interval,
    "Stress at each particle's peak, or a range to draw from.  [default: 7:16]",
)
@option(
    "--peak-strain",
    "STRAIN|LOW:HIGH",
    interval,
    "Strain displacement/D_e at the peak instead; displacement control only.",
)
@option("--C1", "C1", POSITIVE, "Fix C1 for all particles.  [default: drawn from Table 2]")
@option("--C3", "C3", NOT_NEGATIVE, "Fix C3 likewise.")
@option("--C5", "C5", POSITIVE, "Fix C5 likewise.")
@option("--a", "A", NUMBER, "Shape parameter.", default=1.43, show_default=True)
@option("--effective-modulus", "MPa", POSITIVE, "Effective modulus.", default=16000.0, show_default=True)
@common.law
@common.effect(
    "NAME[:VARIANT][=X][,P=V]",
    "An effect that the law does not contain; repeatable.  [default amplitude: the middle of what is plausible]",
)
@_read_out("--noise-um", "um", "displacement_noise_um", "Standard deviation of noise on displacement.")
@_read_out("--noise-mN", "mN", "force_noise_mN", "Standard deviation of noise on force.")
@_read_out("--resolution-um", "um", "displacement_resolution_um", "Smallest step of displacement.")
@_read_out("--resolution-mN", "mN", "force_resolution_mN", "Smallest step of force.")
@_read_out("--zero-um", "um", "zero_um", "Standard deviation of each test's zero of displacement.")
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
        from ..simulate import read_effect

        progress("reading the input")
        particles, hidden = _particles(options["particles"]), [read_effect(text) for text in options["effects"]]
        progress("simulating")
        campaign = _simulated(particles, hidden, options)
        progress("writing")
        write_campaign(campaign, out)
    points = sum(len(curve) for curve in campaign.curves)
    forces = [curve.force_mN.max() for curve in campaign.curves]
    longest = max(float(curve.time_s[-1]) for curve in campaign.curves)
    seed, control = options["seed"], campaign.metadata.control
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


EXCLUSIVE = {
    "programme": ("control", "rate", "levels", "unload_to", "hold_s", "points", "interval_s"),
    "points": ("interval_s",),
    "peak_stress": ("peak_strain",),
}
"""Options that say what another one says already."""


def _refuse_contradictions(options: dict[str, Any]) -> None:
    """No option is accepted and then ignored."""
    for one, others in EXCLUSIVE.items():
        for other in others:
            if options[one] is not None and options[other] is not None:
                names = (name.replace("_", "-") for name in (other, one))
                raise click.UsageError(f"--{' does not go with --'.join(names)}.")
    peaks, unload_to = options["levels"] or (1.0,), options["unload_to"]
    if unload_to is not None and len(peaks) < 2:
        raise click.UsageError("--unload-to needs two --levels or more: the last unloading is always complete.")
    if unload_to is not None and unload_to >= min(peaks[:-1]):
        raise click.UsageError("--unload-to lies not below the --levels it unloads from.")


def _particles(file: Path | None) -> tuple[Any, Any, Any]:
    """Names, diameters [um] and further columns of a table of particles, or of the paper's Table 1."""
    from ..campaign import PAPER_DIAMETERS_UM, read_particles

    if file is None:
        return [str(i + 1) for i in range(len(PAPER_DIAMETERS_UM))], PAPER_DIAMETERS_UM, {}
    names, diameters_um, columns = read_particles(file)
    # What an earlier simulation called the truth is not that of this one.
    return names, diameters_um, {key: cells for key, cells in columns.items() if not key.startswith("true_")}


def _simulated(particles: tuple[Any, Any, Any], hidden: Sequence[HiddenEffect], options: Mapping[str, Any]) -> Campaign:
    """The campaign, of coefficients fixed or drawn, with the further columns of the particles' table."""
    import equinox as eqx
    import jax

    from ..campaign import check_campaign
    from ..campaign.record import humidity_column
    from ..law import Plastic
    from ..simulate import Instrument, Programme, law_for_each, paper_population, read_programme, simulate_campaign

    names, diameters_um, columns = particles
    file, seed = options["programme"], options["seed"]
    if file is not None:
        programme = read_programme(file)
    else:
        replaced = {name: options[name] for name in EXCLUSIVE["programme"] if options[name] is not None}
        programme = Programme.cycles(**replaced)
    D1, D2, D3 = diameters_um.T
    least = float((1 + options["a"] * (1 - D3**2 / (D1 * D2))).min())
    if not least > 0:
        problem = f"--a {options['a']:g} gives a particle the shape factor {least:.4g}"
        raise InputError(problem, file=options["particles"], remedy="Give an --a nearer to zero")
    drawn = paper_population().sample(jax.random.key(seed), len(names))
    fixed = {name: jax.numpy.full(len(names), options[name]) for name in COEFFICIENTS if options[name] is not None}
    plastic = eqx.filter_vmap(Plastic)(*(fixed.get(name, getattr(drawn, name)) for name in COEFFICIENTS))
    form = options["unloading"], options["strain_scaling"]
    laws = law_for_each(plastic, options["a"], options["effective_modulus"], *form)
    peaks = _peaks(laws, diameters_um, programme, options)
    instrument = Instrument(**{field.name: options[field.name] for field in dataclasses.fields(Instrument)})
    humidity = humidity_column(names, columns, str(options["particles"] or "")) if hidden else None
    try:
        _check_size(programme, peaks)
        campaign = simulate_campaign(
            laws,
            diameters_um,
            peaks,
            programme,
            instrument=instrument,
            particles=names,
            effects=hidden,
            relative_humidity_percent=humidity,
            seed=seed,
            provenance=f"simulated by mcc-jax simulate, seed {seed}; not a measurement",
        )
        campaign = dataclasses.replace(campaign, columns={**columns, **campaign.columns})
        return check_campaign(campaign)
    except InputError as error:
        raise error.changed(file=file or options["particles"], remedy="Choose less extreme values") from error


def _peaks(laws: MccLaw, diameters_um: np.ndarray, programme: Programme, options: Mapping[str, Any]) -> np.ndarray:
    """Each particle's peak [mN or um], shape (N,)."""
    import equinox as eqx
    import numpy as np

    from ..campaign import particle_batch
    from ..geometry import Particle
    from ..simulate import PAPER_PEAK_STRESS_MPA
    from ..simulate.campaign import draw_evenly, peaks_at_stress

    between = options["peak_strain"] or options["peak_stress"] or PAPER_PEAK_STRESS_MPA
    drawn, particles = draw_evenly(between, len(diameters_um), options["seed"]), particle_batch(diameters_um)
    if options["peak_strain"] is None:
        return peaks_at_stress(laws, particles, drawn, programme.control)
    if programme.control != "displacement":
        remedy = "Give --peak-stress or --control displacement"
        raise InputError("--peak-strain has no meaning under load control", file=options["programme"], remedy=remedy)
    return np.asarray(eqx.filter_vmap(Particle.displacement)(particles, drawn))


def _check_size(programme: Programme, peaks: np.ndarray) -> None:
    """Refuse what would fill memory or disk."""
    import numpy as np

    turns = dataclasses.replace(programme, interval_s=None, points=2)
    durations = np.array([turns.sample(float(peak))[0][-1] for peak in peaks])
    if not durations.max() < LONGEST_S:
        raise InputError(f"a test would take {durations.max():.4g} s, which calls for a higher rate")
    rows, steps = np.full(peaks.shape, programme.points or 0.0), len(programme.steps)
    if programme.interval_s:
        rows = np.ceil(durations / programme.interval_s)
    if np.sum(rows + steps) > MAX_ROWS or rows.max() * steps > 10 * MAX_ROWS:
        raise InputError(
            f"the campaign would have more than {MAX_ROWS} rows, or too many steps for its points, which calls for "
            "fewer points, a longer interval or a higher rate"
        )
