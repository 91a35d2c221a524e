"""Typed values as bytes and back, to the last bit: dataclasses, modules, arrays, enums; never code (no pickle).

Arrays keep dtype, shape and bytes; an object is the name of its class, its fields and the cached properties that its
class lists in `archived`, and is built again without running any of its code. Only classes of this package are built,
and those of `FOREIGN`.
"""

from __future__ import annotations

import dataclasses
import enum
import hashlib
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from ._errors import InputError
from ._version import __version__
from .files import POSTERIOR_BYTES, read_regular

VERSION = 1  # of the format
AGAIN = "Write it again with the command or function that made it, or move it away."
FOREIGN = ("tinygp.kernels.quasisep", "tinygp.solvers.quasisep")
_PLAIN = (bool, int, float, str, bytes, type(None))


class _Archive(msgspec.Struct):
    format: Literal["mcc_jax result"]
    version: int
    written_by: str
    sha256: str
    content: bytes


def encode(value: Any) -> bytes:
    """The bytes of a file that holds a value; `InputError` names a part that cannot be written."""
    content = msgspec.msgpack.encode(_plain(value, "result"))
    digest = hashlib.sha256(content).hexdigest()
    return msgspec.msgpack.encode(_Archive("mcc_jax result", VERSION, __version__, digest, content))


def read_archive(file: Path) -> Any:
    """The value that a file holds; `InputError` if it is missing, cut off, changed or of a newer version."""
    raw = read_regular(file, POSTERIOR_BYTES, AGAIN)
    try:
        archive = msgspec.msgpack.decode(raw, type=_Archive)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"is no result of mcc_jax, or is cut off: {error}", file=file, remedy=AGAIN) from None
    if archive.version > VERSION:
        remedy = f"Install mcc_jax {archive.written_by[:40]} or newer."
        raise InputError(f"was written by a newer version, {archive.written_by[:40]}", file=file, remedy=remedy)
    if hashlib.sha256(archive.content).hexdigest() != archive.sha256:
        raise InputError("is damaged: its checksum is another", file=file, remedy=AGAIN)
    try:
        return _built(msgspec.msgpack.decode(archive.content))
    except (AttributeError, KeyError, TypeError, ValueError, ImportError, RecursionError) as error:
        raise InputError(f"was written by another version: {error}", file=file, remedy=AGAIN) from error


# ---- values as MessagePack knows them --------------------------------------------------------------------------------


def _plain(value: Any, where: str) -> Any:
    if isinstance(value, enum.Enum):
        return {"enum": _name(type(value), where), "name": value.name}
    if type(value) in _PLAIN:
        return value
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _array(value, where)
    if isinstance(value, list | tuple):
        items = [_plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
        if isinstance(value, list):
            return items
        return {"named": _name(type(value), where), "items": items} if hasattr(value, "_fields") else {"tuple": items}
    if isinstance(value, Mapping):
        return {"mapping": [[_plain(k, where), _plain(item, f"{where}[{k!r}]")] for k, item in value.items()]}
    if isinstance(value, type):
        return {"class": _name(value, where)}
    if dataclasses.is_dataclass(value):
        fields = {name: _plain(getattr(value, name), f"{where}.{name}") for name in _contents(type(value))}
        return {"object": _name(type(value), where), "fields": fields}
    raise InputError(f"{where} is of a kind that cannot be written, {type(value).__name__}")


def _contents(kind: Any) -> list[str]:
    return [*(f.name for f in dataclasses.fields(kind)), *getattr(kind, "archived", ())]


def _array(value: jax.Array | np.ndarray | np.generic, where: str) -> dict[str, Any]:
    kind = "jax" if isinstance(value, jax.Array) else "numpy" if isinstance(value, np.ndarray) else "scalar"
    array = np.asarray(value)
    if array.dtype.kind not in "biufcU":
        raise InputError(f"{where} is an array of {array.dtype}, which cannot be written")
    return {"array": kind, "dtype": array.dtype.str, "shape": list(array.shape), "bytes": array.tobytes()}


def _trusted(module: str) -> bool:
    """Whether classes of a module are built: this package's, and the factored covariances of tinygp, which are data."""
    return any(module == one or module.startswith(f"{one}.") for one in (__name__.split(".")[0], *FOREIGN))


def _name(kind: type, where: str) -> str:
    if not _trusted(kind.__module__) or "<" in kind.__qualname__:
        problem = f"{where} is of the class {kind.__module__}.{kind.__qualname__}, which is not of mcc_jax"
        raise InputError(problem, remedy="Such results cannot be read back; keep the script that makes them.")
    return f"{kind.__module__}:{kind.__qualname__}"


# ---- and back --------------------------------------------------------------------------------------------------------


def _built(value: Any) -> Any:
    if isinstance(value, list):
        return [_built(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        array = np.frombuffer(value["bytes"], np.dtype(value["dtype"])).reshape(value["shape"])
        if value["array"] == "scalar":
            return array[()]
        return jnp.asarray(array) if value["array"] == "jax" else array  # NumPy's arrays cannot be written to
    if "mapping" in value:
        return {_built(key): _built(item) for key, item in value["mapping"]}
    if "tuple" in value:
        return tuple(_built(item) for item in value["tuple"])
    if "named" in value:
        return _class(value["named"], tuple)(*(_built(item) for item in value["items"]))
    if "enum" in value:
        return _class(value["enum"], enum.Enum)[value["name"]]
    if "class" in value:
        return _class(value["class"], object)
    return _object(_class(value["object"], object), value["fields"])


def _object(kind: type, contents: Mapping[str, Any]) -> Any:
    """An object with these fields; none of its code runs."""
    if not dataclasses.is_dataclass(kind):
        raise TypeError(f"{kind.__name__} is no dataclass")
    if wrong := set(contents).symmetric_difference(_contents(kind)):
        raise TypeError(f"fields of {kind.__name__} differ: {', '.join(sorted(wrong))}")
    made = object.__new__(kind)
    made.__dict__.update({name: _built(content) for name, content in contents.items()})
    return made


def _class(name: str, base: type) -> Any:
    module, _, path = name.partition(":")
    if not _trusted(module):
        raise TypeError(f"{module} is not of mcc_jax")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type) or not issubclass(found, base):
        raise TypeError(f"{name} is no class")
    return found
