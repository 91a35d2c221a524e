"""What README shows runs, and what it claims of the set-up is what CI does."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_python_blocks_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.S)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    assert capsys.readouterr().out.strip()


def test_every_command_shown_exists():
    from mcc_jax.cli._main import cli

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
