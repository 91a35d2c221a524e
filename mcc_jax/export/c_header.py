"""The law as a C99 header, and text from the templates beside it."""

from __future__ import annotations

import json
from typing import Any

from .._extras import extra, own_version
from ..geometry import Particle
from ..law import TESTED_STRAIN, MccLaw, StrainScaling, Unloading
from .effects import factor_in_c, in_words, parameters_in_c
from .origin import Origin, checked, numbers


def c_header(law: MccLaw, particle: Particle | None = None, *, origin: Origin | None = None) -> str:
    """A C99 header, valid as C++, in SI units, with the law's numbers as an initialiser.

    It holds force, tangent and history of one particle between platens, and of a pair of half contacts, for all forms
    of unloading and strain scaling. Coefficients are passed as a struct, so that every particle can have its own.
    Effects that are closed formulas are part of it (`AbstractEffect.closed`), with their numbers as constants.

    Args:
        law: the law.
        particle: if given, the law is checked to carry it, and a comment names its size.
        origin: where the law comes from, for the comment on top.

    Raises:
        InputError: if a parameter is out of its range, the particle carries no stress, or an effect is no closed
            formula or makes a contact gain energy. A law that is not monotone is
            passed on; `read_calibration` refuses it, and so should you unless you know what a pair of them means.
    """
    origin = checked(law, particle, origin, needed=False)
    values = numbers(law)
    return render(
        "mcc_law.h.j2",
        parameters=parameters_in_c(law),
        factor=factor_in_c(law, particle),
        effects=quoted(", ".join(effect.name for effect in law.effects))[1:-1],
        version=own_version(),
        origin=origin_lines(law, particle, origin),
        strain_max=TESTED_STRAIN,
        forms=[
            {
                "name": form.name,
                "constant": repr(form.constant),
                "power": form.stress_power,
            }
            for form in Unloading
        ],
        scalings=[{"name": scaling.name, "power": scaling.power} for scaling in StrainScaling],
        form=law.unloading.name,
        scaling=law.strain_scaling.name,
        modulus=repr(values["effective_modulus_MPa"] * 1e6),
        **{name: repr(values[name]) for name in ("C1", "C3", "C5", "a")},
    )


def origin_lines(law: MccLaw, particle: Particle | None, origin: Origin) -> list[str]:
    """Where the values come from, a fact a line."""
    lines = [f"Unloading {law.unloading.value}, strain scaling {law.strain_scaling.value}."]
    lines += [quoted(line)[1:-1] for line in in_words(law)]
    if origin.calibration is not None:
        c = origin.calibration
        lines.append(
            f"From {quoted(str(c['file']))}, method {quoted(str(c['method']))}, sha256 {str(c['sha256'])[:16]}..."
        )
        if not c["converged"]:
            lines.append("WARNING: that calibration did not converge.")
    whose = "the population (medians)" if origin.particle is None else f"particle {quoted(origin.particle)}"
    lines.append(f"Coefficients of {whose}.")
    if particle is not None:
        sizes = ", ".join(f"{float(d):.6g}" for d in (particle.D1, particle.D2, particle.D3))
        lines.append(f"Particle of the golden table: D1, D2, D3 = {sizes} um ({quoted(origin.geometry)}).")
    if not bool(law.is_monotone):
        lines.append("WARNING: the loading curve is not monotone; a pair of such contacts has several solutions.")
    return lines


def render(name: str, **values: Any) -> str:
    """The template of that name with the values put in; a value it wants and does not get is an error."""
    with extra("export"):
        from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mcc_jax.export"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # C and Markdown, not HTML
    )
    return environment.get_template(name).render(**values)


def quoted(text: str) -> str:
    """Any text in one line of ASCII that ends no comment, string or code block, wherever it is put."""
    return json.dumps(text, ensure_ascii=True).replace("*", "\\u002a").replace("`", "\\u0060").replace("?", "\\u003f")
