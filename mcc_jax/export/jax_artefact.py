"""JAX artefacts: the law as serialised StableHLO, which runs where JAX is and this library is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import arguments
from .._errors import InputError
from ..geometry import Particle
from ..law import History, MccLaw, Plastic
from .origin import checked
from .respond import respond

Which = Literal["force", "step", "step_each"]
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
SIGNATURES: dict[str, dict[str, Any]] = {
    "force": {
        "arguments": ["displacement_um (b,)", "displacement_max_um (b,)"],
        "results": ["force_mN (b,)"],
        "of": "the particle of this export",
    },
    "step": {
        "arguments": ["displacement_um (b,)", "displacement_max_um (b,)"],
        "results": ["force_mN (b,)", "tangent_mN_per_um (b,)", "displacement_max_um after the step (b,)"],
        "of": "the particle of this export",
    },
    "step_each": {
        "arguments": [
            "displacement_um (b,)",
            "displacement_max_um (b,)",
            "diameters_um D1, D2, D3 (b, 3)",
            "coefficients C1, C3, C5 (b, 3)",
        ],
        "results": ["force_mN (b,)", "tangent_mN_per_um (b,)", "displacement_max_um after the step (b,)"],
        "of": "particles of any size, each with coefficients of its own; a and the modulus are those of this export",
    },
}


@dataclass(frozen=True)
class Artefact:
    """A serialised function.

    Attributes:
        name: which function and precision.
        content: what `jax.export.deserialize` takes.
        signature: arguments, results, precision, platforms.
    """

    name: str
    content: bytes
    signature: dict[str, Any]


def jax_artefact(
    law: MccLaw,
    particle: Particle,
    which: Which = "step",
    *,
    dtype: Literal["float64", "float32"] = "float64",
    platforms: Sequence[str] = PLATFORMS,
) -> Artefact:
    """A function of many contacts at once, serialised by `jax.export` with its reverse-mode derivative.

    The number of contacts b is symbolic: one artefact serves every batch size. To use it, with jax and flatbuffers:

        step = jax.export.deserialize(bytearray(Path(file).read_bytes())).call
        force, tangent, displacement_max = step(displacement, displacement_max)

    Args:
        law: the law, whose numbers become constants.
        particle: its size, likewise (not for `step_each`).
        which: `force`, `step` (force, tangent, history) or `step_each` (the same, sizes and C1, C3, C5 as arguments).
        dtype: precision of arguments, results and constants; float64 needs `jax_enable_x64` here and where it runs.
        platforms: for which JAX lowers it.

    Raises:
        InputError: if float64 is wanted and JAX is in single precision.
    """
    checked(law, particle)
    arguments.choice(which, SIGNATURES, "which")
    arguments.choice(dtype, ("float64", "float32"), "dtype")
    if isinstance(platforms, str) or not platforms:
        raise InputError(f"platforms must be a list of names, got {platforms!r}", remedy=f"Some of {PLATFORMS}.")
    for name in platforms:
        arguments.choice(name, PLATFORMS, "platform")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            "JAX is in single precision", remedy='Call jax.config.update("jax_enable_x64", True) or take float32'
        )
    law, particle = (
        jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree) for tree in (law, particle)
    )
    (batch,) = jax.export.symbolic_shape("b")
    one = jax.ShapeDtypeStruct((batch,), jnp.dtype(dtype))
    triple = jax.ShapeDtypeStruct((batch, 3), jnp.dtype(dtype))
    inputs = (one, one, triple, triple) if which == "step_each" else (one, one)
    exported = jax.export.export(jax.jit(_function(law, particle, which)), platforms=tuple(platforms))(*inputs)
    signature = {
        **SIGNATURES[which],
        "dtype": dtype,
        "batch_size": "symbolic",
        "reverse_mode": "one order",
        "platforms": list(exported.platforms),
        "calling_convention_version": exported.calling_convention_version,
        "jax": jax.__version__,
    }
    return Artefact(f"{which}_{dtype}", bytes(exported.serialize(vjp_order=1)), signature)


def _function(law: MccLaw, particle: Particle, which: Which) -> Callable[..., Any]:
    def step(displacement: jax.Array, displacement_max: jax.Array) -> Any:
        return jax.vmap(lambda x, past: respond(law, particle, x, past))(displacement, displacement_max)

    def force(displacement: jax.Array, displacement_max: jax.Array) -> Any:
        def one(x: jax.Array, past: jax.Array) -> jax.Array:
            return law.step(particle, History(past), x)[1]

        return jax.vmap(one)(displacement, displacement_max)

    def each(x: jax.Array, past: jax.Array, diameters: jax.Array, coefficients: jax.Array) -> Any:
        own = eqx.tree_at(lambda tree: tree.plastic, law, Plastic(*coefficients))
        return respond(own, Particle(*diameters), x, past)

    return {"force": force, "step": step, "step_each": jax.vmap(each)}[which]
