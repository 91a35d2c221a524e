"""Every reader that a file of a user reaches: how to damage its files, and how to read them."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from archives import hostile_archive
from mutators import mutate, mutate_json

SAMPLES = Path(__file__).parent / "samples"
Case = dict[str, bytes]


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        name: as in the table and after --only.
        share: of the inputs, relative to the others; slow readers get fewer.
        make: the files of one input, by their path within a folder.
        read: reads them in that folder; returns, or raises `InputError`.
    """

    name: str
    share: float
    make: Callable[[Random], Case]
    read: Callable[[Path], object]


@cache
def sample(name: str) -> bytes:
    return (SAMPLES / name).read_bytes()


@cache
def folder_of(name: str) -> tuple[str, ...]:
    return tuple(sorted(file.name for file in (SAMPLES / name).iterdir()))


def damaged(name: str) -> Callable[[Random], Case]:
    """One sample with damage, spliced now and then with any other text sample."""
    others = (
        "fischer.txt",
        "hysitron.hld",
        "hysitron_lc.txt",
        "micromaterials.txt",
        "campaign/curves.csv",
        "priors.toml",
    )

    def make(rng: Random) -> Case:
        other = sample(name if rng.random() < 0.7 else rng.choice(others))
        return {Path(name).name: mutate(rng, sample(name), other)}

    return make


def damaged_in(folder: str, name: str, *keep: str) -> Callable[[Random], Case]:
    """A folder in which one file has damage; of the others only `keep` are there, if given."""

    def make(rng: Random) -> Case:
        names = keep or folder_of(folder)
        return {other: sample(f"{folder}/{other}") for other in names} | damaged(f"{folder}/{name}")(rng)

    return make


def json_in(*files: str) -> Callable[[Random], Case]:
    """Results beside their campaign, one of the files with other values or with damaged bytes."""

    def make(rng: Random) -> Case:
        case = {f"campaign/{name}": sample(f"campaign/{name}") for name in folder_of("campaign")}
        case |= {name: sample(f"results/{name}") for name in files}
        name = rng.choice(files)
        case[name] = mutate_json(rng, case[name]) if rng.random() < 0.7 else mutate(rng, case[name], case[files[0]])
        return case

    return make


def archive(rng: Random) -> Case:
    return {"tests.zip": hostile_archive(rng, sample("micromaterials.txt"), sample("hysitron_lc.txt"))}


def state(rng: Random) -> Case:
    """A saved state with damage outside or, with checksums that fit, inside."""
    if rng.random() < 0.3:
        return {"state.npz": mutate(rng, sample("state.npz"), sample("fischer.txt"))}
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(sample("state.npz"))) as old, zipfile.ZipFile(buffer, "w") as new:
        names = old.namelist()
        chosen = rng.sample(names, rng.choice((1, 1, 2)))
        for name in names:
            content = old.read(name)
            if name not in chosen:
                new.writestr(zipfile.ZipInfo(name), content)
            elif rng.random() < 0.95:
                new.writestr(zipfile.ZipInfo(name), mutate(rng, content, old.read(rng.choice(names))))
    return {"state.npz": buffer.getvalue()}


def diameters(rng: Random) -> Case:
    if rng.random() < 0.5:
        return damaged("campaign/particles.csv")(rng)
    return {"text": mutate(rng, b"200.0,190.5,1.8e2", b"1,2,3")}


def read_campaign(folder: Path) -> None:
    from mcc_jax.campaign import check_campaign, read_campaign
    from mcc_jax.effects import humidities

    campaign = read_campaign(folder)
    check_campaign(campaign, file=folder)
    humidities(campaign)


def read_diameters(folder: Path) -> None:
    from mcc_jax.campaign import read_diameters

    text = folder / "text"
    read_diameters(text.read_bytes().decode("utf-8", "replace") if text.exists() else folder / "particles.csv")


def convert(name: str, mapping: str | None = None) -> Callable[[Path], None]:
    """What `mcc-jax convert` does: read, write, and what was written must read back the same."""

    def read(folder: Path) -> None:
        from mcc_jax.campaign import read_campaign, read_tester_file, write_campaign

        described = None if mapping is None else folder / mapping
        sizes = None if mapping is not None else [200.0, 190.0, 180.0]
        campaign = read_tester_file(folder / name, diameters_um=sizes, mapping=described)
        again = folder / "converted"
        try:
            write_campaign(campaign, again)
            assert read_campaign(again).particles == campaign.particles
        finally:
            shutil.rmtree(again, ignore_errors=True)

    return read


def read_priors(folder: Path) -> None:
    from mcc_jax.calibrate import read_priors

    read_priors(folder / "priors.toml")


def read_programme(folder: Path) -> None:
    from mcc_jax.simulate import read_programme

    read_programme(folder / "programme.toml")


def read_results(folder: Path) -> None:
    from mcc_jax.report import read_results

    read_results(folder)


def report(folder: Path) -> None:
    from mcc_jax.report import read_results, report_page

    report_page(read_results(folder)).encode("utf-8")


def export(folder: Path) -> None:
    from mcc_jax.export import read_calibration, write_export

    law, shown, origin = read_calibration(folder, particle="1")
    out = folder / "out"
    out.mkdir()
    try:
        write_export("json", law, shown, out, origin=origin, seed=0)
    finally:
        shutil.rmtree(out)


def read_state(folder: Path) -> None:
    from mcc_jax.dem import load_state

    load_state(folder / "state.npz")


READERS = (
    *(Reader(name, 3, damaged_in("campaign", name), read_campaign) for name in ("particles.csv", "campaign.toml")),
    Reader("curves.csv", 5, damaged_in("campaign", "curves.csv"), read_campaign),
    Reader("diameters", 2, diameters, read_diameters),
    *(
        Reader(label, 4, damaged(name), convert(name))
        for label, name in (
            ("Fischer", "fischer.txt"),
            ("Hysitron hld", "hysitron.hld"),
            ("Hysitron text", "hysitron_lc.txt"),
            ("Micro Materials", "micromaterials.txt"),
        )
    ),
    Reader("archive", 5, archive, convert("tests.zip")),
    Reader("mapped table", 4, damaged_in("mapped", "table.txt"), convert("table.txt", "mapping.toml")),
    Reader("mapping", 4, damaged_in("mapped", "mapping.toml"), convert("table.txt", "mapping.toml")),
    Reader("priors", 2, damaged("priors.toml"), read_priors),
    Reader("programme", 2, damaged("programme.toml"), read_programme),
    Reader("calibration.json", 2, json_in("calibration.json"), read_results),
    Reader("discovery.json", 2, json_in("discovery.json"), read_results),
    Reader("posterior.nc", 2, damaged_in("results", "posterior.nc", "posterior.nc"), read_results),
    Reader("saved state", 1, state, read_state),
    Reader("export", 0.2, json_in("calibration.json"), export),
    Reader("report page", 0.1, json_in("calibration.json", "discovery.json"), report),
)
