"""What a check of tests or of a result found, in words that a person can act on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from .._format import described

Level = Literal["told", "look", "bad"]


@dataclass(frozen=True)
class Finding:
    """One thing that a reader of the numbers must know.

    Attributes:
        check: what was checked, in two or three words: "zero of force", "saturation", "breakage", "plausibility",
            "fitted modulus".
        level: "told" where the data allowed it to be settled (corrected, or readings left out), "look" where the
            numbers are to be used with care, "bad" where they are not to be trusted before it is settled.
        sentence: what was found and what was done about it; one sentence, without its full stop.
        remedy: what a person can do; one sentence without its full stop, empty where nothing need be done.
        particles: names of the particles concerned; empty where it concerns the whole campaign.
    """

    check: str
    level: Level
    sentence: str
    remedy: str = ""
    particles: tuple[str, ...] = ()

    __repr__ = described()

    def __str__(self) -> str:
        return ". ".join(text for text in (self.sentence, self.remedy) if text) + "."

    def to_json(self) -> dict[str, Any]:
        """The same as an entry of `calibration.json` and `discovery.json`."""
        return {
            "check": self.check,
            "level": self.level,
            "sentence": self.sentence,
            "remedy": self.remedy,
            "particles": list(self.particles),
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Finding:
        """The finding of such an entry."""
        return cls(**{**entry, "particles": tuple(entry["particles"])})


def worst(findings: Iterable[Finding]) -> Level | None:
    """The most serious level among findings, None where there are none."""
    order: tuple[Level, ...] = ("told", "look", "bad")
    levels = {f.level for f in findings}
    return next((level for level in reversed(order) if level in levels), None)
