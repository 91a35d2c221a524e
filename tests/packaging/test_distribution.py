"""Wheel and sdist hold what they must, and work where nothing but them is installed."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_citation_and_changelog_name_this_version():
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(rf"^version: {re.escape(PROJECT['version'])}$", text, flags=re.M)
    assert re.search(rf"^license: {PROJECT['license']}$", text, flags=re.M)
    assert "arXiv:1812.06173" in text
    assert f"## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def run(*command, **options):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=900, **options)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def uv():
    found = shutil.which("uv")
    if found is None:
        pytest.skip("needs uv")
    return found


@pytest.fixture(scope="module")
def built(uv, tmp_path_factory):
    """(wheel of the sdist, sdist), built in isolation from a copy, so that nothing is left in the tree."""
    folder = tmp_path_factory.mktemp("distribution")
    tree = shutil.copytree(
        ROOT, folder / "tree", ignore=shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache", ".hypothesis")
    )
    run(uv, "build", "--out-dir", folder / "dist", tree)  # the sdist, and from it the wheel
    (wheel,) = (folder / "dist").glob("*.whl")
    (sdist,) = (folder / "dist").glob("*.tar.gz")
    return wheel, sdist


def sources():
    """Every file of the package as it lies in the tree."""
    files = (ROOT / "mcc_jax").rglob("*")
    return {str(f.relative_to(ROOT)) for f in files if f.is_file() and "__pycache__" not in f.parts}


@pytest.mark.extended
def test_the_wheel_holds_the_package_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as wheel:
        inside = set(wheel.namelist())
    package = {name for name in inside if not name.split("/")[0].endswith(".dist-info")}
    assert package == sources()
    assert "mcc_jax/py.typed" in package
    assert any(name.endswith("LICENSE") for name in inside)


@pytest.mark.extended
def test_the_sdist_holds_tests_and_documentation(built):
    with tarfile.open(built[1]) as sdist:
        inside = {name.partition("/")[2] for name in sdist.getnames()}
    assert sources() <= inside
    assert {"tests/conftest.py", "README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md", ".docs/mkdocs.yml"} <= inside


@pytest.mark.extended
def test_the_wheel_works_in_a_clean_environment(uv, built, tmp_path):
    """Alone it is the library, with the extra `command` the whole: a campaign goes through it from end to end."""
    home = tmp_path / "clean"
    run(uv, "venv", "--python", sys.executable, home)
    programs = home / ("Scripts" if os.name == "nt" else "bin")
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    run(uv, "pip", "install", "--python", programs / "python", built[0])
    law = (
        "import mcc_jax as mcc; print(mcc.drive(mcc.paper_law(), mcc.Particle(200, 190, 180), [0.0, 50.0, 48.0]).force)"
    )
    assert "[" in run(programs / "python", "-c", law, cwd=tmp_path, env=clean)
    alone = subprocess.run([programs / "mcc-jax", "demo"], capture_output=True, text=True, env=clean, check=False)
    assert (alone.returncode, alone.stdout) == (2, "")
    assert "mcc-jax[command]" in alone.stderr
    run(uv, "pip", "install", "--python", programs / "python", f"{built[0]}[command]")

    def command(*arguments):
        return run(programs / "mcc-jax", *arguments, cwd=tmp_path, env=clean)

    assert PROJECT["version"] in command("--version")
    where = run(programs / "python", "-c", "import mcc_jax; print(mcc_jax.__file__)", cwd=tmp_path, env=clean)
    assert Path(where.strip()).is_relative_to(home)
    command("simulate", "--out", "tests", "--points", "60", "--noise-um", "0.02", "--noise-mN", "0.05")
    command("calibrate", "tests", "--out", "tests", "--method", "least-squares", "--no-figures")
    assert 1 < json.loads((tmp_path / "tests" / "calibration.json").read_text())["a"]["value"] < 2
    command("report", "tests")
    assert (tmp_path / "tests" / "report.html").stat().st_size > 1_000_000
    command("export", "tests", "--format", "c", "--out", "law", "--allow-not-monotone")
    assert list((tmp_path / "law").glob("*.h"))
