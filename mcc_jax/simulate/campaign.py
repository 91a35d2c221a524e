"""Simulated campaigns: the law in place of the particles, everything else as in a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._results import RESULTS
from .._types import ScalarLike
from ..campaign import (
    PAPER_DIAMETERS_UM,
    PAPER_EFFECTIVE_MODULUS_MPA,
    PAPER_LOAD_RATE_MN_PER_S,
    PAPER_LOG_C,
    PAPER_SHAPE_PARAMETER,
    Campaign,
    Control,
    Curve,
    Metadata,
    particle_batch,
)
from ..effects import HUMIDITY_COLUMN, REFERENCE_HUMIDITY_PERCENT, Need
from ..geometry import Particle
from ..law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading
from .drive import refusal, simulate_batch
from .effects import HiddenEffect, hidden_effects, humidities_of
from .programme import Instrument, Programme

PAPER_PEAK_STRESS_MPA = (7.0, 16.0)
"""Range of the maximum stress of the paper's tests [MPa]; the value of each particle is not published."""


def paper_population() -> PlasticPopulation:
    """C1, C3, C5 of the paper's Table 2."""
    return PlasticPopulation(*(LogNormal(*PAPER_LOG_C[name]) for name in ("C1", "C3", "C5")))


def paper_law(
    unloading: Unloading | str = Unloading.PRINTED, strain_scaling: StrainScaling | str = StrainScaling.RAW
) -> MccLaw:
    """The paper's mean law: a = 1.43, effective modulus 16 GPa (which belongs to the printed form)."""
    return MccLaw(
        paper_population().mean_law, PAPER_SHAPE_PARAMETER, PAPER_EFFECTIVE_MODULUS_MPA, unloading, strain_scaling
    )


def draw_plastic(count: int, seed: int, *, shared: bool) -> Plastic:
    """Coefficients of `count` particles, drawn from Table 2; `shared`: the mean law's for all."""
    population = paper_population()
    if shared:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (count,)), population.mean_law)
    return population.sample(jax.random.key(seed), count)


def draw_evenly(between: Sequence[float] | np.ndarray, count: int, seed: int) -> Array:
    """`count` numbers from a range, from another stream than those of coefficients and noise."""
    rng = np.random.default_rng(np.random.SeedSequence(seed).generate_state(4))
    low, high = between
    return jnp.asarray(rng.uniform(low, high, count))


def peaks_at_stress(laws: MccLaw, particles: Particle, stress_MPa: Array, control: Control) -> np.ndarray:
    """Force [mN] or displacement [um], as is controlled, at which each particle reaches its stress, shape (N,)."""
    if control == "load":
        return np.asarray(eqx.filter_vmap(Particle.force)(particles, stress_MPa))
    strain = eqx.filter_vmap(lambda law, particle, s: law.plastic.strain(s) / law.shape_factor(particle))
    return np.asarray(eqx.filter_vmap(Particle.displacement)(particles, strain(laws, particles, stress_MPa)))


def law_for_each(
    plastic: Plastic,
    a: ScalarLike,
    effective_modulus_MPa: ScalarLike,
    unloading: Unloading | str = Unloading.PRINTED,
    strain_scaling: StrainScaling | str = StrainScaling.RAW,
) -> MccLaw:
    """One law per particle: its own plastic coefficients (leading axis N), a and modulus shared.

    Raises:
        InputError: for coefficients without a leading axis, a number out of its range, or an unknown form.
    """
    if jnp.ndim(plastic.C1) != 1:
        raise InputError("plastic has no leading axis", remedy="For one particle make a MccLaw.")
    return eqx.filter_vmap(lambda one: MccLaw(one, a, effective_modulus_MPa, unloading, strain_scaling))(plastic)


