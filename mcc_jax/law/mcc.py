"""The loading-unloading contact law of microcrystalline cellulose particles, with the effects it may have."""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import arguments
from .._format import described
from .._numerics import compiled_whole, running_max
from .._types import Flag, Path, Scalar, scalar
from ..effects import AbstractEffect, AbstractModulusAtPeak, Context, Record, clean_record
from ..effects.record import first_point
from ..formulas import Contact, Formulas, first_gain
from ..geometry import Particle
from . import response

Time = Scalar | None  # [s]; None means a test in which no time passes
Times = Path | None
TESTED_STRAIN = 0.67
"""Scaled strain eta_p eps at which the paper's tests ended, on its mean curve (peaks of 7 to 16 MPa)."""


class AbstractContactLaw[State](eqx.Module):
    """One particle between two platens: `init` gives the virgin state, `step` advances it, `path` is its scan.

    Batch laws and particles with `equinox.filter_vmap`. No method checks values: `simulate.drive` does.
    """

    @property
    def is_monotone(self) -> Flag:
        """Whether force never falls while the displacement of a virgin particle grows."""
        return jnp.asarray(True)

    @property
    def is_valid(self) -> Flag:
        """Whether every parameter is in its range."""
        return jnp.asarray(True)

    def carries_stress(self, particle: Particle) -> Flag:
        """Whether the law gives this particle any stress at all."""
        return jnp.asarray(True)

    def gain_strain(self, particle: Particle, state: State) -> Scalar:
        """Peak strain [-], up to that of the state, beyond which loading and release gain energy; infinite if none."""
        return jnp.full_like(particle.D3, jnp.inf)

    @abc.abstractmethod
    def init(self, particle: Particle) -> State:
        """State of a particle that was never loaded."""

    @abc.abstractmethod
    def step(self, particle: Particle, state: State, displacement: Scalar, time: Time = None) -> tuple[State, Scalar]:
        """Force [mN] at the platen displacement [um] at the time [s], and the state after it."""

    @abc.abstractmethod
    def step_load(self, particle: Particle, state: State, force: Scalar, time: Time = None) -> tuple[State, Scalar]:
        """Platen displacement [um] under the force [mN] at the time [s], and the state after it."""

    def path(self, particle: Particle, state: State, displacement: Path, time: Times = None) -> tuple[State, Path]:
        """Forces [mN] along a path of displacements [um] at times [s], by `lax.scan` of `step`."""
        return _scan(self.step, particle, state, displacement, time)

    def path_load(self, particle: Particle, state: State, force: Path, time: Times = None) -> tuple[State, Path]:
        """Displacements [um] along a path of forces [mN] at times [s], by `lax.scan` of `step_load`."""
        return _scan(self.step_load, particle, state, force, time)


def _scan(step: Callable[..., Any], particle: Particle, state: Any, path: Path, time: Times) -> Any:
    """A law that knows no time need not have it among its arguments."""
    along = (path,) if time is None else (path, time)
    return jax.lax.scan(lambda past, now: step(particle, past, *now), state, along)


class History(eqx.Module):
    """What a particle remembers: its largest platen displacement [um], and what effects remember, None without any."""

    displacement_max: Scalar = eqx.field(converter=scalar)  # of the law itself, without what effects add
    memory: Any = None

    __repr__ = described(displacement_max="um")


class Energy(eqx.Module):
    """Work done on a particle [nJ]: what it would still give back on full release, and what is dissipated."""

    work: Scalar
    recoverable: Scalar
    dissipated: Scalar

    __repr__ = described(work="nJ", recoverable="nJ", dissipated="nJ")


