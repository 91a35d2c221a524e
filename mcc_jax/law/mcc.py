"""The loading-unloading contact law of micro-crystalline cellulose particles, with the effects it may have."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import arguments
from .._errors import InputError
from .._format import described, value_of
from .._numerics import compiled_whole, running_max
from .._types import Flag, Path, Scalar, scalar
from ..effects import AbstractEffect, AbstractModulusAtPeak, Context, Record, Variant, clean_record, find_variant
from ..effects.record import first_point
from ..formulas import Contact, Formulas
from ..geometry import Particle
from .base import AbstractContactLaw
from .passivity import first_gain
from .response import (
    factor_at_peak,
    folded,
    force_at,
    hold_virgin,
    initial_memory,
    modified,
    one_point,
    peak_forces,
    whole_path,
)

TESTED_STRAIN = 0.67
"""Scaled strain eta_p eps at which the paper's tests ended, on its mean curve (peaks of 7 to 16 MPa)."""


class History(eqx.Module):
    """What a particle remembers: the largest platen displacement, and with effects what they remember.

    Attributes:
        displacement_max: largest displacement so far [um]; 0 for a virgin particle. With effects that of the law
            itself, without what they add.
        memory: what effects and instrument remember (`Memory`); None for a law without effects.
    """

    displacement_max: Scalar = eqx.field(converter=scalar)
    memory: Any = None

    __repr__ = described(displacement_max="um")


class Energy(eqx.Module):
    """Energy balance of one particle [nJ]; `work = recoverable + dissipated`.

    Attributes:
        work: work done by the platens up to now.
        recoverable: what the particle would still give back on full release.
        dissipated: what is lost for good; unchanged by unloading and reloading.
    """

    work: Scalar
    recoverable: Scalar
    dissipated: Scalar

    __repr__ = described(work="nJ", recoverable="nJ", dissipated="nJ")


def _told(effect: AbstractEffect) -> str:
    """An effect with the name and the unit of its amplitude, where a formula of the library made it."""
    try:
        variant = find_variant(effect.label)
    except InputError:
        return repr(effect)
    unit = "" if variant.unit == "-" else f" {variant.unit}"
    others = [f"{n.name} {value_of(getattr(effect, n.name))}" for n in variant.nuisances if hasattr(effect, n.name)]
    return ", ".join([f"{effect.label}: {variant.parameter} {value_of(effect.amplitude)}{unit}", *others])


def _effects(value: Any) -> tuple[AbstractEffect, ...]:
    remedy = 'Take law.with_effects("creep"), or mcc_jax.effects.find_variant("creep").build(0.02).'
    if isinstance(value, str | AbstractEffect) or not isinstance(value, Iterable):
        raise InputError(f"effects must be a list of effects, got {arguments.kind_of(value)}", remedy=remedy)
    return tuple(value)


