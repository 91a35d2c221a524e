"""Why a verdict is wrong: fit the truth directly and compare its evidence with the winner's.

`python -m benchmarks.blind.refit NAME [--part i/n]` writes `benchmarks/results/blind/NAME/kinds.json` (a part writes
`kinds_i_of_n.json`), one campaign after the other, and goes on where it stopped. Kinds: "search failure" (a listed
formula of the truth has more evidence than the winner, by more than its prior odds cost), "prior odds" (more evidence,
but not by so much: the best of as many formulas as there are must lead nothing by the logarithm of their number, and
two names one by the margin), "library gap" (it has less), "ambiguous" (they are within a few nats),
"not compared" (UNLISTED has no evidence of its own here; FIT_NOT_CONVERGED and crashes).
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from . import seal as sealing
from .outcome import Outcome
from .run import RESULTS, part_of
from .score import load
from .settings import SETTINGS

Evidence = Callable[[Sequence[str]], float]
"""Log evidence of the law with effects, each "mechanism:variant"."""


def kind_of(truth: float, winner: float, odds: float = 0.0) -> str:
    """The kind of a wrong verdict, from log evidences of truth and winner, and log prior odds against the truth."""
    if truth - winner > SETTINGS.scoring.ambiguous_nats:
        return "search failure" if truth - winner > odds else "prior odds"
    return "library gap" if winner - truth > SETTINGS.scoring.ambiguous_nats else "ambiguous"


def judge(outcome: Outcome, formulas: dict[str, list[str]], evidence: Evidence) -> dict[str, Any]:
    """The kind of one wrong verdict; `formulas` are the library's by mechanism."""
    if outcome.verdict not in ("NO_GAP", "NAMED", "SET"):
        return {"kind": "not compared", "verdict": outcome.verdict}
    from mcc_jax.discovery.settings import DECISIONS

    named = outcome.found["effects"]
    winner = evidence([f"{e['mechanism']}:{e['variant']}" for e in named])
    odds = 0.0 if len(named) >= len(outcome.truth) else DECISIONS.margin
    if not named and len(outcome.truth) == 1:
        odds = math.log(sum(map(len, formulas.values())))
    ways = list(product(*([f"{m}:{v}" for v in formulas[m]] for m in outcome.truth)))
    step = max(1, -(-len(ways) // SETTINGS.baselines.combinations)) if len(outcome.truth) > 1 else 1
    tried = {" + ".join(way): evidence(way) for way in ways[::step]}
    best = max(tried, key=lambda way: tried[way]) if tried else ""
    truth = tried.get(best, evidence(()))
    return {"kind": kind_of(truth, winner, odds), "truth": best, "evidence_truth": truth, "evidence_winner": winner}


def evidence_of(folder: Path, seed: int = 0) -> Evidence:
    """Log evidences in one campaign, by `mcc_jax.sample`; minus infinity where a formula cannot be fitted."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import mcc_jax as mcc

    campaign = mcc.read_campaign(folder)

    def evidence(effects: Sequence[str]) -> float:
        try:
            return mcc.sample(campaign, mcc.Model().with_effects(*effects), seed=seed).log_evidence[0]
        except mcc.InputError:
            return float("-inf")

    return evidence


def main(arguments: list[str] | None = None) -> None:
    """Judge the wrong verdicts of a run where a listed mechanism is true."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help="of the run")
    parser.add_argument("--part", type=part_of, default=(1, 1), help="i/n: every n-th wrong verdict from the i-th on")
    given = parser.parse_args(arguments)
    from mcc_jax.effects import LIBRARY

    formulas = {name: [variant.name for variant in mechanism] for name, mechanism in LIBRARY.items()}
    campaigns = json.loads((RESULTS / given.name / "run.json").read_text())["campaigns"]
    number, parts = given.part
    place = RESULTS / given.name / ("kinds.json" if parts == 1 else f"kinds_{number}_of_{parts}.json")
    wrong = [o for o in load(given.name) if o.truth and not o.right]
    for outcome in wrong[number - 1 :: parts]:
        kinds = json.loads(place.read_text()) if place.exists() else {}
        if outcome.key not in kinds:
            folder = sealing.WORK / campaigns / "campaigns" / outcome.key
            kinds[outcome.key] = judge(outcome, formulas, evidence_of(folder))
            place.write_text(json.dumps(kinds, indent=1) + "\n")


if __name__ == "__main__":
    main()
