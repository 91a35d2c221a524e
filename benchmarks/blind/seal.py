"""Make the campaigns of a run, seal the answers by a hash before any solver sees them, and open the seal.

`python -m benchmarks.blind.seal --name 2026-11-27-4711` (the last part of a name is its master seed). Campaigns lie in
`work/NAME/campaigns/KEY/`, answers in `work/NAME/answers.json`, the noiseless differences in `work/NAME/truth/KEY.npz`;
`sealed/NAME.txt` holds the hash of the answers: commit it before the run. What was made is kept when the command is
stopped and repeated. `--subset` makes those campaigns only on which baselines run, too.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from . import make
from .plan import Case, digest, keys, plan

HERE = Path(__file__).parent
SEALED, WORK = HERE / "sealed", HERE / "work"


class SealBroken(Exception):
    """Answers or campaigns are not the ones that were sealed."""


def master_of(name: str) -> int:
    """The master seed that a run's name ends with.

    Raises:
        SystemExit: where it ends with none.
    """
    seed = name.rpartition("-")[2]
    if not seed.isdigit():
        raise SystemExit(f"{name}: a run is called DATE-SEED, for example 2026-11-27-4711")
    return int(seed)


def make_one(folder: Path, key: str, case: Case, master: int) -> dict[str, Any]:
    """Make one campaign, or read what was made: its answer, with the hashes of its files."""
    kept = folder / "answers" / f"{key}.json"
    if kept.exists():
        return json.loads(kept.read_text())
    made = make.make(case, master)
    make.write(made, folder / "campaigns" / key)
    (folder / "truth").mkdir(exist_ok=True)
    truth = folder / "truth" / f"{key}.npz"
    np.savez_compressed(truth, left_um=made.left_um.astype("f4"), effect_um=made.effect_um.astype("f4"))
    answer = made.answer | {
        "files": make.digest_of(folder / "campaigns" / key),
        "truth_file": hashlib.sha256(truth.read_bytes()).hexdigest(),
    }
    kept.parent.mkdir(exist_ok=True)
    text = json.dumps(answer)
    kept.write_text(text)
    return json.loads(text)


def seal(name: str, work: Path = WORK, sealed: Path = SEALED, cases: list[Case] | None = None) -> str:
    """Make whatever is missing of a run and write its seal; returns the hash."""
    master, folder = master_of(name), work / name
    planned = plan(master)
    names = keys(master, len(planned))
    wanted = planned if cases is None else cases
    folder.mkdir(parents=True, exist_ok=True)
    answers = {}
    for done, case in enumerate(wanted, 1):
        answers[names[case.number]] = make_one(folder, names[case.number], case, master)
        if done % 20 == 0 or done == len(wanted):
            print(f"made {done} of {len(wanted)}", file=sys.stderr, flush=True)
    tasks = {key: {"subset": answers[key]["case"]["subset"]} for key in sorted(answers)}
    (folder / "tasks.json").write_text(json.dumps(tasks) + "\n")
    content = {"name": name, "plan": digest(master), "answers": dict(sorted(answers.items()))}
    (folder / "answers.json").write_text(json.dumps(content) + "\n")
    found = hashlib.sha256((folder / "answers.json").read_bytes()).hexdigest()
    counts = Counter(case.kind for case in wanted)
    text = (
        f"{found}  answers.json\n{name}: {len(wanted)} campaigns ({', '.join(f'{n} {k}' for k, n in counts.items())})\n"
    )
    place = sealed / f"{name}.txt"
    if place.exists() and place.read_text().split()[0] != found:
        raise SealBroken(f"{name} was sealed with other answers")
    sealed.mkdir(exist_ok=True)
    place.write_text(text)
    return found


def open_answers(name: str, work: Path = WORK, sealed: Path = SEALED) -> dict[str, dict[str, Any]]:
    """The answers by campaign, if they are the sealed ones.

    Raises:
        SealBroken: if the hash of the answers is not the sealed one.
    """
    data = (work / name / "answers.json").read_bytes()
    if hashlib.sha256(data).hexdigest() != (sealed / f"{name}.txt").read_text().split()[0]:
        raise SealBroken(f"{name}: answers.json is not the file that was sealed")
    return json.loads(data)["answers"]


def truth_of(name: str, key: str, answer: dict[str, Any], work: Path = WORK) -> tuple[np.ndarray, np.ndarray]:
    """What no base law takes up of the hidden effect, and the effect itself, um, at every reading before a fault.

    Raises:
        SealBroken: if the file is not the one that was sealed.
    """
    place = work / name / "truth" / f"{key}.npz"
    if hashlib.sha256(place.read_bytes()).hexdigest() != answer["truth_file"]:
        raise SealBroken(f"{name}: {place.name} is not the file that was sealed")
    with np.load(place) as held:
        return held["left_um"].astype(float), held["effect_um"].astype(float)


def main(arguments: list[str] | None = None) -> None:
    """Make and seal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--name", required=True, help="DATE-SEED")
    parser.add_argument("--subset", action="store_true", help="only the campaigns on which baselines run")
    asked = parser.parse_args(arguments)
    cases = [case for case in plan(master_of(asked.name)) if case.subset] if asked.subset else None
    print(seal(asked.name, cases=cases))


if __name__ == "__main__":
    main()
