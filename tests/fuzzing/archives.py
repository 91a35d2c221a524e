"""Archives as testers do not write them: hostile names, links, other compressions, and contents that swell."""

from __future__ import annotations

import io
import stat
import zipfile
from random import Random

from mutators import mutate

NAMES = (
    *(
        "a.txt",
        "b/a.txt",
        "../../x",
        "/etc/passwd",
        "C:\\x.txt",
        "..",
        ".",
        "x/",
        "a\nb.txt",
        "\x1b[31m.txt",
        "con.txt",
    ),
    *("é.txt", "\u202etxt.a", "a" * 300, " ", ".txt", "a,b.txt", '"a".txt', "a\x00b.txt", "a/../../b.txt", "1.txt"),
)
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


def pack(rng: Random, members: list[bytes]) -> bytes:
    """An archive of the members, its names and kinds of entries often hostile."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for i, content in enumerate(members):
            entry = zipfile.ZipInfo(rng.choice(NAMES) + str(i) if rng.random() < 0.5 else f"test {i}.txt")
            entry.compress_type = METHODS[1] if rng.random() < 0.7 else rng.choice(METHODS)
            if rng.random() < 0.1:
                entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def plain_archive(member: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("test.txt"), member)
    return buffer.getvalue()


def hostile_archive(rng: Random, member: bytes, other: bytes) -> bytes:
    """An archive with damaged members, with members that swell, or one that is damaged itself."""
    members = [member, other][: rng.choice((0, 1, 1, 2, 2))]
    match rng.randrange(4):
        case 0:
            members = [mutate(rng, content, other) for content in members]
        case 1 if rng.random() < 0.05:
            members.append(rng.choice((member[-60:], b"\n", b"\0", b"0.000000\t")) * rng.choice((10_000, 200_000)))
        case 2:
            return mutate(rng, pack(rng, members), pack(rng, members[::-1]))
        case _:
            pass
    return pack(rng, members)
