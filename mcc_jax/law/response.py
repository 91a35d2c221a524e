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

from .._errors import InputError
from .._numerics import forward_fill, running_max
from .._types import Path, Scalar, Values
from ..effects import AbstractEffect, AbstractModulusAtPeak, Context, Record
from ..effects.record import first_point, follow
from ..formulas import Formulas, recovery
from ..geometry import Particle
from .loading import strain_under

Effects = tuple[AbstractEffect, ...]
HALVINGS = 64  # from the width of the bracket to below the rounding of a double


class Memory(eqx.Module):
    """What effects and instrument remember of a test.

    Attributes:
        point: the latest point of the test.
        peak_force: largest force so far [mN].
        of_effects, drivers: one entry per effect, None for those without a memory; what drove each at the latest point.
    """

    point: Record
    peak_force: Scalar
    of_effects: tuple[Any, ...]
    drivers: tuple[Any, ...]


def initial_memory(effects: Effects, zero: Scalar, relative_humidity: Scalar | None = None) -> Memory:
    """The memory of a test that has not begun; `zero` gives the precision."""
    own = tuple(effect.start(zero) for effect in effects)
    drivers = tuple(None if memory is None else zero for memory in own)
    return Memory(first_point(zero.dtype, relative_humidity), zero, own, drivers)


def peak_forces(record: Record, before: Scalar) -> Path:
    """Force from which the branch of every point starts [mN]: the record's own peaks, else the largest so far."""
    highest = running_max(record.force) if record.peak is None else record.peak
    return jnp.where(highest > before, highest, before)


def hold_virgin(record: Record) -> Callable[[Path], Path]:
    """What carries the displacement of virgin loading along the branches that follow.

    The running maximum, or where the record knows its peaks, the latest value on virgin loading.
    """
    if record.peak is None:
        return running_max
    virgin = (record.force >= record.peak).at[0].set(True)
    return lambda values: forward_fill(values, virgin)


def one_point(
    law: Formulas,
    effects: Effects,
    particle: Particle,
    displacement_max: Scalar,
    memory: Memory,
    force: Scalar,
    time: Scalar,
) -> tuple[Scalar, Memory, Scalar]:
    """Largest displacement of the law [um], memory and displacement [um] after one more point; for `lax.scan`."""
    before = memory.point
    now = jax.lax.stop_gradient(follow(before, memory.peak_force, force, time))
    record = eqx.tree_at(lambda r: (r.force, r.time, r.relative_humidity), now, (force, time, before.relative_humidity))
    highest = jnp.where(force > memory.peak_force, force, memory.peak_force)
    context = modified(law, effects, particle, displacement_max, record, highest, lambda x: x)

    def remember(effect: AbstractEffect, own: Any, driven: Scalar) -> tuple[Any, Any, Scalar]:
        driver = effect.driver(context)
        return *effect.evolve(own, driven, driver, time - before.time), driver

    own, drivers, values = _remember(effects, memory, remember)
    after = Memory(record, highest, own, drivers)
    return context.peak_displacement, after, context.displacement + _added(effects, context, values)


def whole_path(
    law: Formulas, effects: Effects, particle: Particle, displacement_max: Scalar, memory: Memory, record: Record
) -> tuple[Scalar, Memory, Path]:
    """The same after all points of a record, closed form but for the memories."""
    highest = peak_forces(record, memory.peak_force)
    context = modified(law, effects, particle, displacement_max, record, highest, hold_virgin(record))
    own, drivers, added = additions(effects, memory, context)
    point, highest = jax.tree.map(lambda x: x[-1] if x.ndim else x, (record, highest))
    after = Memory(point, highest, own, drivers)
    return context.peak_displacement[-1], after, context.displacement + added


def modified(
    law: Formulas,
    effects: Effects,
    particle: Particle,
    displacement_max: Scalar,
    record: Record,
    highest: Values,
    along: Callable[[Values], Values],
) -> Context:
    """The law with modified parameters, loading and modulus: what effects see.

    Args:
        law: the law without effects.
        displacement_max: the largest displacement before [um].
        record: one point or all of them.
        highest: the largest force so far [mN].
        along: the running maximum, or nothing for a single point.
    """
    for effect in effects:
        law = effect.modify(law, particle, record)
    loading = tuple(e for e in effects if e.overrides("loading"))
    stiffening = tuple(e for e in effects if e.overrides("stiffness"))
    if loading:
        strain = strain_under(loading, law, particle, record, particle.stress(record.force))
        reached = moved = peak_displacement(particle, record, highest, strain, displacement_max, along)
    else:
        reached, moved = law.contact(particle).under(displacement_max, record.force, highest)
    recoverable = law.recoverable_displacement(particle, reached, highest, jnp.ones_like(reached))
    context = Context(particle, law, record, highest, reached, recoverable, moved)
    if loading or stiffening:
        context = released(context, [effect.stiffness(context) for effect in stiffening])
    return context


