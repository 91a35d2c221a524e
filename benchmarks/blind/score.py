"""Answers against discoveries: every row of the acceptance table, with gate, ambition and interval.

`python -m benchmarks.blind.score FOLDER [--write]`; several folders are scored together, which says more than one run
of few campaigns of a kind, though the solver was another from run to run. A crash, a time-out, an invalid answer and
FIT_NOT_CONVERGED count against the solver wherever a rate is formed. A row whose quantity the solver does not give
reads "not measured", never PASS.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import _report
from benchmarks.blind import sealing
from benchmarks.blind.scoring import (
    Outcome,
    acceptance,
    against_ideal,
    by_mechanism,
    by_noise,
    confusion,
    confusion_rows,
    failures,
    gaps,
    pictures,
)


def outcomes(folder, seal_file=None):
    """All campaigns with answers and results; those without a result are left out.

    Raises:
        sealing.SealBroken: if the answers are not the sealed ones.
    """
    from benchmarks.blind.run import read_results

    content = sealing.open_answers(folder, seal_file)
    results = read_results(folder)
    found = [Outcome(key, answer, results[key]) for key, answer in content["answers"].items() if key in results]
    return found, results, content


def report(folder, record=False, seal_file=None):
    """Score a folder: print the tables, and with `record` keep them in `benchmarks/results/`."""
    found, results, content = outcomes(folder, seal_file)
    if not found:
        raise SystemExit(f"{folder} holds no results")
    missing = sorted({name for o in found for name in o.found.get("options_not_offered") or []})
    run = {
        **_seal(folder),
        "scored": _scored(found, content),
        "options the solver does not offer": ", ".join(missing) or "none",
        **{str(k): str(v) for k, v in _report.environment("numpy", "scipy").items()},
    }
    tables = {
        "Run": [{"what": key, "value": value} for key, value in run.items()],
        "Acceptance": acceptance(found, results),
    }
    tables |= _tables_of(found)
    tables |= _pictures(found, _report.RESULTS if record else Path(folder), "blind")
    _report.write("blind", "Blind test of the discovery workflow", tables, record)
    return tables


def _seal(folder):
    """What the seal of a folder says."""
    first, *rest = (Path(folder) / "seal.txt").read_text().splitlines()
    return {"sealed answers (SHA-256)": first.split()[0], **dict(line.split(": ", 1) for line in rest if ": " in line)}


def _scored(found, content):
    return f"{len(found)} of {len(content['answers'])}"


def _tables_of(found):
    """What stands beside the acceptance, as far as the campaigns say something about it."""
    tables = {
        "Named first, beside an ideal score test": against_ideal(found),
        "Named first, by mechanism (lambda and protocol)": by_mechanism(found),
        "Named first, by noise and number of particles (lambda >= 5)": by_noise(found),
        "Confusion, exact formulas, lambda 10 and 20": confusion_rows(confusion(found)),
        "Held-out gap": gaps(found),
        "Failures": failures(found),
    }
    return {heading: rows for heading, rows in tables.items() if rows}


def _pictures(found, place, prefix):
    """The pictures, made in a folder, as a table."""
    made = pictures(found, place, prefix)
    return {"Pictures": [{"picture": f"![{name}]({name})"} for name in made]} if made else {}


def report_together(folders, record=False):
    """Score several runs as one: print the tables, and with `record` keep them in `benchmarks/results/`; without, the
    pictures lie in the first folder.

    Raises:
        sealing.SealBroken: if answers are not the sealed ones; with `record`, those whose seal the repository holds.
    """
    runs, found, results = [], [], {}
    for folder in map(Path, folders):
        seal = _seal(folder)
        name = seal.get("run", folder.name)
        if any(name == row["run"] for row in runs):
            raise SystemExit(f"{folder}: run {name!r} is given twice; leave one out")
        own, answers, content = outcomes(folder, sealing.SEALED / f"{name}.txt" if record else None)
        runs.append({"run": name, "scored": _scored(own, content), **seal})
        found += [replace(o, key=f"{name}/{o.key}") for o in own]
        results |= {f"{name}/{key}": entry for key, entry in answers.items()}
    tables = {
        "Runs": [
            {key: row.get(key, "") for key in ("run", "scored", "cases", "sealed answers (SHA-256)")} for row in runs
        ],
        "Acceptance, all runs together": acceptance(found, results),
    }
    tables |= _tables_of(found)
    tables |= _pictures(found, _report.RESULTS if record else Path(folders[0]), "blind_runs")
    _report.write("blind_runs", "Sealed blind tests together, each solved by the solver of its day", tables, record)
    return tables


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+", help="of a run; several are scored together")
    parser.add_argument("--seal", type=Path, help="sealed hash to verify one run against (default: its seal.txt)")
    parser.add_argument("--write", action="store_true", help="keep tables and pictures in benchmarks/results")
    args = parser.parse_args(arguments)
    if len(args.folder) > 1:
        if args.seal:
            parser.error("--seal is for one run; with --write the seals kept in the repository count")
        report_together(args.folder, record=args.write)
    else:
        report(args.folder[0], record=args.write, seal_file=args.seal)


if __name__ == "__main__":
    main()
