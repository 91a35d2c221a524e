"""Around the work of a command: the folder of what is compiled, progress in a log."""

import io
import os
import re
import stat
import time
from pathlib import Path
from types import SimpleNamespace

import platformdirs
import pytest

from mcc_jax.cli import session
from mcc_jax.cli.session import _keep_compiled

posix = pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A function that sets JAX up as a command does, and gives the folder that it was told, None if none."""
    above = tmp_path / "home" / ".cache" / "mcc_jax"
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name: above)

    def keep(**settings):
        told = {"jax_compilation_cache_dir": None, "jax_enable_compilation_cache": True} | settings
        config = SimpleNamespace(**told)
        config.update = lambda name, value: setattr(config, name, value)
        _keep_compiled(config)
        told = config.jax_compilation_cache_dir
        return None if told is None else Path(told)

    keep.above = above
    return keep


@posix
def test_the_folder_of_what_is_compiled_is_closed_to_others(kept, monkeypatch):
    """Compiled code is run: a folder that others own, or can write to, is not used."""
    folder = kept()
    assert folder.parent == kept.above
    for one in (folder, kept.above):
        assert stat.S_IMODE(one.stat().st_mode) == 0o700
        for open_to in (0o020, 0o002):
            one.chmod(0o700 | open_to)
            assert kept() is None
        one.chmod(0o700)
    assert kept() == folder
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert kept() is None


@posix
@pytest.mark.parametrize("kind", ["link", "file", "pipe"])
def test_what_is_no_folder_is_not_used(kept, tmp_path, kind):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    make = {"link": lambda p: p.symlink_to(elsewhere), "file": Path.touch, "pipe": os.mkfifo}[kind]
    place = kept()
    for one in (place, kept.above):
        one.rmdir()
        make(one)
        assert kept() is None
        one.unlink()
    assert list(elsewhere.iterdir()) == []


def test_settings_of_ones_own_come_first(kept):
    assert kept(jax_compilation_cache_dir="mine") == Path("mine")
    assert kept(jax_enable_compilation_cache=False) is None
    assert not kept.above.exists()


class Log(io.StringIO):
    """Standard error that is no terminal; `steps` are those that it was told, as lines with their seconds."""

    @property
    def steps(self):
        lines = [re.fullmatch(r"mcc-jax: +(\d+\.\d) s  (.+)", line) for line in self.getvalue().splitlines()]
        seconds = [float(line[1]) for line in lines]
        assert seconds == sorted(seconds)
        return [line[2] for line in lines]


@pytest.fixture
def log(monkeypatch):
    monkeypatch.setattr(session, "QUIET_S", 0.05)
    return Log()


def test_in_a_log_each_step_is_a_line_as_it_begins(log):
    with session._logged(log) as progress:
        progress("loading")
        progress("reading")
        deadline = time.monotonic() + 60
        while not log.getvalue() and time.monotonic() < deadline:  # lines do not wait for the next step
            time.sleep(0.01)
        assert log.steps == ["loading", "reading"]
        progress("fitting")
        assert log.steps == ["loading", "reading", "fitting"]
    assert log.steps == ["loading", "reading", "fitting", "done"]


def test_work_that_fails_is_not_reported_as_done(log):
    def work():
        with session._logged(log) as progress:
            progress("loading")
            progress("reading")
            time.sleep(0.2)
            raise ValueError("no result")

    with pytest.raises(ValueError, match="no result"):
        work()
    assert log.steps == ["loading", "reading"]


@pytest.mark.parametrize("steps", [1, 2])
def test_in_a_log_short_work_is_not_reported(log, monkeypatch, steps):
    monkeypatch.setattr(session, "QUIET_S", 1000.0 if steps == 2 else 0.05)
    with session._logged(log) as progress:
        for step in range(steps):
            progress(f"step {step}")
        time.sleep(0.2)  # loading the library alone is not counted
    assert log.steps == []


def test_a_log_that_nobody_reads_does_not_end_the_work(log, monkeypatch):
    def gone(_):
        raise BrokenPipeError

    monkeypatch.setattr(log, "write", gone)
    with session._logged(log) as progress:
        progress("loading")
        progress("reading")
        time.sleep(0.2)
        progress("fitting")
