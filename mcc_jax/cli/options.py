"""Options that commands share, and their types: numbers that are finite, lists, ranges, paths that are not empty."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

LARGEST = 1e15
UNLOADING = ("printed", "punch", "punch_exact")
STRAIN_SCALING = ("raw", "contact", "master")


def number(least: float | int | None = None, *, above: bool = False) -> Callable[[Any], float]:
    """A type of option: a finite number, from `least` on; `above` refuses the smallest number itself."""

    def convert(value: Any) -> float:
        try:
            found = float(value)
        except ValueError:
            raise click.BadParameter(f"{value!r} is not a number.") from None
        if not math.isfinite(found) or abs(found) > LARGEST:
            raise click.BadParameter(f"{value!r} is not a finite number of sensible size.")
        if least is not None and (found <= least if above else found < least):
            raise click.BadParameter(f"{value} is not {'above' if above else 'at least'} {least:g}.")
        return found

    return convert


_positive = number(0, above=True)


def whole_number(value: Any) -> int:
    """A seed that every generator takes."""
    return int(click.IntRange(0, 2**63 - 1).convert(value, None, None))


def levels(value: Any) -> tuple[float, ...]:
    """Positive numbers with commas between them."""
    return value if isinstance(value, tuple) else tuple(_positive(part) for part in str(value).split(","))


def interval(value: Any) -> tuple[float, float]:
    """A positive number, or two with a colon between them."""
    if isinstance(value, tuple):
        return value
    parts = str(value).split(":")
    if len(parts) > 2:
        raise click.BadParameter(f"{value!r} is neither a number nor LOW:HIGH.")
    low, high = _positive(parts[0]), _positive(parts[-1])
    if low > high:
        raise click.BadParameter(f"{value!r} begins with the larger number; write LOW:HIGH.")
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


def campaign() -> Any:
    """The argument CAMPAIGN."""
    return click.argument("campaign", type=CampaignFolder(), metavar="CAMPAIGN")


def out(**settings: Any) -> Any:
    """`--out DIR`."""
    return click.option("--out", metavar="DIR", type=Location(), help="Folder for the results.", **settings)


def seed(help: str = "Seed of all draws.") -> Any:
    """`--seed`."""
    return click.option("--seed", type=whole_number, default=0, show_default=True, metavar="N", help=help)


def threshold(use: str = ": points below it do not count.", default: float = 0.2) -> Any:
    """`--threshold-MPa`; `use` says what it does."""
    text = f"Stress below which only surface asperities deform{use}"
    settings = {"type": number(0), "metavar": "MPa", "default": default, "show_default": True}
    return click.option("--threshold-MPa", "threshold_MPa", help=text, **settings)


def priors(where: str = "") -> Any:
    """`--priors FILE`; `where` says with which methods."""
    return click.option("--priors", type=Location(), metavar="FILE", help=f"TOML file of priors.{where}")


def one_of(name: str, choices: tuple[str, ...], help: str) -> Any:
    """An option that takes one of several words, the first if it is not given."""
    return click.option(name, type=click.Choice(choices), default=choices[0], show_default=True, help=help)


def law(command: Any) -> Any:
    """`--unloading` and `--strain-scaling`."""
    scaling = one_of("--strain-scaling", STRAIN_SCALING, "How the shape factor enters unloading.")
    unloading = one_of(
        "--unloading",
        UNLOADING,
        "Form of the unloading law; the paper's 16 GPa belongs to 'printed' only. At peak strains where a form would "
        "return more energy than it took ('printed': below about 0.01) the recovered strain is limited.",
    )
    return unloading(scaling(command))


exclude = click.option(
    "--exclude", multiple=True, metavar="NAME", help="Mechanism to exclude from the search; repeatable."
)
leave_out = click.option(
    "--leave-out", multiple=True, metavar="NAME", help="Leave this particle out; may be given several times."
)
no_figures = click.option("--no-figures", is_flag=True, help="Draw no figures.")


def json(file: str, instead: str = "a summary") -> Any:
    """`--json`: print the result's file."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {file} instead of {instead}.")
