"""How large the house is: lines, files, numeric constants and longest file of every package, now and at a commit.

    uv run python benchmarks/house.py            the working tree
    uv run python benchmarks/house.py COMMIT     that commit beside it

The old engine of discovery is a row of its own outside the totals: it is to be deleted as a whole.

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
OUTSIDE = "discover/legacy"
"""Counted, but in no total."""


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
        for package in (OUTSIDE,) if name.startswith(f"{PACKAGE}/{OUTSIDE}/") else of:
            lines, own = text.count("\n"), found[package]
            own[0], own[1], own[2], own[3] = own[0] + lines, own[1] + 1, own[2] + constants(text), max(own[3], lines)
    return {
        name: (own[0], own[1], own[2], own[3]) for name, own in sorted(found.items(), key=lambda item: item[0] == "all")
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", nargs="?")
    commit = parser.parse_args().commit
    now = house(None)
    before = house(commit) if commit else {}
    print("| package | lines | files | constants | longest file |\n|---|---|---|---|---|")
    for name in sorted({*now, *before}, key=lambda n: (n == OUTSIDE, n == "all", n)):
        old, new = before.get(name, (0, 0, 0, 0)), now.get(name, (0, 0, 0, 0))
        cells = [f"{a} -> {b}" if commit else f"{b}" for a, b in zip(old, new, strict=True)]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
