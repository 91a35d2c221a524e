"""The base installation is small; what an extra brings is imported by one helper, and named where it is missing."""

import ast
import builtins
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mcc_jax as mcc
from mcc_jax._errors import InputError
from mcc_jax._extras import EXTRAS, MissingExtraError, extra

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MOST_REQUIRED = 16
MODULE = {"python_calamine": "python-calamine", "msgspec": "msgspec", "lazy_loader": "lazy-loader"}
# What comes with a required package by its own declaration.
BROUGHT = {"arviz_base": "arviz", "arviz_stats": "arviz", "jaxlib": "jax", "xarray": "arviz", "markupsafe": "jinja2"}
OPTIONAL = {"vesin", "jax_md", "jaxdem", "python_calamine"}


def name(requirement):
    return re.match(r"[A-Za-z0-9_-]+", requirement)[0]


def brought(group):
    """The packages of an extra, those of the extras that it names included."""
    found = set()
    for requirement in PROJECT["optional-dependencies"][group]:
        inner = re.match(r"mcc-jax\[(.*)\]$", requirement)
        found |= set().union(*(brought(g) for g in inner[1].split(","))) if inner else {name(requirement)}
    return found


REQUIRED = {name(requirement) for requirement in PROJECT["dependencies"]}


def test_few_packages_are_required():
    assert len(PROJECT["dependencies"]) == len(REQUIRED) <= MOST_REQUIRED


def test_every_import_is_of_a_required_package_or_of_an_extra():
    """By the names of the packages, so that nothing is used which only happens to be installed."""
    allowed = REQUIRED | set().union(*map(brought, EXTRAS))
    for file in (ROOT / "mcc_jax").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [str(node.module)]
            for module in (n.partition(".")[0] for n in names):
                package = BROUGHT.get(module, MODULE.get(module, module))
                known = module in sys.stdlib_module_names or module == "mcc_jax" or module in OPTIONAL
                assert known or package in allowed, f"{file.relative_to(ROOT)} imports {module}"


def test_an_extra_brings_what_its_parts_import():
    for group, (_, modules) in EXTRAS.items():
        packages = {BROUGHT.get(m, MODULE.get(m, m)) for m in modules}
        assert packages <= brought(group) & brought("all") - REQUIRED


def without(monkeypatch, *modules):
    """Make packages appear not to be installed to imports that are still to come."""
    real = builtins.__import__

    def missing(module, *args, **kwargs):
        if module.partition(".")[0] in modules:
            raise ModuleNotFoundError(f"No module named {module!r}", name=module)
        return real(module, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)


def _report(_):
    from mcc_jax.report import Results, report_page

    return report_page(Results("nothing", None, {}, None, None, {}, None, {}, None, (), ""))


def _write(folder):
    from mcc_jax._store import Stage
    from mcc_jax.cli.session import write_result

    posterior = object.__new__(mcc.Posterior)
    return write_result(posterior, Stage(folder, folder), origin={}, figures=False, progress=print)


SPHERE = mcc.Particle(200.0, 200.0, 200.0)
CALLS = {
    "bokeh": ("report", _report),
    "jinja2": ("export", lambda _: mcc.export.c_header(mcc.paper_law(), SPHERE)),
    "flatbuffers": ("export", lambda _: mcc.export.jax_artefact(mcc.paper_law(), SPHERE)),
    "h5netcdf": ("netcdf", _write),
}


@pytest.mark.parametrize("module", CALLS)
def test_a_call_names_the_extra_that_is_missing(module, monkeypatch, tmp_path):
    group, call = CALLS[module]
    without(monkeypatch, module)
    with pytest.raises(MissingExtraError, match=rf"{module}.*python -m pip install 'mcc-jax\[{group}\]'") as caught:
        call(tmp_path)
    assert isinstance(caught.value, InputError)
    assert isinstance(caught.value, ModuleNotFoundError)


def test_what_is_broken_otherwise_is_raised_as_it_is():
    with pytest.raises(ModuleNotFoundError, match="no_such_module") as caught, extra("plots"):
        importlib.import_module("no_such_module")
    assert not isinstance(caught.value, MissingExtraError)


BLOCK = (
    "import sys\n"
    "class Block:\n"
    "    def find_spec(self, name, *_):\n"
    f"        if name.partition('.')[0] in {sorted({m for _, ms in EXTRAS.values() for m in ms})!r}:\n"
    "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
    "sys.meta_path.insert(0, Block())\n"
)


def run(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", BLOCK + code, *arguments], capture_output=True, text=True, timeout=300, check=False
    )


def test_the_command_says_in_one_line_what_to_install():
    done = run("from mcc_jax.cli import run; run()", "demo")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.endswith("Install the extra 'command': python -m pip install 'mcc-jax[command]'")


@pytest.mark.extended
def test_figures_and_report_each_name_their_own_extra():
    code = "import importlib\n"
    for part in ("plots", "report", "plots.paper"):
        code += f"try: importlib.import_module('mcc_jax.{part}')\nexcept ModuleNotFoundError as error: print(error)\n"
    lines = run(code).stdout.splitlines()
    assert [line.partition("[")[2] for line in lines] == ["plots]'", "report]'", "plots]'"]


@pytest.mark.extended
def test_every_public_name_of_the_library_comes_without_any_extra():
    """All but figures and report, whose modules say what they need."""
    done = run("from mcc_jax import *")
    assert done.returncode == 0, done.stderr


@pytest.mark.extended
def test_a_small_calibration_needs_no_extra(tmp_path):
    done = run(
        "import jax\njax.config.update('jax_enable_x64', True)\nimport mcc_jax as mcc\n"
        "programme = mcc.Programme.cycles(levels=(0.5, 1.0), unload_to=0.3, points=60)\n"
        "noise = mcc.Instrument(displacement_noise_um=0.02, force_noise_mN=0.05)\n"
        "campaign = mcc.paper_campaign(seed=0, programme=programme, instrument=noise)\n"
        "squares = mcc.least_squares(campaign)\n"
        "squares.save(sys.argv[1])\n"
        "print(mcc.load(sys.argv[1]).law())\n",
        str(tmp_path / "result"),
    )
    assert done.returncode == 0, done.stderr
