"""As a user runs it: a process of its own, with pipes, signals and limits."""

import os
import re
import select
import signal
import subprocess
import sys
import time

import pytest
from asserting import snapshot

from mcc_jax._store import WORK

COMMAND = [sys.executable, "-m", "mcc_jax"]
pytestmark = pytest.mark.extended  # processes that load the library for seconds each
posix = pytest.mark.skipif(os.name != "posix", reason="signals")


@pytest.fixture(autouse=True)
def _nothing_is_kept(monkeypatch):
    """Of processes that are killed or may not write: they would leave halves of compiled functions to later tests."""
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")


def call(*arguments, **settings):
    settings = {"capture_output": True, "text": True, "timeout": 100} | settings
    return subprocess.run([*COMMAND, *map(str, arguments)], **settings)


def errors(stderr):
    """Standard error without the lines of progress, which come where a command takes long."""
    return re.sub(r"mcc-jax: +\d+\.\d s  .*\n", "", stderr)


def test_help_loads_nothing_heavy():
    code = (
        "import sys, time; start = time.process_time()\n"
        "from mcc_jax.cli.main import cli\n"
        "try: cli.main([], prog_name='mcc-jax')\n"
        "except SystemExit as end: status = end.code\n"
        "took = time.process_time() - start  # of this process, whatever else runs\n"
        "heavy = [m for m in ('jax', 'equinox', 'numpy', 'pandas', 'matplotlib', 'rich') if m in sys.modules]\n"
        "print(status, heavy, took < 0.5)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.stdout.splitlines()[-1] == "0 [] True"
    assert result.stderr == ""


def test_a_missing_accelerator_is_one_line(tmp_path):
    """JAX itself says it in a traceback of a hundred lines, or not before it computes."""
    wanted = os.environ | {"JAX_PLATFORMS": "tpu"}  # a machine may have a graphics card, but hardly one of these
    result = call("simulate", "--out", tmp_path / "simulated", env=wanted)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("mcc-jax: error: JAX finds no device for JAX_PLATFORMS=tpu")
    assert result.stderr.count("\n") == 1
    assert "Unset JAX_PLATFORMS" in result.stderr
    assert not (tmp_path / "simulated").exists()


def test_shell_completion():
    source = call(env=os.environ | {"_MCC_JAX_COMPLETE": "bash_source"})
    assert "mcc-jax" in source.stdout
    asked = {"_MCC_JAX_COMPLETE": "bash_complete", "COMP_WORDS": "mcc-jax cal", "COMP_CWORD": "1"}
    assert "calibrate" in call(env=os.environ | asked).stdout


@posix
def test_full_disk(tmp_path):
    (tmp_path / "curves.csv").write_text("old")
    before = snapshot(tmp_path)
    limited = ["sh", "-c", 'ulimit -f 4; exec "$@"', "sh", *COMMAND, "simulate", "--out", tmp_path, "--points", "20"]
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}  # Python would leave halves of byte code, too
    result = subprocess.run(limited, capture_output=True, text=True, timeout=100, env=environment)
    assert result.returncode == 2
    line = errors(result.stderr)
    assert line.count("\n") == 1
    assert str(tmp_path) in line
    assert WORK not in line
    assert snapshot(tmp_path) == before


@posix
def test_broken_pipe_is_quiet():
    with subprocess.Popen([*COMMAND, "simulate", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


@pytest.fixture
def interruptible():
    """A process begun in the background inherits that interrupts are ignored, and so would what the tests start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


SEAL = r"[^\n]*sealed, SHA-256:\n  [0-9a-f]{64}\n"
"""All that the demo prints before it is done."""


@posix
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_killed_in_the_middle(tmp_path, number, status):
    out = tmp_path / "out"
    (out / "campaign").mkdir(parents=True)
    (out / "campaign" / "curves.csv").write_text("old")
    (out / "calibration.json").write_text("old")
    before = snapshot(out)
    command, pipe = [*COMMAND, "demo", "--out", out], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        deadline = time.monotonic() + 60
        while not (out / WORK / "campaign").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(number)
        stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == status
    assert stdout == "" or re.fullmatch(SEAL, stdout)
    assert errors(stderr) == ("mcc-jax: interrupted\n" if number == signal.SIGINT else "")
    visible = {name: data for name, data in snapshot(out).items() if not name.startswith(".mcc-jax")}
    assert visible == before
    if number != signal.SIGKILL:
        assert snapshot(out) == before


@posix
def test_who_interrupts_does_not_wait_for_other_threads():
    code = (
        "import threading, time, click; from mcc_jax.cli.main import cli, main\n"
        "threading.Thread(target=time.sleep, args=(60,)).start()\n"
        "@cli.command()\n"
        "def halt(): raise KeyboardInterrupt\n"
        "main()"
    )
    result = subprocess.run([sys.executable, "-c", code, "halt"], capture_output=True, text=True, timeout=30)
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "mcc-jax: interrupted\n")


@posix
@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    ("number", "status", "line"), [(signal.SIGINT, 130, "mcc-jax: interrupted\n"), (signal.SIGTERM, 143, "")]
)
def test_a_signal_within_a_destructor_is_not_lost(number, status, line):
    code = (
        "import os, time; from mcc_jax.cli.main import cli, main\n"
        "class Shy:\n"
        f"    def __del__(self): os.kill(os.getpid(), {number:d}); time.sleep(1)\n"
        "@cli.command()\n"
        "def halt():\n"
        "    Shy()\n"
        "    for _ in range(40): time.sleep(0.1)\n"
        "main()"
    )
    result = subprocess.run([sys.executable, "-c", code, "halt"], capture_output=True, text=True, timeout=30)
    assert (result.returncode, result.stdout, result.stderr) == (status, "", line)


@posix
def test_progress_on_a_terminal_is_on_standard_error(tmp_path):
    import pty  # not there on Windows, where this test is skipped

    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    arguments = [*COMMAND, "simulate", "--out", str(tmp_path / "sim"), "--points", "20"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=theirs, env=environment) as process:
        os.close(theirs)
        seen = b""
        while select.select([ours], [], [], 60)[0]:
            try:
                part = os.read(ours, 4096)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            seen += part
        stdout = process.stdout.read()
    os.close(ours)
    assert process.returncode == 0
    assert b"simulating" in seen
    assert b"Simulated 20 particles" in stdout
    assert b"\x1b" not in stdout
