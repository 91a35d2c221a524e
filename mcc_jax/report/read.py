"""What a folder of results holds, and whether its parts belong together."""

from __future__ import annotations

import contextlib
import datetime
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from .. import arguments
from .._errors import InputError
from .._format import described, listed, plain
from ..calibrate import Posterior
from ..calibrate.results import ARCHIVE, CONTENT, DISCOVERY_ARCHIVE, Calibration, read_saved
from ..campaign import Campaign, check_tests, file_checksums, read_campaign
from ..discovery import Discovery
from ..files import RESULT_BYTES, read_regular

CALIBRATION, DISCOVERY, CAMPAIGN = CONTENT, "discovery.json", "campaign"
ARCHIVES = {CALIBRATION: ARCHIVE, DISCOVERY: DISCOVERY_ARCHIVE}
DATA = ("particles.csv", "curves.csv")
FIGURE = re.compile(r"figures/([A-Za-z0-9_-]+)\.png")
PNG = b"\x89PNG\r\n\x1a\n"
LARGEST_FIGURE = 2**21  # bytes; a page must stay small enough to send
A_FOLDER, AGAIN = "Give a folder that mcc-jax demo, calibrate or discover wrote into", "Calibrate or discover again"


class Tests(msgspec.Struct):
    """Where a result had its tests from, and the SHA-256 of their files by name."""

    folder: str = ""
    sha256: dict[str, str] = {}


class Provenance(msgspec.Struct):
    """How a result came about."""

    campaign: Tests | None = None
    settings: dict[str, Any] = {}
    versions: dict[str, str] = {}


class Written(msgspec.Struct):
    """What only the JSON of a result says; all else is in its archive."""

    runtime_s: float | None = None
    figures: list[str] = []
    provenance: Provenance = msgspec.field(default_factory=Provenance)


@dataclass(frozen=True)
class Results:
    """All that a report is made of; what is not there is None or empty.

    Attributes:
        name: of the folder.
        campaign, checksums: the tests, and the SHA-256 of their files by name.
        calibration, discovery: contents of `calibration.json` and `discovery.json`.
        saved, found: the calibration and the discovery themselves.
        provenance: how the two came about, by the names of these files.
        figures: files of `figures/` that the two results name as theirs, by stem.
        written: the day of the newest result.
        cautions: where parts contradict each other.
        missing_campaign: why there is no campaign, if there is none.
    """

    name: str
    campaign: Campaign | None
    checksums: Mapping[str, str]
    calibration: dict[str, Any] | None
    discovery: dict[str, Any] | None
    provenance: Mapping[str, Provenance]
    saved: Calibration | None
    figures: Mapping[str, bytes]
    written: datetime.date | None
    cautions: tuple[str, ...]
    missing_campaign: str
    found: Discovery | None = None

    __repr__ = described()

    @property
    def with_discovery(self) -> Results:
        """What a page shows: of the law with what discovery added where that may be believed, else as it is.

        It may where its draws converged, are of all these particles, and the calibration is of a law without effects.
        """
        posterior, alone = None if self.found is None else self.found.posterior, self.calibration
        if posterior is None or posterior.failures() or alone is None or alone.get("effects"):
            return self
        if self.campaign is None or posterior.campaign.particles != self.campaign.particles:
            return self
        provenance = {**self.provenance, CALIBRATION: self.provenance[DISCOVERY]}
        return replace(self, calibration=posterior.to_json(), provenance=provenance, saved=posterior)

    @property
    def has_found(self) -> bool:
        """Whether the calibration is the discovery's own, of the law with what it added."""
        return self.found is not None and self.saved is not None and self.saved is self.found.posterior

    @property
    def law_alone(self) -> bool:
        """Whether the calibration is of the law without the effects that were found to be missing in it."""
        found, calibration = self.discovery, self.calibration
        return bool(found and found["effects"] and calibration and not calibration.get("effects"))

    @property
    def law(self) -> str:
        """What the law of the calibration is called: "the law", alone or with its effects where that matters."""
        names = [plain(effect["mechanism"]) for effect in (self.calibration or {}).get("effects", ())]
        return f"the law with {listed(names)}" if names else f"the law{' alone' * self.law_alone}"

    @property
    def missing(self) -> tuple[str, ...]:
        """What is not there, and how to get it."""
        parts = (
            (self.campaign is not None, "the tests (name their folder with --campaign CAMPAIGN)"),
            (self.saved is not None, "a calibration (mcc-jax calibrate makes one)"),
            (isinstance(self.saved, Posterior), "a posterior (mcc-jax calibrate makes one)"),
            (self.found is not None, "a discovery (mcc-jax discover makes one)"),
        )
        return tuple(text for there, text in parts if not there)

    @property
    def results(self) -> dict[str, dict[str, Any]]:
        """The two results by the names of their files, those that are there."""
        both = ((CALIBRATION, self.calibration), (DISCOVERY, self.discovery))
        return {name: content for name, content in both if content is not None}


