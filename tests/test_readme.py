"""What README shows runs, and what it claims of the set-up is what CI does."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from mcc_jax.campaign import Campaign, write_campaign
from mcc_jax.simulate import Instrument, paper_campaign

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_python_blocks_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out.strip()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}[^\n]*\n(.*?)^```$", README, flags=re.M | re.S)


def test_every_block_is_of_a_kind_that_is_run():
    """Python, the two commands of the set-up (CI), commands, a file of priors (the docs' page), and the layout."""
    for block in blocks(""):
        first = block.splitlines()[0]
        assert first.startswith(
            ("import ", "# run.py", "python3 -m pip install uv", "uv run mcc-jax", "[a]", "mcc_jax/")
        )
    assert len(re.findall(r"^```", README, flags=re.M)) == 2 * len(blocks(""))


def exports(folder: Path, campaign: Campaign) -> None:
    """What README speaks of: a tester's files, one for a particle, and a table of sizes."""
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
@pytest.mark.parametrize("block", [b for b in blocks("") if b.startswith("uv run mcc-jax")], ids=lambda b: b.split()[3])
def test_commands_run_as_printed(block, tmp_path, monkeypatch):
    from mcc_jax.cli.main import cli

    monkeypatch.chdir(tmp_path)
    tests = paper_campaign(0, instrument=Instrument(displacement_noise_um=0.02, force_noise_mN=0.05))
    exports(tmp_path, tests.select(np.arange(len(tests)) < 8))
    for line in block.splitlines():
        arguments = shlex.split(line, comments=True)[3:]
        done = CliRunner().invoke(cli, arguments)
        assert done.exit_code == 0, (line, done.output)


@pytest.mark.notebook
def test_the_script_for_several_processes_runs_as_printed(tmp_path):
    (script,) = [b for b in blocks("python") if b.startswith("# run.py")]
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
    from mcc_jax.cli.main import cli

    shown = set(re.findall(r"mcc-jax ([a-z]+)", README))
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
    from mcc_jax import __version__

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
