"""Results as bytes: what is read is what was written to the last bit; what we did not write is one clear line."""

import dataclasses
import hashlib

import equinox as eqx
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mcc_jax import InputError, load, paper_law
from mcc_jax._archive import encode, read_archive
from mcc_jax.discovery import Discovery
from mcc_jax.effects import AbstractEffect
from mcc_jax.law import Unloading

PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text() | st.binary()
ARRAYS = arrays(st.sampled_from([np.float64, np.float32, np.int32, np.bool_]), st.integers(0, 4))
VALUES = st.recursive(
    PLAIN | ARRAYS,
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


def again(value, folder):
    file = folder / "calibration.msgpack"
    file.write_bytes(encode(value))
    return read_archive(file)


def bits(value):
    """Value, kinds and bits: NaN is itself, and -0.0 is not 0.0."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return np.float64(value).tobytes()
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [bits(item) for item in value]
    return type(value), value


@given(VALUES)
def test_what_is_read_is_what_was_written(tmp_path_factory, value):
    assert bits(again(value, tmp_path_factory.getbasetemp())) == bits(value)


def test_laws_with_effects_and_memory(tmp_path):
    law = paper_law(Unloading.PUNCH).with_effects("creep:logarithmic", "damage")
    found = again(law, tmp_path)
    assert found.unloading is Unloading.PUNCH
    assert eqx.tree_equal(found, law)


def damaged(file, change):
    archive = msgspec.msgpack.decode(file.read_bytes())
    file.write_bytes(msgspec.msgpack.encode(archive | change))


def written(change):
    return lambda file: file.write_bytes(change(file.read_bytes()))


DAMAGE = {
    "truncated": (written(lambda raw: raw[:-100]), "cut off"),
    "foreign": (written(lambda _: b"\x89HDF\r\n\x1a\n and so on"), "no result of mcc_jax"),
    "empty": (written(lambda _: b""), "cut off"),
    "no text": (written(lambda raw: raw.replace(b"mcc_jax result", b"mcc_jax \xff\xfesult")), "no result"),
    "newer": (lambda file: damaged(file, {"version": 2, "written_by": "9.1.0"}), "newer version, 9.1.0"),
    "another format": (lambda file: damaged(file, {"format": "another"}), "no result of mcc_jax"),
    "changed": (lambda file: damaged(file, {"content": b"\x90"}), "checksum"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_foreign_or_newer_file_is_one_line(tmp_path, kind):
    change, words = DAMAGE[kind]
    file = tmp_path / "discovery.msgpack"
    file.write_bytes(encode(Discovery("NO_GAP", "Nothing is missing.", None, None, 0, 0.0)))
    change(file)
    with pytest.raises(InputError, match=f"{file}.*{words}"):
        load(tmp_path)


class Mine(AbstractEffect):
    """An effect of one's own."""


def test_what_cannot_be_read_back_is_refused_when_it_is_written():
    with pytest.raises(InputError, match=r"test_archive.Mine, which is not of mcc_jax"):
        encode(paper_law().with_effects(Mine(0.1)))
    with pytest.raises(InputError, match="cannot be written"):
        encode({"f": lambda: None})


@pytest.mark.parametrize("name", ["os:system", "mcc_jax._archive:os", "mcc_jax.law.mcc:TESTED_STRAIN", "builtins:eval"])
def test_only_classes_of_the_package_are_built(tmp_path, name):
    file = tmp_path / "calibration.msgpack"
    content = msgspec.msgpack.encode({"object": name, "fields": {}})
    file.write_bytes(encode(None))
    damaged(file, {"content": content, "sha256": hashlib.sha256(content).hexdigest()})
    with pytest.raises(InputError, match="another version"):
        read_archive(file)


def test_a_field_that_nobody_knows_is_another_version(tmp_path):
    @dataclasses.dataclass
    class Stranger:
        verdict: str
        more: int = 0

    Stranger.__module__, Stranger.__qualname__ = Discovery.__module__, Discovery.__qualname__
    file = tmp_path / "calibration.msgpack"
    file.write_bytes(encode(Stranger("NO_GAP")))
    with pytest.raises(InputError, match=r"another version.*\bmore\b"):
        load(tmp_path)
