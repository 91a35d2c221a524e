import errno
import os
from pathlib import Path

import pytest
from asserting import snapshot

from mcc_jax import InputError
from mcc_jax._store import LOCK, READY, WORK, json_text, results, write_file


def test_only_files_named_stale_go(tmp_path):
    for name in ("old.png", "kept.png", "one.txt"):
        (tmp_path / name).write_text("old")
    with results(tmp_path) as stage:
        (stage.folder / "one.txt").write_text("1")
        stage.stale += ["old.png", "never there.png", "one.txt"]
    assert snapshot(tmp_path) == {"one.txt": b"1", "kept.png": b"old"}


@pytest.mark.parametrize("at", range(5))
def test_a_run_killed_at_any_move_leaves_the_old_results_or_the_new_ones(tmp_path, monkeypatch, at):
    old = {"a": "old", "b": "old", "stale": "old", "of the user": "kept"}
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    replace, unlink, calls = Path.replace, Path.unlink, []

    def killed(real):
        def move(self, *arguments, **settings):
            calls.extend([self] if self.name != LOCK else [])
            if self.name != LOCK and len(calls) == at + 1:
                raise KeyboardInterrupt
            return real(self, *arguments, **settings)

        return move

    def killed_run():
        with results(tmp_path) as stage:
            stage.stale += ["stale", "a"]
            (stage.folder / "sub").mkdir()
            for name in ("a", "b", "sub/new"):
                (stage.folder / name).write_text("new")
            monkeypatch.setattr(Path, "replace", killed(replace))
            monkeypatch.setattr(Path, "unlink", killed(unlink))

    with pytest.raises(KeyboardInterrupt):
        killed_run()
    monkeypatch.undo()
    assert (tmp_path / READY).exists() == (at > 0)
    with results(tmp_path):  # whoever reads first in the next run sees
        found = {name: data.decode() for name, data in snapshot(tmp_path).items() if data is not None}
        found = {name: text for name, text in found.items() if not name.startswith(".mcc-jax")}
    assert found == ({"a": "new", "b": "new", "sub/new": "new", "of the user": "kept"} if at else old)
    assert not any(name.startswith(".mcc-jax") for name in snapshot(tmp_path))


def write(folder, **files):
    """Results of these names and texts; an underscore means a subfolder."""
    with results(folder) as stage:
        for name, text in files.items():
            file = stage.folder / name.replace("_", "/")
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)


def test_a_folder_where_a_file_belongs_and_a_file_where_a_folder(tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "sub").write_text("mine")
    (tmp_path / "a").write_text("old")
    before = snapshot(tmp_path)
    with pytest.raises(InputError, match=r"one there is a folder"):
        write(tmp_path, a="new", one="1")
    with pytest.raises(InputError, match="Not a directory"):
        write(tmp_path, a="new", sub_one="1")
    assert snapshot(tmp_path) == before


def failing(error, folder):
    with results(folder) as stage:
        raise error(stage)


def test_the_users_folder_is_named_not_the_stage(tmp_path):
    def error(stage):
        return InputError("cannot be written", file=stage.folder / "campaign", remedy="Free some disk space")

    with pytest.raises(InputError) as caught:
        failing(error, tmp_path / "out")
    assert str(caught.value) == f"{tmp_path / 'out'}: cannot be written. Free some disk space"
    assert snapshot(tmp_path) == {}


def test_a_full_disk_is_bad_luck_and_an_error_of_another_file_is_not_ours(tmp_path):
    with pytest.raises(InputError, match=r"No space left on device\. Free some disk space"):
        failing(lambda _: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), tmp_path)
    with pytest.raises(FileNotFoundError):
        failing(lambda _: FileNotFoundError(errno.ENOENT, "no such file", "/somewhere/else"), tmp_path)


def test_one_run_at_a_time(tmp_path):
    with results(tmp_path) as stage:
        with pytest.raises(InputError, match="another mcc-jax run is writing there"):
            write(tmp_path, b="second")
        (stage.folder / "a").write_text("first")  # undisturbed by the refusal
    assert snapshot(tmp_path) == {"a": b"first"}
    with results(tmp_path):
        pass


def test_left_overs_of_a_killed_run_are_cleared(tmp_path):
    (tmp_path / LOCK).write_text("1\n")
    (tmp_path / WORK).mkdir()
    (tmp_path / WORK / "half").write_text("half")
    write(tmp_path, a="a")
    assert snapshot(tmp_path) == {"a": b"a"}


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks(tmp_path, monkeypatch, number):
    fcntl = pytest.importorskip("fcntl")

    def no_locks(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    write(tmp_path, a="a")
    assert snapshot(tmp_path) == {"a": b"a"}


def test_one_file_is_replaced_when_it_is_complete(tmp_path, monkeypatch):
    file = tmp_path / "state"
    write_file(file, b"old")

    def full(_):
        raise OSError("planted")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="planted"):
        write_file(file, b"new")
    assert snapshot(tmp_path) == {"state": b"old"}
    monkeypatch.undo()
    write_file(file, b"new")
    assert snapshot(tmp_path) == {"state": b"new"}


def test_json_is_strict():
    assert json_text({"a": float("nan"), "b": [1.5, float("inf")], "c": "µ"}) == (
        '{\n  "a": null,\n  "b": [\n    1.5,\n    null\n  ],\n  "c": "µ"\n}\n'
    )
