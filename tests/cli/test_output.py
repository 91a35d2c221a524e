import errno
import json
import os
from pathlib import Path

import pytest
from asserting import snapshot

from mcc_jax import InputError
from mcc_jax._store import LOCK, MOVES, WORK, json_text, results, write_file


def test_results_appear_together(tmp_path):
    out = tmp_path / "a" / "b"
    with results(out) as stage:
        (stage.folder / "sub").mkdir()
        (stage.folder / "one.txt").write_text("1")
        (stage.folder / "sub" / "two.txt").write_text("2")
        assert not (out / "one.txt").exists()
    assert snapshot(out) == {"one.txt": b"1", "sub": None, "sub/two.txt": b"2"}


def test_only_files_named_stale_go(tmp_path):
    for name in ("old.png", "kept.png", "one.txt"):
        (tmp_path / name).write_text("old")
    with results(tmp_path) as stage:
        (stage.folder / "one.txt").write_text("1")
        stage.stale += ["old.png", "never there.png", "one.txt"]
    assert snapshot(tmp_path) == {"one.txt": b"1", "kept.png": b"old"}


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_move_that_fails_is_undone(tmp_path, monkeypatch, at):
    for name in ("a", "b", "stale"):
        (tmp_path / name).write_text("old")
    replace, calls = Path.replace, []

    def failing(self, target):
        calls.append(target)
        if len(calls) == at:
            raise OSError(errno.EIO, "planted", str(target))
        return replace(self, target)

    def write():
        with results(tmp_path) as stage:
            stage.stale.append("stale")
            (stage.folder / "sub").mkdir()
            for name in ("a", "b", "sub/new"):
                (stage.folder / name).write_text("new")
            monkeypatch.setattr(Path, "replace", failing)

    before = snapshot(tmp_path)
    with pytest.raises(InputError, match="planted"):
        write()
    assert snapshot(tmp_path) == before


def test_a_folder_where_a_file_belongs(tmp_path):
    (tmp_path / "one.txt").mkdir()
    (tmp_path / "a.txt").write_text("old")
    before = snapshot(tmp_path)

    def write():
        with results(tmp_path) as stage:
            (stage.folder / "a.txt").write_text("new")
            (stage.folder / "one.txt").write_text("1")

    with pytest.raises(InputError, match=r"one\.txt there is a folder"):
        write()
    assert snapshot(tmp_path) == before


def test_without_hard_links(tmp_path, monkeypatch):
    def no_links(*_):
        raise OSError(errno.EPERM, "no hard links here")

    (tmp_path / "a").write_text("old")
    monkeypatch.setattr(Path, "hardlink_to", no_links)
    with results(tmp_path) as stage:
        (stage.folder / "a").write_text("new")
    assert snapshot(tmp_path) == {"a": b"new"}


def test_the_users_folder_is_named_not_the_stage(tmp_path):
    def write():
        with results(tmp_path / "out") as stage:
            raise InputError("cannot be written", file=stage.folder / "campaign", remedy="Make room")

    with pytest.raises(InputError) as caught:
        write()
    assert str(caught.value) == f"{tmp_path / 'out'}: cannot be written. Make room"
    assert snapshot(tmp_path) == {}


def test_a_full_disk_is_bad_luck_not_a_defect(tmp_path):
    def write():
        with results(tmp_path):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(InputError, match=r"No space left on device\. Make room"):
        write()


def test_an_error_of_another_file_is_not_ours(tmp_path):
    def read():
        with results(tmp_path):
            raise FileNotFoundError(errno.ENOENT, "no such file", "/somewhere/else")

    with pytest.raises(FileNotFoundError):
        read()


def test_one_run_at_a_time(tmp_path):
    def second():
        with results(tmp_path):
            raise AssertionError

    with results(tmp_path) as stage:
        with pytest.raises(InputError, match=rf"another mcc-jax run \(process {os.getpid()}\) is writing there"):
            second()
        (stage.folder / "a").write_text("first")  # undisturbed by the refusal
    assert snapshot(tmp_path) == {"a": b"first"}
    with results(tmp_path):
        pass


