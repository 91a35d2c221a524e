"""The blind test in one command: generate, seal, solve, score.

`python -m benchmarks.blind.run --out FOLDER` (or this file by its path). Finished cases are kept in
FOLDER/results.jsonl and skipped when the command is repeated; the sealed campaigns are kept as well.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import shutil
import sys
import time
import traceback
from collections import deque
from multiprocessing.connection import wait
from pathlib import Path

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.blind import adapter, score, sealing, smoke
from benchmarks.blind.generator import tiers


def _worker(pipe, solver, seed):
    """Solve what comes through the pipe until None comes."""
    with contextlib.suppress(Exception):  # a solver that cannot be found shows in every result
        adapter.find(solver)
    pipe.send(None)  # started: from here on time counts
    cold = True
    while (task := pipe.recv()) is not None:
        began = time.perf_counter()
        try:
            solve = adapter.find(solver)
            discovery = solve(Path(task["folder"]), exclude=tuple(task["exclude"]), seed=seed, options=task["options"])
            wrong = adapter.problem(discovery)
            result = {"status": "invalid" if wrong else "ok", "error": wrong, "discovery": discovery}
        except Exception as error:
            lines = traceback.format_exc().splitlines()[-6:]
            result = {"status": "crash", "error": f"{type(error).__name__}: {error}", "trace": lines, "discovery": None}
        pipe.send({"key": task["key"], "wall_s": time.perf_counter() - began, "cold": cold, **result})
        cold = False


class _Pool:
    """Worker processes that can be stopped and replaced: a case that hangs or kills its process costs only itself."""

    def __init__(self, jobs, solver, seed, timeout):
        self._context = multiprocessing.get_context("spawn")
        self._solver, self._seed, self._timeout = solver, seed, timeout
        self._workers = [self._start() for _ in range(jobs)]

    def _start(self):
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_worker, args=(theirs, self._solver, self._seed), daemon=True)
        process.start()
        theirs.close()
        return {"process": process, "pipe": ours, "task": None, "began": 0.0, "started": False}

    def run(self, tasks):
        """Yield results as they come."""
        waiting = deque(tasks)
        try:
            while waiting or any(w["task"] for w in self._workers):
                for worker in self._workers:
                    if worker["started"] and worker["task"] is None and waiting:
                        worker["task"], worker["began"] = waiting.popleft(), time.monotonic()
                        # A worker that has died meanwhile shows below, as a pipe at its end.
                        with contextlib.suppress(BrokenPipeError):
                            worker["pipe"].send(worker["task"])
                busy = [w for w in self._workers if w["task"] or not w["started"]]
                ready = wait([w["pipe"] for w in busy], timeout=1.0)
                for worker in busy:
                    if not worker["started"]:
                        if worker["pipe"] in ready:
                            try:
                                worker["pipe"].recv()
                            except (EOFError, ConnectionResetError):
                                raise RuntimeError("a worker died while it started: does the solver import?") from None
                            worker["started"] = True
                    elif worker["pipe"] in ready:
                        try:
                            yield worker["pipe"].recv()
                            worker["task"] = None
                        except (EOFError, ConnectionResetError):
                            yield self._lost(worker, "crash", "the process died")
                    elif time.monotonic() - worker["began"] > self._timeout:
                        yield self._lost(worker, "timeout", f"no answer in {self._timeout:g} s")
        finally:
            for worker in self._workers:
                with contextlib.suppress(OSError):
                    worker["pipe"].send(None)
                worker["process"].join(2)
                if worker["process"].is_alive():
                    worker["process"].kill()

    def _lost(self, worker, status, error):
        result = {
            "key": worker["task"]["key"],
            "wall_s": time.monotonic() - worker["began"],
            "cold": False,
            "status": status,
            "error": error,
            "discovery": None,
        }
        worker["process"].kill()
        worker["process"].join()
        worker.update(self._start())
        return result


def read_results(folder):
    """Results by key; a line that was cut off is left out, so its case runs again."""
    results = {}
    path = Path(folder) / "results.jsonl"
    for line in path.read_text().splitlines() if path.exists() else ():
        with contextlib.suppress(json.JSONDecodeError):
            entry = json.loads(line)
            results[entry["key"]] = entry
    return results


def _progress(what):
    began = time.monotonic()
    last = [0.0]

    def show(done, total):
        now = time.monotonic()
        if now - last[0] > (2.0 if sys.stderr.isatty() else 60.0) or done == total:
            last[0] = now
            left = (now - began) / max(done, 1) * (total - done)
            print(f"{what}: {done} of {total}, about {left / 60:.0f} min left", file=sys.stderr, flush=True)

    return show


def solve(folder, *, solver="inprocess", jobs=2, seed=0, timeout=300.0, repeat=0, keys=None, asked=None):
    """Run the solver on every task of a sealed folder that has no result yet.

    keys: the tasks; those of the folder if None. asked: options of tasks that are not the folder's own.
    """
    folder = Path(folder)
    tasks = json.loads((folder / "tasks.json").read_text())
    done = read_results(folder)
    wanted = {key: key for key in (keys or tasks)}
    wanted |= {f"{key}#repeat": key for key in list(tasks)[:repeat]}
    queue = [
        {
            "key": key,
            "folder": str(folder / "campaigns" / base.split("#")[0]),
            **tasks.get(base, {"exclude": [], "options": asked or {}}),
        }
        for key, base in wanted.items()
        if key not in done
    ]
    if not queue:
        return done
    show = _progress("solving")
    with (folder / "results.jsonl").open("a") as record:
        # A cut-off line from an interrupted run must not swallow the next one.
        if record.tell():
            record.write("\n")
        for number, result in enumerate(_Pool(min(jobs, max(1, len(queue))), solver, seed, timeout).run(queue), 1):
            record.write(json.dumps(result) + "\n")
            record.flush()
            show(number, len(queue))
    return read_results(folder)


def solve_cold(folder, *, solver="inprocess", seed=0, timeout=300.0):
    """Solve the first campaign of 20 particles once more: alone, by a new process, with nothing compiled before."""
    folder = Path(folder)
    tasks = json.loads((folder / "tasks.json").read_text())
    done = read_results(folder)
    twenty = (k for k in tasks if len((folder / "campaigns" / k / "particles.csv").read_text().splitlines()) == 21)
    key = next(twenty, None)
    if key is None or f"{key}#cold" in done:
        return
    task = {"key": f"{key}#cold", "folder": str(folder / "campaigns" / key), **tasks[key]}
    hidden = {name: os.environ.pop(name) for name in SHARED_SETTINGS if name in os.environ}
    try:
        (result,) = _Pool(1, solver, seed, timeout).run([task])
    finally:
        os.environ.update(hidden)
    with (folder / "results.jsonl").open("a") as record:
        record.write("\n" + json.dumps(result) + "\n")


SHARED_SETTINGS = ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")
"""What workers side by side are told, and a user's process is not."""


