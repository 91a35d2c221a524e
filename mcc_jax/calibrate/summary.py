"""The numbers of a calibration as one table, which `summary()`, `repr`, the command and the report print."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from .._format import plain, with_sd
from .judgement import modulus_is_open
from .population import COEFFICIENTS

if TYPE_CHECKING:
    import pandas as pd


class Quantity(NamedTuple):
    """A number of the law with what is known of it.

    Attributes:
        name: as in files, with its unit.
        label: for people.
        estimate: value, standard deviation and 95 % interval.
        factor, unit: what people see is the estimate times this factor, in this unit.
    """

    name: str
    label: str
    estimate: Mapping[str, Any]
    factor: float = 1.0
    unit: str = ""

    @property
    def text(self) -> str:
        """Value ± standard deviation with the unit."""
        return f"{with_sd(self.estimate, self.factor)} {self.unit}".rstrip()


def quantities(content: Mapping[str, Any]) -> Iterator[Quantity]:
    """The numbers of the law in a `calibration.json`, or in the parameters before and after of a `discovery.json`."""
    yield Quantity("a", "shape parameter a", content["a"])
    modulus = dict.fromkeys(content["a"]) if modulus_is_open(content) else content["effective_modulus_MPa"]
    yield Quantity("effective_modulus_MPa", "effective modulus", modulus, 1e-3, "GPa")
    if "modulus_at_peaks_MPa" in content:
        peaks = content["modulus_at_peaks_MPa"]
        yield Quantity("modulus_at_peaks_MPa", "effective modulus at the peaks", peaks, 1e-3, "GPa")
    for name in COEFFICIENTS:
        log = content[f"log_{name}"]
        yield Quantity(f"{name}_median", f"{name}, median", exponential(log["mean"]))
        yield Quantity(f"{name}_sd_of_log", f"{name}, sd of its logarithm", log["sd"])
    for effect in content.get("effects", ()):
        label = plain(f"{effect['mechanism']}, {effect['variant']}")
        for name, estimate in effect["parameters"].items():
            yield Quantity(f"{effect['mechanism']}.{name}", f"{label}: {name}", estimate)
    if "yield_stress_MPa" in content:
        yield Quantity("yield_stress_MPa", "yield stress", content["yield_stress_MPa"], 1.0, "MPa")


def summary_table(content: Mapping[str, Any]) -> pd.DataFrame:
    """Value, standard deviation and ends of the 95 % interval (columns) of the law's numbers (rows); NaN if unknown."""
    import pandas as pd

    rows = {}
    for one in quantities(content):
        low, high = one.estimate["interval_95"] or (None, None)
        rows[one.name] = {"value": one.estimate["value"], "sd": one.estimate["sd"], "low_95": low, "high_95": high}
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def exponential(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """The estimate of exp of what is estimated."""

    def exp(value: float) -> float:
        return math.exp(min(value, 700.0))

    value, sd, ends = estimate["value"], estimate["sd"], estimate["interval_95"]
    middle = None if value is None else exp(value)
    return {
        "value": middle,
        "sd": None if middle is None or sd is None else middle * sd,
        "interval_95": None if ends is None else [exp(end) for end in ends],
    }
