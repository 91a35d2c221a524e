"""Damage to bytes: what disks, editors, spreadsheets, instruments and malice do to files."""

from __future__ import annotations

import copy
import json
import re
from random import Random
from typing import Any

NASTY = [
    b"", b",", b"\n", b"\r", b"\r\n", b"\t", b" ", b'"', b'""', b"'", b";", b":", b"=", b"[", b"]", b"[[", b"{", b"}",
    b"#", b"\\", b"/", b"..", b"\0", b"\x1a", b"\x0b", b"\x0c", b"\x7f", b"\xff", b"\xef\xbb\xbf", b"\xb5", b"null",
    b"nan", b"inf", b"true", b"-", b".", b"e", b"1e400", b"1_0", b"0x1", b"1.2.3", b"<script>", b"%s", b"{0}",
    "µ", "μ", "１", "\u2028", "\u202e", "é", "\U0001f9ea",
    b"\xed\xa0\x80", b"\\ud800", b"\\u0000", b"force_mN", b"time_s", b"particle", b"D1_um", b"F\th\tt", b"../../x",
    b"[" * 3000, b"9" * 5000, b"0x" + b"f" * 5000, b"A" * 150_000, b"\n" * 50_000, b" " * 3000, b"a.b." * 500,
]  # fmt: skip
NASTY = [piece.encode() if isinstance(piece, str) else piece for piece in NASTY]
NUMBERS = [
    *(b"nan", b"inf", b"-inf", b"1e400", b"-1e400", b"1e308", b"-1", b"0", b"-0.0", b"1e-320", b"", b" ", b"x", b"1,5"),
    *(b"9" * 400, b"9" * 5000, b"0x" + b"f" * 400, b"1e16", b"2147483648", b"9223372036854775808", b"-1e-9", b"1.2.3"),
    *(b"true", b"null", b'"1"', b"[1]", b"{}", b"1_0", b"1e", b"0.1e1e1", b"1.000000", b"1979-05-27", b"25:61:61"),
]
_NUMBER = re.compile(rb"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?")
_ENCODINGS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1", "cp1252", "utf-8-sig", "utf-7")


def _span(rng: Random, data: bytes) -> tuple[int, int]:
    start = rng.randrange(len(data) + 1)
    return start, min(len(data), start + rng.choice((0, 1, 1, 2, 8, 64, 1000)))


def flip(rng: Random, data: bytes, _: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 16))):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def set_byte(rng: Random, data: bytes, _: bytes) -> bytes:
    at, _ = _span(rng, data)
    return data[:at] + bytes([rng.choice((0, 1, 127, 128, 254, 255, rng.randrange(256)))]) + data[at + 1 :]


def insert(rng: Random, data: bytes, _: bytes) -> bytes:
    start, stop = _span(rng, data)
    return data[:start] + rng.choice(NASTY) + data[rng.choice((start, stop)) :]


def delete(rng: Random, data: bytes, _: bytes) -> bytes:
    start, stop = _span(rng, data)
    return data[:start] + data[stop:]


def duplicate(rng: Random, data: bytes, _: bytes) -> bytes:
    start, stop = _span(rng, data)
    return data[:stop] + data[start:stop] * rng.choice((1, 1, 2, 100)) + data[stop:]


def truncate(rng: Random, data: bytes, _: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def splice(rng: Random, data: bytes, other: bytes) -> bytes:
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


def lines(rng: Random, data: bytes, _: bytes) -> bytes:
    """A line lost, doubled, moved, or with cells lost, doubled or moved."""
    rows = data.split(b"\n")
    i, j = rng.randrange(len(rows)), rng.randrange(len(rows))
    match rng.randrange(5):
        case 0:
            del rows[i]
        case 1:
            rows.insert(i, rows[j])
        case 2:
            rows[i], rows[j] = rows[j], rows[i]
        case 3:
            rows[i] = b""
        case _:
            mark = rng.choice((b",", b"\t", b" ", b"=", b":"))
            cells = rows[i].split(mark)
            k, m = rng.randrange(len(cells)), rng.randrange(len(cells))
            rows[i] = mark.join(rng.choice((cells[:k] + cells[k + 1 :], [*cells, cells[k]], [*cells[m:], *cells[:m]])))
    return b"\n".join(rows)


def number(rng: Random, data: bytes, _: bytes) -> bytes:
    found = list(_NUMBER.finditer(data))
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 3)))), key=lambda m: -m.start()):
        data = data[: match.start()] + rng.choice(NUMBERS) + data[match.end() :]
    return data


def encoding(rng: Random, data: bytes, _: bytes) -> bytes:
    return data.decode("utf-8", "replace").encode(rng.choice(_ENCODINGS), "replace")


def line_ends(rng: Random, data: bytes, _: bytes) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r", b"\r\n", b"\n\n", b"\n\r", b"\x0b", b"\n" * 20)))


MUTATORS = (flip, set_byte, insert, insert, delete, duplicate, truncate, splice, lines, lines, number, number, number)
RARE = (encoding, line_ends)
LARGEST = 1 << 20


def mutate(rng: Random, data: bytes, other: bytes) -> bytes:
    """One to four kinds of damage; `other` is a second file to splice with."""
    for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
        data = rng.choice(RARE if rng.random() < 0.05 else MUTATORS)(rng, data, other)
    return data[:LARGEST]


VALUES = (
    None, True, False, 0, -1, 1, 0.5, -0.0, 1e-320, 1e300, -1e300, 1e308, 10**18, 10**400, float("nan"), float("inf"),
    "", " ", "x", "\ud800", "\0", "\n", "\u202e", "</script>", "{{ 7 * 7 }}", "%s", "../..", "1", "A" * 9000, "é",
    [], {}, [[]], [None], {"": ""}, {"value": None}, [1, 2], [1e300, -1e300],
)  # fmt: skip


def mutate_json(rng: Random, data: bytes) -> bytes:
    """Valid JSON in which one to three values, keys or items are others, are gone, or stand there twice."""
    root = {"root": json.loads(data)}
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        places = _places(root)
        holder, key = rng.choice(places)
        other, other_key = rng.choice(places)
        match rng.randrange(4):
            case 0 if holder is not root:
                del holder[key]
            case 1:
                holder[key] = copy.deepcopy(other[other_key])
            case 2 if isinstance(holder, list):
                holder.append(copy.deepcopy(holder[key]))
            case _:
                # Mostly of the same type: what a schema refuses at once tests nothing behind it.
                alike = [value for value in VALUES if rng.random() < 0.3 or type(value) is type(holder[key])]
                holder[key] = copy.deepcopy(rng.choice(alike or VALUES))
    return json.dumps(root["root"]).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    items = list(value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ())
    return [(value, key) for key, _ in items] + [place for _, item in items for place in _places(item)]
