"""Answers of the second blind test against what the solver found."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from benchmarks import _report
from benchmarks.blind import sealing
from benchmarks.blind.run import read_results
from benchmarks.blind.scoring import interval

from .plan import TIERS

SINGLE = ("exact", "variant", "units")


@dataclass(frozen=True)
class Grade:
    """One campaign: what was hidden and what was answered.

    A crash, a time-out, an invalid answer and FIT_NOT_CONVERGED are wrong answers in every tier.
    """

    key: str
    answer: dict
    result: dict

    @property
    def tier(self):
        return self.answer["tier"]

    @property
    def truth(self):
        return self.answer["mechanisms"]

    @property
    def found(self):
        return self.result.get("discovery") or {}

    @property
    def verdict(self):
        if self.result["status"] != "ok":
            return self.result["status"]
        return self.found["verdict"]

    @property
    def failed(self):
        return self.result["status"] != "ok" or self.verdict == "FIT_NOT_CONVERGED"

    @property
    def names(self):
        """Mechanisms the solver named."""
        return [] if self.failed else [effect["mechanism"] for effect in self.found["effects"]]

    @property
    def sets(self):
        """For each effect named, the mechanisms that explain it as well."""
        return [] if self.failed else self.found.get("candidate_set") or []

    @property
    def right(self):
        if self.failed:
            return False
        if self.tier == "null":
            return self.verdict == "NO_GAP"
        if self.tier == "unlisted":
            return self.verdict == "UNLISTED"
        return sorted(self.names) == sorted(self.truth)

    @property
    def in_set(self):
        """Whether every hidden mechanism is among the names or in a reported set."""
        reported = {*self.names, *(name for names in self.sets for name in names)}
        return bool(self.truth) and reported.issuperset(self.truth)


def grades(folder):
    """Graded campaigns and the number of all of them; those without a result are left out.

    Raises:
        sealing.SealBroken: if the answers are not those whose hash was written with them.
    """
    folder = Path(folder)
    data = (folder / "answers.json").read_bytes()
    if hashlib.sha256(data).hexdigest() != (folder / "answers.sha256").read_text().split()[0]:
        raise sealing.SealBroken("answers.json is not the file whose hash was kept")
    answers = json.loads(data)["answers"]
    results = read_results(folder)
    return [Grade(key, answer, results[key]) for key, answer in answers.items() if key in results], len(answers)


def summary(graded):
    """Rows of the table: rates with Clopper-Pearson intervals."""
    by_tier = {tier: [g for g in graded if g.tier == tier] for tier in TIERS}
    single = [g for tier in SINGLE for g in by_tier[tier]]
    rows = []
    for tier in (*SINGLE, "the three together"):
        some = by_tier.get(tier, single)
        rows += [
            _rate(tier, "the only effect named is the true one", [g.right for g in some]),
            _rate(tier, "true name in the reported set", [g.in_set for g in some]),
            _rate(tier, "two named although one is hidden", [len(g.names) > 1 for g in some]),
        ]
    rows += [
        _rate("null", "NO_GAP", [g.right for g in by_tier["null"]]),
        _rate("unlisted", "UNLISTED", [g.right for g in by_tier["unlisted"]]),
        _rate("pair", "both named", [g.right for g in by_tier["pair"]]),
    ]
    return [row for row in rows if row]


def _rate(tier, question, flags):
    if not flags:
        return None
    hits, number = sum(flags), len(flags)
    low, high = interval(hits, number)
    return {
        "tier": tier,
        "answered": question,
        "campaigns": f"{hits} of {number}",
        "share": f"{100 * hits / number:.1f} %",
        "95 % interval": f"{100 * low:.1f}-{100 * high:.1f} %",
    }


def wrong(graded):
    """Rows of the campaigns that were not answered rightly, by tier."""
    return [
        {
            "campaign": g.key,
            "tier": g.tier,
            "hidden": ", ".join(g.truth) or "nothing on the list",
            "formula": "`" + g.answer["formula"].replace("|", "\\|") + "`",
            "lambda": f"{g.answer['lambda']:.1f}",
            "protocol": g.answer["protocol"],
            "particles": g.answer["n_particles"],
            "noise": g.answer["noise"],
            "verdict": g.verdict,
            "named": ", ".join(g.names) or "-",
            "sets": "; ".join(", ".join(names) for names in g.sets) or "-",
        }
        for g in sorted(graded, key=lambda g: (TIERS.index(g.tier), g.key))
        if not g.right
    ]


def report(folder, record=False):
    """Print the tables, and with `record` keep them in `benchmarks/results/`."""
    graded, number = grades(folder)
    if not graded:
        raise SystemExit(f"{folder} holds no results")
    verdicts = Counter(g.verdict for g in graded)
    run = {
        "answers (SHA-256)": (Path(folder) / "answers.sha256").read_text().strip(),
        "graded": f"{len(graded)} of {number}",
        "verdicts": ", ".join(f"{name} {count}" for name, count in verdicts.most_common()),
        **_report.environment("numpy", "scipy"),
    }
    tables = {
        "Run": [{"what": key, "value": str(value)} for key, value in run.items()],
        "Graded": summary(graded),
    }
    if rows := wrong(graded):
        tables["Not answered rightly"] = rows
    _report.write("blind_second", "Second blind test, by another author's generator", tables, record)
    return tables