def peak_displacement(
    particle: Particle,
    record: Record,
    highest: Values,
    strain: Values,
    displacement_max: Scalar,
    along: Callable[[Values], Values],
) -> Values:
    """Largest displacement so far [um], from the strain of virgin loading at every point's force."""
    new = along(jnp.where(record.force >= highest, particle.displacement(strain), 0.0))
    return jnp.where(new > displacement_max, new, displacement_max)


def released(context: Context, factors: Sequence[Values]) -> Context:
    """The context with these factors on the effective modulus of its branches."""
    law, particle, reached = context.law, context.particle, context.peak_displacement
    factor = math.prod(factors, start=jnp.ones_like(reached))
    recoverable = law.recoverable_displacement(particle, reached, context.peak_force, factor)
    share = jnp.where(context.record.force < context.peak_force, recovery(context.load_share), 0.0)
    return replace(context, recoverable=recoverable, displacement=reached - recoverable * share)


def additions(effects: Effects, memory: Memory, context: Context) -> tuple[tuple[Any, ...], tuple[Any, ...], Path]:
    """The effects' memories after a path under load control, what drove them last, and what is added along it [um]."""
    record = context.record
    seconds = jnp.diff(record.time, prepend=memory.point.time)

    def remember(effect: AbstractEffect, own: Any, driven: Scalar) -> tuple[Any, Any, Scalar]:
        along = effect.driver(context)
        earlier = jnp.concatenate([jnp.broadcast_to(driven, (1,)), along[:-1]])
        own, value = jax.lax.scan(lambda past, now: effect.evolve(past, *now), own, (earlier, along, seconds))
        return own, value, along[-1]

    own, drivers, values = _remember(effects, memory, remember)
    return own, drivers, _added(effects, context, values)


def force_at(
    displacement_under: Callable[[Any, Scalar], Scalar], given: Any, displacement: Scalar, scale: Scalar
) -> Scalar:
    """Force [mN] at which a displacement [um] that grows with force is met; 0 where the platen does not touch.

    Bisection in a bracket that grows from a force of the right size; derivatives by the implicit-function rule.
    """
    still, target = jax.tree.map(jax.lax.stop_gradient, (given, displacement))

    def gap(force: Scalar, _: Any = None) -> Scalar:
        return displacement_under(still, force) - target

    zero = jnp.zeros_like(scale)
    below = gap(zero) < 0
    solver = optx.Bisection(rtol=float(4 * jnp.finfo(scale.dtype).eps), atol=0.0, expand_if_necessary=True)
    bracket = {"lower": zero, "upper": jax.lax.stop_gradient(scale)}

    def sought(force: Scalar, _: Any) -> Scalar:
        met = gap(force)
        # Where no force is enough, the bracket would grow for ever once the displacement is not a number.
        return jnp.where(below, jnp.where(jnp.isnan(met), 1.0, met), force - 0.5 * bracket["upper"])

    found = optx.root_find(sought, solver, scale, options=bracket, max_steps=HALVINGS, throw=False).value
    root = jax.lax.stop_gradient(jnp.where(below, found, 0.0))
    slope = jax.jvp(gap, (root,), (jnp.ones_like(root),))[1]
    touches = (root > 0) & (slope > 0)
    off = displacement_under(given, root) - displacement
    # One Newton step from the frozen root carries the derivatives; its own length is rounding, which is not wanted.
    change = -(off - jax.lax.stop_gradient(off)) / jnp.where(touches, slope, 1.0)
    return root + jnp.where(touches, change, 0.0)


def folded(
    law: Formulas, effects: Effects, particle: Particle, what: str
) -> tuple[Formulas, tuple[AbstractModulusAtPeak, ...]]:
    """The law with the parameters that effects make of it for a particle, and the effects on the modulus at a peak.

    Raises:
        InputError: naming an effect that is not a closed formula of particle and peak, and `what` was wanted of the
            law.
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


def factor_at_peak(effects: tuple[AbstractModulusAtPeak, ...], strain: Values, stress: Values) -> Values:
    """Product of the factors of effects on the effective modulus at a peak strain [-] and a peak stress [MPa]."""
    factor = jnp.ones_like(strain)
    for effect in effects:
        factor = factor * effect.factor(strain, stress)
    return factor


def _remember(
    effects: Effects, memory: Memory, remember: Callable[[AbstractEffect, Any, Scalar], tuple[Any, Any, Scalar]]
) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]:
    """The effects' memories after the last point, what drove them there, and the value of each for `inside`."""
    each = zip(effects, memory.of_effects, memory.drivers, strict=True)
    found = [(None, None, None) if own is None else remember(effect, own, before) for effect, own, before in each]
    own, values, drivers = zip(*found, strict=True) if found else ((), (), ())
    return own, drivers, values


def _added(effects: Effects, context: Context, values: tuple[Any, ...]) -> Values:
    total = jnp.zeros_like(context.displacement)
    for effect, value in zip(effects, values, strict=True):
        if effect.overrides("inside", "observe"):
            own = eqx.tree_at(lambda c: c.memory, context, value, is_leaf=lambda x: x is None)
            total = total + effect.inside(own) + effect.observe(own)
    return total
