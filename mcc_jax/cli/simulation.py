"""Composing a simulated campaign from the options of the command line. Imported once the command runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from ..campaign import (
    PAPER_DIAMETERS_UM,
    Campaign,
    check_campaign,
    of_each_particle,
    particle_batch,
    read_particles,
)
from ..campaign.record import humidity_column
from ..effects import HUMIDITY_COLUMN, Need
from ..geometry import Particle, plastic_shape_factor
from ..law import MccLaw, StrainScaling, Unloading
from ..simulate import (
    PAPER_PEAK_STRESS_MPA,
    HiddenEffect,
    Instrument,
    Programme,
    Ramp,
    law_for_each,
    paper_population,
    read_effect,
    read_programme,
    simulate_campaign,
)

MAX_ROWS = 10_000_000
LONGEST_S = 1e12


@dataclass(frozen=True)
class Sizes:
    """Particles to simulate: names, diameters [um] of shape (N, 3), further columns, and the file they are from."""

    names: tuple[str, ...]
    diameters_um: np.ndarray
    columns: Mapping[str, tuple[str, ...]]
    file: Path | None


def particle_sizes(file: Path | None) -> Sizes:
    """The particles of a table, or of the paper's Table 1.

    Raises:
        InputError: if the table is damaged.
    """
    if file is None:
        return Sizes(tuple(str(i + 1) for i in range(len(PAPER_DIAMETERS_UM))), PAPER_DIAMETERS_UM, {}, None)
    names, diameters, columns = read_particles(file)
    # What an earlier simulation called the truth is not that of this one.
    return Sizes(names, diameters, {k: v for k, v in columns.items() if not k.startswith("true_")}, file)


@dataclass(frozen=True)
class Material:
    """What the particles are made of: fixed or drawn coefficients, and what all share."""

    fixed: Mapping[str, float | None]
    shared: bool
    a: float
    effective_modulus_MPa: float
    unloading: Unloading
    strain_scaling: StrainScaling

    def laws(self, sizes: Sizes, seed: int) -> MccLaw:
        """One law per particle.

        Raises:
            InputError: if `a` leaves a particle without stress.
        """
        count = len(sizes.names)
        population = paper_population()
        if self.shared:
            plastic = jax.tree.map(lambda x: jnp.broadcast_to(x, (count,)), population.mean_law)
        else:
            plastic = population.sample(jax.random.key(seed), count)
        for name, value in self.fixed.items():
            if value is not None:
                plastic = eqx.tree_at(lambda p, n=name: getattr(p, n), plastic, jnp.full(count, value))
        eta = of_each_particle(sizes.diameters_um, lambda p: plastic_shape_factor(p, self.a))
        if not (eta > 0).all():
            worst = int(np.argmin(eta))
            raise InputError(
                f"the shape factor of particle {sizes.names[worst]!r} is {eta[worst]:.4g} with a = {self.a:g}",
                file=sizes.file,
                remedy="Give an --a nearer to zero: shape factors must be positive",
            )
        return law_for_each(plastic, self.a, self.effective_modulus_MPa, self.unloading, self.strain_scaling)


def peaks_and_programme(
    options: Mapping[str, Any], laws: MccLaw, sizes: Sizes, seed: int
) -> tuple[np.ndarray, Programme]:
    """Each particle's peak [mN or um], shape (N,), and what the tester does.

    Raises:
        InputError: if the programme is unfit, or the test would be too long.
    """
    if options["programme"] is not None:
        programme = read_programme(options["programme"])
    else:
        programme = Programme.cycles(
            control=options["control"] or "load",
            rate=2.0 if options["rate"] is None else options["rate"],
            levels=options["levels"] or (1.0,),
            unload_to=options["unload_to"] or 0.0,
            hold_s=options["hold_s"] or 0.0,
            interval_s=options["interval_s"],
            points=options["points"],
        )
    # The same draws as `paper_campaign` makes.
    rng = np.random.default_rng(np.random.SeedSequence(seed).generate_state(4))
    count = len(sizes.names)
    particles = particle_batch(sizes.diameters_um)
    if options["peak_strain"] is not None:
        if programme.control != "displacement":
            raise InputError(
                "the programme runs under load control, where --peak-strain has no meaning",
                file=options["programme"],
                remedy="Give --peak-stress",
            )
        peaks = _each(Particle.displacement, particles, _draw(rng, options["peak_strain"], count))
    else:
        stress = jnp.asarray(_draw(rng, options["peak_stress"] or PAPER_PEAK_STRESS_MPA, count))
        if programme.control == "load":
            peaks = _each(Particle.force, particles, stress)
        else:
            strain = eqx.filter_vmap(lambda law, particle, s: law.plastic.strain(s) / law.shape_factor(particle))
            peaks = _each(Particle.displacement, particles, strain(laws, particles, stress))
    _check_size(programme, peaks, options["programme"])
    return peaks, programme


def _each(method: Callable[..., Any], particles: Particle, values: np.ndarray | jax.Array) -> np.ndarray:
    return np.asarray(eqx.filter_vmap(method)(particles, jnp.asarray(values)))


def _draw(rng: np.random.Generator, interval: tuple[float, float], count: int) -> np.ndarray:
    return rng.uniform(interval[0], interval[1], count)


def _check_size(programme: Programme, peaks: np.ndarray, file: Path | None) -> None:
    """Refuse what would fill memory or disk.

    Raises:
        InputError: if so.
    """
    rows = 0.0
    for peak in peaks:
        duration, level = 0.0, 0.0
        for step in programme.steps:
            if isinstance(step, Ramp):
                duration += abs(step.to - level) * float(peak) / step.rate
                level = step.to
            else:
                duration += step.seconds
        if not duration < LONGEST_S:
            raise InputError(f"a test would take {duration:.4g} s", file=file, remedy="Give a higher rate")
        samples = programme.points or math.ceil(duration / (programme.interval_s or 1.0))
        rows += samples + len(programme.steps)
        if rows > MAX_ROWS or samples * len(programme.steps) > 10 * MAX_ROWS:
            raise InputError(
                f"the campaign would have more than {MAX_ROWS} rows, or too many steps for its points",
                file=file,
                remedy="Take fewer points, a longer interval or a higher rate",
            )


def hidden_effects(texts: Sequence[str], sizes: Sizes) -> tuple[HiddenEffect, ...]:
    """The effects of the option --effect.

    Raises:
        InputError: naming the valid choices, or what an effect needs of the table of particles.
    """
    hidden = []
    for text in texts:
        try:
            hidden.append(read_effect(text))
        except ValueError as error:
            raise InputError(f"--effect {text}: {error}") from error
    wet = [effect for effect in hidden if Need.HUMIDITY_COLUMN in effect.variant.needs]
    if wet and HUMIDITY_COLUMN not in sizes.columns:
        raise InputError(
            f"--effect {wet[0].variant.mechanism}: needs a column {HUMIDITY_COLUMN} in the table of particles",
            file=sizes.file,
            remedy="Give --particles FILE with that column",
        )
    return tuple(hidden)


def _humidity(sizes: Sizes) -> np.ndarray | None:
    return humidity_column(sizes.names, sizes.columns, str(sizes.file or ""))


def simulate_particles(
    laws: MccLaw,
    sizes: Sizes,
    peaks: np.ndarray,
    programme: Programme,
    options: Mapping[str, Any],
    effects: Sequence[HiddenEffect],
    seed: int,
) -> Campaign:
    """The campaign, with the further columns of the particles' table.

    Raises:
        InputError: if the law or the programme give no usable curves.
    """
    instrument = Instrument(
        displacement_noise_um=options["noise_um"],
        force_noise_mN=options["noise_mN"],
        displacement_resolution_um=options["resolution_um"],
        force_resolution_mN=options["resolution_mN"],
        zero_um=options["zero_um"],
    )
    try:
        campaign = simulate_campaign(
            laws,
            sizes.diameters_um,
            peaks,
            programme,
            instrument=instrument,
            particles=sizes.names,
            effects=effects,
            relative_humidity_percent=_humidity(sizes) if effects else None,
            seed=seed,
            provenance=f"simulated by mcc-jax simulate, seed {seed}; not a measurement",
        )
    except ValueError as error:
        raise InputError(
            str(error), file=options["programme"] or sizes.file, remedy="Choose less extreme values"
        ) from error
    campaign = dataclasses.replace(campaign, columns={**sizes.columns, **campaign.columns})
    try:
        check_campaign(campaign, file="")
    except InputError as error:
        raise InputError(
            f"what was simulated is no campaign: {error.problem}", remedy="Choose less extreme values"
        ) from error
    return campaign
