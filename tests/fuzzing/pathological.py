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
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
SECONDS, MORE_MIB, HANG_S = 10.0, 1024.0, 120
"""Most time of a run without compiling, most memory beyond a plain run's, and when a run is given up [s]."""


@dataclass(frozen=True)
class Outcome:
    """How one run of one case ended.

    Attributes:
        kind, seed, method: which.
        how: "converged", "not converged", "refused" or "failed".
        text: the error's line, or the warnings.
        seconds: without compiling.
        compiling: seconds of that.
        MiB: most memory above that at the start.
        fault: what is wrong with this end; empty if nothing is.
    """

    kind: str
    seed: int
    method: str
    how: str
    text: str
    seconds: float
    compiling: float
    MiB: float
    fault: str


def campaign_of(kind: Kind, seed: int) -> Campaign:
    return kind.make(_generator(kind, seed))


def _generator(kind: Kind, seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, *kind.name.encode()])


def methods_of(kind: Kind, chosen: Sequence[str]) -> list[str]:
    """The methods that a kind can be tried with: damaged files are for the command alone."""
    return [m for m in chosen if kind.damage is None or m in COMMAND]


def run_one(kind: Kind, seed: int, method: str) -> Outcome:
    """Run one case by one method and judge how it ends; what took long runs once more, compiled."""
    found = _run(kind, seed, method)
    if not found.fault and found.seconds > SECONDS:
        found = _run(kind, seed, method)
        if found.seconds > SECONDS:
            found = replace(found, fault=f"took {found.seconds:.1f} s")
    return found


def _run(kind: Kind, seed: int, method: str) -> Outcome:
    compiling = _Compiling.total
    base = _reset_peak()
    began, working = time.perf_counter(), time.process_time()
    content: dict[str, Any] | None = None
    how, text, fault = "failed", "", ""
    try:
        with _given_up(HANG_S), warnings.catch_warnings():
            warnings.simplefilter("error")
            campaign = campaign_of(kind, seed)
            began, working = time.perf_counter(), time.process_time()
            if method in COMMAND:
                content, text = _command(kind, seed, campaign, COMMAND[method])
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
    # Beside other work the clock on the wall counts that, too.
    took = min(time.perf_counter() - began, time.process_time() - working)
    compiling = _Compiling.total - compiling
    peak = _peak() - base
    if content is None and not fault:
        how, fault = "refused", _judge_refusal(kind, text)
    elif content is not None:
        how = "converged" if content["converged"] else "not converged"
        fault = _judge_result(kind, method, content, campaign)
        text = " | ".join(content["warnings"])
    seconds = max(took - compiling, 0.0)
    return Outcome(kind.name, seed, method, how, text, seconds, compiling, peak, fault)


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


def _command(kind: Kind, seed: int, campaign: Campaign, method: str) -> tuple[dict[str, Any] | None, str]:
    """`mcc-jax calibrate` on the campaign's files: the result, or the one line of the error."""
    from click.testing import CliRunner

    from mcc_jax.cli.main import cli

    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "campaign", Path(folder) / "out"
        write_campaign(campaign, place)
        if kind.damage is not None:
            kind.damage(_generator(kind, seed), place)
        arguments = ["calibrate", str(place), "--out", str(out), "--method", method, "--no-figures"]
        ended = CliRunner().invoke(cli, arguments, prog_name="mcc-jax")
        if (out / "calibration.json").exists():
            if ended.exit_code in (1, 2):
                raise AssertionError(f"exit status {ended.exit_code} beside a result: {ended.stderr}")
            return json.loads((out / "calibration.json").read_text(encoding="utf-8")), ""
    line = ended.stderr.strip()
    if ended.exit_code != 2 or not line.startswith("mcc-jax: error: ") or "\n" in line:
        raise AssertionError(f"exit status {ended.exit_code}: {line}")
    if str(place) not in line:
        raise AssertionError(f"the file is not named: {line}")
    if not re.search(r"\. [A-Z]", line.replace(str(place), "")):
        raise AssertionError(f"no remedy: {line}")
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


class _Compiling:
    """Seconds that JAX has spent on compiling."""

    total = 0.0

    @classmethod
    def add(cls, event: str, seconds: float, **_: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":  # tracing and lowering count as the run's own
            cls.total += seconds


jax.monitoring.register_event_duration_secs_listener(_Compiling.add)


def _reset_peak() -> float:
    """Let the kernel count the peak of memory from now on; what is used now [MiB]."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak() -> float:
    return _status("VmHWM")


def _status(name: str) -> float:
    with contextlib.suppress(OSError):
        found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
        return float(found[1]) / 1024 if found else 0.0
    return 0.0


def table(outcomes: Sequence[Outcome]) -> str:
    """Counts by method."""
    ends = ("converged", "not converged", "refused", "failed")
    header = ("method", "runs", *ends, "faults", "slowest [s]", "most memory [MiB]")
    lines = []
    for method in dict.fromkeys(o.method for o in outcomes):
        some = [o for o in outcomes if o.method == method]
        counts = collections.Counter(o.how for o in some)
        faults = sum(bool(o.fault) for o in some)
        slowest, most = max(o.seconds for o in some), max(o.MiB for o in some)
        lines.append((method, len(some), *(counts[e] for e in ends), faults, f"{slowest:.1f}", f"{most:.0f}"))
    cells = [[str(c) for c in line] for line in (header, *lines)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join("  ".join(c.rjust(w) for c, w in zip(line, widths, strict=True)) for line in cells)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing.pathological", description=__doc__)
    parser.add_argument("--cases", type=int, default=200, help="kinds times seeds, as many of each kind")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", action="append", default=[], metavar="WORDS", help="kinds whose names hold these")
    parser.add_argument("--method", action="append", default=[], choices=[*METHODS, *COMMAND, DISCOVER])
    parser.add_argument("--share", default="0/1", help="i/n: every n-th case, from the i-th")
    parser.add_argument("--cache", type=Path, help="where compiled functions are kept between runs")
    parser.add_argument("--verbose", action="store_true", help="a line for every run")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(given.cache or tempfile.mkdtemp(prefix="compiled-")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.03)
    kinds = [k for k in KINDS if not given.only or any(words in k.name for words in given.only)]
    cases = [(kinds[i % len(kinds)], given.first + i // len(kinds)) for i in range(given.cases)]
    start, step = map(int, given.share.split("/"))
    methods = given.method or [*METHODS, *COMMAND]
    outcomes: list[Outcome] = []
    most = 0.0
    for number, (kind, seed) in enumerate(cases[start::step]):
        for method in methods_of(kind, methods):
            found = run_one(kind, seed, method)
            outcomes.append(found)
            if given.verbose or found.fault:
                print(
                    f"{found.method:>21}  {found.kind}, seed {found.seed}: {found.how}, {found.seconds:.1f} s "
                    f"(+{found.compiling:.1f} s compiling), {found.MiB:.0f} MiB"
                    + (f"  FAULT {found.fault}" if found.fault else f"  {found.text[:200]}"),
                    flush=True,
                )
        if number % 20 == 19:
            jax.clear_caches()  # compiled functions of many shapes; they are kept on disk
        most = max(most, _status("VmRSS"))
    print(table(outcomes))
    faults = sum(bool(o.fault) for o in outcomes)
    count = len(cases[start::step])
    print(f"{count} cases of {len(kinds)} kinds, {len(outcomes)} runs, {faults} faults, RSS {most:.0f} MiB")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
