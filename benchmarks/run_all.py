"""Run every benchmark, one after the other, and gather its targets in `README.md`.

Run `uv run --group bench --group bench-dem python benchmarks/run_all.py` on a machine with nothing else to do (an hour
on two cores). `--only law dem` runs some; `--gather` runs none and rewrites the table from `results/`. Every benchmark
runs in a process of its own with `--write`; one that fails is named at the end and does not stop the others.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
SCRIPTS = {
    "law": "bench_law.py",
    "import": "bench_import.py",
    "calibrate": "bench_calibrate.py",
    "dem": "bench_dem.py",
    "bench_dem_quasistatic": "bench_dem_quasistatic.py",
    "dem_lammps": "bench_dem_lammps.py",
    "scale": "bench_scale.py",
}
# Memory for large results is kept between calls. Without it a process is lucky or unlucky with the allocator, and page
# faults of the results cost as much as the law.
KEEP_MEMORY = ":".join(
    f"glibc.malloc.{name}={value}"
    for name, value in {
        "hugetlb": 1,
        "mmap_threshold": 2**25,
        "trim_threshold": 2**34,
        "arena_max": 1,
        "top_pad": 2**26,
    }.items()
)
START, END = "<!-- targets -->", "<!-- end of targets -->"


def run(name: str) -> float:
    """Seconds that the benchmark took; raises if it fails."""
    began = time.monotonic()
    environment = {"GLIBC_TUNABLES": KEEP_MEMORY, **os.environ}
    subprocess.run([sys.executable, HERE / SCRIPTS[name], "--write"], check=True, env=environment)
    return time.monotonic() - began


def gathered() -> list[str]:
    """Lines of the table: every target in `results/`, with command, device and date."""
    lines = ["| claim | measured | limit | | command | device | date |", "|---|---|---|---|---|---|---|"]
    for name, script in SCRIPTS.items():
        file = HERE / "results" / f"{name}.json"
        content = json.loads(file.read_text()) if file.exists() else {}
        settings = {row["setting"]: row["value"] for row in content.get("Settings", [])}
        for row in content.get("Targets", []):
            value = row["value"] if "value" in row else row["ratio"]
            limit = row.get("limit", row.get("at most"))
            claim, least = row["target"].removesuffix(", at least"), row["target"].endswith(", at least")
            limit = limit if isinstance(limit, str) else f"at {'least' if least else 'most'} {limit:g}"
            where = f"{settings.get('cores', '?')} cores, {settings.get('processor', 'unknown')}"
            verdict = "met" if row["verdict"] else "**missed**"
            cells = [claim, f"{value:.3g}", limit, verdict, f"`{script}`", where, settings.get("date", "?")]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def main() -> int:
    """Run, gather, and say what failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SCRIPTS), default=list(SCRIPTS))
    parser.add_argument("--gather", action="store_true", help="run nothing, rewrite the table")
    arguments = parser.parse_args()
    failed = []
    for name in [] if arguments.gather else arguments.only:
        try:
            print(f"{name}: {run(name):.0f} s", flush=True)
        except subprocess.CalledProcessError as error:
            failed.append(f"{name} (exit status {error.returncode})")
    readme = HERE / "README.md"
    before, rest = readme.read_text().split(START)
    readme.write_text(before + "\n".join([START, *gathered(), END]) + rest.split(END)[1])
    if failed:
        print("failed: " + ", ".join(failed), file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    raise SystemExit(main())
