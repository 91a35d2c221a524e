"""The second blind test: make its campaigns, solve them, grade the answers.

`python -m benchmarks.blind.second --out FOLDER` makes the campaigns (three minutes), `--solve` and `--score` work on a
folder that was made. Finished cases are kept in FOLDER/results.jsonl and skipped when the command is repeated.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from benchmarks.blind.second import effects, folder
from benchmarks.blind.second.plan import TIERS


def _list():
    for formula in (*(f for formulas in effects.LISTED.values() for f in formulas), *effects.UNLISTED):
        print(f"{formula.mechanism:28s} {formula.text}  [{formula.unit}]")


def _progress():
    began = time.monotonic()

    def show(done, total, key, answer):
        passed = time.monotonic() - began
        print(
            f"{passed:6.1f} s  {done} of {total}  {key} {answer['tier']:8s} {answer['mechanism']:34s} "
            f"lambda {answer['lambda']:5.1f}  {answer['protocol']}  {answer['n_particles']} particles",
            file=sys.stderr,
            flush=True,
        )

    return show


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder of the campaigns; to make them it must be new or empty")
    parser.add_argument("--seed", type=int, default=0, help="of the campaigns (0)")
    parser.add_argument("--list", action="store_true", help="show the formulas and do nothing")
    parser.add_argument("--only", nargs="+", choices=TIERS, metavar="TIER", help=f"make only these: {', '.join(TIERS)}")
    parser.add_argument("--limit", type=int, help="make no more campaigns than this")
    parser.add_argument("--solve", action="store_true", help="run the solver on the campaigns of the folder")
    parser.add_argument("--solver", default="inprocess", help="inprocess, command or module:function")
    parser.add_argument("--jobs", type=int, default=2, help="worker processes of the solver (2)")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds per campaign (300)")
    parser.add_argument("--score", action="store_true", help="grade what was solved")
    parser.add_argument("--write", action="store_true", help="with --score, keep the tables in benchmarks/results")
    args = parser.parse_args(arguments)
    if args.list:
        _list()
        return
    if args.out is None:
        parser.error("--out is needed")
    if args.write and not args.score:
        parser.error("--write goes with --score")
    if not args.solve and not args.score:
        try:
            folder.make(args.out, args.seed, args.only, args.limit, _progress())
        except FileExistsError as error:
            parser.error(str(error))
        return
    if not (args.out / "tasks.json").exists():
        parser.error(f"{args.out} holds no campaigns: make them first, without --solve and --score")
    if args.solve:
        # Only here: the generator must not load the first bench.
        from benchmarks.blind import run

        if args.jobs > 1:
            os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
        run.solve(args.out, solver=args.solver, jobs=args.jobs, timeout=args.timeout)
    if args.score:
        from benchmarks.blind.second import grading

        grading.report(args.out, record=args.write)


if __name__ == "__main__":
    main()