NAMES_ONLY = {"confirm": False, "experiments": False, "posterior": False}
"""What a solver is asked once a proposed experiment was carried out: is one name left?"""


def follow_up(folder, content, **options):
    """Carry out the first proposed experiment of every campaign that got a set, and ask again."""
    results = read_results(folder)
    path = Path(folder) / "follow_up.json"
    answers = json.loads(path.read_text()) if path.exists() else {}
    for key, answer in content["answers"].items():
        found = (results.get(key) or {}).get("discovery") or {}
        if f"{key}+next" in answers or answer["case"]["tier"] not in ("T1", "T2") or found.get("verdict") != "SET":
            continue
        changes = adapter.follow_up_of(found.get("next_experiments") or [], answer["case"])
        made = None if changes is None else sealing.follow_up(folder, key, answer, changes)
        answers[f"{key}+next"] = made and {"changes": changes, "lambda": [e["lambda"] for e in made["effects"]]}
    path.write_text(json.dumps(answers) + "\n")
    solve(folder, keys=[key for key, made in answers.items() if made], asked=NAMES_ONLY, **options)
    return answers


def _fractions(text):
    """The share of each tier; under "" that of those not named."""
    found = {}
    for part in text.split(","):
        tier, _, share = part.rpartition("=")
        if tier and tier not in tiers.TIERS:
            raise argparse.ArgumentTypeError(f"no tier {tier!r}; there are {', '.join(tiers.TIERS)}")
        try:
            found[tier] = float(share)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{share!r} is no number") from None
        if not 0 < found[tier] <= 1:
            raise argparse.ArgumentTypeError(f"a share must be more than 0 and at most 1, got {share}")
    return found


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; an existing one is continued")
    parser.add_argument("--name", default="blind", help="name of the run in its seal")
    parser.add_argument("--tiers", default=",".join(tiers.TIERS), help="for example T0,T1")
    parser.add_argument(
        "--seeds", type=int, default=tiers.SEEDS, help="campaigns per cell (T0: times 50 clean, 20 per nuisance)"
    )
    parser.add_argument(
        "--fraction", type=_fractions, default={}, help="share of each tier to run: 0.02, or T0=0.1,T1=0.02"
    )
    parser.add_argument("--smoke", action="store_true", help="the fixed 40 cases instead of tiers")
    parser.add_argument("--seed", type=int, help="master seed of the generator (default: random, told in the answers)")
    parser.add_argument("--solver", default="inprocess", help="inprocess, command or module:function")
    parser.add_argument("--solver-seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds per campaign")
    parser.add_argument("--repeat", type=int, default=4, help="campaigns solved twice, for determinism")
    parser.add_argument(
        "--follow-up", action="store_true", help="carry out the proposed experiment where a set was found"
    )
    parser.add_argument(
        "--stop-after", choices=("seal", "solve"), help="for committing the seal before the solver runs"
    )
    parser.add_argument("--fresh", action="store_true", help="forget an existing run in --out")
    parser.add_argument("--write", action="store_true", help="keep seal, tables and pictures in the repository")
    args = parser.parse_args(arguments)
    if args.jobs > 1:
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")

    if args.fresh and (args.out / "seal.txt").exists():
        shutil.rmtree(args.out)
    if not (args.out / "seal.txt").exists():
        if args.smoke:
            cases, master = smoke.cases(), smoke.MASTER_SEED
        else:
            chosen = args.tiers.split(",")
            share = [args.fraction.get(tier, args.fraction.get("", 1.0)) for tier in chosen]
            parts = [tiers.plan((t,), args.seeds, f) for t, f in zip(chosen, share, strict=True)]
            cases, master = [case for part in parts for case in part], args.seed
        sealing.seal(args.out, cases, master, args.jobs, args.name, progress=_progress("generating"))
    print((args.out / "seal.txt").read_text(), end="")
    if args.write:
        sealing.SEALED.mkdir(exist_ok=True)
        kept = sealing.SEALED / f"{args.name}.txt"
        if not kept.exists():
            shutil.copy(args.out / "seal.txt", kept)
    if args.stop_after == "seal":
        return
    options = {"solver": args.solver, "jobs": args.jobs, "seed": args.solver_seed, "timeout": args.timeout}
    solve_cold(args.out, **{name: value for name, value in options.items() if name != "jobs"})
    solve(args.out, repeat=args.repeat, **options)
    if args.stop_after == "solve":
        return
    seal_file = sealing.SEALED / f"{args.name}.txt" if args.write else None
    if args.follow_up:
        follow_up(args.out, sealing.open_answers(args.out, seal_file), **options)
    score.report(args.out, record=args.write, seal_file=seal_file)


if __name__ == "__main__":
    main()
