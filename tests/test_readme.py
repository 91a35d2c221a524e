"""What README shows runs, and what it claims of the set-up is what CI does."""

import importlib
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from mcc_jax import __version__
from mcc_jax.campaign import Campaign, write_campaign
from mcc_jax.cli.main import cli
from mcc_jax.simulate import Instrument, paper_campaign

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
HOW_TO = ROOT / ".docs" / "pages" / "how-to"
PAGES = {name: (HOW_TO / f"{name}.md").read_text(encoding="utf-8") for name in ("commands", "discover", "devices")}
RESULTS = ROOT / "benchmarks" / "results"


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"^```{language}[^\n]*\n(.*?)^```$", text, flags=re.M | re.S)


@pytest.mark.notebook
def test_python_blocks_run():
    assert blocks("python")
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), {})


def test_every_block_is_of_a_kind_that_is_run():
    """Python, the two commands of the set-up (CI), and commands."""
    for block in blocks(""):
        assert block.startswith(("import ", "python3 -m pip install uv", "uv run mcc-jax"))


def cell(file: str, keys: tuple[str, ...], column: str) -> str:
    """The entry in a column of the first table that has it, in the first row that begins with the keys."""
    header: list[str] = []
    for line in (RESULTS / file).read_text(encoding="utf-8").splitlines():
        cells = [part.strip() for part in line.strip().strip("|").split(" | ")] if line.startswith("|") else []
        header = [] if not cells else header or cells
        if column in header and tuple(cells[: len(keys)]) == keys:
            return cells[header.index(column)]
    raise AssertionError(f"{file} has no row {keys} with a column {column}")


SET = "2026-11-27-84117"
BLIND = f"blind/{SET}/score.md"
HARDER = "2026-11-28-29852-final"
BASELINES = {"oracle": "oracle", "aic": "AIC", "discrepancy": "discrepancy"}
"""Labels of the runs of other methods, and what README calls them."""
SEALED = {
    "right name alone": "right name alone, lambda >= 10",
    "both named": "two effects, both named, lambda >= 20, correlation < 0.8",
    "false alarm": "alarm, nothing hidden",
    "outside the library": "UNLISTED said, residual lambda >= 10",
    "true modulus": "effective_modulus_MPa within its 95 % interval",
}
"""Rows of the table of sealed campaigns, by words of README."""
LAMMPS = ("1000", "whole stroke", "CPU")
CLAIMS = [
    *((word, BLIND, (row,), column) for word, row in SEALED.items() for column in ("found", "n")),
    *((word, BLIND, (SEALED[word],), f"{SET}-{name}") for word in list(SEALED)[:-1] for name in BASELINES),
    ("true modulus", BLIND, (SEALED["true modulus"],), "bar"),
    ("posterior", "calibrate.md", ("posterior, warm [s]",), "value"),
    ("posterior", "calibrate.md", ("posterior from a new process, nothing compiled before [s]",), "value"),
    ("NumPyro", "calibrate.md", ("textbook, NumPyro, centred",), "seconds"),
    ("PyMC", "calibrate.md", ("textbook, PyMC and nutpie, centred",), "seconds"),
    ("least squares", "calibrate.md", ("mcc_jax, the least squares alone",), "seconds"),
    ("SciPy", "calibrate.md", ("scipy.optimize.least_squares",), "seconds"),
    ("lmfit", "calibrate.md", ("lmfit.minimize",), "seconds"),
    ("million contacts", "law.md", ("contacts", "step"), "median [ms]"),
    ("numba", "law.md", ("contacts", "numba"), "median [ms]"),
    ("fastmath", "law.md", ("contacts", "numba fastmath"), "median [ms]"),
    *(("LAMMPS", "dem_lammps.md", LAMMPS, f"{code} [particle-steps/s]") for code in ("mcc", "MDR", "Hertz")),
]
"""A word of a row of README's scoreboard, and the source of its number: table, first cells of the row, column."""


def drifted(readme: str) -> list[str]:
    """Every claim of a README whose number is not that of its table."""
    found = []
    for word, file, keys, column in CLAIMS:
        (row,) = [line for line in readme.splitlines() if line.startswith("| ") and word in line]
        number = cell(file, keys, column).split("%")[0].split(" (")[0].lstrip("<>= ").strip()
        baseline = BASELINES.get(column.removeprefix(f"{SET}-"))
        if baseline:
            number = f"{baseline} {number}"
        elif file == BLIND and column == "found":
            number = f"{number} % of"
        if not re.search(rf"(?<![\d.]){re.escape(number)}(?!\d|\.\d)", row):
            found.append(f"{file} {keys} {column}: {number} is not in {row}")
    return found