def test_left_overs_of_a_killed_run_are_cleared(tmp_path):
    (tmp_path / LOCK).write_text("1\n")
    (tmp_path / f"{WORK}x" / "new").mkdir(parents=True)
    (tmp_path / f"{WORK}x" / "new" / "half").write_text("half")
    with results(tmp_path) as stage:
        (stage.folder / "a").write_text("a")
    assert snapshot(tmp_path) == {"a": b"a"}


@pytest.mark.parametrize("moved", [0, 1, 2, 3])
def test_what_a_run_killed_while_moving_had_still_to_move_is_moved(tmp_path, moved):
    work = tmp_path / f"{WORK}x"
    new = {"a": "new a", "figures/b.png": "new b", "c": "new c"}
    (tmp_path / "figures").mkdir()
    (work / "new" / "figures").mkdir(parents=True)
    for i, (name, text) in enumerate(new.items()):
        (tmp_path / name).write_text(text if i < moved else "old")
        if i >= moved:
            (work / "new" / name).write_text(text)
    (tmp_path / "dropped").write_text("old")
    (work / MOVES).write_text(json.dumps({"new": list(new), "stale": ["dropped"]}))
    (tmp_path / "of the user").write_text("kept")
    with results(tmp_path) as stage:
        assert (tmp_path / "a").read_text() == "new a"  # whoever reads first sees them
        (stage.folder / "d").write_text("d")
    found = {name: data for name, data in snapshot(tmp_path).items() if data is not None}
    assert found == {name: text.encode() for name, text in (new | {"of the user": "kept", "d": "d"}).items()}


@pytest.mark.parametrize(
    "text", ["", "[]", '{"new": ["../b"], "stale": []}', '{"new": [], "stale": ["/etc/hostname"]}']
)
def test_a_list_of_moves_by_somebody_else_moves_nothing(tmp_path, text):
    out, work = tmp_path / "out", tmp_path / "out" / f"{WORK}x"
    (work / "new").mkdir(parents=True)
    (work / "b").write_text("b")
    (work / MOVES).write_text(text)
    with results(out):
        pass
    assert snapshot(tmp_path) == {"out": None}


def test_a_move_that_fails_leaves_nothing_to_finish(tmp_path):
    (tmp_path / "b").mkdir()
    seen = []

    def write():
        with results(tmp_path) as stage:
            (stage.folder / "a").write_text("a")
            (stage.folder / "b").write_text("b")
            seen.append(stage.folder.parent)

    with pytest.raises(InputError, match="there is a folder"):
        write()
    assert not seen[0].exists()
    assert set(snapshot(tmp_path)) == {"b"}


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_file_in_the_locks_place_is_refused(tmp_path, kind):
    """Whoever may write into the folder may have put it there, for us to write through."""
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.write_text("theirs")
    lock = out / LOCK
    {"link": lambda: lock.symlink_to(elsewhere), "pipe": lambda: os.mkfifo(lock), "folder": lock.mkdir}[kind]()
    with pytest.raises(InputError, match="is no regular file, and cannot lock the folder"), results(out):
        pass
    assert elsewhere.read_text() == "theirs"
    assert [file.name for file in out.iterdir()] == [LOCK]


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks(tmp_path, monkeypatch, number):
    fcntl = pytest.importorskip("fcntl")

    def no_locks(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with results(tmp_path) as stage:
        (stage.folder / "a").write_text("a")
    assert snapshot(tmp_path) == {"a": b"a"}


def test_one_file_is_replaced_when_it_is_complete(tmp_path):
    file = tmp_path / "state"
    file.write_text("old")

    def half(stream):
        stream.write(b"ha")
        raise ValueError("planted")

    with pytest.raises(ValueError, match="planted"):
        write_file(file, half)
    assert snapshot(tmp_path) == {"state": b"old"}
    write_file(file, lambda stream: stream.write(b"new"))
    assert snapshot(tmp_path) == {"state": b"new"}


def test_json_is_strict():
    assert json_text({"a": float("nan"), "b": [1.5, float("inf")], "c": "µ"}) == (
        '{\n  "a": null,\n  "b": [\n    1.5,\n    null\n  ],\n  "c": "µ"\n}\n'
    )
