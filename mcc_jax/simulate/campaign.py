"""Simulated campaigns: the law, and effects hidden in it, in place of the particles; all else as in a measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import arguments
from .._errors import InputError
from .._format import number
from .._results import RESULTS
from .._types import ScalarLike
from ..campaign import (
    PAPER_DIAMETERS_UM,
    PAPER_EFFECTIVE_MODULUS_MPA,
    PAPER_LOG_C,
    PAPER_SHAPE_PARAMETER,
    Campaign,
    Control,
    Curve,
    Metadata,
    particle_batch,
)
from ..effects import HUMIDITY_COLUMN, REFERENCE_HUMIDITY_PERCENT, AbstractEffect, Need, Variant, find_variant
from ..geometry import Particle
from ..law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading
from .drive import refusal, simulate_batch
from .programme import Instrument, Programme

_STREAM = 0x0EFF_EC75  # separates the draws of effects from those of noise, coefficients and peaks


@dataclass(frozen=True)
class HiddenEffect:
    """An effect for `simulate_campaign`.

    Attributes:
        variant: its formula.
        amplitude: its strength in the variant's unit; the standard deviation where it is random from test to test.
            The middle of the plausible range if None.
        nuisance: nuisance parameters by name, the same in all tests; those not given take the variant's middle value,
            or are random from test to test where the variant says so.
    """

    variant: Variant
    amplitude: float | None = None
    nuisance: Mapping[str, float] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        variant = self.variant
        physical: Any = {1: {"least": 0.0}, -1: {"most": 0.0}, 0: {}}[variant.sign]
        arguments.number(self.strength, f"{variant.label}: {variant.parameter}", **physical)
        variant.check_names(self.nuisance)
        for one in variant.nuisances:
            above = 0.0 if one.plausible[0] > 0 else -np.inf
            arguments.number(self.numbers[one.name], f"{variant.label}: {one.name}", above=above)

    def __repr__(self) -> str:
        named = ", ".join(f"{name} {number(value)}" for name, value in self.numbers.items())
        drawn = f"; drawn for every test: {', '.join(self.random)}" if self.random else ""
        return f"HiddenEffect {self.variant.label}: {named}{drawn}"

    @property
    def strength(self) -> float:
        """The amplitude, or the middle of the plausible range."""
        return self.variant.typical if self.amplitude is None else self.amplitude

    @property
    def numbers(self) -> dict[str, float]:
        """Amplitude and nuisance parameters by name, as given or the variant's own."""
        middle = {n.name: n.middle for n in self.variant.nuisances}
        return {self.variant.parameter: self.strength, **middle, **self.nuisance}

    def draw(self, seed: int, place: int, count: int) -> tuple[AbstractEffect, dict[str, np.ndarray]]:
        """The effect with a leading axis N in every field, and its parameters by name, shape (N,), of N tests; at
        each place among the effects of a campaign with its own random numbers."""
        values = {name: np.full(count, value) for name, value in self.numbers.items()}
        nuisances = {one.name: one for one in self.variant.nuisances}
        for i, name in enumerate(self.random):
            # A stream for each test: adding one leaves the others as they were.
            streams = np.random.SeedSequence([seed, _STREAM, place, i]).spawn(count)
            generators = [np.random.default_rng(stream) for stream in streams]
            if name == self.variant.parameter:
                values[name] = self.strength * np.array([rng.standard_normal() for rng in generators])
                continue
            share = np.array([rng.random() for rng in generators])
            low, high = nuisances[name].plausible
            if low > 0:  # evenly in the logarithm, between the ends of the grid
                low, high = min(nuisances[name].grid), max(nuisances[name].grid)
                values[name] = low * (high / low) ** share
            else:
                values[name] = low + (high - low) * share
        arrays = {name: jnp.asarray(value, dtype=float) for name, value in values.items()}
        build = eqx.filter_vmap(lambda amplitude, others: self.variant.build(amplitude, **others))
        return build(arrays.pop(self.variant.parameter), arrays), values

    @property
    def random(self) -> tuple[str, ...]:
        """Names of the parameters that differ at random from test to test."""
        names = [self.variant.parameter] if self.variant.random_per_test else []
        names += [n.name for n in self.variant.nuisances if n.random_per_test and n.name not in self.nuisance]
        return tuple(names)

    def describe(self) -> dict[str, Any]:
        """For the campaign's metadata."""
        fixed = {name: float(value) for name, value in self.numbers.items() if name not in self.random}
        amplitude = {self.variant.parameter: float(self.strength)}  # of a random one the standard deviation
        formula = {"mechanism": self.variant.mechanism, "variant": self.variant.name}
        return {**formula, **amplitude, **fixed, "random_per_test": list(self.random)}


