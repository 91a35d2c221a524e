"""How much does `import mcc_jax` cost over importing what it stands on?

Run `uv run --group bench python benchmarks/bench_import.py`; `--write` keeps the table in `benchmarks/results/`.
`mcc_jax` loads its names at first use, so that the bare statement imports next to nothing; what counts is the second
row, every public name. Each import runs in a fresh process, in turns; the ratio is the median over the rounds.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

import _report

TARGET = 1.5
STATEMENTS = {
    "bare": "import mcc_jax",
    "every name": "from mcc_jax import *",
    "base": "import jax, equinox, optimistix, numpyro",
}


def seconds(statement):
    """Wall-clock time of the statement in a fresh interpreter, its start included."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", statement], check=True)
    return time.perf_counter() - start


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    for statement in STATEMENTS.values():
        seconds(statement)  # fills the caches of the disk and of byte code
    rounds = [{name: seconds(statement) for name, statement in STATEMENTS.items()} for _ in range(arguments.rounds)]

    times, targets = [], []
    for name, statement in STATEMENTS.items():
        column = [one[name] for one in rounds]
        times.append({"statement": f"`{statement}`", "median [s]": statistics.median(column), "min [s]": min(column)})
        if name != "base":
            ratio = statistics.median(one[name] / one["base"] for one in rounds)
            targets.append(_report.verdict(f"{name} / base", ratio, TARGET))
    settings = {"rounds": arguments.rounds, **_report.environment("jax", "jaxlib", "equinox", "optimistix")}
    tables = {"Targets": targets, "Times": times, "Settings": _report.settings(settings)}
    _report.write("import", "Time of import", tables, arguments.write)


if __name__ == "__main__":
    main()
