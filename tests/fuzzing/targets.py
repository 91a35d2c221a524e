"""Every reader that a file of a user reaches: how to damage its files, and how to read them."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from mutators import mutate, mutate_json

from mcc_jax import load
from mcc_jax._archive import encode
from mcc_jax.calibrate import read_priors
from mcc_jax.campaign import (
    check_campaign,
    humidities,
    read_campaign,
    read_diameters,
    read_instrument_file,
    write_campaign,
)
from mcc_jax.dem import load_state
from mcc_jax.discovery import Discovery
from mcc_jax.report import read_results, report_page
from mcc_jax.simulate import read_programme

SAMPLES = Path(__file__).parent / "samples"
Case = dict[str, bytes]


Damage = Callable[[Random, Case], Case]


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        name: as in the table and after --only.
        share: of the inputs, relative to the others; slow readers get fewer.
        whole: files that it reads, by their path within a folder.
        damage: what becomes of them in one input.
        read: reads them in that folder; returns, or raises `InputError`.
    """

    name: str
    share: float
    whole: Case
    damage: Damage
    read: Callable[[Path], object]


def sample(name: str) -> bytes:
    return (SAMPLES / name).read_bytes()


def samples(folder: str) -> Case:
    return {file.name: file.read_bytes() for file in sorted((SAMPLES / folder).iterdir())}


CAMPAIGN = {f"campaign/{name}": content for name, content in samples("campaign").items()}
OTHERS = [sample(name) for name in ("fischer.txt", "hysitron.hld", "hysitron_lc.txt", "campaign/curves.csv")]


def bytes_of(name: str) -> Damage:
    """Damage to one file, spliced now and then with a sample of another kind."""

    def damage(rng: Random, whole: Case) -> Case:
        other = whole[name] if rng.random() < 0.7 else rng.choice(OTHERS)
        return whole | {name: mutate(rng, whole[name], other)}

    return damage


def values_of(*names: str) -> Damage:
    """Other values in one of several JSON files, or damaged bytes."""

    def damage(rng: Random, whole: Case) -> Case:
        name = rng.choice(names)
        return whole | {name: mutate_json(rng, whole[name])} if rng.random() < 0.7 else bytes_of(name)(rng, whole)

    return damage


def diameters(rng: Random, whole: Case) -> Case:
    if rng.random() < 0.5:
        return bytes_of("particles.csv")(rng, whole)
    return {"text": mutate(rng, b"200.0,190.5,1.8e2", b"1,2,3")}


def read_folder(folder: Path) -> None:
    humidities(check_campaign(read_campaign(folder), file=folder))


def read_sizes(folder: Path) -> None:
    text = folder / "text"
    read_diameters(text.read_bytes().decode("utf-8", "replace") if text.exists() else folder / "particles.csv")


def convert(name: str, mapping: str | None = None) -> Callable[[Path], None]:
    """What `mcc-jax convert` does: read, write, and what was written must read back the same."""

    def read(folder: Path) -> None:
        described = None if mapping is None else folder / mapping
        sizes = None if mapping is not None else [200.0, 190.0, 180.0]
        campaign = read_instrument_file(folder / name, diameters_um=sizes, mapping=described)
        again = folder / "converted"
        try:
            write_campaign(campaign, again)
            assert read_campaign(again).particles == campaign.particles
        finally:
            shutil.rmtree(again, ignore_errors=True)

    return read


def report(folder: Path) -> None:
    report_page(read_results(folder)).encode("utf-8")


def of_file(name: str, share: float, file: str, read: Callable[[Path], object]) -> Reader:
    """A reader of one file."""
    return Reader(name, share, {file: sample(file)}, bytes_of(file), lambda folder: read(folder / file))


def zipped(member: bytes) -> bytes:
    """An archive of one test."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("test.txt"), member)
    return buffer.getvalue()


FOLDER, MAPPED, HEADED = samples("campaign"), samples("mapped"), samples("headed")
ZIP = {"tests.zip": zipped(sample("micromaterials.txt"))}
INSTRUMENTS = (
    ("Fischer", "fischer.txt"),
    ("Hysitron hld", "hysitron.hld"),
    ("Hysitron text", "hysitron_lc.txt"),
    ("Micro Materials", "micromaterials.txt"),
)
SAVED = "discovery.msgpack"
NO_GAP = Discovery("NO_GAP", "Nothing is missing.", None, None, 0, 2.0)
DISCOVERY = {"discovery.json": sample("results/discovery.json"), SAVED: encode(NO_GAP)}
READERS = (
    *(Reader(name, 4, FOLDER, bytes_of(name), read_folder) for name in FOLDER),
    Reader("diameters", 2, {"particles.csv": FOLDER["particles.csv"]}, diameters, read_sizes),
    *(Reader(label, 4, {name: sample(name)}, bytes_of(name), convert(name)) for label, name in INSTRUMENTS),
    Reader("archive", 5, ZIP, bytes_of("tests.zip"), convert("tests.zip")),
    Reader("mapped table", 4, MAPPED, bytes_of("table.txt"), convert("table.txt", "mapping.toml")),
    Reader("mapping", 4, MAPPED, bytes_of("mapping.toml"), convert("table.txt", "mapping.toml")),
    Reader("headed table", 4, HEADED, bytes_of("table.txt"), convert("table.txt", "mapping.toml")),
    Reader("headed mapping", 4, HEADED, bytes_of("mapping.toml"), convert("table.txt", "mapping.toml")),
    of_file("priors", 2, "priors.toml", read_priors),
    of_file("programme", 2, "programme.toml", read_programme),
    Reader("discovery.json", 2, CAMPAIGN | DISCOVERY, values_of("discovery.json"), read_results),
    Reader("saved discovery", 2, {SAVED: DISCOVERY[SAVED]}, bytes_of(SAVED), load),
    of_file("saved state", 1, "state.msgpack", load_state),
    Reader("report page", 0.05, CAMPAIGN | DISCOVERY, values_of("discovery.json"), report),
)
