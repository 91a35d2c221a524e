"""Pathological campaigns through Python and the command: `python -m tests.fuzzing.pathological --cases 200`."""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import re
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parent))

import jax
import numpy as np
from pathological_kinds import KINDS, MODULUS_MPA, Kind

from mcc_jax import Campaign, InputError, write_campaign
from mcc_jax.calibrate import calibrate_paper, least_squares, sample

METHODS: dict[str, Callable[[Campaign], Any]] = {
    "paper": calibrate_paper,
    "least-squares": least_squares,
    "bayes": lambda campaign: sample(campaign, draws=500),
}
COMMAND = {"command least-squares": "least-squares", "command paper": "paper"}
DISCOVER = "discover"
HANG_S = 120
"""When a run is given up [s]."""


class Outcome(NamedTuple):
    """How one case ended: "converged", "not converged", "refused" or "failed"; the error's line, or the warnings; and
    what is wrong with this end, empty if nothing is."""

    how: str
    text: str
    fault: str


def campaign_of(kind: Kind, seed: int) -> Campaign:
    return kind.make(np.random.default_rng([seed, *kind.name.encode()]))


def run_one(kind: Kind, seed: int, method: str) -> Outcome:
    """Run one case by one method and judge how it ends."""
    campaign: Campaign | None = None
    content: dict[str, Any] | None = None
    text, fault = "", ""
    try:
        with _given_up(HANG_S), warnings.catch_warnings():
            warnings.simplefilter("error")
            campaign = campaign_of(kind, seed)
            if method in COMMAND:
                content, text = _command(campaign, COMMAND[method])
            elif method == DISCOVER:
                content = _discover(campaign)
            else:
                content = METHODS[method](campaign).to_json()
    except InputError as error:
        text = str(error)
        if not error.remedy:
            fault = "an error without a remedy"
    except Exception as error:  # whatever it is, it is what is looked for
        where = traceback.extract_tb(error.__traceback__)[-1]
        fault = f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {error}"
    if campaign is not None and content is not None:
        how = "converged" if content["converged"] else "not converged"
        return Outcome(how, " | ".join(content["warnings"]), _judge_result(kind, method, content, campaign))
    if fault:
        return Outcome("failed", text, fault)
    return Outcome("refused", text, _judge_refusal(kind, text))


def _judge_refusal(kind: Kind, text: str) -> str:
    if kind.reads:
        return f"valid data refused: {text}"
    if "\n" in text or len(text) > 1200:
        return f"not one line: {text}"
    if "()" in text:
        return f"no reason given: {text}"
    if kind.says and kind.says not in text:
        return f"does not say {kind.says!r}: {text}"
    return ""


def _judge_result(kind: Kind, method: str, content: dict[str, Any], campaign: Campaign) -> str:
    try:
        json.dumps(content, allow_nan=False)
    except ValueError:
        return "a number that is not finite: " + ", ".join(_not_finite(content))
    if kind.refused:
        return "should have been refused"
    why_not = [entry["why_not"] for entry in content.get("particles", ())]
    if any(entry["kept"] == bool(entry["why_not"]) for entry in content.get("particles", ())):
        return "a particle left out without its reason"
    if kind.says and not any(why and kind.says in why for why in why_not):
        return f"no particle's reason says {kind.says!r}: {why_not}"
    if not content["converged"] and not content["warnings"]:
        return "not converged, and no word why"
    if kind.suspect and content["converged"] and not content["warnings"]:
        return "nonsense without a warning"
    if kind.slip and not content.get("findings", True) and not content["warnings"]:
        return "a slip without a word"
    if kind.modulus and "paper" not in method and content["converged"]:
        modulus = content["effective_modulus_MPa"]["value"]
        true = campaign.metadata.other.get("simulation", {}).get("effective_modulus_MPa", MODULUS_MPA)
        if not 1 / kind.modulus < modulus / true < kind.modulus:
            return f"modulus {modulus:.4g} MPa where {true:.4g} is true"
    return ""


def _not_finite(content: Any, name: str = "") -> Iterator[str]:
    if isinstance(content, dict):
        for key, value in content.items():
            yield from _not_finite(value, f"{name}.{key}")
    elif isinstance(content, list | tuple):
        for i, value in enumerate(content):
            yield from _not_finite(value, f"{name}[{i}]")
    elif isinstance(content, float) and not np.isfinite(content):
        yield f"{name.lstrip('.')} = {content}"


def _command(campaign: Campaign, method: str) -> tuple[dict[str, Any] | None, str]:
    """`mcc-jax calibrate` on the campaign's files: the result, or the one line of the error."""
    from click.testing import CliRunner

    from mcc_jax.cli.main import cli

    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "campaign", Path(folder) / "out"
        write_campaign(campaign, place)
        arguments = ["calibrate", str(place), "--out", str(out), "--method", method, "--no-figures"]
        ended = CliRunner().invoke(cli, arguments, prog_name="mcc-jax")
        if (out / "calibration.json").exists():
            assert ended.exit_code not in (1, 2), f"exit status {ended.exit_code} with a result: {ended.stderr}"
            return json.loads((out / "calibration.json").read_text(encoding="utf-8")), ""
    line = ended.stderr.strip()
    assert ended.exit_code == 2, f"exit status {ended.exit_code}: {line}"
    assert re.fullmatch(rf"mcc-jax: error: .*{re.escape(str(place))}.*\. [A-Z].*", line), f"no file or remedy: {line}"
    return None, line


def _discover(campaign: Campaign) -> dict[str, Any]:
    from mcc_jax import discover

    found = discover(campaign, confirm=False, experiments=False, posterior=False).to_json()
    return {"converged": found["verdict"] != "FIT_NOT_CONVERGED", "warnings": [found["verdict"]], "found": found}


@contextlib.contextmanager
def _given_up(seconds: int) -> Iterator[None]:
    """Raise where the code is after so many seconds."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"no end after {seconds} s")

    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing.pathological", description=__doc__)
    parser.add_argument("--cases", type=int, default=200, help="kinds times seeds, as many of each kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", action="append", default=[], metavar="WORDS", help="kinds whose names hold these")
    parser.add_argument("--method", action="append", default=[], choices=[*METHODS, *COMMAND, DISCOVER])
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kinds = [k for k in KINDS if not given.only or any(words in k.name for words in given.only)]
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    faults = 0
    for number in range(given.cases):
        kind, seed = kinds[number % len(kinds)], given.first + number // len(kinds)
        for method in given.method or [*METHODS, *COMMAND]:
            found = run_one(kind, seed, method)
            counts[method, found.how] += 1
            if found.fault:
                faults += 1
                print(f"{method}, {kind.name}, seed {seed}: {found.how}: {found.fault}", flush=True)
        if number % 20 == 19:
            jax.clear_caches()  # compiled functions of many shapes
    for (method, how), count in sorted(counts.items()):
        print(f"{method:>21}  {how:13} {count}")
    print(f"{given.cases} cases of {len(kinds)} kinds, {counts.total()} runs, {faults} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