def test_the_scoreboard_says_what_the_tables_say():
    assert drifted(README) == []
    assert len(drifted(README.replace("97.5 % of", "97.4 % of").replace("oracle 75.0", "oracle 76.0"))) == 2
    for name in ("textbook, NumPyro, centred", "textbook, PyMC and nutpie, centred"):
        assert cell("calibrate.md", (name,), "converged") == "FAIL"


def test_the_harder_set_is_reported_below_the_scoreboard():
    found = [cell(f"blind/{HARDER}/score.md", (row,), "found").split("%")[0].strip() for row in SEALED.values()]
    assert f"in this order, {' %, '.join(found[:-1])} % and {found[-1]} %" in " ".join(README.split())
    assert "114 of 460 campaigns answered" in (RESULTS / f"blind/{HARDER}/score.md").read_text(encoding="utf-8")
    assert "100 of 100 campaigns answered" in (RESULTS / BLIND).read_text(encoding="utf-8")


def test_the_list_of_benchmarks_is_gathered_from_their_tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    run_all = importlib.import_module("run_all")
    text = (ROOT / "benchmarks" / "README.md").read_text(encoding="utf-8")
    listed = text.partition(run_all.START)[2].partition(run_all.END)[0]
    assert listed.strip().splitlines() == run_all.gathered()


PAGES_WITH_COMMANDS = (README, PAGES["commands"], PAGES["discover"])
SHOWN = [b for text in PAGES_WITH_COMMANDS for b in blocks("", text) if b.startswith("uv run mcc")]


def exports(folder: Path, campaign: Campaign) -> None:
    """The files that README assumes: exports of a test machine, one per particle, and a table of sizes."""
    (folder / "exports").mkdir()
    rows = ["particle,D1_um,D2_um,D3_um"]
    for name, sizes, curve in zip(campaign.particles, campaign.diameters_um, campaign.curves, strict=True):
        samples = np.stack([curve.force_mN, curve.displacement_um, curve.time_s], axis=1)
        text = "\n".join("\t".join(f"{x:.6g}".replace(".", ",") for x in sample) for sample in samples)
        head = "FS1.hap\tName of the application\nBlock : 1   Value : 1\nF\th\tt\n"
        (folder / "exports" / f"{name}.txt").write_text(f"{head}{text}\n", encoding="utf-8")
        rows.append(",".join([name, *(f"{d:g}" for d in sizes)]))
    (folder / "sizes.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


@pytest.mark.notebook
@pytest.mark.parametrize("block", SHOWN, ids=lambda b: f"{b.split()[3]}-{len(b.splitlines())}")
def test_commands_run_as_printed(block, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tests = paper_campaign(0, instrument=Instrument(displacement_noise_um=0.02, force_noise_mN=0.05))
    exports(tmp_path, tests.select(np.arange(len(tests)) < 8))
    for line in block.splitlines():
        done = run(*shlex.split(line, comments=True)[3:])
        assert done.exit_code == 0, (line, done.output)


@pytest.mark.notebook
def test_the_script_for_several_processes_runs_as_printed(tmp_path):
    (script,) = [b for b in blocks("text", PAGES["devices"]) if b.startswith("# run.py")]
    (tmp_path / "run.py").write_text(script, encoding="utf-8")
    write_campaign(paper_campaign(0, instrument=Instrument(displacement_noise_um=0.02)), tmp_path / "tests")
    runs = [
        subprocess.Popen([sys.executable, "run.py", str(i)], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        for i in range(2)
    ]
    errors = [run.communicate(timeout=300)[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], errors
    assert (tmp_path / "posterior.nc").exists()


def test_every_command_shown_exists():
    shown = set(re.findall(r"mcc-jax ([a-z]+)", README + "".join(PAGES.values())))
    assert {"demo", "convert", "calibrate", "simulate", "discover"} <= shown
    assert shown <= set(cli.commands), shown - set(cli.commands)


def test_every_path_named_is_there():
    for name in re.findall(r"\]\(([^)#]+)\)|^(mcc_jax/\S+|notebooks/|benchmarks/)", README, flags=re.M):
        path = next(part for part in name if part)
        if not path.startswith("http"):
            assert (ROOT / path).exists(), path


def test_ci_runs_readme_s_commands():
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for command in re.findall(r"uv run (.+)", "\n".join(re.findall(r"```\n(python3 .*?)\n```", README))):
        assert f"uv run {command}" in ci


def test_version_is_one():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
