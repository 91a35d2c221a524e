"""How much does `import mcc_jax` cost over importing what it stands on?

Run `uv run --group bench python benchmarks/bench_import.py`; `--write` keeps the table in `benchmarks/results/`.
Each import runs in a fresh process, in turns; the ratio is the median of the pairs.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time

import _report

TARGET = 1.5
STATEMENTS = {"mcc_jax": "import mcc_jax", "base": "import jax, equinox, optimistix"}


def seconds(statement):
    """Wall-clock time of the statement in a fresh interpreter, its start included."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", statement], check=True)
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=7)
    parser.add_argument("--write", action="store_true", help="keep the table in benchmarks/results/")
    arguments = parser.parse_args()
    for statement in STATEMENTS.values():
        seconds(statement)  # fills the caches of the disk and of byte code
    pairs = [{name: seconds(statement) for name, statement in STATEMENTS.items()} for _ in range(arguments.pairs)]
    ratio = statistics.median(pair["mcc_jax"] / pair["base"] for pair in pairs)
    times = [
        {
            "statement": f"`{STATEMENTS[name]}`",
            "median [s]": statistics.median(pair[name] for pair in pairs),
            "min [s]": min(pair[name] for pair in pairs),
        }
        for name in STATEMENTS
    ]
    settings = {"pairs": arguments.pairs, **_report.environment("jax", "jaxlib", "equinox", "optimistix")}
    tables = {
        "Targets": [{"target": "median ratio", "ratio": ratio, "at most": TARGET, "verdict": ratio <= TARGET}],
        "Times": times,
        "Settings": [{"setting": key, "value": str(value)} for key, value in settings.items()],
    }
    _report.write("import", "Time of import", tables, arguments.write)


if __name__ == "__main__":
    main()
