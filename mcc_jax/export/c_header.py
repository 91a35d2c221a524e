"""The law as a C99 header, and how to put it into LAMMPS and Yade: text from `templates`."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import InputError
from .._extras import extra
from .._types import Scalar
from .._version import __version__
from ..dem import half_contact
from ..formulas import Formulas, Plastic
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw, StrainScaling, Unloading
from ..law.response import factor_at_peak, folded
from .origin import UNKNOWN, Origin, check, effects_of, numbers


def c_header(law: MccLaw, particle: Particle, *, origin: Origin = UNKNOWN) -> str:
    """A C99 header, valid as C++, in SI units, with the law's numbers as an initialiser.

    It holds force, tangent and history of one particle between platens, and of a pair of half contacts, for all forms
    of unloading and strain scaling. Coefficients are passed as a struct, so that every particle can have its own.
    Effects that are closed formulas are part of it (`AbstractEffect.closed`), with their numbers as constants. The
    comment on top states the `origin` of the law and the size of the golden table's `particle`. A law that is not
    monotone is accepted.

    Raises:
        InputError: if a parameter is out of its range, the particle carries no stress, or an effect is no closed
            formula or makes a contact gain energy.
    """
    return _rendered("mcc_law.h.j2", law, particle, origin)


def lammps_recipe(law: MccLaw, particle: Particle, *, origin: Origin = UNKNOWN) -> str:
    """Markdown: a normal model for LAMMPS' `pair_style granular` around the header of `c_header`, with the values."""
    return _rendered("lammps.md.j2", law, particle, origin)


def yade_recipe(law: MccLaw, particle: Particle, *, origin: Origin = UNKNOWN) -> str:
    """Markdown: material, `Ip2` and `Law2` functors for Yade around the header of `c_header`, with the values."""
    return _rendered("yade.md.j2", law, particle, origin)


def _rendered(template: str, law: MccLaw, particle: Particle, origin: Origin) -> str:
    """A template with the law's values put in, in SI units; a value it wants and does not get is an error."""
    with extra("export"):
        from jinja2 import Environment, PackageLoader, StrictUndefined

    check(law, particle)
    values = numbers(law)
    environment = Environment(
        loader=PackageLoader("mcc_jax.export"), undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True, autoescape=False,  # C and Markdown, not HTML
    )  # fmt: skip
    return environment.get_template(template).render(
        **{name: repr(values[name]) for name in ("C1", "C3", "C5", "a")},
        modulus=repr(values["effective_modulus_MPa"] * 1e6),
        parameters=parameters_in_c(law),
        factor=factor_in_c(law, particle),
        effects=_quoted(", ".join(effect.name for effect in law.effects))[1:-1],
        version=__version__,
        origin=_origin_lines(law, particle, origin),
        strain_max=TESTED_STRAIN,
        forms=Unloading,
        scalings=StrainScaling,
        form=law.unloading.name,
        scaling=law.strain_scaling.name,
    )


def _origin_lines(law: MccLaw, particle: Particle, origin: Origin) -> Iterator[str]:
    yield f"Unloading {law.unloading.value}, strain scaling {law.strain_scaling.value}."
    for one in effects_of(law):
        values = ", ".join(f"{name} = {value:.6g}" for name, value in one["numbers"].items())
        yield _quoted(f"Effect {one['name']}: {one['equation']}; {values}.")[1:-1]
    if c := origin.calibration:
        yield f"From {_quoted(c['file'])}, method {_quoted(c['method'])}, sha256 {str(c['sha256'])[:16]}..."
        if not c["converged"]:
            yield "WARNING: that calibration did not converge."
    whose = "the population (medians)" if origin.particle is None else f"particle {_quoted(origin.particle)}"
    yield f"Coefficients of {whose}."
    sizes = ", ".join(f"{float(d):.6g}" for d in jax.tree.leaves(particle))
    yield f"Particle of the golden table: D1, D2, D3 = {sizes} um ({_quoted(origin.geometry)})."
    if not bool(law.is_monotone):
        yield "WARNING: the loading curve is not monotone; a pair of such contacts has several solutions."


def _quoted(text: str) -> str:
    """Any text in one line of ASCII that ends no comment, string or code block, wherever it is put."""
    return json.dumps(text, ensure_ascii=True).replace("*", "\\u002a").replace("`", "\\u0060").replace("?", "\\u003f")


def parameters_in_c(law: MccLaw) -> str | None:
    """C statements that put what effects make of `*law` for D1, D2, D3 into `own`, all SI; None if nothing changes."""
    if not any(effect.overrides("modify") for effect in law.effects):
        return None

    def own(C1: Scalar, C3: Scalar, C5: Scalar, a: Scalar, E: Scalar, *diameters: Scalar) -> tuple[Scalar, ...]:
        plain = Formulas(Plastic(C1, C3, C5), a, 1e-6 * E, law.unloading, law.strain_scaling)
        made, _ = folded(plain, law.effects, Particle(*(1e6 * D for D in diameters)), "C")
        return made.plastic.C1, made.plastic.C3, made.plastic.C5, made.a, 1e6 * made.effective_modulus

    names = ("C1", "C3", "C5", "a", "effective_modulus")
    lines, results = in_c(own, [f"law->{name}" for name in names] + ["D1", "D2", "D3"])
    return "\n".join([*lines, *(f"own.{name} = {value};" for name, value in zip(names, results, strict=True))])


def factor_in_c(law: MccLaw, particle: Particle) -> str | None:
    """C statements that return the factor on the modulus at `strain` and `stress` [MPa]; None if there is none."""
    at_peak = half_contact(law, particle).effects
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
    """A function of as many scalars as names, traced by JAX, as C: the statements, and what to write for each result.

    Raises `InputError` for an operation that has no counterpart in C.
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
            name, kind, results = equation.primitive.name, equation.outvars[0].aval, list(map(read, equation.invars))
            if name in _CALLS:
                inner = next(p for p in equation.params.values() if hasattr(p, "jaxpr"))
                results = follow(inner.jaxpr, inner.consts, results)
            elif name not in _THE_SAME or kind.ndim:
                if name == "integer_pow":
                    product = " * ".join(results * abs(equation.params["y"]))
                    expression = product if equation.params["y"] > 0 else f"1.0 / ({product})"
                elif name in _OPERATIONS and not kind.ndim:
                    expression = _OPERATIONS[name].format(*results)
                else:
                    problem = f"an effect of this law takes the operation {name}, which has no counterpart in C"
                    remedy = "Export the law as a JAX artefact (--format jax), or leave that effect out."
                    raise InputError(problem, remedy=remedy)
                results = [f"t{len(statements)}"]
                statements.append(("int" if kind.dtype.kind == "b" else "double", results[0], expression))
            known.update(zip(equation.outvars, results, strict=True))
        return list(map(read, jaxpr.outvars))

    results = follow(traced.jaxpr, traced.consts, names)
    needed, lines = set(results), []
    for kind, name, expression in reversed(statements):  # a compiler would warn of what is not used
        if name in needed:
            needed.update(re.findall(r"\bt\d+\b", expression))
            lines.insert(0, f"const {kind} {name} = {expression};")
    return lines, results
