"""One campaign: what was hidden and what was answered; and the statistics of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .settings import FAULT_CHECKS, SETTINGS

NAMING = ("NAMED", "SET")


@dataclass(frozen=True)
class Outcome:
    """One campaign: what was hidden (`answer`) and the solver's line (`result`)."""

    key: str
    answer: dict[str, Any]
    result: dict[str, Any]

    @property
    def case(self) -> dict[str, Any]:
        """The case as planned."""
        return self.answer["case"]

    @property
    def kind(self) -> str:
        """Kind of campaign, see `plan.KINDS`."""
        return self.case["kind"]

    @property
    def found(self) -> dict[str, Any]:
        """What is kept of `discovery.json`."""
        return self.result.get("discovery") or {}

    @property
    def verdict(self) -> str:
        """The verdict; "failed" for a crash, a time-out or an invalid answer."""
        return self.found["verdict"] if self.result["status"] == "ok" else "failed"

    @property
    def failed(self) -> bool:
        """Whether there is no answer, or one that says it cannot tell."""
        return self.verdict in ("failed", "FIT_NOT_CONVERGED")

    @property
    def truth(self) -> list[str]:
        """Hidden listed mechanisms."""
        return [e["mechanism"] for e in self.answer["effects"] if e["mechanism"] != "unlisted"]

    @property
    def named(self) -> list[str]:
        """Mechanisms that were added."""
        return [e["mechanism"] for e in self.found["effects"]] if self.verdict in NAMING else []

    @property
    def right(self) -> bool:
        """Whether exactly the hidden mechanisms were named (or none, or UNLISTED, where that is the truth)."""
        if self.kind == "unlisted":
            return self.verdict == "UNLISTED"
        if self.kind == "fault":
            return not self.named
        if not self.truth:
            return self.verdict == "NO_GAP"
        return sorted(self.named) == sorted(self.truth)

    @property
    def ghost(self) -> bool:
        """Whether a wrong name stands beside the right one."""
        return set(self.truth) <= set(self.named) and len(set(self.named)) > len(self.truth)

    @property
    def reported(self) -> set[str]:
        """All mechanisms named or in a set."""
        sets = self.found.get("candidate_set") or [] if self.verdict in NAMING else []
        return {*self.named, *(name for names in sets for name in names)}

    @property
    def strength(self) -> float:
        """The least lambda of the hidden effects; of an unlisted one what the best listed formula leaves."""
        name = "lambda_residual" if self.kind == "unlisted" else "lambda"
        return min((e[name] for e in self.answer["effects"]), default=0.0)

    @property
    def probabilities(self) -> dict[str, float]:
        """Stated probability of every ranked mechanism."""
        ranking = self.found.get("ranking") or []
        return {r["mechanism"]: r["probability"] for r in ranking if r.get("probability") is not None}

    @property
    def told(self) -> bool:
        """Whether the fault of the tester is among the findings."""
        check = FAULT_CHECKS.get(self.case["fault"])
        return any(finding.get("check") == check for finding in self.found.get("findings") or [])


def wilson(hits: float, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    z2 = SETTINGS.scoring.quantile**2
    share = hits / number
    middle = (share + z2 / (2 * number)) / (1 + z2 / number)
    half = np.sqrt(z2 * (share * (1 - share) / number + z2 / (4 * number**2))) / (1 + z2 / number)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


def share_over(flags: Sequence[bool], groups: Sequence[str] | None = None) -> float:
    """The share that holds; with groups, the mean of the groups' shares."""
    if groups is None:
        return float(np.mean(flags))
    by: dict[str, list[bool]] = {}
    for flag, group in zip(flags, groups, strict=True):
        by.setdefault(group, []).append(flag)
    return float(np.mean([np.mean(values) for values in by.values()]))


def calibration_error(stated: Sequence[float], hit: Sequence[bool]) -> float:
    """Expected calibration error over bins of equal width."""
    bins = SETTINGS.scoring.bins
    p, right = np.asarray(stated, float), np.asarray(hit, float)
    place = np.minimum((p * bins).astype(int), bins - 1)
    return float(sum(abs(np.sum(p[place == b] - right[place == b])) for b in np.unique(place)) / len(p))
