"""Response of a law with effects: parameters, loading, modulus, then what is added in the law and by the instrument."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from .. import arguments
from .._errors import InputError
from .._format import in_words
from .._numerics import forward_fill, running_max
from .._types import Path, Scalar, Values
from ..effects import AbstractEffect, AbstractModulusAtPeak, Context, Factors, Record, Variant, find_variant
from ..effects.record import first_point
from ..formulas import Formulas, Quintic, recovery
from ..formulas.contact import reached
from ..geometry import Particle

Effects = tuple[AbstractEffect, ...]
AtPeak = tuple[AbstractModulusAtPeak, ...]
HALVINGS = 64  # from the width of the bracket to below the rounding of a double
NEWTON_STEPS = 6  # from a start within a few per cent, to rounding: tests/effects/test_physics.py


def given_effects(effects: Any) -> tuple[AbstractEffect, ...]:
    """Effects from effects, variants and names, or from one of these."""
    given = [effects] if isinstance(effects, str | Variant | AbstractEffect) else effects
    return tuple(map(_one_effect, given))


def _one_effect(effect: Any) -> AbstractEffect:
    if isinstance(effect, str):
        effect = find_variant(effect)
    if isinstance(effect, Variant):
        effect = effect.build(effect.typical)
    if not isinstance(effect, AbstractEffect):
        problem = f"an effect must be a name, a Variant or an effect, got {arguments.kind_of(effect)}"
        remedy = 'Give a name such as "creep:logarithmic", a Variant, or what its build(amplitude) makes.'
        raise InputError(problem, remedy=remedy)
    return effect


def describe(effect: AbstractEffect) -> str:
    """An effect with the name and the unit of its amplitude, where a formula of the library made it."""
    try:
        variant = find_variant(effect.label)
    except InputError:
        return repr(effect)
    unit = "" if variant.unit == "-" else f" {variant.unit}"
    others = [f"{n.name} {in_words(getattr(effect, n.name))}" for n in variant.nuisances if hasattr(effect, n.name)]
    return ", ".join([f"{effect.label}: {variant.parameter} {in_words(effect.amplitude)}{unit}", *others])


class Memory(eqx.Module):
    """What effects and instrument remember of a test: its latest point, the largest force so far [mN], and the memory
    of each effect and what drove it there, None for those without one."""

    point: Record
    peak_force: Scalar
    of_effects: tuple[Any, ...]
    drivers: tuple[Any, ...]


def initial_memory(
    effects: Effects, zero: Scalar, humidity: Scalar | None = None, time: Scalar | None = None
) -> Memory:
    """The memory of a test that has not begun, as `first_point`; `zero` gives the precision."""
    own = tuple(effect.start(zero) for effect in effects)
    drivers = tuple(None if memory is None else zero for memory in own)
    return Memory(first_point(zero.dtype, humidity, time), zero, own, drivers)


def peak_forces(record: Record, before: Scalar) -> Path:
    """Force from which the branch of every point starts [mN]: the record's own peaks, else the largest so far."""
    highest = running_max(record.force) if record.peak is None else record.peak
    return jnp.where(highest > before, highest, before)


def context_along(
    law: Formulas, effects: Effects, particle: Particle, displacement_max: Scalar, record: Record, highest: Path
) -> Context:
    """What effects see: the law with modified parameters, loading and modulus, from a largest displacement [um]."""
    for effect in effects:
        law = effect.modify(law, particle, record)
    loading = tuple(e for e in effects if e.overrides("loading"))
    stiffening = tuple(e for e in effects if e.overrides("stiffness"))
    if loading:
        strain = strain_under(loading, law, particle, record, particle.stress(record.force))
        peak = moved = peak_displacement(particle, record, highest, strain, displacement_max)
    else:
        peak, moved = law.contact(particle).under(displacement_max, record.force, highest)
    recoverable = law.recoverable_displacement(particle, peak, highest, jnp.ones_like(peak))
    context = Context(particle, law, record, highest, peak, recoverable, moved)
    if loading or stiffening:
        context = released(context, [effect.stiffness(context) for effect in stiffening])
    return context


def peak_displacement(particle: Particle, record: Record, highest: Path, strain: Path, before: Scalar) -> Path:
    """Largest displacement so far [um], from that before and the strain of virgin loading at every point's force.

    Where the record knows its peaks, the branches that follow carry the latest value on virgin loading: the largest one
    would be too large by its noise.
    """
    virgin = record.force >= highest
    on_loading = jnp.where(virgin, particle.displacement(strain), 0.0)
    if record.peak is None:
        new = running_max(on_loading)
    else:
        new = forward_fill(on_loading, (record.force >= record.peak).at[0].set(True))
        # On a faster ramp the loading curve begins below the peak from which it goes on: the peak stays until then.
        ended = running_max(jnp.where(virgin, 0.0, new))
        new = jnp.where(new > ended, new, ended)
    return jnp.where(new > before, new, before)