def read_effect(text: str) -> HiddenEffect:
    """An effect as text: `mechanism[:variant][=amplitude][,parameter=value...]`; `InputError` names valid choices."""
    head, *rest = text.split(",")
    name, equals, value = head.partition("=")
    variant = find_variant(name.strip())
    numbers: dict[str, float] = {}
    for part in [f"{variant.parameter}={value}", *rest] if equals else rest:
        key, _, value = (piece.strip() for piece in part.partition("="))
        if key in numbers:
            raise InputError(f"{key} is given twice")
        try:
            numbers[key] = float(value)
        except ValueError:
            raise InputError(f"{part.strip()!r} is not parameter=number") from None
    return HiddenEffect(variant, numbers.pop(variant.parameter, None), numbers)


PAPER_PEAK_STRESS_MPA = (7.0, 16.0)
"""Range of the maximum stress of the paper's tests [MPa]; the value of each particle is not published."""


def paper_population() -> PlasticPopulation:
    """C1, C3, C5 of the paper's Table 2."""
    return PlasticPopulation(*(LogNormal(*PAPER_LOG_C[name]) for name in ("C1", "C3", "C5")))


def paper_law(
    unloading: Unloading | str = Unloading.PRINTED, strain_scaling: StrainScaling | str = StrainScaling.RAW
) -> MccLaw:
    """The paper's mean law: a = 1.43, effective modulus 16 GPa (which belongs to the printed form)."""
    plastic = paper_population().mean_law
    return MccLaw(plastic, PAPER_SHAPE_PARAMETER, PAPER_EFFECTIVE_MODULUS_MPA, unloading, strain_scaling)


