"""How to put the law into LAMMPS and Yade, as Markdown with code around the C header."""

from __future__ import annotations

from .._extras import own_version
from ..geometry import Particle
from ..law import MccLaw
from .c_header import origin_lines, render
from .effects import factor_in_c
from .origin import Origin, checked, numbers


def lammps_recipe(law: MccLaw, particle: Particle, *, origin: Origin | None = None) -> str:
    """Markdown: a normal model for LAMMPS' `pair_style granular` around the header of `c_header`, with the values.

    Args:
        law: the law.
        particle: the particle of the golden table beside it.
        origin: where the law comes from.

    Raises:
        InputError: if the law or the particle is not usable, or the law has an effect that `c_header` refuses.
    """
    return _recipe("lammps.md.j2", law, particle, origin)


def yade_recipe(law: MccLaw, particle: Particle, *, origin: Origin | None = None) -> str:
    """Markdown: material, `Ip2` and `Law2` functors for Yade around the header of `c_header`, with the values.

    Arguments and errors as of `lammps_recipe`.
    """
    return _recipe("yade.md.j2", law, particle, origin)


def _recipe(name: str, law: MccLaw, particle: Particle, origin: Origin | None) -> str:
    origin = checked(law, particle, origin)
    values = numbers(law)
    return render(
        name,
        version=own_version(),
        factor=factor_in_c(law, particle),
        origin=[f"- {line}" for line in origin_lines(law, particle, origin)],
        modulus=repr(values["effective_modulus_MPa"] * 1e6),
        **{key: repr(values[key]) for key in ("C1", "C3", "C5", "a")},
    )
