"""Options that commands share, and their types: numbers that are finite, lists, ranges, paths that are not empty."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

LARGEST = 1e15
UNLOADING = ("printed", "punch", "punch_exact")
STRAIN_SCALING = ("raw", "contact", "master")


class Number(click.FloatRange):
    """A finite number of sensible size, which excludes `nan` as well."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number of a text."""
        found = super().convert(value, param, ctx)
        if not abs(found) <= LARGEST:
            self.fail(f"{value!r} is not a finite number of sensible size.", param, ctx)
        return found


NUMBER, POSITIVE, NOT_NEGATIVE = Number(), Number(min=0, min_open=True), Number(min=0)


def whole_number(value: Any) -> int:
    """A seed that every generator takes."""
    return int(click.IntRange(0, 2**63 - 1).convert(value, None, None))


def levels(value: Any) -> tuple[float, ...]:
    """Positive numbers with commas between them."""
    return tuple(POSITIVE.convert(part, None, None) for part in value.split(","))


def interval(value: Any) -> tuple[float, float]:
    """A positive number, or two with a colon between them."""
    ends = [POSITIVE.convert(part, None, None) for part in value.split(":")]
    if len(ends) > 2 or ends[0] > ends[-1]:
        raise click.BadParameter(f"{value!r} is neither a number nor LOW:HIGH.")
    return ends[0], ends[-1]


class Location(click.Path):
    """A path; whether it fits is for the reader to say, which knows more."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path of a text."""
        if str(value) == "" or "\0" in str(value):
            self.fail("the path is empty or damaged.", param, ctx)
        return super().convert(value, param, ctx)


campaign = click.argument("campaign", type=Location(), metavar="CAMPAIGN")


def option(name: str, metavar: str, kind: Any, help: str, *, variable: str = "", **settings: Any) -> Any:
    """An option whose variable is spelt as the option is: click would write it in lower case."""
    variable = variable or name[2:].replace("-", "_")
    return click.option(name, variable, type=kind, metavar=metavar, help=help, **settings)


def one_of(name: str, choices: tuple[str, ...], help: str, **settings: Any) -> Any:
    """An option that takes one of several words, the first if it is not given."""
    return click.option(name, type=click.Choice(choices), default=choices[0], show_default=True, help=help, **settings)


def out(**settings: Any) -> Any:
    """`--out DIR`."""
    return option("--out", "DIR", Location(), "Folder for the results.", **settings)


def seed(help: str = "Seed of all draws.") -> Any:
    """`--seed`."""
    return option("--seed", "N", whole_number, help, default=0, show_default=True)


no_seed = click.option("--seed", type=whole_number, hidden=True, expose_value=False)
"""Accepted, since every command takes a seed, and not shown where nothing is random."""


def diameters(help: str) -> Any:
    """`--diameters`: three lengths or a table."""
    return option("--diameters", "D1,D2,D3|FILE", str, help)


def threshold(use: str = ": points below it do not count.", default: float = 0.2) -> Any:
    """`--threshold-MPa`; `use` says what it does."""
    text = f"Stress below which only surface asperities deform{use}"
    return option("--threshold-MPa", "MPa", NOT_NEGATIVE, text, default=default, show_default=True)


def priors(**settings: Any) -> Any:
    """`--priors FILE`."""
    return option("--priors", "FILE", Location(), "TOML file of priors.", **settings)


def effect(metavar: str, help: str, **settings: Any) -> Any:
    """`--effect`, which may be repeated."""
    return option("--effect", metavar, str, help, variable="effects", multiple=True, **settings)


def leave_out(help: str = "Leave this particle out; may be given several times.") -> Any:
    """`--leave-out`, which may be repeated."""
    return option("--leave-out", "NAME", str, help, multiple=True)


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


exclude = option("--exclude", "NAME", str, "Mechanism to exclude from the search; repeatable.", multiple=True)
no_figures = click.option("--no-figures", is_flag=True, help="Draw no figures.")


def json(file: str, instead: str = "a summary") -> Any:
    """`--json`: print the result's file."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {file} instead of {instead}.")
