"""Layers import downwards only; what is public is re-exported by name; importing does nothing else."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

import mcc_jax

PACKAGE = Path(mcc_jax.__file__).parent
# Every top-level module by layer; one not listed fails the test. Those of the first layer may import each other.
ORDER = (
    ("_version", "_errors", "_extras", "_types", "_numerics", "_results", "arguments"),
    ("_format", "_blocks", "files"),
    ("_archive", "_store", "geometry"),
    *((name,) for name in ("formulas", "effects", "law", "campaign", "simulate", "calibrate", "dem", "discovery")),
    ("export", "plots"),
    ("report",),
    ("cli",),
    ("__init__", "__main__"),
)
LAYERS = {name: layer for layer, names in enumerate(ORDER) for name in names}
# What importing the package must not load: slow, optional, or for the command line only.
HEAVY = (
    *("arviz", "pandas", "matplotlib", "scipy.optimize", "scipy.stats"),
    *("pint", "rich", "click", "bokeh", "jinja2", "jsonschema"),
)
# By dotted name below mcc_jax: "law.mcc", "law" for its __init__, "" for the package itself.
MODULES = {
    ".".join(f.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").removesuffix("."): f
    for f in sorted(PACKAGE.rglob("*.py"))
}
PACKAGES = sorted(n for n, f in MODULES.items() if f.name == "__init__.py")


def resolve(parts):
    """The module that holds a dotted name: the longest prefix that is a module."""
    while parts and ".".join(parts) not in MODULES:
        parts = parts[:-1]
    return ".".join(parts)


def imports(name):
    """Modules of mcc_jax that one of them imports, at the top or inside functions, relative or absolute."""
    file = MODULES[name]
    here = ["mcc_jax", *file.relative_to(PACKAGE).parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            start = here[: len(here) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            names = [f"{module}.{alias.name}" for alias in node.names]
        found |= {resolve(one.split(".")[1:]) for one in names if one.split(".")[0] == "mcc_jax"}
    return found


def top(module):
    return module.split(".")[0] or "__init__"


def test_every_top_level_module_has_its_layer():
    unknown = set(map(top, MODULES)) - set(LAYERS)
    assert not unknown, f"give {sorted(unknown)} a layer in tests/test_architecture.py"
    assert {"law.response", "geometry"} <= imports("law.mcc")


def test_imports_point_downwards():
    for name in MODULES:
        for target in imports(name):
            here, there = LAYERS[top(name)], LAYERS[top(target)]
            allowed = there < here or here == there == 0 or top(target) == top(name)
            assert allowed, f"{name} imports {target}, of a later layer"


def test_no_cycles():
    """A package's __init__ gathers its own files; a file that imports a sibling through it would close a circle."""
    graphlib.TopologicalSorter({name: imports(name) - {name} for name in MODULES}).prepare()


def public(name):
    """Where a package lists its public names: its __init__; at the top, which loads lazily, the stub next to it."""
    file = MODULES[name]
    return ast.parse((file if name else file.with_suffix(".pyi")).read_text(encoding="utf-8"))


def test_the_top_of_the_package_loads_lazily_and_holds_every_name_of_its_stub():
    code = (
        "import sys, mcc_jax\n"
        "assert 'jax' not in sys.modules\n"
        "for name in mcc_jax.__all__: getattr(mcc_jax, name)\n"
        "print(*mcc_jax.__all__)\n"
    )
    names = run(code).stdout.split()
    assert "drive" in names
    assert names == sorted(a.name for node in public("").body if isinstance(node, ast.ImportFrom) for a in node.names)


@pytest.mark.parametrize("name", PACKAGES)
def test_public_names_are_re_exported_one_by_one(name):
    """`from .x import y as y`, in addition to a docstring: no definitions, nothing that runs on import."""
    body = public(name).body
    for node in body[1:] if name else body[:-1]:  # at the top `__version__` is the last
        assert isinstance(node, ast.ImportFrom), f"mcc_jax.{name}, line {node.lineno}: only re-exports belong here"
        assert node.level in (1, 2)  # what a package below has may be offered by name, too
        for alias in node.names:
            assert alias.asname == alias.name, f"mcc_jax.{name}: write `import {alias.name} as {alias.name}`"
            assert not alias.name.startswith("_")


def run(code):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120, check=True
    )


def test_importing_loads_nothing_heavy_prints_nothing_and_configures_nothing():
    code = (
        "import sys, jax; before = dict(jax.config.values)\n"
        "import mcc_jax, mcc_jax.law, mcc_jax.geometry\n"
        f"for name in set(mcc_jax.__all__) - {set(PACKAGES)!r}: getattr(mcc_jax, name)\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "assert not heavy, heavy\n"
        "assert not jax.config.jax_enable_x64\n"
        "changed = {k for k in before if jax.config.values[k] != before[k]}\n"
        "assert not changed, changed\n"
    )
    done = run(code)
    assert (done.stdout, done.stderr) == ("", "")


def test_no_two_test_files_have_one_name():
    """Helpers are next to tests, and imported by their bare names."""
    names = [file.name for file in PACKAGE.parent.glob("tests/**/*.py") if file.name != "conftest.py"]
    assert len(names) == len(set(names)), sorted({n for n in names if names.count(n) > 1})
