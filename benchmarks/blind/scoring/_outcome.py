"""One campaign: what was hidden and what was answered."""

from __future__ import annotations

from dataclasses import dataclass

_ON_TARGET = 0.10


@dataclass(frozen=True)
class Outcome:
    """One campaign: what was hidden and what was answered."""

    key: str
    answer: dict
    result: dict

    @property
    def case(self):
        return self.answer["case"]

    @property
    def tier(self):
        return self.case["tier"]

    @property
    def found(self):
        return self.result.get("discovery") or {}

    @property
    def failed(self):
        return self.result["status"] != "ok" or self.found["verdict"] == "FIT_NOT_CONVERGED"

    @property
    def verdict(self):
        return "failed" if self.failed else self.found["verdict"]

    @property
    def truth(self):
        return [effect["mechanism"] for effect in self.answer["effects"]]

    @property
    def named(self):
        return [] if self.failed else [effect["mechanism"] for effect in self.found["effects"]]

    @property
    def top(self):
        """The mechanism named first; None for NO_GAP, UNLISTED and failures."""
        return self.named[0] if self.verdict in ("NAMED", "SET") else None

    @property
    def label(self):
        return self.top or {"NO_GAP": "NO_GAP", "UNLISTED": "UNLISTED"}.get(self.verdict, "failed")

    @property
    def first_set(self):
        """Candidates for the first effect; the named one alone where the solver gives no set."""
        if self.top is None:
            return []
        sets = self.found.get("candidate_set") or []
        return list(dict.fromkeys([*(sets[0] if sets else []), self.top]))

    @property
    def strength(self):
        """Nominal lambda, or None where the amplitude's bounds kept the campaign off it."""
        if not self.case["effects"]:
            return None
        nominal = self.case["effects"][0][2]
        reached = [e["lambda_residual" if self.case["residual"] else "lambda"] for e in self.answer["effects"]]
        return nominal if all(abs(value / nominal - 1.0) <= _ON_TARGET for value in reached) else None

    @property
    def right(self):
        return self.top is not None and self.top == self.truth[0]

    @property
    def leads(self):
        """Whether the hidden mechanism is the most probable one, though it may not be significant."""
        ranking = self.found.get("ranking") or []
        return bool(ranking) and max(ranking, key=lambda r: r["probability"] or 0.0)["mechanism"] == self.truth[0]