def draw_evenly(between: Sequence[float], count: int, seed: int) -> Array:
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
    """One law per particle: its own plastic coefficients (leading axis N), a and modulus shared."""
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
        diameters_um: D1, D2, D3, shape (N, 3).
        peaks: each particle's peak, force [mN] under load control or displacement [um], shape (N,), > 0.
        programme: what the instrument does, relative to the peak.
        instrument: how it reads; perfect if None.
        particles: names; "1" to "N" if None.
        effects: what acts in addition to the law; parameters that are random from test to test are in `columns`.
        relative_humidity_percent: of the room during each test, shape (N,); it becomes a column.
        seed: of noise and effects. Each particle has its own stream: adding one leaves the others as they were.
        provenance: for the campaign's metadata.

    Returns:
        A campaign; the true coefficients, and whether each law is monotone, are in its `columns`.

    Raises:
        InputError: if the law refuses a particle (`RESULTS` says why).
    """
    instrument = Instrument() if instrument is None else instrument
    seed = arguments.seed(seed)
    effects = (effects,) if isinstance(effects, HiddenEffect) else tuple(effects)
    diameters_um = arguments.diameters(diameters_um)
    peaks = arguments.floats(peaks, "peaks", shape="the peak of every particle, shape (N,)")
    arguments.positive(peaks, "peaks [mN or um]")
    count = len(diameters_um)
    names = tuple(str(i + 1) for i in range(count)) if particles is None else tuple(particles)
    if not (peaks.shape == laws.plastic.C1.shape == (count,) == (len(names),)):
        shapes = f"{len(names)} names, peaks of shape {peaks.shape} and laws of shape {laws.plastic.C1.shape}"
        remedy = "Make one law for each with mcc_jax.simulate.law_for_each."
        raise InputError(f"{count} particles need as many names, peaks and laws, got {shapes}", remedy=remedy)
    humidity = _humidity(relative_humidity_percent, effects, count)
    samples = [programme.sample(float(peak)) for peak in peaks]
    longest = max(len(time) for time, _ in samples)
    longest += -longest % 64  # programmes of similar length share one compilation
    # Padding repeats the last value: a valid path whose further points change nothing.
    times, paths = (
        jnp.asarray(np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows]))
        for rows in zip(*samples, strict=True)
    )
    drawn = [effect.draw(seed, i, count) for i, effect in enumerate(effects)]
    acting, batch = laws.with_effects(*(effect for effect, _ in drawn)), particle_batch(diameters_um)
    surroundings = {"times": times, "relative_humidity": humidity} if acting.effects else {}
    response = simulate_batch(acting, batch, paths, control=programme.control, **surroundings)
    force, displacement = np.asarray(response.force, float), np.asarray(response.displacement, float)
    bad = np.flatnonzero(np.asarray(response.result != RESULTS.successful))
    if len(bad):
        law, particle, one = jax.tree.map(lambda x: x[bad[0]], (acting, batch, response))
        raise refusal(law, particle, one, f"particle {names[bad[0]]!r}")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(count)]
    curves = [
        Curve(time, *instrument.read(rng, force[i, : len(time)], displacement[i, : len(time)]))
        for i, ((time, _), rng) in enumerate(zip(samples, streams, strict=True))
    ]
    numbers: dict[str, Any] = {f"true_{name}": getattr(laws.plastic, name) for name in ("C1", "C3", "C5")}
    mechanisms = [effect.variant.mechanism for effect in effects]
    for i, (effect, (_, values)) in enumerate(zip(effects, drawn, strict=True)):
        mark = "" if mechanisms.count(mechanisms[i]) == 1 else f"_{i + 1}"
        numbers |= {f"true_{mechanisms[i]}{mark}_{name}": values[name] for name in effect.random}
    if relative_humidity_percent is not None:
        numbers[HUMIDITY_COLUMN] = humidity
    columns = {name: tuple(repr(float(v)) for v in np.asarray(values, float)) for name, values in numbers.items()}
    columns["true_monotone"] = tuple("yes" if m else "no" for m in np.asarray(response.monotone))
    simulation = {
        "seed": seed,
        "a": float(np.asarray(laws.a).ravel()[0]),
        "effective_modulus_MPa": float(np.asarray(laws.effective_modulus).ravel()[0]),
        "unloading": laws.unloading.value,
        "strain_scaling": laws.strain_scaling.value,
        **{name: getattr(instrument, name) for name in ("displacement_noise_um", "force_noise_mN", "zero_um")},
    }
    if effects:
        simulation["effects"] = [effect.describe() for effect in effects]
    metadata = Metadata(
        control=programme.control,
        force_resolution_mN=instrument.force_resolution_mN or None,
        displacement_resolution_um=instrument.displacement_resolution_um or None,
        provenance=provenance,
        other={"simulation": simulation},
    )
    return Campaign(names, np.asarray(diameters_um, float), tuple(curves), columns, metadata)


def _humidity(values: Any, effects: Sequence[HiddenEffect], count: int) -> np.ndarray:
    """Relative humidity of every test [%], shape (N,): the reference where none is given and no effect needs it."""
    if values is None:
        needs = [effect.variant.mechanism for effect in effects if Need.HUMIDITY_COLUMN in effect.variant.needs]
        if needs:
            raise InputError(f"the effect {needs[0]} needs the relative humidity of every test ({HUMIDITY_COLUMN})")
        return np.full(count, REFERENCE_HUMIDITY_PERCENT)
    must = f"{count} numbers from 0 to 100, one for every test"
    found = arguments.floats(values, HUMIDITY_COLUMN, shape=must)
    if found.shape != (count,) or not ((found >= 0) & (found <= 100)).all():
        raise InputError(f"{HUMIDITY_COLUMN} must be {must}, got {arguments.shown(found.tolist())}")
    return found


def paper_campaign(
    seed: int = 0,
    *,
    shared_material: bool = False,
    instrument: Instrument | None = None,
    programme: Programme | None = None,
    unloading: Unloading | str = Unloading.PRINTED,
    strain_scaling: StrainScaling | str = StrainScaling.RAW,
    effects: Sequence[HiddenEffect] = (),
    relative_humidity_percent: Any = None,
) -> Campaign:
    """A campaign drawn from the paper: Table 1's particles, Table 2's coefficients, its protocol.

    The paper publishes no measured curve as numbers. Maximum stresses are drawn evenly from the published range. Of
    draws from Table 2, 2.4 % are not monotone; they snap through under load control, and `true_monotone` marks them.

    Args:
        seed: seed of coefficients, peaks and noise.
        shared_material: give every particle the mean law instead of a draw.
        instrument: read-out; 0.02 um and 0.05 mN of noise if None.
        programme: what the instrument does; one cycle at 2 mN/s if None.
        unloading, strain_scaling: as of `MccLaw`; 16 GPa belongs to the printed form.
        effects, relative_humidity_percent: as of `simulate_campaign`.
    """
    seed = arguments.seed(seed)
    programme = Programme.cycles() if programme is None else programme
    instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05) if instrument is None else instrument
    count, population = len(PAPER_DIAMETERS_UM), paper_population()
    plastic = population.sample(jax.random.key(seed), count)
    if shared_material:
        plastic = jax.tree.map(lambda x: jnp.full(count, x), population.mean_law)
    laws = law_for_each(plastic, PAPER_SHAPE_PARAMETER, PAPER_EFFECTIVE_MODULUS_MPA, unloading, strain_scaling)
    stress = draw_evenly(PAPER_PEAK_STRESS_MPA, count, seed)
    peaks = peaks_at_stress(laws, particle_batch(PAPER_DIAMETERS_UM), stress, programme.control)
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