def simulate_campaign(
    laws: MccLaw,
    diameters_um: Any,
    peaks: Any,
    programme: Programme,
    *,
    instrument: Instrument | None = None,
    particles: Sequence[str] | None = None,
    effects: Sequence[HiddenEffect] = (),
    relative_humidity_percent: Any = None,
    seed: int = 0,
    provenance: str = "simulated",
) -> Campaign:
    """Test N particles in the computer.

    Args:
        laws: one law per particle, every array field with a leading axis N (`law_for_each`), with or without effects.
        diameters_um: D1, D2, D3 [um], shape (N, 3).
        peaks: each particle's peak, force [mN] under load control or displacement [um], shape (N,), > 0.
        programme: what the instrument does, relative to the peak.
        instrument: how it reads; perfect if None.
        particles: names; "1" to "N" if None.
        effects: what acts in addition to the law; strengths that differ from test to test are drawn with the seed,
            and are in `columns`.
        relative_humidity_percent: of the room during each test, shape (N,); it becomes a column.
        seed: seed of the read-out's noise and of the effects. Each particle has a stream of its own: adding one leaves
            the others as they were.
        provenance: for the campaign's metadata.

    Returns:
        A campaign; the true coefficients, and whether each law is monotone, are in its `columns`.

    Raises:
        InputError: for sizes or peaks that are not positive, or arguments of the wrong kind.
        ValueError: if lengths disagree, an effect of humidity gets no humidities, or the law refuses a particle
            (`RESULTS` says why).
    """
    if jnp.ndim(laws.plastic.C1) != 1:
        raise InputError("laws has no leading axis", remedy="Make one law for each with mcc_jax.simulate.law_for_each.")
    instrument = Instrument() if instrument is None else instrument
    seed = arguments.seed(seed)
    effects = hidden_effects(effects)
    diameters_um = arguments.diameters(diameters_um)
    peaks = arguments.floats(peaks, "peaks", shape="the peak of every particle, shape (N,)")
    if peaks.ndim != 1 or not peaks.size:
        raise InputError(f"peaks must be the peak of every particle, shape (N,), got the shape {peaks.shape}")
    arguments.positive(peaks, "peaks [mN or um]")
    if relative_humidity_percent is not None:
        relative_humidity_percent = humidities_of(relative_humidity_percent, len(diameters_um))
    count = len(diameters_um)
    if isinstance(particles, str):
        raise InputError(f"particles must be a list of names, got the text {particles!r}")
    names = tuple(str(i + 1) for i in range(count)) if particles is None else tuple(particles)
    if not (len(names) == len(peaks) == count == laws.plastic.C1.shape[0]):
        raise InputError(
            f"{count} particles need as many names ({len(names)}), peaks ({len(peaks)}) "
            f"and laws ({laws.plastic.C1.shape[0]})"
        )
    samples = [programme.sample(float(peak)) for peak in peaks]
    longest = max(len(time) for time, _ in samples)
    longest += -longest % 64  # programmes of similar length share one compilation
    # Padding repeats the last value: a valid path whose further points change nothing.
    times, paths = (
        jnp.asarray(np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows]))
        for rows in zip(*samples, strict=True)
    )
    drawn = [effect.draw(seed, i, count) for i, effect in enumerate(effects)]
    humidity = relative_humidity_percent
    if humidity is None:
        for effect in effects:
            if Need.HUMIDITY_COLUMN in effect.variant.needs:
                name = effect.variant.mechanism
                raise InputError(f"the effect {name} needs the relative humidity of every test ({HUMIDITY_COLUMN})")
        humidity = np.full(count, REFERENCE_HUMIDITY_PERCENT)
    acting = laws.with_effects(*(effect for effect, _ in drawn))
    response = simulate_batch(
        acting,
        particle_batch(diameters_um),
        paths,
        times=times if acting.effects else None,
        relative_humidity=jnp.asarray(humidity, dtype=float) if acting.effects else None,
        control=programme.control,
    )
    force, displacement = np.asarray(response.force, float), np.asarray(response.displacement, float)
    bad = np.flatnonzero(np.asarray(response.result != RESULTS.successful))
    if len(bad):
        law, particle, one = jax.tree.map(lambda x: x[bad[0]], (acting, particle_batch(diameters_um), response))
        raise refusal(law, particle, one, f"particle {names[bad[0]]!r}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(count)]
    curves = [
        Curve(time, *instrument.read(rng, force[i, : len(time)], displacement[i, : len(time)]))
        for i, ((time, _), rng) in enumerate(zip(samples, streams, strict=True))
    ]
    truth = {name: getattr(laws.plastic, name) for name in ("C1", "C3", "C5")}
    mechanisms = [effect.variant.mechanism for effect in effects]
    for i, (effect, (_, values)) in enumerate(zip(effects, drawn, strict=True)):
        mark = "" if mechanisms.count(mechanisms[i]) == 1 else f"_{i + 1}"
        truth |= {f"{mechanisms[i]}{mark}_{name}": values[name] for name in effect.random}
    numbers = {f"true_{name}": values for name, values in truth.items()}
    if relative_humidity_percent is not None:
        numbers[HUMIDITY_COLUMN] = relative_humidity_percent
    columns = {name: tuple(repr(float(v)) for v in np.asarray(values, float)) for name, values in numbers.items()}
    columns["true_monotone"] = tuple("yes" if m else "no" for m in np.asarray(response.monotone))
    metadata = Metadata(
        control=programme.control,
        force_resolution_mN=instrument.force_resolution_mN or None,
        displacement_resolution_um=instrument.displacement_resolution_um or None,
        provenance=provenance,
        other={
            "simulation": {
                "seed": seed,
                "a": float(np.asarray(laws.a).ravel()[0]),
                "effective_modulus_MPa": float(np.asarray(laws.effective_modulus).ravel()[0]),
                "unloading": laws.unloading.value,
                "strain_scaling": laws.strain_scaling.value,
                "displacement_noise_um": instrument.displacement_noise_um,
                "force_noise_mN": instrument.force_noise_mN,
                "zero_um": instrument.zero_um,
                **({"effects": [effect.describe() for effect in effects]} if effects else {}),
            }
        },
    )
    return Campaign(names, np.asarray(diameters_um, float), tuple(curves), columns, metadata)


def paper_campaign(
    seed: int = 0,
    *,
    shared_material: bool = False,
    instrument: Instrument | None = None,
    programme: Programme | None = None,
    unloading: Unloading | str = Unloading.PRINTED,
    strain_scaling: StrainScaling | str = StrainScaling.RAW,
    peak_stress_MPa: Sequence[float] = PAPER_PEAK_STRESS_MPA,
    effects: Sequence[HiddenEffect] = (),
    relative_humidity_percent: Any = None,
) -> Campaign:
    """A campaign drawn from the paper: Table 1's particles, Table 2's coefficients, its protocol.

    The paper publishes no measured curve as numbers; this is what its law says such a campaign looks like. Maximum
    stresses are drawn evenly from the published range. Of draws from Table 2, 2.4 % are not monotone; they are kept,
    snap through under load control and are marked in the column `true_monotone`.

    Args:
        seed: seed of coefficients, peaks and noise.
        shared_material: give every particle the mean law instead of a draw.
        instrument: read-out; 0.02 um and 0.05 mN of noise if None.
        programme: what the instrument does; one cycle at 2 mN/s if None.
        unloading: form of the unloading law (16 GPa belongs to the printed one).
        strain_scaling: how the shape factor enters unloading.
        peak_stress_MPa: range of the maximum stress [MPa].
        effects: what acts in addition to the law.
        relative_humidity_percent: of the room during each test [%], shape (20,).

    Raises:
        InputError: for an argument of the wrong kind or out of its range.
    """
    seed = arguments.seed(seed)
    shared_material = arguments.flag(shared_material, "shared_material")
    programme = Programme.cycles(rate=PAPER_LOAD_RATE_MN_PER_S) if programme is None else programme
    instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05) if instrument is None else instrument
    unloading = arguments.member(unloading, Unloading, "unloading")
    strain_scaling = arguments.member(strain_scaling, StrainScaling, "strain_scaling")
    between = arguments.floats(peak_stress_MPa, "peak_stress_MPa", shape="two stresses [MPa], the smaller first")
    if between.shape != (2,) or not (0 < between[0] <= between[1] < np.inf):
        raise InputError(f"peak_stress_MPa must be two stresses > 0, the smaller first, got {between.tolist()}")
    count = len(PAPER_DIAMETERS_UM)
    plastic = draw_plastic(count, seed, shared=shared_material)
    laws = law_for_each(plastic, PAPER_SHAPE_PARAMETER, PAPER_EFFECTIVE_MODULUS_MPA, unloading, strain_scaling)
    peaks = peaks_at_stress(
        laws, particle_batch(PAPER_DIAMETERS_UM), draw_evenly(between, count, seed), programme.control
    )
    return simulate_campaign(
        laws,
        PAPER_DIAMETERS_UM,
        peaks,
        programme,
        instrument=instrument,
        effects=effects,
        relative_humidity_percent=relative_humidity_percent,
        seed=seed,
        provenance=f"simulated from Tables 1 and 2 of Bommireddy et al. (2018), seed {seed}; not a measurement",
    )
