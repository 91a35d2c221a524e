"""What a folder of results holds, and whether its parts belong together."""

from __future__ import annotations

import datetime
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .. import arguments
from .._archive import read_archive
from .._errors import InputError
from .._format import described
from ..calibrate.results import ARCHIVE, DISCOVERY_ARCHIVE, Calibration, OldCalibration, PosteriorDraws, read_result
from ..campaign import Campaign, check_tests, file_checksums, read_campaign
from ..discover import Discovery
from ..files import read_regular

CALIBRATION, DISCOVERY, CAMPAIGN = "calibration.json", "discovery.json", "campaign"
MADE_BY = {CALIBRATION: "mcc-jax calibrate", DISCOVERY: "mcc-jax discover"}
DATA = ("particles.csv", "curves.csv")
FIGURE = re.compile(r"figures/([A-Za-z0-9_-]+)\.png")
PNG = b"\x89PNG\r\n\x1a\n"
LARGEST_FIGURE = 2**21
"""Bytes; a page must stay small enough to send."""


@dataclass(frozen=True)
class Results:
    """All that a report is made of; what is not there is None or empty.

    Attributes:
        name: of the folder.
        campaign: the tests.
        checksums: of their files, SHA-256 by name.
        calibration: contents of `calibration.json`.
        discovery: contents of `discovery.json`.
        saved: the calibration itself, as `mcc_jax.load` gives it, or its numbers alone where nothing else is left.
        figures: files of `figures/` that the two results name as theirs, by stem.
        written: the day of the newest result.
        cautions: where parts contradict each other.
        missing_campaign: why there is no campaign, if there is none.
        found: the discovery itself, where it was saved.
    """

    name: str
    campaign: Campaign | None
    checksums: Mapping[str, str]
    calibration: dict[str, Any] | None
    discovery: dict[str, Any] | None
    saved: Calibration | None
    figures: Mapping[str, bytes]
    written: datetime.date | None
    cautions: tuple[str, ...]
    missing_campaign: str
    found: Discovery | None = None

    __repr__ = described()

    @property
    def posterior(self) -> PosteriorDraws | None:
        """The calibration, if it is one by draws of a posterior."""
        return self.saved if isinstance(self.saved, PosteriorDraws) else None

    @property
    def with_found(self) -> PosteriorDraws | None:
        """The posterior of the law with what discovery added, if it may be believed and is of all these particles.

        None, too, where the calibration is of a law with effects itself, or there is none that it would be beside.
        """
        found, campaign = self.found, self.campaign
        if self.calibration is None or self.calibration.get("effects"):
            return None
        if found is None or campaign is None or found.posterior is None or found.posterior.failures():
            return None
        return found.posterior if found.posterior.campaign.particles == campaign.particles else None

    @property
    def told(self) -> Results:
        """What a page shows: of the law with what discovery added where that may be believed, else as it is."""
        posterior, found = self.with_found, self.discovery
        if posterior is None or found is None:
            return self
        content = posterior.to_json() | {"figures": [], "provenance": found["provenance"]}
        return replace(self, calibration=content, saved=posterior)

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

    The campaign is looked for in the folder itself, in its subfolder `campaign`, and where calibration or discovery
    found it.

    Args:
        folder: the folder of results.
        campaign: the folder of the campaign, if it is elsewhere.
        name: what to call the folder.

    Raises:
        InputError: if a file is damaged, of another schema, or there is nothing to report.
    """
    path = arguments.file_path(folder, "folder")
    if campaign is not None:
        campaign = arguments.file_path(campaign, "campaign")
    there = _listed(path)
    results = {name: read_result(path / name, again) for name, again in MADE_BY.items() if name in there}
    calibration, discovery = results.get(CALIBRATION), results.get(DISCOVERY)
    where, why = _find(path, there, campaign, list(results.values()))
    data = None if where is None else check_tests(read_campaign(where))
    checksums = {} if where is None else file_checksums(where)
    if data is None and not results:
        found = ", ".join(sorted(there)[:8]) or "nothing"
        raise InputError(
            "there is nothing to report",
            file=path,
            remedy=f"Give a folder that mcc-jax demo, calibrate or discover wrote into; found there: {found}",
        )
    cautions = list(_cautions(data, checksums, results))
    saved = None if calibration is None else OldCalibration(calibration, data)
    if calibration is not None and ARCHIVE in there:
        kept = read_archive(path / ARCHIVE)
        if isinstance(kept, Calibration) and _belongs(kept, calibration):
            saved, data = kept, kept.campaign if data is None else data
        else:
            cautions.append(f"{ARCHIVE} is not of the {CALIBRATION} beside it, and is left out")
    found = None
    if discovery is not None and DISCOVERY_ARCHIVE in there:
        found = read_archive(path / DISCOVERY_ARCHIVE)
        if not isinstance(found, Discovery) or found.to_json()["summary"] != discovery["summary"]:
            found = None
            cautions.append(f"{DISCOVERY_ARCHIVE} is not of the {DISCOVERY} beside it, and is left out")
    return Results(
        name or path.resolve().name or str(path),
        data,
        checksums,
        calibration,
        discovery,
        saved,
        _figures(path, [name for content in results.values() for name in content["figures"]]),
        max((datetime.date.fromtimestamp((path / name).stat().st_mtime) for name in results), default=None),
        tuple(cautions),
        why,
        found,
    )


def _listed(path: Path) -> set[str]:
    try:
        return {entry.name for entry in path.iterdir() if not entry.name.startswith(".")}
    except FileNotFoundError:
        problem, remedy = "there is no such folder", "Give a folder of results; mcc-jax demo makes one"
    except NotADirectoryError:
        problem, remedy = "is a file, not a folder of results", "Give the folder that calibrate wrote into"
    except OSError as error:
        problem, remedy = f"cannot be read: {error.strerror or error}", "Check the permissions"
    raise InputError(problem, file=path, remedy=remedy)


def _find(
    path: Path, there: set[str], given: str | Path | None, results: list[dict[str, Any]]
) -> tuple[Path | None, str]:
    """The campaign's folder, or why there is none."""
    if given is not None:
        return Path(given), ""
    if there & set(DATA):
        return path, ""
    if CAMPAIGN in there:
        return path / CAMPAIGN, ""
    told = [r["provenance"]["campaign"]["folder"] for r in results if r["provenance"]["campaign"]]
    for folder in told:
        try:
            if all((path / folder / name).is_file() for name in DATA):
                return path / folder, ""
        except (OSError, ValueError):  # a text that is no path
            continue
    if told:
        return None, "The campaign's folder is no longer where the results found it."
    return None, "The results do not say where their campaign is."


