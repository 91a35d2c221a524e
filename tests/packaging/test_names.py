"""Names that CHANGELOG.md promises are there, and nothing in the package needs one system."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FUNCTIONS = ("chown", "fork", "getpgid", "getuid", "killpg", "mkfifo", "nice", "pread", "setsid", "uname", "wait")
SIGNALS = ("SIGALRM", "SIGCHLD", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1")
POSIX = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"}
POSIX |= {f"os.{name}" for name in FUNCTIONS} | {f"signal.{name}" for name in SIGNALS}
"""What only POSIX has: used behind a check whether it is there."""


def test_every_new_name_of_the_table_is_there():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for part, name in re.findall(r"\| `mcc_jax\.([a-z]+)\.(\w+)` \|[^|]*\|$", text, flags=re.M):
        namespace = {}
        exec(f"from mcc_jax.{part} import {name}", namespace)
        assert name in namespace


def test_nothing_is_called_that_only_posix_has():
    for file in (ROOT / "mcc_jax").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = {a.name.partition(".")[0] for a in node.names} if isinstance(node, ast.Import) else set()
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = {str(node.module).partition(".")[0]}
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                names = {f"{node.value.id}.{node.attr}"}
            assert not names & POSIX, f"{file}, line {node.lineno}"


def test_contributing_names_files_that_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:mcc_jax|tests|\.docs|\.ci)/[\w./-]+)`", text)
    assert len(named) > 10
    assert [name for name in named if "NAME" not in name and not (ROOT / name).exists()] == []
