"""Solve the campaigns of a sealed run, one outcome a line, kept at once.

`python -m benchmarks.blind.run --name 2026-11-27-4711 --part 1/8`. Outcomes stand in
`benchmarks/results/blind/NAME/part_1_of_8.jsonl`, with `--label aic` in `NAME-aic/`; campaigns that have one, in any
part, are skipped, so a stopped run goes on where it was. A campaign that crashes its process or is not answered in time
costs its own case only.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from . import seal as sealing
from . import workers
from .outcome import NAMING
from .settings import SETTINGS, Running

RESULTS = Path(__file__).parents[1] / "results" / "blind"


def read_outcomes(folder: Path) -> dict[str, dict[str, Any]]:
    """Outcomes by campaign; a line that was cut off is left out, so its campaign runs again."""
    found = {}
    for part in sorted(folder.glob("part_*.jsonl")):
        for line in part.read_text().splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                outcome = json.loads(line)
                found[outcome["key"]] = outcome
    return found


def solve(
    name: str,
    part: tuple[int, int] = (1, 1),
    *,
    label: str = "",
    solver: str = "inprocess",
    seed: int = 0,
    subset: int | None = None,
    named: str = "",
    work: Path = sealing.WORK,
    results: Path = RESULTS,
    running: Running = SETTINGS.running,
) -> int:
    """Solve what a part has left; returns how many campaigns that was."""
    tasks = json.loads((work / name / "tasks.json").read_text())
    wanted = [key for key in sorted(tasks) if subset is None or tasks[key]["subset"]]
    if subset not in (None, len(wanted)):
        raise SystemExit(f"the subset of {name} has {len(wanted)} campaigns, not {subset}")
    if named:
        told = read_outcomes(results / named)
        wanted = [key for key in wanted if (told.get(key, {}).get("discovery") or {}).get("verdict") in NAMING]
    number, parts = part
    folder = results / (f"{name}-{label}" if label else name)
    folder.mkdir(parents=True, exist_ok=True)
    # Not the path of this machine: the label says which checkout.
    kept = "checkout" if solver.startswith("checkout:") else solver
    (folder / "run.json").write_text(json.dumps({"campaigns": name, "solver": kept, "seed": seed}) + "\n")
    done = read_outcomes(folder)
    queue = [(key, work / name / "campaigns" / key) for key in wanted[number - 1 :: parts] if key not in done]
    began = time.monotonic()
    with (folder / f"part_{number}_of_{parts}.jsonl").open("a") as record:
        if record.tell():  # a line that was cut off must not swallow the next one
            record.write("\n")
        for count, outcome in enumerate(workers.outcomes(queue, solver, seed, running), 1):
            record.write(json.dumps(outcome) + "\n")
            record.flush()
            left = (time.monotonic() - began) / count * (len(queue) - count)
            print(f"{count} of {len(queue)}, about {left / 60:.0f} min left", file=sys.stderr, flush=True)
    return len(queue)


def part_of(text: str) -> tuple[int, int]:
    """A part of a run from its text i/n."""
    number, _, parts = text.partition("/")
    if not (number.isdigit() and parts.isdigit() and 1 <= int(number) <= int(parts)):
        raise argparse.ArgumentTypeError(f"{text!r} is no part: say 1/8")
    return int(number), int(parts)


def main(arguments: list[str] | None = None) -> None:
    """Make what is missing, look at the seal, solve a part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", required=True, help="of the run: DATE-SEED")
    parser.add_argument("--part", type=part_of, default=(1, 1), help="i/n: every n-th campaign from the i-th on (1/1)")
    parser.add_argument("--solver", default="inprocess", help="inprocess, module:function or checkout:FOLDER")
    parser.add_argument("--label", default="", help="of another solver's outcomes: they stand in NAME-LABEL")
    parser.add_argument("--subset", type=int, help="only the fixed subset, given by its size (100)")
    parser.add_argument("--named", default="", help="only campaigns in which this run named something")
    parser.add_argument("--seed", type=int, default=0, help="of the solver (0)")
    parser.add_argument("--timeout", type=float, default=SETTINGS.running.timeout_s, help="seconds a campaign")
    given = parser.parse_args(arguments)
    if not (sealing.WORK / given.name / "answers.json").exists():
        sealing.seal(given.name)
    sealing.open_answers(given.name)
    running = replace(SETTINGS.running, timeout_s=given.timeout)
    solve(
        given.name, given.part, label=given.label, solver=given.solver, seed=given.seed, subset=given.subset,
        named=given.named, running=running,
    )  # fmt: skip


if __name__ == "__main__":
    main()
