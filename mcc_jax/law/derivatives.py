r"""Derivatives of displacement by everything it depends on: of the law with effects, and of every effect at its null.

A program that holds law and formula would be compiled for every formula, and for every pair of them. So the law is
taken in stages,

    parameters -> strain of loading -> peak and recovery -> modulus -> additions,

each a program of its own, and so is each hook of an effect. A stage is given values and their derivatives along some
directions, and passes both on by the chain rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import arguments
from .._numerics import compiled
from .._types import Path, Scalar
from ..effects import AbstractEffect, Context, Record
from ..formulas import Formulas, Plastic, StrainScaling, Unloading
from ..geometry import Particle
from . import response
from .mcc import MccLaw

DIRECTIONS = 12  # as many as two effects with two further numbers each need; fewer are padded, to share programs
INSIDE = "modify", "loading", "stiffness"  # hooks that act on the law itself
SETTLED = 1e-9  # relative step of the strain from which on the last step of Newton's method is exact to rounding


def padded(directions: int) -> int:
    """Number of directions, padding included, that `along` takes where formulas act."""
    return -(-directions // DIRECTIONS) * DIRECTIONS + 1


class Numbers(NamedTuple):
    """Of every test: C1, C3, C5, a and the effective modulus; the force of every point and that from which its branch
    starts [mN]; amplitude and further numbers of each effect."""

    law: Any
    force: Any
    peak: Any
    effects: tuple[Any, ...]


class Formula(NamedTuple):
    """An effect without its numbers, and the names of the fields that are its numbers, the amplitude first."""

    effect: AbstractEffect  # without a label, which would keep equal programs apart
    names: tuple[str, ...]


Forms = tuple[Unloading, StrainScaling]  # of unloading, and of how the shape factor enters it


def along(
    forms: Forms, formulas: Sequence[Formula], particle: Particle, record: Record, numbers: Numbers, directions: Numbers
) -> tuple[Float[Array, "tests points"], Float[Array, "along tests points"]]:
    """Displacement [um] of virgin particles along their tests, and its derivatives along directions of all numbers.

    Particle and record, with its peaks, have an axis of tests; `directions` have a leading axis, and where formulas
    act the last of them is along nothing (`padded`).
    """
    tests, law, d_law = (particle, record), numbers.law, directions.law
    loads, d_loads = (numbers.force, numbers.peak), (directions.force, directions.peak)

    def hook(which: str, k: int, context: Any = (), d_context: Any = ()) -> tuple[Any, Any]:
        given, along = (numbers.effects[k], law, loads, context), (directions.effects[k], d_law, d_loads, d_context)
        return _staged(_hook, given, along, tests, (forms, which, formulas[k]))

    def with_hook(*names: str) -> list[int]:
        return [k for k, formula in enumerate(formulas) if formula.effect.overrides(*names)]

    for k in with_hook("modify"):
        law, d_law = hook("modify", k)
    if loading := with_hook("loading"):
        strain, step = _start(forms, law, loads, particle, []), jnp.inf
        by_strain = np.zeros((len(d_law), *strain.shape))
        by_strain[-1] = 1.0  # the direction along nothing else

        def factors(strain: Any) -> tuple[list[Any], list[Any]]:
            found = [hook("loading", k, strain, by_strain) for k in loading]
            return [one for one, _ in found], [one for _, one in found]

        strain = _start(forms, law, loads, particle, factors(strain)[0])
        for _ in range(response.NEWTON_STEPS):
            strain, step = _newton(forms, law, loads, particle, (strain, *factors(strain)))
            if not arguments.is_traced(step) and step < SETTLED:
                break
        reached, d_reached = _reached(forms, law, loads, tests, (strain, *factors(strain)), (d_law, d_loads))
        given, directed = (law, loads, reached, []), (d_law, d_loads, d_reached, [])
        context, d_context = _staged(_released, given, directed, tests, forms)
    else:
        context, d_context = _staged(_base, (law, loads), (d_law, d_loads), tests, forms)
    if stiffening := with_hook("stiffness"):
        values, slopes = zip(*(hook("stiffness", k, context, d_context) for k in stiffening), strict=True)
        given, directed = (law, loads, context[0], values), (d_law, d_loads, d_context[0], slopes)
        context, d_context = _staged(_released, given, directed, tests, forms)
    total, slopes = context[2], d_context[2]
    for k in with_hook("inside", "observe"):
        added, d_added = hook("added", k, context, d_context)
        total, slopes = total + added, slopes + d_added
    return total, slopes


@compiled
def _staged(stage: Callable[..., Any], given: Any, directions: Any, tests: Any, form: Any) -> tuple[Any, Any]:
    """A stage of every test and its derivatives along directions of what it is given."""

    def every(given: Any) -> Any:
        return jax.vmap(lambda one, test: stage(one, *test, form))(given, tests)

    value, push = jax.linearize(every, given)
    return value, jax.vmap(push)(directions)


def _law(numbers: Array, forms: Forms) -> Formulas:
    C1, C3, C5, a, modulus = numbers
    return Formulas(Plastic(C1, C3, C5), a, modulus, *forms)


def _loaded(
    law: Array, loads: Any, particle: Particle, record: Record, forms: Forms
) -> tuple[Particle, Formulas, Record, Path]:
    """What a context begins with: particle, law, record, and the force from which every branch starts."""
    record = eqx.tree_at(lambda r: (r.force, r.peak), record, loads)
    return particle, _law(law, forms), record, response.peak_forces(record, jnp.zeros_like(particle.D3))


def _base(given: Any, particle: Particle, record: Record, forms: Forms) -> tuple[Path, Path, Path]:
    numbers, loads = given
    _, law, record, highest = _loaded(numbers, loads, particle, record, forms)
    reached, moved = law.contact(particle).under(jnp.zeros_like(particle.D3), record.force, highest)
    return reached, law.recoverable_displacement(particle, reached, highest, jnp.ones_like(reached)), moved


def _released(given: Any, particle: Particle, record: Record, forms: Forms) -> tuple[Path, Path, Path]:
    law, loads, reached, factors = given
    particle, formulas, record, highest = _loaded(law, loads, particle, record, forms)
    context = response.released(Context(particle, formulas, record, highest, reached, reached, reached), factors)
    return reached, context.recoverable, context.displacement


def _hook(given: Any, particle: Particle, record: Record, form: tuple[Forms, str, Formula]) -> Any:
    """One hook of an effect with its numbers."""
    numbers, law, loads, moved = given
    forms, which, formula = form
    effect = replace(formula.effect, **dict(zip(formula.names, numbers, strict=True)))
    loaded = _loaded(law, loads, particle, record, forms)
    if which == "modify":
        changed = effect.modify(loaded[1], particle, record)
        plastic = changed.plastic
        return jnp.stack([plastic.C1, plastic.C3, plastic.C5, changed.a, changed.effective_modulus])
    if which == "loading":
        return effect.loading(loaded[1], particle, loaded[2], moved)
    context = Context(*loaded, *moved)
    if which == "stiffness":
        return effect.stiffness(context)
    before = response.initial_memory((effect,), jnp.zeros_like(particle.D3), time=record.time[0])
    return response.additions((effect,), before, context)[-1]


def _stress(particle: Particle, loads: Any) -> Path:
    stress = particle.stress(loads[0])
    return jnp.where(stress >= 0, stress, 0.0)


@compiled
def _start(forms: Forms, law: Array, loads: Any, particle: Particle, factors: list[Any]) -> Array:
    """Strain of loading at every force, the factors taken as independent of strain."""
    return jax.vmap(
        lambda law, loads, particle, f: response.base_strain(_law(law, forms), particle, _stress(particle, loads), f)
    )(law, loads, particle, factors)


@compiled
def _newton(forms: Forms, law: Array, loads: Any, particle: Particle, there: Any) -> tuple[Array, Array]:
    """A step of Newton's method, and how long it was at most, relative to the strain."""
    strain, factors, slopes = there

    def one(law: Array, loads: Any, particle: Particle, *at: Any) -> Array:
        return response.newton_step(_law(law, forms), particle, _stress(particle, loads), *at)

    new = jax.vmap(one)(law, loads, particle, strain, factors, jax.tree.map(lambda x: x[-1], slopes))
    return new, jnp.max(jnp.abs(new - strain) / jnp.where(strain > 0, strain, 1.0))


