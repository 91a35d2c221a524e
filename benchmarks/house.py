"""How large the house is: lines, files, numeric constants and longest file of every package, now and at a commit.

    uv run python benchmarks/house.py            the working tree
    uv run python benchmarks/house.py COMMIT     that commit beside it
    uv run python benchmarks/house.py --literals discover     numbers of a package but 0, 1, 2, 1/2

A constant is a number assigned at module level, each member of a tuple once (redesign's way of counting).
"""

from __future__ import annotations

import argparse
import ast
import subprocess
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "mcc_jax"
EVERYDAY = {0, 1, 2, -1, 0.5}
"""Numbers that say nothing about a choice."""


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def sources(commit: str | None) -> dict[str, str]:
    """The text of every Python file of the package, by its path."""
    if commit is None:
        return {str(f.relative_to(ROOT)): f.read_text(encoding="utf-8") for f in (ROOT / PACKAGE).rglob("*.py")}
    names = git("ls-tree", "-r", "--name-only", commit, "--", PACKAGE).split()
    return {name: git("show", f"{commit}:{name}") for name in names if name.endswith(".py")}


def numbers(node: ast.expr) -> int:
    """How many numbers an expression holds."""
    return sum(
        isinstance(part, ast.Constant) and isinstance(part.value, int | float) and not isinstance(part.value, bool)
        for part in ast.walk(node)
    )


def constants(text: str) -> int:
    """Numbers assigned at module level, but for tables: dictionaries and calls."""
    assigned = (n.value for n in ast.parse(text).body if isinstance(n, ast.Assign | ast.AnnAssign))
    plain = (ast.Constant, ast.Tuple, ast.List, ast.UnaryOp, ast.BinOp)
    return sum(numbers(value) for value in assigned if isinstance(value, plain))


def house(commit: str | None) -> dict[str, tuple[int, int, int, int]]:
    """Lines, files, constants and the longest file of every package, and of all."""
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for name, text in sources(commit).items():
        parts = name.split("/")
        of = (parts[1] if len(parts) > 2 else "(root)", "all")
        for package in of:
            lines, own = text.count("\n"), found[package]
            own[0], own[1], own[2], own[3] = own[0] + lines, own[1] + 1, own[2] + constants(text), max(own[3], lines)
    return {
        name: (own[0], own[1], own[2], own[3]) for name, own in sorted(found.items(), key=lambda item: item[0] == "all")
    }


def literals(package: str) -> list[tuple[str, int, str]]:
    """Every number of a package but everyday ones: file, line, and the line's text; its settings are left out."""
    found = []
    for name, text in sorted(sources(None).items()):
        if name.startswith(f"{PACKAGE}/{package}/") and not name.endswith("/settings.py"):
            lines = text.splitlines()
            rows = {
                part.lineno
                for part in ast.walk(ast.parse(text))
                if isinstance(part, ast.Constant) and type(part.value) in (int, float) and part.value not in EVERYDAY
            }
            found += [(name, row, lines[row - 1].strip()) for row in sorted(rows)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", nargs="?")
    parser.add_argument("--literals", metavar="PACKAGE")
    asked = parser.parse_args()
    if asked.literals:
        for name, row, text in literals(asked.literals):
            print(f"{name}:{row}: {text}")
        return
    commit = asked.commit
    now = house(None)
    before = house(commit) if commit else {}
    print("| package | lines | files | constants | longest file |\n|---|---|---|---|---|")
    for name in sorted({*now, *before}, key=lambda n: (n == "all", n)):
        old, new = before.get(name, (0, 0, 0, 0)), now.get(name, (0, 0, 0, 0))
        cells = [f"{a} -> {b}" if commit else f"{b}" for a, b in zip(old, new, strict=True)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
