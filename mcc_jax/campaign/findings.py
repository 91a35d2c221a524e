"""What a check of tests or of a result found, in words that a person can act on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from .._format import described, first_few

Level = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing that a reader of the numbers must know.

    Attributes:
        check: what was checked, in two or three words: "zero of force", "breakage", "plausibility".
        level: "info" where it was settled (corrected, or readings left out), "warning" where the numbers are to be used
            with care, "error" where they are not to be trusted before it is settled.
        sentence: what was found and done, without its full stop; of a single test with `{}` in place of its numbers.
        remedy: what a person can do, without its full stop; empty where nothing need be done.
        particles: names of the particles concerned; empty where it concerns the whole campaign.
        code: what was found, for programs that decide by it; not in files.
        numbers: of a single test, one for each `{}`; not in files.
    """

    check: str
    level: Level
    sentence: str
    remedy: str = ""
    particles: tuple[str, ...] = ()
    code: str = ""
    numbers: tuple[float | int, ...] = ()

    __repr__ = described()

    def __str__(self) -> str:
        return ". ".join(text for text in (self.sentence, self.remedy) if text) + "."

    def of(self, *numbers: float | int) -> Finding:
        """The same finding of a test, with its numbers."""
        return replace(self, numbers=numbers)

    @property
    def reason(self) -> str:
        """The same as a clause behind the name of a particle."""
        return f"{self.sentence}; {self.remedy}"

    def to_json(self) -> dict[str, Any]:
        """The same as an entry of `calibration.json` and `discovery.json`."""
        names = ("check", "level", "sentence", "remedy")
        return {name: getattr(self, name) for name in names} | {"particles": list(self.particles)}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Finding:
        """The finding of such an entry."""
        return cls(**{**entry, "particles": tuple(entry["particles"])})


def has_error(findings: Iterable[Finding]) -> bool:
    """Whether the numbers are not to be trusted before something is settled."""
    return any(one.level == "error" for one in findings)


def named(names: tuple[str, ...], of: int, most: int = 5) -> str:
    """Particles by their names, as the beginning of a sentence; of many the first ones and how many there are."""
    if len(names) == 1:
        return f"Particle {names[0]}"
    return f"Particles {first_few(names, most)}" + (f" ({len(names)} of {of})" if len(names) > most else "")


def joined(each: Mapping[str, Iterable[Finding]]) -> tuple[Finding, ...]:
    """One finding, with ranges of its numbers, for all tests of the same fault; by the names of their particles."""
    groups: dict[Finding, dict[str, tuple[float | int, ...]]] = {}
    for name, found in each.items():
        for one in found:
            groups.setdefault(one.of(), {})[name] = one.numbers
    together = []
    for one, numbers in groups.items():
        ends = [(f"{min(values):.4g}", f"{max(values):.4g}") for values in zip(*numbers.values(), strict=True)]
        texts = [low if low == high else f"{low} to {high}" for low, high in ends]
        sentence = f"{named(tuple(numbers), len(each))}: {one.sentence.format(*texts)}"
        together.append(replace(one, sentence=sentence, particles=tuple(numbers)))
    return tuple(together)