def released(context: Context, factors: Sequence[Values]) -> Context:
    """The context with these factors on the effective modulus of its branches."""
    peak = context.peak_displacement
    factor = math.prod(factors, start=jnp.ones_like(peak))
    recoverable = context.law.recoverable_displacement(context.particle, peak, context.peak_force, factor)
    share = jnp.where(context.record.force < context.peak_force, recovery(context.load_share), 0.0)
    return replace(context, recoverable=recoverable, displacement=peak - recoverable * share)


def additions(effects: Effects, memory: Memory, context: Context) -> tuple[tuple[Any, ...], tuple[Any, ...], Path]:
    """The effects' memories after a path under load control, what drove them last, and what is added along it [um]."""
    seconds = jnp.diff(context.record.time, prepend=memory.point.time)
    memories, drivers, total = [], [], jnp.zeros_like(context.displacement)
    for effect, own, driver in zip(effects, memory.of_effects, memory.drivers, strict=True):
        seen = None
        if own is not None:
            along = effect.driver(context)
            earlier = jnp.concatenate([jnp.broadcast_to(driver, (1,)), along[:-1]])
            own, seen = jax.lax.scan(
                lambda past, now, effect=effect: effect.evolve(past, *now), own, (earlier, along, seconds)
            )
            driver = along[-1]
        if effect.overrides("inside", "observe"):
            own_context = replace(context, memory=seen)
            total = total + effect.inside(own_context) + effect.observe(own_context)
        memories.append(own)
        drivers.append(driver)
    return tuple(memories), tuple(drivers), total


def force_at(displacement_under: Callable[..., Scalar], given: Any, displacement: Scalar, scale: Scalar) -> Scalar:
    """Force [mN] at which a displacement [um] that grows with force is met, below zero where the particle sticks to the
    platen; 0 where the two do not touch.

    Bisection in a bracket that grows from a force of the right size; derivatives by the implicit-function rule.
    """
    still, target = jax.tree.map(jax.lax.stop_gradient, (given, displacement))

    def gap(force: Scalar, _: Any = None) -> Scalar:
        return displacement_under(still, force) - target

    high = jax.lax.stop_gradient(scale)
    bracket = {"lower": -high, "upper": high}  # at a tension as large as that a contact has broken
    met_somewhere = gap(bracket["lower"]) < 0
    solver = optx.Bisection(rtol=float(4 * jnp.finfo(scale.dtype).eps), atol=0.0, expand_if_necessary=True)

    def sought(force: Scalar, _: Any) -> Scalar:
        met = gap(force)
        # Where no force is enough, the bracket would grow for ever once the displacement is not a number.
        return jnp.where(met_somewhere, jnp.where(jnp.isnan(met), 1.0, met), force - 0.5 * high)

    found = optx.root_find(sought, solver, scale, options=bracket, max_steps=HALVINGS, throw=False).value
    root = jax.lax.stop_gradient(jnp.where(met_somewhere, found, 0.0))
    slope = jax.jvp(gap, (root,), (jnp.ones_like(root),))[1]
    touches = (root != 0) & (slope > 0)
    off = displacement_under(given, root) - displacement
    # One Newton step from the frozen root carries the derivatives; its own length is rounding, which is not wanted.
    change = -(off - jax.lax.stop_gradient(off)) / jnp.where(touches, slope, 1.0)
    return jnp.where(touches | (root > 0), root + jnp.where(touches, change, 0.0), 0.0)


