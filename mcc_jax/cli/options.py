"""Types of options: numbers that are finite, lists, ranges, paths that are not empty."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

LARGEST = 1e15
UNLOADING = ("printed", "punch", "punch_exact")
STRAIN_SCALING = ("raw", "contact", "master")


class Number(click.ParamType):
    """A finite number, from a smallest one on.

    Args:
        least: the smallest number allowed; none if None.
        above: refuse the smallest number itself.
        metavar: what it is, for the help text: the unit.
    """

    name = "number"

    def __init__(self, least: float | int | None = None, *, above: bool = False, metavar: str = "NUMBER") -> None:
        self.least, self.above, self.metavar = least, above, metavar

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """The unit."""
        return self.metavar

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number of a text."""
        try:
            number = float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number.", param, ctx)
        if not math.isfinite(number) or abs(number) > LARGEST:
            self.fail(f"{value!r} is not a finite number of sensible size.", param, ctx)
        if self.least is not None and (number <= self.least if self.above else number < self.least):
            self.fail(f"{value} is not {'above' if self.above else 'at least'} {self.least:g}.", param, ctx)
        return number


class Seed(click.ParamType):
    """A whole number that every generator takes."""

    name = "seed"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """The number of a text."""
        return int(click.IntRange(0, 2**63 - 1).convert(value, param, ctx))


class Levels(click.ParamType):
    """Positive numbers with commas between them."""

    name = "levels"

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """An example of the form."""
        return "L1,L2,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        """The numbers of a text."""
        if isinstance(value, tuple):
            return value
        number = Number(0, above=True)
        return tuple(number.convert(part, param, ctx) for part in str(value).split(","))


class Interval(click.ParamType):
    """A positive number, or two with a colon between them."""

    name = "interval"

    def __init__(self, metavar: str) -> None:
        self.metavar = metavar

    def get_metavar(self, param: click.Parameter, ctx: click.Context) -> str | None:
        """The form, with the unit."""
        return self.metavar

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        """The two ends."""
        if isinstance(value, tuple):
            return value
        parts = str(value).split(":")
        if len(parts) > 2:
            self.fail(f"{value!r} is neither a number nor LOW:HIGH.", param, ctx)
        number = Number(0, above=True)
        low, high = (number.convert(part, param, ctx) for part in (parts[0], parts[-1]))
        if low > high:
            self.fail(f"{value!r} begins with the larger number; write LOW:HIGH.", param, ctx)
        return low, high


class Location(click.Path):
    """A path; whether it fits is for the reader to say, which knows more."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path of a text."""
        if str(value) == "" or "\0" in str(value):
            self.fail("the path is empty or damaged.", param, ctx)
        return super().convert(value, param, ctx)


class CampaignFolder(Location):
    """A campaign; a path that cannot be one is refused before anything else is asked for."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path of a text. Raises `InputError` saying what was expected and what is there."""
        path = super().convert(value, param, ctx)
        if not all((path / name).exists() for name in ("particles.csv", "curves.csv")):
            from ..campaign import check_folder

            check_folder(path)
        return path


def out_option(**settings: Any) -> Any:
    """`--out DIR`."""
    return click.option("--out", metavar="DIR", type=Location(), help="Folder for the results.", **settings)


def seed_option(help: str = "Seed of all draws.") -> Any:
    """`--seed`."""
    return click.option(
        "--seed",
        type=Seed(),
        default=0,
        show_default=True,
        metavar="N",
        help=help,
    )


def threshold_option(use: str = ": points below it do not count.", default: float = 0.2) -> Any:
    """`--threshold-MPa`; `use` says what it does."""
    return click.option(
        "--threshold-MPa",
        "threshold_MPa",
        type=Number(0, metavar="MPa"),
        default=default,
        show_default=True,
        help=f"Stress below which only surface asperities deform{use}",
    )


def priors_option(where: str = "") -> Any:
    """`--priors FILE`; `where` says with which methods."""
    return click.option("--priors", type=Location(), metavar="FILE", help=f"TOML file of priors.{where}")


exclude_option = click.option(
    "--exclude", multiple=True, metavar="NAME", help="A mechanism that cannot be there, on your authority; repeatable."
)


def law_options(command: Any) -> Any:
    """`--unloading` and `--strain-scaling`."""
    scaling = click.option(
        "--strain-scaling",
        type=click.Choice(STRAIN_SCALING),
        default=STRAIN_SCALING[0],
        show_default=True,
        help="How the shape factor enters unloading.",
    )
    unloading = click.option(
        "--unloading",
        type=click.Choice(UNLOADING),
        default=UNLOADING[0],
        show_default=True,
        help="Form of the unloading law; the paper's 16 GPa belongs to 'printed' only. At peak strains where a form "
        "would return more energy than it took ('printed': below about 0.01) the recovered strain is limited.",
    )
    return unloading(scaling(command))


leave_out_option = click.option(
    "--leave-out", multiple=True, metavar="NAME", help="Leave this particle out; may be given several times."
)
no_figures_option = click.option("--no-figures", is_flag=True, help="Draw no figures.")


def json_option(file: str, instead: str = "a summary") -> Any:
    """`--json`: print the result's file."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {file} instead of {instead}.")
