"""Calibrations killed with SIGKILL at any moment: `python -m tests.killing --times 60`.

A folder holds results. Again and again a calibration into it is killed: at a random moment, as soon as it begins to
write, and while finished files are moved into place. What lies in the folder then must be all of the old results or,
once the next run has taken the folder, all of the new ones; every file whole, and the user's own file untouched.
"""

from __future__ import annotations

import argparse
import collections
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mcc_jax._store import READY, WORK, results

COMMAND = [sys.executable, "-m", "mcc_jax"]
NOTE = "notes of the user.txt"


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.killing", description=__doc__)
    parser.add_argument("--times", type=int, default=60, help="how many runs are killed")
    parser.add_argument("--seed", type=int, default=0, help="another seed kills at other moments")
    given = parser.parse_args()
    chance = random.Random(given.seed)
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory(prefix="killing-") as temporary:
        campaign, fit = Path(temporary, "campaign"), Path(temporary, "fit")
        _run("simulate", "--out", campaign, "--points", "40")
        began = time.monotonic()
        _run(*_calibrate(campaign, fit))
        usual = time.monotonic() - began
        (fit / NOTE).write_text("mine")
        while counts["killed"] < given.times:
            counts.update(_killed_once(_calibrate(campaign, fit), fit, chance, usual))
    for what in sorted(counts):
        print(f"{what:40s} {counts[what]}")
    return 1 if counts["LOST"] else 0


def _calibrate(campaign: Path, fit: Path) -> list[str]:
    return ["calibrate", str(campaign), "--out", str(fit), "--method", "paper"]


def _run(*arguments: str | Path) -> None:
    subprocess.run([*COMMAND, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def _killed_once(arguments: list[str], fit: Path, chance: random.Random, usual: float) -> list[str]:
    """What happened to one run and to the folder, as words to count."""
    before = _files(fit)
    when = chance.choice(["at any moment", "while writing", "while moving", "while moving"])
    with subprocess.Popen([*COMMAND, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        if when == "at any moment":
            time.sleep(chance.uniform(0, usual))
        else:
            pattern = f"{WORK}/*" if when == "while writing" else READY
            while process.poll() is None and not any(fit.glob(pattern)):
                pass
            time.sleep(chance.uniform(0, 0.3) if when == "while writing" else chance.uniform(0, 0.002))
        process.kill()
        process.wait()
    if process.returncode == 0:
        return ["had finished before it could be killed"]
    words = ["killed", f"killed {when}"]
    at_once = _state(before, _files(fit))
    if at_once == "mixed":
        words.append("found half moved")
    with results(fit):  # what the next run does first
        pass
    words.append({"old": "old results intact", "new": "new results complete"}.get(_state(before, _files(fit)), "LOST"))
    if not _whole(fit):
        words.append("LOST")
    return words


def _files(fit: Path) -> dict[str, int]:
    """Every visible file and which one it is."""
    return {
        str(file.relative_to(fit)): file.stat().st_ino
        for file in fit.rglob("*")
        if file.is_file() and not file.relative_to(fit).parts[0].startswith(".mcc-jax")
    }


def _state(before: dict[str, int], now: dict[str, int]) -> str:
    if before.keys() != now.keys() or before[NOTE] != now[NOTE]:
        return "mixed"
    same = {before[name] == now[name] for name in now if name != NOTE}
    return {(True,): "old", (False,): "new"}.get(tuple(same), "mixed")


def _whole(fit: Path) -> bool:
    """Whether every file can be read to its end."""
    for file in fit.rglob("*.json"):
        json.loads(file.read_text())
    pictures = [file.read_bytes() for file in fit.rglob("*.png")]
    left_over = [file for file in fit.iterdir() if file.name.startswith(".mcc-jax")]
    return all(p.startswith(b"\x89PNG") and p.endswith(b"IEND\xaeB`\x82") for p in pictures) and not left_over


if __name__ == "__main__":
    sys.exit(main())
