"""Readers with every fault that the runner must notice, one to each."""

from __future__ import annotations

import os
import time
import warnings
from pathlib import Path

from targets import Reader

from mcc_jax import InputError


def _read(folder: Path) -> None:
    match int((folder / "number").read_bytes()):
        case 1:
            raise KeyError("crash")
        case 2:
            time.sleep(60)
        case 3:
            bytearray(3 << 30)
        case 4:
            os.abort()
        case 5:
            raise InputError("")
        case 6:
            warnings.warn("noise", stacklevel=1)
        case 7:
            (folder / "left").touch()
        case 8:
            raise InputError("it cannot be read")


def _reader(number: int) -> Reader:
    return Reader(f"fault {number}", 1, {"number": b"0"}, lambda *_: {"number": b"%d" % number}, _read)


READERS = tuple(_reader(number) for number in range(9))