def _cautions(data: Campaign | None, checksums: Mapping[str, str], results: Mapping[str, dict[str, Any]]):
    told = {name: checksums_told(content) for name, content in results.items()}
    for name, sums in told.items():
        changed = [f for f in DATA if f in sums and f in checksums and sums[f] != checksums[f]]
        if changed:
            yield f"{name} was made from other data: {' and '.join(changed)} of the campaign differ in their checksums"
    if len(told) == 2 and all(told.values()) and any(told[CALIBRATION].get(f) != told[DISCOVERY].get(f) for f in DATA):
        yield f"{CALIBRATION} and {DISCOVERY} were made from different data"
    if data is not None and CALIBRATION in results:
        names = [entry["particle"] for entry in results[CALIBRATION]["particles"]]
        missing = [name for name in names if name not in data.particles]
        if missing:
            yield f"{len(missing)} particles of {CALIBRATION} are not in the campaign, {missing[0]!r} first"


def checksums_told(content: dict[str, Any]) -> dict[str, str]:
    """SHA-256 of the campaign's files as a result records them; empty where it does not."""
    return (content["provenance"]["campaign"] or {}).get("sha256", {})


def _belongs(saved: Calibration, content: dict[str, Any]) -> bool:
    told = saved.to_json()
    return all(told[name] == content[name] for name in ("method", "a", "effective_modulus_MPa", "log_C1"))


def _figures(path: Path, names: list[str]) -> dict[str, bytes]:
    found = {}
    for name in names:
        match = FIGURE.fullmatch(name)
        try:
            if match is None or not (path / name).exists():
                continue
            picture = read_regular(path / name, LARGEST_FIGURE, "")
        except (OSError, InputError):  # the page does without it
            continue
        if picture.startswith(PNG):
            found[match[1]] = picture
    return found
