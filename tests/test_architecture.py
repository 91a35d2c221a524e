"""Layers import downwards only; what is public is re-exported by name; importing does nothing else."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import mcc_jax

PACKAGE = Path(mcc_jax.__file__).parent
LEAF = 0
# Every top-level module of the package and its layer; one not listed fails the test. A part of one may have its own.
LAYERS = {
    "__init__": 99,
    "__main__": 99,
    "_errors": LEAF,
    "_extras": LEAF,
    "_types": LEAF,
    "_memory": LEAF,
    "_numerics": LEAF,
    "_results": LEAF,
    "_format": 1,
    "arguments": LEAF,
    "_blocks": 1,
    "_archive": 2,
    "_store": 2,
    "files": 1,
    "geometry": 2,
    "formulas": 3,
    "effects": 4,
    "law": 5,
    "campaign": 6,
    "simulate": 7,
    "calibrate": 8,
    "dem": 9,
    "discovery": 10,
    "export": 11,
    "plots": 11,
    "report": 12,
    "cli": 13,
}
# What importing the package must not load: slow, optional, or for the command line only.
HEAVY = (
    *("arviz", "pandas", "matplotlib", "scipy.optimize", "scipy.stats"),
    *("pint", "rich", "click", "bokeh", "jinja2", "jsonschema"),
)
FILES = sorted(p for p in PACKAGE.rglob("*.py"))


def module_name(file):
    """Dotted name below mcc_jax: "law.mcc", "law" for its __init__, "" for the package itself."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(f): f for f in FILES}


def resolve(name):
    """The module that holds a dotted name: the longest prefix that is a module."""
    parts = name.split(".") if name else []
    while parts and ".".join(parts) not in MODULES:
        parts.pop()
    return ".".join(parts)


def imports(file):
    """Modules of mcc_jax that a file imports, at the top or inside functions, relative or absolute."""
    parts = file.relative_to(PACKAGE).parts[:-1]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "mcc_jax":
                    yield resolve(".".join(alias.name.split(".")[1:]))
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                base = [*parts[: len(parts) - node.level + 1], *(node.module or "").split(".")]
            elif (node.module or "").split(".")[0] == "mcc_jax":
                base = node.module.split(".")[1:]
            else:
                continue
            base = [b for b in base if b]
            for alias in node.names:
                yield resolve(".".join([*base, alias.name]))


def group(module):
    """What has a layer of its own: the top-level module, or the part of it that is listed."""
    parts = (module or "__init__").split(".")
    return next((name for name in (".".join(parts[:2]), parts[0]) if name in LAYERS), parts[0])


def layer(module):
    return LAYERS[group(module)]


def test_there_is_something_to_check():
    assert {"geometry", "law.mcc", "formulas.recovery", "_numerics"} <= set(MODULES)
    assert "law.response" in set(imports(MODULES["law.mcc"]))
    assert "geometry" in set(imports(MODULES["law.mcc"]))


def test_every_top_level_module_has_its_layer():
    unknown = {(name or "__init__").split(".")[0] for name in MODULES} - set(LAYERS)
    assert not unknown, f"give {sorted(unknown)} a layer in tests/test_architecture.py"


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_point_downwards(name):
    for target in set(imports(MODULES[name])):
        if group(target) == group(name):
            continue
        assert target or layer(name) == LAYERS["__init__"], (
            f"{name} imports the top of mcc_jax, which imports everything"
        )
        leaf = layer(name) == layer(target) == LEAF
        assert layer(target) < layer(name) or leaf, f"{name} imports {target}, of a later layer"


def test_no_cycles():
    graph = {name: {t for t in imports(file) if t != name} for name, file in MODULES.items()}
    # A package's __init__ gathers its own files; a file that imports a sibling through it would close a circle.
    done, active = set(), []

    def visit(name):
        if name in done:
            return
        assert name not in active, " -> ".join([*active[active.index(name) :], name])
        active.append(name)
        for target in sorted(graph[name]):
            visit(target)
        active.pop()
        done.add(name)

    for name in graph:
        visit(name)


def public(name):
    """Where a package lists its public names: its __init__; at the top, which loads lazily, the stub beside it."""
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


@pytest.mark.parametrize("name", sorted(n for n, f in MODULES.items() if f.name == "__init__.py"))
def test_public_names_are_re_exported_one_by_one(name):
    """`from .x import y as y`, besides a docstring: no star, no definitions, nothing that runs on import."""
    body = public(name).body
    if name:
        assert ast.get_docstring(public(name))
        body = body[1:]
    for node in body:
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            continue
        if not name and isinstance(node, ast.AnnAssign):
            assert ast.unparse(node.target) == "__version__"
            continue
        assert isinstance(node, ast.ImportFrom), f"mcc_jax.{name}, line {node.lineno}: only re-exports belong here"
        assert node.level in (1, 2)  # what a package below has may be offered by name, too
        for alias in node.names:
            assert alias.asname == alias.name, f"mcc_jax.{name}: write `import {alias.name} as {alias.name}`"


@pytest.mark.parametrize("name", sorted(n for n, f in MODULES.items() if f.name == "__init__.py"))
def test_private_names_stay_private(name):
    tree = public(name)
    exported = [a.name for node in tree.body if isinstance(node, ast.ImportFrom) for a in node.names]
    assert not [e for e in exported if e.startswith("_") and e != "__future__"]
    assert len(set(exported)) == len(exported)


def run(code):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120, check=True
    )


def test_importing_loads_nothing_heavy_prints_nothing_and_configures_nothing():
    code = (
        "import sys, jax; before = dict(jax.config.values)\n"
        "import mcc_jax, mcc_jax.law, mcc_jax.geometry\n"
        "from mcc_jax import *\n"
        f"heavy = [m for m in {HEAVY!r} if m in sys.modules]\n"
        "assert not heavy, heavy\n"
        "assert not jax.config.jax_enable_x64\n"
        "changed = {k for k in before if jax.config.values[k] != before[k]}\n"
        "assert not changed, changed\n"
    )
    done = run(code)
    assert done.stdout == ""
    assert done.stderr == ""


def test_no_two_test_files_have_one_name():
    """Helpers stand beside tests, so files are imported by their bare names."""
    names = [file.name for file in PACKAGE.parent.glob("tests/**/*.py") if file.name != "conftest.py"]
    assert len(names) == len(set(names)), sorted({n for n in names if names.count(n) > 1})