class MccLaw(Formulas, AbstractContactLaw[History]):
    r"""Plastic loading along a quintic, elastic unloading and reloading along an arcsine branch, and effects.

    With :math:`\epsilon = \gamma/D_e`, :math:`\sigma = F/(\pi R_e^2)`, :math:`\eta_p` from `plastic_shape_factor` and
    :math:`(\epsilon_P, \sigma_P)` the largest strain so far and its stress,

    .. math::
        \sigma &= C_1 \eta_p\epsilon - (C_3 \eta_p\epsilon)^3 + (C_5 \eta_p\epsilon)^5
            && \text{plastic loading},\ \epsilon \ge \epsilon_P \\
        \sigma &= \tfrac{2}{\pi} \sigma_P \left[\arccos s - s\sqrt{1 - s^2}\right],\quad
            s = (\epsilon_P - \epsilon)/\delta && \text{elastic unloading and reloading}

    and zero once s >= 1 (`formulas.Contact`). The recovered strain :math:`\delta` has three forms (`Unloading`) and
    three ways in which :math:`\eta_p` enters (`StrainScaling`); the defaults are the paper's. Rate independent, no
    adhesion.

    `effects` act on it together. Under load control, the primary form,

    .. math:: \gamma(F, t) = \gamma_{law}(F;\, \text{modified parameters}) + \sum_k \Delta_k(F, t),

    and displacement control solves it for the force. Amplitudes of zero change nothing. With effects, methods that
    advance the law take times [s] as well; None stands for a test in which no time passes.

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
        effects: what acts in addition to the formulas above; their order does not matter beyond rounding.

    Raises:
        InputError: for a plain number out of its range, or an unknown form.

    References:
        Bommireddy et al. (2018), eqs. 16, 23 and 24.
    """

    effects: tuple[AbstractEffect, ...] = eqx.field(converter=_effects, default=())

    def _rows(self) -> list[tuple[str, str]]:
        return [*super()._rows(), *(("effect", _told(effect)) for effect in self.effects)]

    @property
    def is_valid(self) -> Flag:
        """Whether C1, C5 and the modulus are positive, C3 is not negative, and every number is finite."""
        valid = self.formulas.is_valid
        for leaf in jax.tree.leaves(eqx.filter(self.effects, eqx.is_inexact_array)):
            valid = valid & jnp.all(jnp.isfinite(leaf))
        return valid

    @property
    def formulas(self) -> Formulas:
        """The law's parameters alone, without effects."""
        return Formulas(self.plastic, self.a, self.effective_modulus, self.unloading, self.strain_scaling)

    # ---- effects -----------------------------------------------------------------------------------------------------

    def with_effects(self, *effects: Any) -> MccLaw:
        """The law with further effects.

        Args:
            effects: each by name, "mechanism" or "mechanism:variant" of `mcc_jax.effects.LIBRARY`, or a `Variant`, both
                with the middle of its plausible range; or an effect built with an amplitude of one's own.
        """
        return self._with((*self.effects, *(_one_effect(effect) for effect in effects)))

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

    # ---- peak --------------------------------------------------------------------------------------------------------

    def internal_variables(self, particle: Particle, history: History) -> tuple[Scalar, Scalar]:
        r"""The paper's :math:`(\epsilon_P, \sigma_P)`: largest strain [-] and its stress [MPa]."""
        strain_max = particle.strain(history.displacement_max)
        return strain_max, self.loading_stress(particle, strain_max)

    @compiled_whole
    def residual_displacement(self, particle: Particle, history: History) -> Scalar:
        """Displacement [um] that stays after full release, by the formulas without effects."""
        peak = history.displacement_max
        return peak - self.contact(particle).recovered(peak).displacement

    # ---- force and displacement --------------------------------------------------------------------------------------

    def init(self, particle: Particle, relative_humidity: Scalar | None = None) -> History:
        """A virgin particle at the beginning of its test; relative humidity [%] of the room, the reference if None."""
        zero = jnp.zeros_like(particle.D3)
        return History(zero, initial_memory(self.effects, zero, relative_humidity) if self.effects else None)

    @compiled_whole
    def step(
        self, particle: Particle, state: History, displacement: Scalar, time: Scalar | None = None
    ) -> tuple[History, Scalar]:
        """Force [mN] at the platen displacement [um] (negative: not yet touching) and time [s], and the history after.

        With effects: the force that makes `step_load` meet the displacement, which must grow with force; 0 where the
        platen does not touch. Where it jumps (a law that is not monotone, a pop-in), the force stays at that of the
        jump.
        """
        if self.effects:
            # What one MPa takes is a scale for a particle that was never loaded.
            scale = jnp.maximum(state.memory.peak_force, particle.force(jnp.ones_like(displacement)))
            arguments = (self, particle, state, time)
            force = force_at(_moved, arguments, displacement, scale)
            return self.step_load(particle, state, force, time)[0], force
        peak, force = self.contact(particle).step(state.displacement_max, displacement)
        return History(peak), force

    @compiled_whole
    def step_load(
        self, particle: Particle, state: History, force: Scalar, time: Scalar | None = None
    ) -> tuple[History, Scalar]:
        """Platen displacement [um] under the force [mN] at the time [s], and the history after it.

        A force <= 0 means out of contact: the displacement stays where the platen left the particle.
        """
        if self.effects:
            now: Scalar = state.memory.point.time if time is None else time
            peak, memory, displacement = one_point(
                self.formulas, self.effects, particle, state.displacement_max, state.memory, force, now
            )
            return History(peak, memory), displacement
        peak, displacement = self.contact(particle).under(state.displacement_max, force, force)
        return History(peak), displacement

    @compiled_whole
    def path(
        self, particle: Particle, state: History, displacement: Path, time: Path | None = None
    ) -> tuple[History, Path]:
        """Forces [mN] along a path of displacements [um] at times [s].

        Without effects in closed form over the running maximum, with them by `lax.scan` of `step`.
        """
        if self.effects:
            return super().path(particle, state, displacement, time)
        peak, force = self.contact(particle).path(state.displacement_max, displacement)
        return History(peak), force

    @compiled_whole
    def path_load(
        self, particle: Particle, state: History, force: Path, time: Path | None = None
    ) -> tuple[History, Path]:
        """Displacements [um] along a clean path of forces [mN] at times [s], in closed form over the running maximum.

        A scan follows the effects' memories only. For measured, noisy forces make a `Record` and use `respond`.
        """
        if self.effects:
            before = state.memory.point
            time = jnp.broadcast_to(before.time, force.shape) if time is None else time
            humidity = before.relative_humidity
            peak_force = state.memory.peak_force
            record = clean_record(force, time, relative_humidity=humidity, before=before, peak_force=peak_force)
            return self._along(particle, state, record)
        peak, displacement = self.contact(particle).under(state.displacement_max, force, running_max(force))
        return History(peak[-1]), displacement

    def respond(self, particle: Particle, record: Record) -> Path:
        """Displacement [um] of a virgin particle along a record: what a fit compares with the measurement."""
        state = self.init(particle)
        if self.effects:
            state = eqx.tree_at(lambda s: s.memory.point.time, state, record.time[0])
            return self._along(particle, state, record)[1]
        zero = state.displacement_max
        return self.contact(particle).under(zero, record.force, peak_forces(record, zero))[1]

    def context(self, particle: Particle, record: Record) -> Context:
        """What effects see along a record, from a virgin particle: the law with modified parameters."""
        zero = jnp.zeros_like(particle.D3)
        return modified(
            self.formulas, self.effects, particle, zero, record, peak_forces(record, zero), hold_virgin(record)
        )

    def _along(self, particle: Particle, state: History, record: Record) -> tuple[History, Path]:
        peak, memory, displacement = whole_path(
            self.formulas, self.effects, particle, state.displacement_max, state.memory, record
        )
        return History(peak, memory), displacement

    # ---- energy ------------------------------------------------------------------------------------------------------

    @compiled_whole
    def gain_strain(self, particle: Particle, state: History) -> Scalar:
        """Smallest peak strain [-] beyond which the particle, loaded further and released, gains energy.

        Infinite where it does not up to the state's peak, and without damage and densification it never does. Methods
        that advance the law do not ask; `simulate.drive` does. Effects on parameters and on the modulus at the peak
        enter; others (cyclic damage, rates, creep) have no energy in closed form and are left aside.
        """
        at_peak = tuple(e for e in self.effects if isinstance(e, AbstractModulusAtPeak))
        if not at_peak:
            return super().gain_strain(particle, state)
        record = first_point(particle.D3.dtype) if state.memory is None else state.memory.point
        formulas = self.formulas
        for effect in self.effects:
            formulas = effect.modify(formulas, particle, record)
        contact_at = functools.partial(_unloading_from, formulas, at_peak, particle)
        return particle.strain(first_gain(contact_at, state.displacement_max))

    @compiled_whole
    def energy(self, particle: Particle, history: History, displacement: Scalar) -> Energy:
        r"""Energy balance [nJ] at a displacement [um] on the branch that starts at the history's peak.

        .. math:: W_{rec} = \pi R_e^2 D_e\, \sigma_P\, \delta\, g(s), \quad g(0) = \tfrac{4}{3\pi}, \qquad
            W_{diss} = W_{load}(\epsilon_P) - W_{rec}(s = 0)

        A displacement beyond the peak counts as further loading. Effects on parameters and on the modulus at the peak
        enter.

        Raises:
            InputError: naming another effect, whose energy has no closed form.
        """
        peak = jnp.where(displacement >= history.displacement_max, displacement, history.displacement_max)
        formulas, at_peak = folded(self.formulas, self.effects, particle, "the energy")
        contact = _unloading_from(formulas, at_peak, particle, peak)
        whole, now = contact.stored(peak, peak - displacement)
        dissipated = contact.work(peak) - whole
        return Energy(dissipated + now, now, dissipated)


def _unloading_from(
    law: Formulas, at_peak: tuple[AbstractModulusAtPeak, ...], particle: Particle, peak: Scalar
) -> Contact:
    """The contact that unloads from a peak displacement [um], with the modulus that effects leave it there."""
    contact, strain = law.contact(particle), particle.strain(peak)
    return contact.softened(factor_at_peak(at_peak, strain, law.loading_stress(particle, strain)))


def _moved(given: tuple[Any, Particle, History, Scalar | None], force: Scalar) -> Scalar:
    law, particle, state, time = given
    return law.step_load(particle, state, force, time)[1]


def _one_effect(effect: Any) -> AbstractEffect:
    if isinstance(effect, str):
        effect = find_variant(effect)
    if isinstance(effect, Variant):
        return effect.build(effect.typical)
    if not isinstance(effect, AbstractEffect):
        remedy = 'Give a name such as "creep:logarithmic", a Variant, or what its build(amplitude) makes.'
        raise InputError(
            f"an effect must be a name, a Variant or an effect, got {arguments.kind_of(effect)}", remedy=remedy
        )
    return effect
