"""Packages that only some parts need, by the extra that brings them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ._errors import InputError

EXTRAS = {
    "command": ("the command mcc-jax needs", ("click", "rich", "platformdirs")),
    "plots": ("figures need", ("matplotlib",)),
    "report": ("the report needs", ("matplotlib", "bokeh", "jinja2", "markupsafe")),
    "export": ("this export needs", ("jinja2", "flatbuffers")),
    "netcdf": ("writing posterior.nc needs", ("h5netcdf", "h5py")),
    "excel": ("reading an Excel workbook needs", ("python_calamine",)),
}
"""For each extra of `pyproject.toml` what it is for, and the modules of it that this library imports."""


class MissingExtraError(InputError, ModuleNotFoundError):
    """Something is called for that the base installation does not bring; the message says how to get it."""


@contextlib.contextmanager
def extra(name: str, file: str | Path | None = None) -> Iterator[None]:
    """Imports of what an extra brings, for a file if one needs it: `with extra("plots"): from matplotlib import ...`.

    Raises `MissingExtraError` where a package of the extra is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in EXTRAS[name][1]:  # something else is broken: that is raised as it is
            raise
        problem = f"{EXTRAS[name][0]} the package {missing}, which is not installed"
        remedy = f"Install the extra {name!r}: python -m pip install 'mcc-jax[{name}]'"
        raise MissingExtraError(problem, file=file, remedy=remedy) from None
