"""Open the seal of a run and write its table, beside baselines on the campaigns that these have.

`python -m benchmarks.blind.score NAME [NAME-LABEL ...]`. Prints the table and keeps it in
`benchmarks/results/blind/NAME/score.md`. A crash, a time-out, an invalid answer and FIT_NOT_CONVERGED count as wrong; a
figure that the answers do not hold reads "not measured", never as passed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from . import seal as sealing
from .outcome import Outcome
from .rows import Row, table
from .run import RESULTS, read_outcomes
from .truth import Truths


def load(name: str, results: Path = RESULTS, work: Path = sealing.WORK, sealed: Path = sealing.SEALED) -> list[Outcome]:
    """The outcomes of a run with their answers, if the answers are the sealed ones."""
    campaigns = json.loads((results / name / "run.json").read_text())["campaigns"]
    answers = sealing.open_answers(campaigns, work, sealed)
    found = read_outcomes(results / name)
    return [Outcome(key, answers[key], found[key]) for key in sorted(found)]


def kinds_of(name: str, results: Path = RESULTS) -> dict[str, str]:
    """Kind of every wrong verdict that `refit` has looked at."""
    files = sorted((results / name).glob("kinds*.json"))
    return {key: row["kind"] for file in files for key, row in json.loads(file.read_text()).items()}


def wrong(outcomes: list[Outcome], kinds: dict[str, str]) -> list[list[str]]:
    """Rows of the wrong verdicts."""
    rows = []
    for o in outcomes:
        if o.right:
            continue
        hidden = " + ".join(f"{e['mechanism']}: {e['formula']}" for e in o.answer["effects"])
        hidden = hidden or o.case["fault"] or f"nothing, {o.case['noise']} noise"
        strength = ", ".join(f"{e['lambda']:.0f}" for e in o.answer["effects"])
        said = ", ".join(o.named) or (o.result.get("error") or "")[:80].replace("|", "/")
        rows.append([o.key, o.kind, o.case["generator"], hidden, strength, o.verdict, said, kinds.get(o.key, "")])
    return rows


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [header, ["---"] * len(header), *rows])


def _cells(row: Row) -> list[str]:
    verdict = "" if row.passed is None else ("pass" if row.passed else "FAIL")
    return [row.text, row.interval, str(row.number), verdict]


def report(names: list[str], results: Path = RESULTS, work: Path = sealing.WORK, sealed: Path = sealing.SEALED) -> str:
    """The text of the table of a run, with baselines beside it."""
    name, *baselines = names
    campaigns = json.loads((results / name / "run.json").read_text())["campaigns"]
    outcomes, truths, kinds = load(name, results, work, sealed), Truths(campaigns, work), kinds_of(name, results)
    answers = sealing.open_answers(campaigns, work, sealed)
    rows = table(outcomes, truths, kinds)
    seal = (sealed / f"{campaigns}.txt").read_text().split()[0]
    parts = [
        f"# Blind run {name}",
        f"Answers sealed as `{seal}`; {len(outcomes)} of {len(answers)} campaigns answered.",
        markdown(["figure", "bar", "found", "95 % interval", "n", ""], [[r.name, r.bar, *_cells(r)] for r in rows]),
    ]
    for baseline in baselines:
        others = load(baseline, results, work, sealed)
        same = {o.key for o in others} & {o.key for o in outcomes}
        ours = {r.name: r for r in table([o for o in outcomes if o.key in same], truths, kinds)}
        theirs = {r.name: r for r in table([o for o in others if o.key in same], truths, kinds_of(baseline, results))}
        lines = [
            [key, row.text, row.interval, theirs[key].text, theirs[key].interval, str(row.number)]
            for key, row in ours.items()
            if key in theirs
        ]
        header = ["figure", name, "95 %", baseline, "95 %", "n"]
        parts += [f"## Beside {baseline}, on the {len(same)} campaigns that both answered", markdown(header, lines)]
    lines = wrong(outcomes, kinds)
    header = ["campaign", "of", "generator", "hidden", "lambda", "verdict", "named", "kind"]
    parts += [f"## Wrong verdicts: {len(lines)}", markdown(header, lines) if lines else "None."]
    return "\n\n".join(parts) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help="a run, then baselines on the same campaigns")
    names = parser.parse_args(arguments).names
    text = report(names)
    print(text)
    (RESULTS / names[0] / "score.md").write_text(text)


if __name__ == "__main__":
    main()
