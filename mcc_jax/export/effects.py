"""Effects in exports: in words for every format, and as C where they are closed formulas of particle and peak."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from .._types import Scalar
from ..dem import half_contact
from ..effects import LIBRARY
from ..formulas import Formulas, Plastic
from ..geometry import Particle
from ..law import MccLaw
from ..law.response import factor_at_peak, folded

SPHERE_UM = 200.0
"""Diameter of the sphere on which a law with effects is checked where no particle is given."""


def described(law: MccLaw) -> list[dict[str, Any]]:
    """The effects of a law: name, equation, the amplitude's unit where it is known, and numbers by name."""
    told = []
    for effect in law.effects:
        mechanism, _, name = effect.name.partition(":")
        known = next((v for v in LIBRARY.get(mechanism, ()) if v.name == name), None)
        numbers = {field.name: getattr(effect, field.name) for field in dataclasses.fields(effect)}
        numbers = {name: float(value) for name, value in numbers.items() if eqx.is_inexact_array(value)}
        if known is None:
            more = {"equation": (inspect.getdoc(effect) or "").partition("\n")[0]}
        else:
            more = {"equation": known.equation, "unit": known.unit}
            numbers = {known.parameter if name == "amplitude" else name: value for name, value in numbers.items()}
        told.append({"name": effect.name, **more, "numbers": numbers})
    return told


def in_words(law: MccLaw) -> list[str]:
    """A line for each effect of a law."""
    numbers = [", ".join(f"{name} = {v:.6g}" for name, v in effect["numbers"].items()) for effect in described(law)]
    return [f"Effect {e['name']}: {e['equation']}; {n}." for e, n in zip(described(law), numbers, strict=True)]


def parameters_in_c(law: MccLaw) -> str | None:
    """C statements that put what effects make of `law` for a particle into `own`; None if no effect changes parameters.

    They read C1, C3, C5, a and effective_modulus of `*law`, and D1, D2, D3, all SI.
    """
    if not any(effect.overrides("modify") for effect in law.effects):
        return None

    def own(C1: Scalar, C3: Scalar, C5: Scalar, a: Scalar, E: Scalar, *diameters: Scalar) -> tuple[Scalar, ...]:
        plain = Formulas(Plastic(C1, C3, C5), a, 1e-6 * E, law.unloading, law.strain_scaling)
        made, _ = folded(plain, law.effects, Particle(*(1e6 * D for D in diameters)), "C")
        return made.plastic.C1, made.plastic.C3, made.plastic.C5, made.a, 1e6 * made.effective_modulus

    names = ("C1", "C3", "C5", "a", "effective_modulus")
    lines, results = in_c(own, [f"law->{name}" for name in names] + ["D1", "D2", "D3"])
    return "\n".join([*lines, *(f"own.{name} = {value};" for name, value in zip(names, results, strict=True))])


def factor_in_c(law: MccLaw, particle: Particle | None) -> str | None:
    """C statements that return the factor on the modulus at `strain` and `stress` [MPa]; None if there is none.

    Raises:
        InputError: naming an effect that no particle code can take.
    """
    sphere = Particle(SPHERE_UM, SPHERE_UM, SPHERE_UM)
    at_peak = half_contact(law, sphere if particle is None else particle).effects
    if not at_peak:
        return None
    lines, results = in_c(lambda strain, stress: (factor_at_peak(at_peak, strain, stress),), ["strain", "stress"])
    unused = [f"(void){name};" for name in ("strain", "stress") if not any(re.search(rf"\b{name}\b", x) for x in lines)]
    return "\n".join([*lines, *unused, f"return {results[0]};"])


_OPERATIONS = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}", "square": "{0} * {0}",
    "gt": "{} > {}", "lt": "{} < {}", "ge": "{} >= {}", "le": "{} <= {}", "eq": "{} == {}", "ne": "{} != {}",
    "and": "{} && {}", "or": "{} || {}", "not": "!{}", "select_n": "{0} ? {2} : {1}", "abs": "fabs({})",
    "max": "{0} > {1} ? {0} : {1}", "min": "{0} < {1} ? {0} : {1}", "pow": "pow({}, {})", "rsqrt": "1.0 / sqrt({})",
    **{name: f"{name}({{}})" for name in ("exp", "log", "log1p", "expm1", "sqrt", "cbrt", "sin", "cos", "tan", "tanh")},
}  # fmt: skip
"""What JAX calls an operation on numbers, and how C writes it."""
_THE_SAME = ("broadcast_in_dim", "convert_element_type", "copy", "reduce_precision", "optimization_barrier")
_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")


def in_c(function: Callable[..., tuple[Scalar, ...]], names: Sequence[str]) -> tuple[list[str], list[str]]:
    """A function of as many scalars as names as C: the statements, and what to write for each result.

    JAX traces it; so C computes what the library computes, of an effect of the user's own, too.

    Raises:
        InputError: for an operation that has no counterpart in C.
    """
    traced = jax.make_jaxpr(function)(*(jnp.ones(()) for _ in names))
    statements: list[tuple[str, str, str]] = []

    def written(value: Any) -> str:
        number = np.asarray(value)
        text = repr(number.item() if number.dtype.kind == "f" else int(number))
        return f"({text})" if text.startswith("-") else text

    def follow(jaxpr: Any, constants: Sequence[Any], given: Sequence[str]) -> list[str]:
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(written, constants), *given], strict=True))

        def read(atom: Any) -> str:
            return written(atom.val) if hasattr(atom, "val") else known[atom]

        for equation in jaxpr.eqns:
            results = list(map(read, equation.invars))
            if equation.primitive.name in _CALLS:
                inner = next(p for p in equation.params.values() if hasattr(p, "jaxpr"))
                results = follow(inner.jaxpr, inner.consts, results)
            elif equation.primitive.name not in _THE_SAME or equation.outvars[0].aval.ndim:
                kind = "int" if equation.outvars[0].aval.dtype.kind == "b" else "double"
                statements.append((kind, f"t{len(statements)}", _operation(equation, results)))
                results = [statements[-1][1]]
            known.update(zip(equation.outvars, results, strict=True))
        return list(map(read, jaxpr.outvars))

    results = follow(traced.jaxpr, traced.consts, names)
    needed, lines = set(results), []
    for kind, name, expression in reversed(statements):  # a compiler would warn of what is not used
        if name in needed:
            needed.update(re.findall(r"\bt\d+\b", expression))
            lines.insert(0, f"const {kind} {name} = {expression};")
    return lines, results


def _operation(equation: Any, inputs: Sequence[str]) -> str:
    name = equation.primitive.name
    if name == "integer_pow":
        product = " * ".join([inputs[0]] * abs(equation.params["y"]))
        return product if equation.params["y"] > 0 else f"1.0 / ({product})"
    if name not in _OPERATIONS or equation.outvars[0].aval.ndim:
        raise InputError(
            f"an effect of this law takes the operation {name}, which has no counterpart in C",
            remedy="Export the law as a JAX artefact (--format jax), or leave that effect out.",
        )
    return _OPERATIONS[name].format(*inputs)
