"""Names that CHANGELOG.md promises are there, and nothing in the package needs one system."""

import ast
import re
from pathlib import Path

import pytest

import mcc_jax as mcc

ROOT = Path(__file__).parents[2]
# Modules and functions that only POSIX has; a use of one stands behind a question whether it is there.
POSIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios", "tty"}
POSIX_FUNCTIONS = {"chown", "fork", "getpgid", "getuid", "killpg", "mkfifo", "nice", "pread", "setsid", "uname", "wait"}
POSIX_SIGNALS = {"SIGALRM", "SIGCHLD", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1"}


def test_a_name_that_is_not_there_is_missing_as_usual():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = mcc.no_such_name
    assert not hasattr(mcc, "no_such_name")


def test_every_new_name_of_the_table_is_there():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    for part, name in re.findall(r"\| `mcc_jax\.([a-z]+)\.(\w+)` \|[^|]*\|$", text, flags=re.M):
        namespace = {}
        exec(f"from mcc_jax.{part} import {name}", namespace)
        assert name in namespace


@pytest.mark.parametrize("file", sorted((ROOT / "mcc_jax").rglob("*.py")), ids=lambda f: f.stem)
def test_nothing_is_called_that_only_posix_has(file):
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            assert not {a.name.partition(".")[0] for a in node.names} & POSIX_MODULES
        elif isinstance(node, ast.ImportFrom) and not node.level:
            assert str(node.module).partition(".")[0] not in POSIX_MODULES
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            assert not (node.value.id == "os" and node.attr in POSIX_FUNCTIONS), node.attr
            assert not (node.value.id == "signal" and node.attr in POSIX_SIGNALS), node.attr


def test_contributing_names_files_that_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:mcc_jax|tests|\.docs|\.ci)/[\w./-]+)`", text)
    assert len(named) > 10
    assert [name for name in named if "NAME" not in name and not (ROOT / name).exists()] == []
