"""Damaged files for every reader: `python -m tests.fuzzing --inputs 1000000`."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from runner import Watched, run, shares
from targets import READERS

HEADER = ("reader", "inputs", "refused", "read", "failures", "slowest [ms]", "peak memory [MiB]", "inputs/s")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing", description=__doc__)
    parser.add_argument("--inputs", type=int, default=10_000, help="number of inputs, shared among the readers")
    parser.add_argument("--seed", type=int, default=0, help="another seed gives other inputs")
    parser.add_argument("--first", type=int, default=0, help="number of the first input, to repeat one")
    parser.add_argument("--only", action="append", default=[], choices=[r.name for r in READERS], metavar="READER")
    parser.add_argument("--out", type=Path, help="where inputs that fail are kept [a new temporary folder]")
    given = parser.parse_args()
    out = given.out or Path(tempfile.mkdtemp(prefix="fuzzing-"))
    began = time.monotonic()
    table = run(Watched("targets", shares("targets", given.inputs, given.first, given.only), given.seed, out))
    rows = [_row(name, values) for name, values in table.items()]
    widths = [max(map(len, column)) for column in zip(HEADER, *rows, strict=True)]
    for row in (HEADER, *rows):
        print("  ".join(x.rjust(w) if i else x.ljust(w) for i, (x, w) in enumerate(zip(row, widths, strict=True))))
    inputs, failures = (int(sum(values[key] for values in table.values())) for key in ("inputs", "failures"))
    print(f"{inputs} inputs with seed {given.seed} in {time.monotonic() - began:.0f} s, {failures} failures")
    for kind in sorted(out.glob("*/*")):
        print(f"  {kind.parent.name}: {kind.name}, for example {sorted(kind.iterdir())[0]}")
    return 1 if failures else 0


def _row(name: str, v: dict[str, float]) -> tuple[str, ...]:
    rate = v["inputs"] / v["seconds"] if v["seconds"] else 0.0
    counts = (f"{v[key]:.0f}" for key in ("inputs", "refused", "read", "failures"))
    return (name, *counts, f"{v['slowest_ms']:.1f}", f"{v['peak_MiB']:.0f}", f"{rate:.0f}")


sys.exit(main())