@compiled
def _reached(forms: Forms, law: Array, loads: Any, tests: Any, there: Any, directions: Any) -> tuple[Array, Array]:
    """Largest displacement so far, and its derivatives by the implicit-function rule at the strain of loading."""
    particle, (strain, factors, slopes) = tests[0], there

    def residual(given: Any, particle: Particle, strain: Array, _: Any) -> Array:
        law, loads, factors = given
        return response.stress_at(_law(law, forms), particle, strain, factors) - _stress(particle, loads)

    def peak(given: Any, particle: Particle, record: Record, _: Any) -> Array:
        strain, *loads = given
        _, _, record, highest = _loaded(law[0], loads, particle, record, forms)
        return response.peak_displacement(particle, record, highest, strain, jnp.zeros_like(particle.D3))

    off, change = _staged(residual, (law, loads, factors), (*directions, slopes), (particle, strain), None)
    by_strain = jax.tree.map(lambda x: x[-1], slopes)
    slope_at = jax.vmap(lambda law, *at: response.slope_at(_law(law, forms), *at))
    slope = slope_at(law, particle, strain, factors, by_strain)
    given, along = (strain - off / slope, *loads), (-change / slope[None], *directions[1])
    return _staged(peak, given, along, tests, None)


def signatures(base: MccLaw, particle: Particle, record: Record, effects: Sequence[AbstractEffect]) -> Array:
    r"""Derivatives of the displacement by the amplitude of each effect at zero [um per unit], shape (effects, steps).

    The same as one `jax.jvp` of `base.with_effects(effect).respond` per effect, at a fraction of what that takes to
    compile: at the null every effect acts through its own first-order change of parameters, loading strain, modulus and
    displacement, and all share one pass through the law,

    .. math:: \frac{\partial\gamma}{\partial\theta_k} = \frac{\partial\gamma}{\partial p}\cdot\frac{\partial p}
        {\partial\theta_k} + \frac{\partial\Delta_k}{\partial\theta_k}.

    Batch it over particles with `equinox.filter_vmap`. The amplitudes that the effects have are not used.
    """
    if not effects:
        return jnp.zeros((0, *record.force.shape), record.force.dtype)
    law = replace(base, effects=())
    context = law.context(particle, record)
    strain, zero_um = _virgin_strain(law, context), jnp.zeros_like(particle.D3)
    slope = response.slope_at(law, particle, strain, [], [])

    def changes(effect: AbstractEffect) -> tuple[Any, Path]:
        """First-order change of parameters, loading strain and modulus if it acts there, and of what is added."""
        loads, inside = effect.overrides("loading"), effect.overrides(*INSIDE)

        def act(amplitude: Scalar) -> tuple[Any, Any, Any, Path]:
            own = eqx.tree_at(lambda e: e.amplitude, effect, amplitude)
            changed = eqx.filter(own.modify(law, particle, record), eqx.is_inexact_array) if inside else None
            factors = own.loading(law, particle, record, strain) if loads else None
            start = response.initial_memory((own,), zero_um, time=record.time[0])
            added = response.additions((own,), start, context)[-1]
            return changed, factors, own.stiffness(context) if inside else None, added

        zero = jnp.zeros_like(effect.amplitude)
        changed, factors, stiffness, added = jax.jvp(act, (zero,), (jnp.ones_like(zero),))[1]
        shift = -response.stress_at(law, particle, strain, [factors]) / slope if loads else jnp.zeros_like(strain)
        return (changed, shift, stiffness) if inside else None, added

    groups: dict[object, list[int]] = {}
    effects = [replace(effect, label="") for effect in effects]  # which would keep apart what is compiled at once
    for i, effect in enumerate(effects):
        groups.setdefault((type(effect), jax.tree.structure(effect)), []).append(i)
    order: list[int] = []
    rows, directions, further = [], [], []
    for members in sorted(groups.values(), key=lambda members: effects[members[0]].overrides(*INSIDE)):
        alike = [jax.tree.map(jnp.asarray, effects[i]) for i in members]
        inside, added = jax.vmap(changes)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike))
        order += members
        if inside is None:
            rows.append(added)
        else:
            directions.append(inside)
            further.append(added)
    if directions:
        parameters, rest = eqx.partition(law, eqx.is_inexact_array)

        def displaced(parameters: Any, shift: Path, stiffness: Path) -> Path:
            return _response(eqx.combine(parameters, rest), context, shift, stiffness)

        _, push = jax.linearize(displaced, parameters, jnp.zeros_like(strain), jnp.ones_like(strain))
        along = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *directions)
        rows.append(jax.vmap(push)(*along) + jnp.concatenate(further))
    return jnp.concatenate(rows)[np.argsort(order)]


def _virgin_strain(law: Formulas, context: Context) -> Path:
    """Strain of virgin loading at every force, whatever was before."""
    return response.base_strain(law, context.particle, _stress(context.particle, (context.record.force,)))


def _response(law: Formulas, context: Context, shift: Path, stiffness: Path) -> Path:
    """Displacement of a virgin particle whose loading strain is shifted and whose modulus has a factor."""
    particle, record, highest = context.particle, context.record, context.peak_force
    strain = _virgin_strain(law, context) + shift
    peak = response.peak_displacement(particle, record, highest, strain, jnp.zeros_like(particle.D3))
    return response.released(Context(particle, law, record, highest, *(peak,) * 3), [stiffness]).displacement
