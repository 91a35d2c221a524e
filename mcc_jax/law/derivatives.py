"""What one unit of each effect would add to a measured curve, to first order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import arguments
from .._types import Path, Scalar
from ..effects import AbstractEffect, Context, Record
from ..formulas import Formulas, recovery, tangent_modulus
from ..geometry import Particle
from .mcc import MccLaw
from .response import additions, no_memory, since_peak


def signatures(
    base: MccLaw, particle: Particle, record: Record, effects: Sequence[AbstractEffect]
) -> Float[Array, "effects steps"]:
    r"""Derivatives of the displacement by the amplitude of each effect, all amplitudes being zero.

    The same as one `jax.jvp` of `base.with_effects(effect).respond` per effect, at a fraction of what that takes to
    compile: at the null every effect acts through its own first-order change of parameters, loading strain, modulus and
    displacement, and all share one pass through the law,

    .. math:: \frac{\partial\gamma}{\partial\theta_k} = \frac{\partial\gamma}{\partial p}\cdot\frac{\partial p}
        {\partial\theta_k} + \frac{\partial\Delta_k}{\partial\theta_k}.

    Batch it over particles with `equinox.filter_vmap`.

    Args:
        base: the law.
        particle: the particle.
        record: its test.
        effects: one for every point of every variant's grid; their amplitudes are taken as zero.

    Returns:
        Derivatives [um per unit of amplitude].
    """
    arguments.instance(base, MccLaw, "base", "Take mcc_jax.paper_law(), or the law of a calibration.")
    arguments.instance(particle, Particle, "particle", "Make one with mcc_jax.Particle(D1, D2, D3), in um.")
    arguments.instance(record, Record, "record", "Make one with mcc_jax.effects.record_of(curve).")
    context = replace(base, effects=()).context(particle, record)
    formulas = base.formulas
    strain = _virgin_strain(formulas, context)
    x, zero_um = formulas.shape_factor(particle) * strain, jnp.zeros_like(particle.D3)
    K1, K3, K5 = formulas.plastic.polynomial
    slope = tangent_modulus(K1, K3, K5, x) * formulas.shape_factor(particle)
    least = 1e-3 * K1 * formulas.shape_factor(particle)
    slope = jnp.where(slope > least, slope, least)

    def changes(effect: AbstractEffect) -> tuple[Any, Path, Path, Path]:
        """First-order change of the law's parameters, of loading strain, of the modulus, and what is added."""

        def act(amplitude: Scalar) -> tuple[Any, Any, Path, Path]:
            own = eqx.tree_at(lambda e: e.amplitude, effect, amplitude)
            law = eqx.filter(own.modify(formulas, particle, record), eqx.is_inexact_array)
            start = eqx.tree_at(lambda m: m.point.time, no_memory((own,), zero_um), record.time[0])
            added = additions((own,), start, context)[1]
            return law, own.loading(formulas, particle, record, strain), own.stiffness(context), added

        zero = jnp.zeros_like(effect.amplitude)
        law, (f1, f3, f5), stiffness, added = jax.jvp(act, (zero,), (jnp.ones_like(zero),))[1]
        square = x * x
        shift = -x * (K1 * f1 - square * (K3 * f3 - square * (K5 * f5))) / slope
        return law, shift, stiffness, added

    if not effects:
        return jnp.zeros((0, *record.force.shape), record.force.dtype)
    groups: dict[object, list[int]] = {}
    effects = [replace(effect, label="") for effect in effects]  # which would keep apart what is compiled at once
    for i, effect in enumerate(effects):
        groups.setdefault((type(effect), jax.tree.structure(effect)), []).append(i)
    order, parts = [], []
    for members in groups.values():
        alike = [jax.tree.map(jnp.asarray, effects[i]) for i in members]
        parts.append(jax.vmap(changes)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *alike)))
        order.extend(members)
    law, shift, stiffness, added = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    parameters, rest = eqx.partition(formulas, eqx.is_inexact_array)
    still, one = jnp.zeros_like(strain), jnp.ones_like(strain)

    def response(parameters: Any, shift: Path, stiffness: Path) -> Path:
        return _response(eqx.combine(parameters, rest), context, shift, stiffness)

    _, push = jax.linearize(response, parameters, still, one)
    rows = jax.vmap(push)(law, shift, stiffness) + added
    return rows[jnp.argsort(jnp.asarray(order))]


def _virgin_strain(law: Formulas, context: Context) -> Path:
    """Strain of virgin loading at every force, whatever was before."""
    particle = context.particle
    return law.plastic.strain(particle.stress(context.record.force)) / law.shape_factor(particle)


def _response(law: Formulas, context: Context, shift: Path, stiffness: Path) -> Path:
    """Displacement of a virgin particle whose loading strain is shifted and whose modulus has a factor."""
    particle, record = context.particle, context.record
    virgin = record.force >= context.peak_force
    strain = _virgin_strain(law, context) + shift
    peak = since_peak(record)(jnp.where(virgin, particle.displacement(strain), 0.0))
    recoverable = law.recoverable_displacement(particle, peak, context.peak_force, stiffness)
    return peak - jnp.where(record.force < context.peak_force, recoverable * recovery(context.load_share), 0.0)