def read_results(folder: str | Path, campaign: str | Path | None = None, *, name: str | None = None) -> Results:
    """Read what a folder holds of a campaign, a calibration, its posterior and a discovery.

    Args:
        folder: the folder of results.
        campaign: the folder of the campaign; looked for in the folder itself, in its subfolder `campaign`, and where
            calibration or discovery found it, if None.
        name: what to call the folder.

    Raises:
        InputError: if a file is damaged or there is nothing to report.
    """
    path = arguments.file_path(folder, "folder")
    try:
        there = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")}
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path, remedy=A_FOLDER) from None
    saved, contents, written, cautions = {}, {}, {}, []
    for file, archive in ARCHIVES.items():
        if archive not in there:
            if file in there:
                raise InputError(f"{archive} is missing next to {file}", file=path, remedy=AGAIN)
            continue
        saved[file] = read_saved(path / archive)
        contents[file] = saved[file].to_json()
        written[file] = _written(path / file) if file in there else Written()
        if file in there and written[file].runtime_s != contents[file]["runtime_s"]:
            written[file] = Written()
            cautions.append(f"{file} is not of the {archive} next to it, and is left out")
    provenance = {file: one.provenance for file, one in written.items()}
    where, why = (Path(campaign), "") if campaign is not None else _find(path, there, provenance)
    data = None if where is None else check_tests(read_campaign(where))
    checksums = {} if where is None else file_checksums(where)
    if data is None and not saved:
        problem = f"there is nothing to report: the folder holds {listed(sorted(there)[:8])}"
        raise InputError(problem, file=path, remedy=A_FOLDER)
    calibration = saved.get(CALIBRATION)
    days = (datetime.date.fromtimestamp((path / ARCHIVES[file]).stat().st_mtime) for file in saved)
    return Results(
        name or path.resolve().name or str(path),
        calibration.campaign if data is None and calibration is not None else data,
        checksums,
        contents.get(CALIBRATION),
        contents.get(DISCOVERY),
        provenance,
        calibration,
        _figures(path, [name for one in written.values() for name in one.figures]),
        max(days, default=None),
        (*cautions, *_cautions(checksums, provenance)),
        why,
        saved.get(DISCOVERY),
    )


def _written(file: Path) -> Written:
    try:
        return msgspec.json.decode(read_regular(file, RESULT_BYTES, AGAIN), type=Written)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"is damaged: {error}", file=file, remedy=AGAIN) from None


def _find(path: Path, there: set[str], provenance: Mapping[str, Provenance]) -> tuple[Path | None, str]:
    """The campaign's folder, or why there is none."""
    if there & set(DATA):
        return path, ""
    if CAMPAIGN in there:
        return path / CAMPAIGN, ""
    recorded = [path / one.campaign.folder for one in provenance.values() if one.campaign is not None]
    for folder in recorded:
        with contextlib.suppress(OSError, ValueError):  # a text that is no path
            if all((folder / name).is_file() for name in DATA):
                return folder, ""
    if recorded:
        return None, "The campaign's folder is no longer where the results found it."
    return None, "The results do not say where their campaign is."


def _cautions(checksums: Mapping[str, str], provenance: Mapping[str, Provenance]) -> Iterator[str]:
    recorded = {name: one.campaign.sha256 for name, one in provenance.items() if one.campaign is not None}
    for name, sums in recorded.items():
        changed = [f for f in DATA if f in sums and f in checksums and sums[f] != checksums[f]]
        if changed:
            yield f"{name} was made from other data: {' and '.join(changed)} of the campaign differ in their checksums"
    if len(recorded) == 2 and all(recorded.values()):
        one, other = recorded.values()
        if any(one.get(f) != other.get(f) for f in DATA):
            yield f"{CALIBRATION} and {DISCOVERY} were made from different data"


def _figures(path: Path, names: list[str]) -> dict[str, bytes]:
    """Pictures by stem; the page does without those that cannot be read."""
    found = {}
    for match in filter(None, map(FIGURE.fullmatch, names)):
        with contextlib.suppress(InputError):
            picture = read_regular(path / match[0], LARGEST_FIGURE, "")
            if picture.startswith(PNG):
                found[match[1]] = picture
    return found
