"""The contact law with missing effects added: differentiable parameters, load and displacement control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import arguments
from .._numerics import running_max
from .._types import Flag, Path, Scalar, Values
from ..geometry import Particle
from ..law import History, MccLaw, recovery
from .context import Context
from .effect import AbstractEffect, overrides
from .record import Record, clean_record, first_point, follow
from .root import increasing_root
from .solve import recoverable_displacement, strain_under


class ExtendedState(eqx.Module):
    """What a particle and its tester remember.

    Attributes:
        history: the law's own history, without additions.
        point: the latest point of the test.
        peak_force: largest force so far [mN].
        memories: one entry per effect, None for those without a memory.
        drivers: what drove each memory at the latest point.
    """

    history: History
    point: Record
    peak_force: Scalar
    memories: tuple[Any, ...]
    drivers: tuple[Any, ...]


class ExtendedLaw(eqx.Module):
    r"""A law and effects that act on it together.

    .. math:: \gamma(F, t) = \gamma_{law}(F;\, \text{modified parameters}) + \sum_k \Delta_k(F, t)

    A tester controls force, so load control is the primary form: `respond` follows a `Record`, closed form over running
    maxima, with a scan only for memories. `path_load` makes the record of a clean path itself, `step_load` advances
    point by point with the same result, and `step` and `path` (displacement control) solve for the force.

    With every amplitude zero the displacement is that of the base law to the last bit, while its derivatives by the
    amplitudes are those of the effects.

    The base may be the law of a fit that has taken in the shape factor (a = 0, coefficients multiplied by it): effects
    use strains and stresses, never the shape factor itself.

    Attributes:
        base: the law, an ordinary `MccLaw`.
        effects: what is added; their order does not matter beyond rounding.
    """

    base: MccLaw
    effects: tuple[AbstractEffect, ...]

    def __init__(self, base: Any, effects: Any) -> None:
        self.base = arguments.instance(base, MccLaw, "base", "Take mcc_jax.paper_law(), or the law of a calibration.")
        remedy = 'Make one with mcc_jax.effects.find_variant("creep").build(0.02).'
        given = arguments.instance(effects, Sequence, "effects", f"Give a list of effects. {remedy}")
        self.effects = tuple(arguments.instance(one, AbstractEffect, "every one of effects", remedy) for one in given)

    @property
    def is_monotone(self) -> Flag:
        """Whether the base law's force never falls while the displacement of a virgin particle grows."""
        return self.base.is_monotone

    @property
    def is_valid(self) -> Flag:
        """Whether the base law's parameters are in range and every number of the effects is finite."""
        valid = self.base.is_valid
        for leaf in jax.tree.leaves(eqx.filter(self.effects, eqx.is_inexact_array)):
            valid = valid & jnp.all(jnp.isfinite(leaf))
        return valid

    def carries_stress(self, particle: Particle) -> Flag:
        """Whether the base law gives this particle any stress."""
        return self.base.carries_stress(particle)

    def init(self, particle: Particle, relative_humidity: Scalar | None = None) -> ExtendedState:
        """A virgin particle at the beginning of its test.

        Args:
            particle: the particle.
            relative_humidity: of the room [%]; the reference if None.
        """
        zero = jnp.zeros_like(particle.D3)
        memories = tuple(effect.start(zero) for effect in self.effects)
        drivers = tuple(None if memory is None else zero for memory in memories)
        point = first_point(zero.dtype, relative_humidity)
        return ExtendedState(self.base.init(particle), point, zero, memories, drivers)

    # ---- load control ------------------------------------------------------------------------------------------------

    def respond(self, particle: Particle, record: Record) -> Path:
        """Displacement [um] of a virgin particle along a record: what a fit compares with the measurement."""
        start = eqx.tree_at(lambda s: s.point.time, self.init(particle), record.time[0])
        return self._along(particle, start, record)[1]

    def path_load(
        self, particle: Particle, state: ExtendedState, force: Path, time: Path
    ) -> tuple[ExtendedState, Path]:
        """Displacements [um] along a clean path of forces [mN] at times [s], and the state after it.

        For measured forces, which are noisy, make a `Record` from their segments and use `respond`.
        """
        record = clean_record(
            force,
            time,
            relative_humidity=state.point.relative_humidity,
            before=state.point,
            peak_force=state.peak_force,
        )
        return self._along(particle, state, record)

    def step_load(
        self, particle: Particle, state: ExtendedState, force: Scalar, time: Scalar
    ) -> tuple[ExtendedState, Scalar]:
        """Displacement [um] under the force [mN] at the time [s], and the state after it; for `lax.scan`."""
        now = jax.lax.stop_gradient(follow(state.point, state.peak_force, force, time))
        record = eqx.tree_at(
            lambda r: (r.force, r.time, r.relative_humidity), now, (force, time, state.point.relative_humidity)
        )
        highest = jnp.where(force > state.peak_force, force, state.peak_force)
        context = self._law(particle, state.history, record, highest, lambda x: x)

        def remember(effect: AbstractEffect, memory: Any, before: Scalar) -> tuple[Any, Any, Scalar]:
            driver = effect.driver(context)
            return *effect.evolve(memory, before, driver, time - state.point.time), driver

        after, values = self._remember(state, context, record, remember)
        return after, self._added(context, values)

    def _along(self, particle: Particle, state: ExtendedState, record: Record) -> tuple[ExtendedState, Path]:
        highest = running_max(record.force)
        highest = jnp.where(highest > state.peak_force, highest, state.peak_force)
        return self.add(state, self._law(particle, state.history, record, highest, running_max))

    def context(self, particle: Particle, record: Record) -> Context:
        """What the effects are told along a record, from a virgin particle: the law with modified parameters."""
        highest = running_max(jnp.where(record.force > 0, record.force, 0.0))
        return self._law(particle, self.base.init(particle), record, highest, running_max)

    def add(self, state: ExtendedState, context: Context) -> tuple[ExtendedState, Path]:
        """The second half of a path under load control: memories, additions inside the law, additions outside.

        Args:
            state: the state before the path.
            context: the law along the path (`context`).
        """
        record = context.record
        seconds = jnp.diff(record.time, prepend=state.point.time)

        def remember(effect: AbstractEffect, memory: Any, before: Scalar) -> tuple[Any, Any, Scalar]:
            along = effect.driver(context)
            earlier = jnp.concatenate([jnp.broadcast_to(before, (1,)), along[:-1]])
            memory, value = jax.lax.scan(lambda past, now: effect.evolve(past, *now), memory, (earlier, along, seconds))
            return memory, value, along[-1]

        last = jax.tree.map(lambda x: x[-1], (record.at_points, context.peak_displacement, context.peak_force))
        point, peak, highest = last
        ends = eqx.tree_at(lambda c: (c.peak_displacement, c.peak_force), context, (peak, highest))
        after, values = self._remember(state, ends, point, remember)
        return after, self._added(context, values)

    def _remember(
        self,
        state: ExtendedState,
        last: Context,
        point: Record,
        remember: Callable[[AbstractEffect, Any, Scalar], tuple[Any, Any, Scalar]],
    ) -> tuple[ExtendedState, list[Any]]:
        """The state after the last point, and what each memory tells its effect."""
        memories, values, drivers = [], [], []
        for effect, memory, before in zip(self.effects, state.memories, state.drivers, strict=True):
            told = (None, None, None) if memory is None else remember(effect, memory, before)
            for entries, entry in zip((memories, values, drivers), told, strict=True):
                entries.append(entry)
        history = History(last.peak_displacement)
        return ExtendedState(history, point, last.peak_force, tuple(memories), tuple(drivers)), values

    def _law(
        self,
        particle: Particle,
        history: History,
        record: Record,
        highest: Values,
        along: Callable[[Values], Values],
    ) -> Context:
        """The law with modified parameters; `along` is the running maximum, or nothing for a single point."""
        force = record.force
        peak, displacement = self.base.peak_and_displacement(particle, history, force, highest)
        # What follows must not be compiled together with the base law, or its last bits would depend on the effects.
        peak, displacement = jax.lax.optimization_barrier((peak, displacement))
        modify = tuple(e for e in self.effects if overrides(e, "modify"))
        load = tuple(e for e in self.effects if overrides(e, "loading"))
        stiffen = tuple(e for e in self.effects if overrides(e, "stiffness"))
        law = self.base
        for effect in modify:
            law = effect.modify(law, particle, record)
        reached, moved = peak, displacement
        if load:
            virgin = force >= highest
            strain = strain_under(load, law, particle, record, particle.stress(force))
            new = along(jnp.where(virgin, particle.displacement(strain), 0.0))
            reached = jnp.where(new > history.displacement_max, new, history.displacement_max)
        elif modify:
            reached, moved = law.peak_and_displacement(particle, history, force, highest)
        recoverable = recoverable_displacement(law, particle, reached, highest, jnp.ones_like(reached))
        context = Context(particle, law, record, highest, reached, recoverable, moved)
        if stiffen:
            factor = jnp.ones_like(reached)
            for effect in stiffen:
                factor = factor * effect.stiffness(context)
            recoverable = recoverable_displacement(law, particle, reached, highest, factor)
            context = eqx.tree_at(lambda c: c.recoverable, context, recoverable)
        if load or stiffen:
            released = jnp.where(force < highest, recoverable * recovery(context.load_share), 0.0)
            moved = reached - released
        if modify or load or stiffen:
            null = _all_null((*modify, *load, *stiffen))
            reached = peak + _exact_at_null(null, reached - peak)
            moved = displacement + _exact_at_null(null, moved - displacement)
        return eqx.tree_at(lambda c: (c.peak_displacement, c.displacement), context, (reached, moved))

    def _added(self, context: Context, values: list[Any]) -> Values:
        total = context.displacement
        for effect, value in zip(self.effects, values, strict=True):
            if overrides(effect, "inside", "observe"):
                own = eqx.tree_at(lambda c: c.memory, context, value, is_leaf=lambda x: x is None)
                added = effect.inside(own) + effect.observe(own)
                total = total + _exact_at_null(effect.amplitude == 0, added)
        return total

    # ---- displacement control ----------------------------------------------------------------------------------------

    def step(
        self, particle: Particle, state: ExtendedState, displacement: Scalar, time: Scalar
    ) -> tuple[ExtendedState, Scalar]:
        """Force [mN] at the platen displacement [um] at the time [s], and the state after it.

        The force that makes `step_load` meet the displacement, found in a bracket; 0 where the platen does not touch.
        Displacement must grow with force, as it does for all but absurd amplitudes. Where it jumps (a law that is not
        monotone, a sharp pop-in), the force stays at that of the jump. Derivatives follow from the implicit-function
        rule.
        """
        law, p, past, target, when = jax.tree.map(jax.lax.stop_gradient, (self, particle, state, displacement, time))

        def gap(force: Scalar) -> Scalar:
            return law.step_load(p, past, force, when)[1] - target

        # What one MPa takes is a scale for a particle that was never loaded.
        start = jnp.maximum(past.peak_force, p.force(jnp.ones_like(past.peak_force)))
        root = increasing_root(gap, start)
        slope = jax.jvp(gap, (root,), (jnp.ones_like(root),))[1]
        touches = (root > 0) & (slope > 0)
        off = self.step_load(particle, state, root, time)[1] - displacement
        # One Newton step from the frozen root carries the derivatives; its own length is rounding, which is not wanted.
        change = -(off - jax.lax.stop_gradient(off)) / jnp.where(touches, slope, 1.0)
        force = root + jnp.where(touches, change, 0.0)
        return self.step_load(particle, state, force, time)[0], force

    def path(
        self, particle: Particle, state: ExtendedState, displacement: Path, time: Path
    ) -> tuple[ExtendedState, Path]:
        """Forces [mN] along a path of displacements [um] at times [s], by `lax.scan` of `step`."""
        return jax.lax.scan(lambda past, now: self.step(particle, past, *now), state, (displacement, time))


def _all_null(effects: tuple[AbstractEffect, ...]) -> Flag:
    null = jnp.asarray(True)
    for effect in effects:
        null = null & (effect.amplitude == 0)
    return null


def _exact_at_null(null: Flag, change: Values) -> Values:
    """The change an effect makes; at its null exactly zero in value, with the derivatives of the change."""
    return jnp.where(null, change - jax.lax.stop_gradient(change), change)