class MccLaw(Formulas, AbstractContactLaw[History]):
    r"""Plastic loading along a quintic, elastic unloading and reloading along an arcsine branch, and effects.

    With :math:`\epsilon = \gamma/D_e`, :math:`\sigma = F/(\pi R_e^2)`, :math:`\eta_p` from `plastic_shape_factor` and
    :math:`(\epsilon_P, \sigma_P)` the largest strain so far and its stress,

    .. math::
        \sigma &= C_1 \eta_p\epsilon - (C_3 \eta_p\epsilon)^3 + (C_5 \eta_p\epsilon)^5
            && \text{plastic loading},\ \epsilon \ge \epsilon_P \\
        \sigma &= \tfrac{2}{\pi} \sigma_P \left[\arccos s - s\sqrt{1 - s^2}\right],\quad
            s = (\epsilon_P - \epsilon)/\delta && \text{elastic unloading and reloading}

    and zero once s >= 1 (`formulas.Contact`). Rate independent, no adhesion. Effects act under load control,

    .. math:: \gamma(F, t) = \gamma_{law}(F;\, \text{modified parameters}) + \sum_k \Delta_k(F, t),

    and displacement control solves it for the force. Amplitudes of zero change nothing. With effects, methods that
    advance the law take times [s] as well; None means a test in which no time passes.

    Validity: the paper's tests ended at 7 to 16 MPa, :math:`\eta_p\epsilon \le 0.67` on the mean curve. If the quintic
    is not monotone, displacement control follows it down, load control snaps through. Value and first derivatives are
    finite everywhere, in both modes; at the onset of unloading the derivative is that of loading, at full release that
    of the released particle.

    Attributes:
        plastic: C1, C3, C5.
        a: geometric parameter of the shape factor [-].
        effective_modulus: :math:`\bar E = E/(1-\nu^2)` [MPa], > 0; its value belongs to the chosen `unloading` form.
        unloading: form of the recovered strain, also as its text: "printed", "punch", "punch_exact".
        strain_scaling: how the shape factor enters it, also as its text: "raw", "contact", "master".
        effects: what acts in addition; their order does not matter beyond rounding.

    Raises:
        InputError: for a plain number out of its range, or an unknown form.

    References:
        Bommireddy et al. (2018), eqs. 16, 23 and 24.
    """

    effects: tuple[AbstractEffect, ...] = eqx.field(converter=response.given_effects, default=())

    def _rows(self) -> list[tuple[str, str]]:
        return [*super()._rows(), *(("effect", response.describe(effect)) for effect in self.effects)]

    @property
    def is_valid(self) -> Flag:
        """Whether C1, C5 and the modulus are positive, C3 is not negative, and every number is finite."""
        valid = super().is_valid
        for leaf in jax.tree.leaves(eqx.filter(self.effects, eqx.is_inexact_array)):
            valid = valid & jnp.all(jnp.isfinite(leaf))
        return valid

    def with_effects(self, *effects: Any) -> MccLaw:
        """The law with further effects: by name, "mechanism" or "mechanism:variant", or as a `Variant`, both with the
        middle of its plausible range; or built with another amplitude."""
        return self._with((*self.effects, *response.given_effects(effects)))

    def of_particle(self) -> MccLaw:
        """The law without what belongs to the instrument (frame, drift, platens)."""
        return self._with(tuple(effect for effect in self.effects if not effect.of_instrument))

    def without_effects(self, *names: str) -> MccLaw:
        """The law without the effects of these names, as `effect.name` gives them; without names, without any."""
        for name in names:
            arguments.choice(name, [effect.name for effect in self.effects], "the name of an effect of the law")
        return self._with(tuple(e for e in self.effects if names and e.name not in names))

    def _with(self, effects: tuple[AbstractEffect, ...]) -> MccLaw:
        # Not by the constructor, which takes one law's numbers only and not those of a batch of laws.
        return eqx.tree_at(lambda law: law.effects, self, effects, is_leaf=lambda x: isinstance(x, tuple) and not x)

    @compiled_whole
    def residual_displacement(self, particle: Particle, history: History) -> Scalar:
        """Displacement [um] that stays after full release, by the formulas without effects."""
        peak = history.displacement_max
        return peak - self.contact(particle).recovered(peak).displacement

    def init(self, particle: Particle, relative_humidity: Scalar | None = None) -> History:
        """A virgin particle at the beginning of its test; relative humidity [%], the reference if None."""
        zero = jnp.zeros_like(particle.D3)
        return History(zero, response.initial_memory(self.effects, zero, relative_humidity) if self.effects else None)

    @compiled_whole
    def step(
        self, particle: Particle, state: History, displacement: Scalar, time: Time = None
    ) -> tuple[History, Scalar]:
        """Force [mN] at the platen displacement [um] (negative: not yet touching) and time [s], and the history after.

        With effects the force that makes `step_load` meet the displacement, or that at which it jumps over it (a law
        that is not monotone, a pop-in); 0 where the platen does not touch.
        """
        if self.effects:
            # What one MPa takes is a scale for a particle that was never loaded.
            scale = jnp.maximum(state.memory.peak_force, particle.force(jnp.ones_like(displacement)))
            arguments = (self, particle, state, time)
            force = response.force_at(_moved, arguments, displacement, scale)
            return self.step_load(particle, state, force, time)[0], force
        peak, force = self.contact(particle).step(state.displacement_max, displacement)
        return History(peak), force

    @compiled_whole
    def step_load(self, particle: Particle, state: History, force: Scalar, time: Time = None) -> tuple[History, Scalar]:
        """Platen displacement [um] under the force [mN] at the time [s], and the history after it.

        A force <= 0 means out of contact: the displacement stays where the platen left the particle.
        """
        if self.effects:
            state, displacement = self.path_load(particle, state, force[None], None if time is None else time[None])
            return state, displacement[0]
        peak, displacement = self.contact(particle).under(state.displacement_max, force, force)
        return History(peak), displacement

    @compiled_whole
    def path(self, particle: Particle, state: History, displacement: Path, time: Times = None) -> tuple[History, Path]:
        """Forces [mN] along a path of displacements [um] at times [s].

        Without effects in closed form over the running maximum, with them by `lax.scan` of `step`.
        """
        if self.effects:
            return super().path(particle, state, displacement, time)
        peak, force = self.contact(particle).path(state.displacement_max, displacement)
        return History(peak), force

    @compiled_whole
    def path_load(self, particle: Particle, state: History, force: Path, time: Times = None) -> tuple[History, Path]:
        """Displacements [um] along a clean path of forces [mN] at times [s], in closed form over the running maximum.

        A scan follows the effects' memories only. For measured, noisy forces make a `Record` and use `respond`.
        """
        if self.effects:
            before, peak_force = state.memory.point, state.memory.peak_force
            time = jnp.broadcast_to(before.time, force.shape) if time is None else time
            humidity = before.relative_humidity
            record = clean_record(force, time, relative_humidity=humidity, before=before, peak_force=peak_force)
            return self._along(particle, state, record)
        peak, displacement = self.contact(particle).under(state.displacement_max, force, running_max(force))
        return History(peak[-1]), displacement

    def respond(self, particle: Particle, record: Record) -> Path:
        """Displacement [um] of a virgin particle along a record: what a fit compares with the measurement."""
        zero = jnp.zeros_like(particle.D3)
        if self.effects:
            memory = response.initial_memory(self.effects, zero, time=record.time[0])
            return self._along(particle, History(zero, memory), record)[1]
        return self.contact(particle).under(zero, record.force, response.peak_forces(record, zero))[1]

    def context(self, particle: Particle, record: Record) -> Context:
        """What effects see along a record, from a virgin particle: the law with modified parameters."""
        zero = jnp.zeros_like(particle.D3)
        return response.context_along(self, self.effects, particle, zero, record, response.peak_forces(record, zero))

    def _along(self, particle: Particle, state: History, record: Record) -> tuple[History, Path]:
        """The history and the displacements [um] after the points of a record, with effects."""
        highest = response.peak_forces(record, state.memory.peak_force)
        context = response.context_along(self, self.effects, particle, state.displacement_max, record, highest)
        own, drivers, added = response.additions(self.effects, state.memory, context)
        last = record, highest, context.peak_displacement
        point, peak_force, peak = jax.tree.map(lambda x: x[-1] if x.ndim else x, last)
        return History(peak, response.Memory(point, peak_force, own, drivers)), context.displacement + added

    @compiled_whole
    def gain_strain(self, particle: Particle, state: History) -> Scalar:
        """Smallest peak strain [-] beyond which the particle, loaded further and released, gains energy.

        Infinite where it does not up to the state's peak, and without damage and densification it never does. Effects
        on parameters and on the modulus at the peak enter; others have no energy in closed form and are left aside.
        """
        at_peak = tuple(e for e in self.effects if isinstance(e, AbstractModulusAtPeak))
        if not at_peak:
            return super().gain_strain(particle, state)
        record = first_point(particle.D3.dtype) if state.memory is None else state.memory.point
        law = functools.reduce(lambda law, effect: effect.modify(law, particle, record), self.effects, self)
        contact_at = functools.partial(_unloading_from, law, at_peak, particle)
        return particle.strain(first_gain(contact_at, state.displacement_max))

    @compiled_whole
    def energy(self, particle: Particle, history: History, displacement: Scalar) -> Energy:
        r"""Energy balance [nJ] at a displacement [um] on the branch that starts at the history's peak.

        .. math:: W_{rec} = \pi R_e^2 D_e\, \sigma_P\, \delta\, g(s), \quad g(0) = \tfrac{4}{3\pi}, \qquad
            W_{diss} = W_{load}(\epsilon_P) - W_{rec}(s = 0)

        A displacement beyond the peak counts as further loading. `InputError` names an effect whose energy has no
        closed form.
        """
        peak = jnp.where(displacement >= history.displacement_max, displacement, history.displacement_max)
        law, at_peak = response.folded(self, self.effects, particle, "the energy")
        contact = _unloading_from(law, at_peak, particle, peak)
        whole, now = contact.stored(peak, peak - displacement)
        dissipated = contact.work(peak) - whole
        return Energy(dissipated + now, now, dissipated)


def _unloading_from(law: Formulas, at_peak: response.AtPeak, particle: Particle, peak: Scalar) -> Contact:
    """The contact that unloads from a peak displacement [um], with the modulus that effects leave it there."""
    contact, strain = law.contact(particle), particle.strain(peak)
    return contact.softened(response.factor_at_peak(at_peak, strain, law.loading_stress(particle, strain)))


def _moved(given: tuple[Any, Particle, History, Time], force: Scalar) -> Scalar:
    law, particle, state, time = given
    return law.step_load(particle, state, force, time)[1]