def strain_under(effects: Effects, law: Formulas, particle: Particle, record: Record, stress: Path) -> Path:
    r"""Strain of virgin loading at a stress [MPa] when effects change the loading curve; 0 at and below zero.

    Solves :math:`f_1 K_1 x - f_3 K_3 x^3 + f_5 K_5 x^5 = \sigma`, :math:`x = \eta_p \epsilon`, with factors
    :math:`f_j(\epsilon)`: the base law's inverse with the factors at its own strain, then Newton's method. Derivatives
    follow from the implicit-function rule, as one Newton step from the frozen root is differentiated.
    """
    target = jnp.where(stress >= 0, stress, 0.0)
    fixed = jax.tree.map(jax.lax.stop_gradient, (effects, law, particle, record))
    law_there, particle_there, target_there = *fixed[1:3], jax.lax.stop_gradient(target)

    def factors(strain: Path) -> list[Factors]:
        return [effect.loading(*fixed[1:], strain) for effect in fixed[0]]

    def with_slopes(strain: Path) -> tuple[list[Factors], list[Factors]]:
        return jax.jvp(factors, (strain,), (jnp.ones_like(strain),))

    def newton(_: Any, strain: Path) -> Path:
        return newton_step(law_there, particle_there, target_there, strain, *with_slopes(strain))

    start = base_strain(law_there, particle_there, target_there)
    start = base_strain(law_there, particle_there, target_there, factors(start))
    # Written out, the steps would multiply what is to be compiled.
    root = jax.lax.fori_loop(0, NEWTON_STEPS, newton, start)
    residual = stress_at(law, particle, root, [e.loading(law, particle, record, root) for e in effects]) - target
    return root - residual / slope_at(law_there, particle_there, root, *with_slopes(root))


def stress_at(law: Formulas, particle: Particle, strain: Path, factors: Sequence[Factors] = ()) -> Path:
    """Stress [MPa] of virgin loading at a strain, with the factors of effects on its three terms."""
    return _with_factors(law, strain, factors).halley(law.shape_factor(particle) * strain)[0]


def slope_at(
    law: Formulas, particle: Particle, strain: Path, factors: Sequence[Factors], slopes: Sequence[Factors]
) -> Path:
    """Slope of `stress_at` over strain, of the factors' own slopes too; kept above a thousandth of the initial one,
    where a curve stops being monotone."""
    one = jnp.ones_like(strain)
    slope = jax.jvp(lambda *at: stress_at(law, particle, *at), (strain, factors), (one, slopes))[1]
    least = 1e-3 * law.plastic.C1 * law.shape_factor(particle)
    return jnp.where(slope > least, slope, least)


def base_strain(law: Formulas, particle: Particle, stress: Path, factors: Sequence[Factors] = ()) -> Path:
    """Strain of virgin loading at a stress, with factors that do not depend on strain."""
    curve = _with_factors(law, stress, factors)
    return jax.vmap(reached)(curve, stress, jnp.zeros_like(stress)) / law.shape_factor(particle)


def newton_step(
    law: Formulas, particle: Particle, stress: Path, strain: Path, factors: Sequence[Factors], slopes: Sequence[Factors]
) -> Path:
    """A step of Newton's method for the strain at a stress, of at most 30 % of the strain."""
    change = (stress - stress_at(law, particle, strain, factors)) / slope_at(law, particle, strain, factors, slopes)
    limit = 0.3 * strain
    return strain + jnp.where(change > limit, limit, jnp.where(change < -limit, -limit, change))


def _with_factors(law: Formulas, like: Path, factors: Sequence[Factors]) -> Quintic:
    K1, K3, K5 = (jnp.broadcast_to(K, like.shape) for K in law.plastic.polynomial)
    for f1, f3, f5 in factors:
        K1, K3, K5 = K1 * f1, K3 * f3, K5 * f5
    return Quintic(K1, K3, K5)


def folded(law: Formulas, effects: Effects, particle: Particle, what: str) -> tuple[Formulas, AtPeak]:
    """The law with the parameters that effects make of it for a particle, and the effects on the modulus at a peak.

    `InputError` names another effect, and `what` was wanted of the law.
    """
    at_peak = tuple(e for e in effects if isinstance(e, AbstractModulusAtPeak))
    for effect in effects:
        other = effect.overrides("stiffness") and not isinstance(effect, AbstractModulusAtPeak)
        if not effect.closed or other or effect.overrides("loading", "inside", "observe"):
            leave = "of_particle() leaves out what belongs to the instrument"
            leave = leave if effect.of_instrument else f'without_effects("{effect.name}") leaves it out'
            raise InputError(
                f"{what} of a law with {effect.name} is not known in closed form",
                remedy=f"law.{leave}; mcc_jax.drive and the JAX artefact (export --format jax) take every effect.",
            )
    record = first_point(particle.D3.dtype)
    for effect in effects:
        law = effect.modify(law, particle, record)
    return law, at_peak


def factor_at_peak(effects: AtPeak, strain: Values, stress: Values) -> Values:
    """Product of the factors of effects on the effective modulus at a peak strain [-] and a peak stress [MPa]."""
    return math.prod((effect.factor(strain, stress) for effect in effects), start=jnp.ones_like(strain))
