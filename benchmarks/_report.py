"""What every benchmark records: versions and device, never a machine's name or path."""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def parser(description):
    """A parser of the command line that shows the text as it stands and knows `--write`."""
    options = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--write", action="store_true", help="keep the result in benchmarks/results/")
    return options


def environment(*packages):
    """Date, processor, versions, number of cores and the C allocator's settings, for the record."""
    return {
        "date": datetime.date.today().isoformat(),
        "processor": _processor(),
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
        "cores": len(os.sched_getaffinity(0)),
        "GLIBC_TUNABLES": os.environ.get("GLIBC_TUNABLES", ""),
    }


def _processor():
    """The processor's type."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def verdict(target, value, limit, *, at_least=False):
    """Row of the table of targets."""
    passed = value >= limit if at_least else value <= limit
    text = f"at {'least' if at_least else 'most'} {limit:g}"
    return {"target": target, "value": value, "limit": text, "verdict": bool(passed)}


def settings(values):
    """Rows of the table of settings."""
    return [{"setting": key, "value": str(value)} for key, value in values.items()]


def table(rows):
    """A markdown table of dictionaries with the same keys."""
    keys = list(rows[0])
    cells = [keys, ["---"] * len(keys)] + [[_text(row[key]) for key in keys] for row in rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in cells)


def _text(value):
    if isinstance(value, bool):
        return "PASS" if value else "FAIL"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write(name, title, tables, record):
    """Print the tables and, if `record` holds, keep them in `results/name.md` and `.json`."""
    text = f"# {title}\n\n" + "\n\n".join(f"## {heading}\n\n{table(rows)}" for heading, rows in tables.items()) + "\n"
    print(text)
    if record:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / f"{name}.md").write_text(text)
        (RESULTS / f"{name}.json").write_text(json.dumps(tables, indent=1) + "\n")
