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
from .._format import described
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
LARGEST_FIGURE = 2**21
"""Bytes; a page must stay small enough to send."""


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
    def posterior(self) -> Posterior | None:
        """The calibration, if it is one by draws of a posterior."""
        return self.saved if isinstance(self.saved, Posterior) else None

    @property
    def with_found(self) -> Posterior | None:
        """The posterior of the law with what discovery added, if it may be believed and is of all these particles.

        None, too, where the calibration is of a law with effects itself, or there is none to compare it with.
        """
        posterior = None if self.found is None else self.found.posterior
        if posterior is None or self.campaign is None or self.calibration is None or self.calibration.get("effects"):
            return None
        same = posterior.campaign.particles == self.campaign.particles
        return posterior if same and not posterior.failures() else None

    @property
    def with_discovery(self) -> Results:
        """What a page shows: of the law with what discovery added where that may be believed, else as it is."""
        posterior = self.with_found
        if posterior is None:
            return self
        provenance = {**self.provenance, CALIBRATION: self.provenance[DISCOVERY]}
        return replace(self, calibration=posterior.to_json(), provenance=provenance, saved=posterior)

    @property
    def has_found(self) -> bool:
        """Whether the calibration is the discovery's own, of the law with what it added."""
        return self.found is not None and self.saved is not None and self.saved is self.found.posterior

    @property
    def missing(self) -> tuple[str, ...]:
        """What is not there, and how to get it."""
        parts = (
            (self.campaign, "the tests (name their folder with --campaign CAMPAIGN)"),
            (self.calibration, "a calibration (mcc-jax calibrate makes one)"),
            (self.posterior, "a posterior (mcc-jax calibrate makes one)"),
            (self.discovery, "a discovery (mcc-jax discover makes one)"),
        )
        return tuple(text for part, text in parts if part is None)

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
    path, again = arguments.file_path(folder, "folder"), "Calibrate or discover again"
    try:
        there = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")}
    except OSError as error:
        remedy = "Give a folder that mcc-jax demo, calibrate or discover wrote into"
        raise InputError(f"cannot be read: {error.strerror or error}", file=path, remedy=remedy) from None
    for file, archive in ARCHIVES.items():
        if file in there and archive not in there:
            raise InputError(f"{archive} is missing next to {file}", file=path, remedy=again)
    saved = {file: read_saved(path / archive) for file, archive in ARCHIVES.items() if archive in there}
    contents = {file: result.to_json() for file, result in saved.items()}
    cautions, written = [], {file: Written() for file in saved}
    for file in sorted(there & set(saved)):
        try:
            found = msgspec.json.decode(read_regular(path / file, RESULT_BYTES, again), type=Written)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise InputError(f"is damaged: {error}", file=path / file, remedy=again) from None
        if found.runtime_s == contents[file]["runtime_s"]:
            written[file] = found
        else:
            cautions.append(f"{file} is not of the {ARCHIVES[file]} next to it, and is left out")
    provenance = {file: one.provenance for file, one in written.items()}
    where, why = (Path(campaign), "") if campaign is not None else _find(path, there, provenance)
    data = None if where is None else check_tests(read_campaign(where))
    checksums = {} if where is None else file_checksums(where)
    if data is None and not saved:
        remedy = "Give a folder that mcc-jax demo, calibrate or discover wrote into; found there: "
        remedy += ", ".join(sorted(there)[:8]) or "nothing"
        raise InputError("there is nothing to report", file=path, remedy=remedy)
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
        (*cautions, *_cautions(data, checksums, provenance, contents.get(CALIBRATION))),
        why,
        saved.get(DISCOVERY),
    )


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


def _cautions(
    data: Campaign | None,
    checksums: Mapping[str, str],
    provenance: Mapping[str, Provenance],
    calibration: dict[str, Any] | None,
) -> Iterator[str]:
    recorded = {name: one.campaign.sha256 for name, one in provenance.items() if one.campaign is not None}
    for name, sums in recorded.items():
        changed = [f for f in DATA if f in sums and f in checksums and sums[f] != checksums[f]]
        if changed:
            yield f"{name} was made from other data: {' and '.join(changed)} of the campaign differ in their checksums"
    if len(recorded) == 2 and all(recorded.values()):
        one, other = recorded.values()
        if any(one.get(f) != other.get(f) for f in DATA):
            yield f"{CALIBRATION} and {DISCOVERY} were made from different data"
    if data is not None and calibration is not None:
        missing = [name for entry in calibration["particles"] if (name := entry["particle"]) not in data.particles]
        if missing:
            yield f"{len(missing)} particles of {CALIBRATION} are not in the campaign, {missing[0]!r} first"


def _figures(path: Path, names: list[str]) -> dict[str, bytes]:
    """Pictures by stem; the page does without those that cannot be read."""
    found = {}
    for name in names:
        match = FIGURE.fullmatch(name)
        with contextlib.suppress(OSError, InputError):
            picture = read_regular(path / name, LARGEST_FIGURE, "") if match else b""
            if match and picture.startswith(PNG):
                found[match[1]] = picture
    return found
