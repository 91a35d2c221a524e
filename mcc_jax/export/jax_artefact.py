"""JAX artefacts: the law as serialised StableHLO, which runs where JAX is and this library is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp

from .. import arguments
from .._errors import InputError
from .._extras import extra
from .._format import described
from ..geometry import Particle
from ..law import History, MccLaw, Plastic
from .origin import check

Which = Literal["force", "step", "step_each", "step_load"]
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
_OWN = "the particle of this export"
_ALL = "particles of any size, each with coefficients of its own; a and the modulus are those of this export"


def signatures(law: MccLaw) -> dict[Which, dict[str, Any]]:
    """The functions there are of a law, with arguments and results; effects need time and a memory."""
    x, past, F = "displacement_um (b,)", "displacement_max_um (b,)", "force_mN (b,)"
    second = "time_s (b,)" if law.effects else past
    each = ["diameters_um D1, D2, D3 (b, 3)", "coefficients C1, C3, C5 (b, 3)"]
    memory = ["what `memory` lists, one by one"] if law.effects else []
    results = [F, "tangent_mN_per_um (b,)", *(memory or [f"{past} after the step"])]
    step = {"arguments": [x, second, *memory], "results": results, "of": _OWN}
    step_each = {"arguments": [x, second, *each, *memory], "results": results, "of": _ALL}
    if law.effects:
        step_load = {"arguments": [F, second, *memory], "results": [x, *memory], "of": _OWN}
        return {"step_load": step_load, "step": step, "step_each": step_each}
    force = {"arguments": [x, past], "results": [F], "of": _OWN}
    return {"force": force, "step": step, "step_each": step_each}


@dataclass(frozen=True)
class Artefact:
    """A serialised function: its name, what `jax.export.deserialize` takes, and its arguments and results in words."""

    name: str
    content: bytes
    signature: dict[str, Any]

    __repr__ = described()


def jax_artefact(
    law: MccLaw, particle: Particle, which: Which = "step", *, dtype: Literal["float64", "float32"] = "float64"
) -> Artefact:
    """A function of many contacts at once, serialised by `jax.export` with its reverse-mode derivative.

    The number of contacts b is symbolic: one artefact serves every batch size. To use it, with jax and flatbuffers:

        step = jax.export.deserialize(bytearray(Path(file).read_bytes())).call
        force, tangent, displacement_max = step(displacement, displacement_max)

    The memory of effects is a list of arrays, in and out of every step; `signature["memory"]` names them with what they
    are for a virgin particle:

        memory = [jnp.full((b, *m["shape"]), m["start"], m["dtype"]) for m in signature["memory"]]
        force, tangent, *memory = step(displacement, time, *memory)

    Args:
        law, particle: their numbers become constants, those of the particle not in `step_each`.
        which: `force`, `step` (force, tangent, history) or `step_each` (the same, sizes and C1, C3, C5 as arguments);
            of a law with effects `step`, `step_each` or `step_load` (displacement under a force).
        dtype: precision of arguments, results and constants; float64 needs `jax_enable_x64` here and where it runs.
    """
    with extra("export"):
        import flatbuffers  # noqa: F401
    check(law, particle)
    functions = signatures(law)
    arguments.choice(which, functions, "which")
    arguments.choice(dtype, ("float64", "float32"), "dtype")
    if dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        remedy = 'Call jax.config.update("jax_enable_x64", True) or take float32'
        raise InputError("JAX is in single precision", remedy=remedy)
    law, particle = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, (law, particle))
    start, structure = jax.tree_util.tree_flatten_with_path(law.init(particle))
    (batch,) = jax.export.symbolic_shape("b")
    one, triple = (jax.ShapeDtypeStruct((batch, *shape), jnp.dtype(dtype)) for shape in ((), (3,)))
    inputs = [one, one, triple, triple] if which == "step_each" else [one, one]
    memory = {}
    if law.effects:
        inputs += [jax.ShapeDtypeStruct((batch, *leaf.shape), leaf.dtype) for _, leaf in start]
        named = [(jax.tree_util.keystr(path).removeprefix("."), leaf) for path, leaf in start]
        rows = [{"name": n, "shape": [*x.shape], "dtype": str(x.dtype), "start": x.tolist()} for n, x in named]
        memory = {"memory": rows}
    function = jax.jit(jax.vmap(_function(law, particle, which, structure)))
    exported = jax.export.export(function, platforms=PLATFORMS)(*inputs)
    signature = {
        **functions[which],
        **memory,
        "dtype": dtype,
        "batch_size": "symbolic",
        "reverse_mode": "one order",
        "platforms": list(exported.platforms),
        "calling_convention_version": exported.calling_convention_version,
        "jax": jax.__version__,
    }
    return Artefact(f"{which}_{dtype}", bytes(exported.serialize(vjp_order=1)), signature)


def _function(law: MccLaw, particle: Particle, which: Which, structure: Any) -> Callable[..., Any]:
    """One step of one contact on plain arrays."""

    def step(x: jax.Array, second: jax.Array, *memory: jax.Array, law: MccLaw = law, body: Particle = particle) -> Any:
        state, time = (jax.tree.unflatten(structure, memory), second) if law.effects else (History(second), None)
        move = lambda x: law.step(body, state, x, time)[::-1]  # noqa: E731
        force, tangent, after = jax.jvp(move, (x,), (jnp.ones_like(x),), has_aux=True)
        return force, tangent, *jax.tree.leaves(after)

    def force(x: jax.Array, past: jax.Array) -> jax.Array:
        return law.step(particle, History(past), x)[1]

    def step_load(force: jax.Array, time: jax.Array, *memory: jax.Array) -> Any:
        after, displacement = law.step_load(particle, jax.tree.unflatten(structure, memory), force, time)
        return displacement, *jax.tree.leaves(after)

    def each(x: jax.Array, second: jax.Array, diameters: jax.Array, coefficients: jax.Array, *memory: jax.Array) -> Any:
        own = eqx.tree_at(lambda tree: tree.plastic, law, Plastic(*coefficients))
        return step(x, second, *memory, law=own, body=Particle(*diameters))

    return {"force": force, "step": step, "step_each": each, "step_load": step_load}[which]
