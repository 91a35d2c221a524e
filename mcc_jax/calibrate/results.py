"""What every calibration can do once it is made: give its law, its curves, be saved and be read again."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from .. import arguments
from .._archive import encode, read_archive
from .._errors import InputError
from .._format import table, with_sd
from .._store import json_text, results
from ..campaign import Campaign, read_campaign
from ..effects import Variant
from ..law import MccLaw
from .content import read_result
from .curves import FittedCurve, fitted_curves
from .data import Selection
from .fit_result import Fit
from .judgement import modulus_is_open
from .laws import law_of
from .model import Model
from .population import COEFFICIENTS, Population

ARCHIVE, CONTENT, DISCOVERY_ARCHIVE = "calibration.msgpack", "calibration.json", "discovery.msgpack"
A_FOLDER = "Give a folder that a result's save, mcc-jax calibrate or mcc-jax discover wrote into."


class Saved(abc.ABC):
    """What is written as JSON for people and as an archive that `mcc_jax.load` reads.

    Attributes:
        content_file: name of the JSON.
        archive_file: name of the archive.
    """

    content_file: ClassVar[str]
    archive_file: ClassVar[str]

    @abc.abstractmethod
    def to_json(self) -> dict[str, Any]:
        """The contents of the JSON."""

    def save(self, folder: str | Path) -> None:
        """Write the JSON and what `mcc_jax.load` reads into a folder: both or nothing.

        Raises:
            InputError: if the folder cannot be written, or a part cannot be read back.
        """
        with results(arguments.file_path(folder, "folder")) as stage:
            self.write(stage.folder)

    def write(self, folder: Path, **more: Any) -> dict[str, Any]:
        """Write the files of `save` into a folder that appears as a whole; returns the contents of the JSON.

        Args:
            folder: an existing folder.
            more: further entries of the JSON, such as provenance.
        """
        content = self.to_json() | more
        (folder / self.content_file).write_text(json_text(content), encoding="utf-8")
        (folder / self.archive_file).write_bytes(encode(self))
        return content


class Calibration(Saved):
    """A calibration of any method: `law`, `curves`, `save`; `mcc_jax.load` reads what was saved."""

    content_file, archive_file = CONTENT, ARCHIVE
    archived: ClassVar[tuple[str, ...]] = ("curves",)  # kept with the fields: nobody works them out again
    campaign: Any  # the tests, or None where only numbers are left

    def __repr__(self) -> str:
        content = self.to_json()
        used = sum(entry["kept"] for entry in content["particles"])
        title = f"{type(self).__name__} of {used} of {len(content['particles'])} particles, "
        title += "converged" if content["converged"] else "NOT converged"
        rows = [("shape parameter a", with_sd(content["a"]))]
        modulus = f"{with_sd(content['effective_modulus_MPa'], 1e-3)} GPa"
        rows.append(("effective modulus", "these tests do not tell it" if modulus_is_open(content) else modulus))
        for name in COEFFICIENTS:
            log = content[f"log_{name}"]
            rows.append((f"log {name}", f"mean {with_sd(log['mean'])}, sd between particles {with_sd(log['sd'])}"))
        law = content["law"]
        rows.append(("law", f"unloading {law['unloading']}, strain scaling {law['strain_scaling']}"))
        rows += [("warning", text[:100]) for text in content.get("warnings", [])]
        return table(title, rows)

    def law(self, particle: str | None = None) -> MccLaw:
        """The calibrated law.

        Args:
            particle: take this particle's own coefficients; if None those of the median particle, exp(mean of log C).

        Raises:
            InputError: for a particle that took no part, or numbers that the calibration does not have.
        """
        campaign = self.campaign
        if campaign is None or particle not in campaign.particles:
            return law_of(self.to_json(), particle, variants=self.variants)
        size = campaign.diameters_um[campaign.index(particle)]
        return law_of(self.to_json(), particle, size, self.variants)

    @property
    def variants(self) -> dict[str, Variant]:
        """The formulas of the law's effects by name, which need not be of the library."""
        return {}

    @cached_property
    def curves(self) -> tuple[FittedCurve, ...]:
        """Every test of the campaign from contact on: measured, compared, and as the law has it."""
        if self.campaign is None:
            return ()
        return fitted_curves(self.to_json(), self.campaign, self.compared(), self.predictions, self.variants)

    def compared(self) -> Mapping[int, tuple[np.ndarray, np.ndarray]]:
        """Of each particle that took part, by its place in the campaign: rows of its curve, and which are compared."""
        return {}

    def predictions(self, particle: str) -> np.ndarray | None:
        """Draws of what may be measured of a particle at its rows [um], shape (draws, rows); None without draws."""
        return None


class PosteriorDraws(Calibration):
    """A calibration by draws of a posterior, as predictions need it; see `Posterior` for its attributes."""

    campaign: Campaign
    selection: Selection
    model: Model
    fit: Fit
    population: Population
    C: np.ndarray
    modulus_MPa: np.ndarray
    zero_um: np.ndarray
    theta: np.ndarray
    seed: int

    @property
    @abc.abstractmethod
    def particles(self) -> tuple[str, ...]:
        """Names of the particles that took part."""

    @abc.abstractmethod
    def named_population(self) -> dict[str, np.ndarray]:
        """Draws of the population by the names used in files, shape (chains, draws)."""


@dataclass(frozen=True, repr=False)
class OldCalibration(Calibration):
    """A calibration of which nothing but `calibration.json` (schema 1) is left: numbers, but neither fit nor curves.

    Attributes:
        content: the contents of the file.
        campaign: its tests, where they are known.
    """

    content: dict[str, Any]
    campaign: Campaign | None = None

    def to_json(self) -> dict[str, Any]:
        """The contents of `calibration.json`."""
        return self.content


def load(folder: str | Path) -> Any:
    """What a folder holds: a discovery, else a calibration, else a campaign, as it was saved.

    A discovery beside a calibration has it as its `before`.

    A calibration of an older version, of which only `calibration.json` is there, gives its numbers and its law.

    Args:
        folder: where `save`, `mcc-jax calibrate` or `mcc-jax discover` wrote.

    Returns:
        A `Discovery`, a `PaperCalibration`, `LeastSquares`, `Posterior` or `OldCalibration`, or a
        `Campaign`.

    Raises:
        InputError: if the folder holds none, or a file is damaged, foreign or of a newer version.
    """
    path = arguments.file_path(folder, "folder")
    if not path.is_dir():
        raise InputError("there is no such folder", file=path, remedy=A_FOLDER)
    there = {entry.name for entry in path.iterdir()}
    saved = [_read(path / archive) for archive in (DISCOVERY_ARCHIVE, ARCHIVE) if archive in there]
    if len(saved) == 2:
        return replace(saved[0], before=saved[1])
    if saved:
        return saved[0]
    tests = {"particles.csv", "curves.csv"} <= there
    if CONTENT in there:
        return OldCalibration(read_result(path / CONTENT, "mcc-jax calibrate"), read_campaign(path) if tests else None)
    if tests:
        return read_campaign(path)
    raise InputError(f"{CONTENT} is missing: holds no result and no campaign", file=path, remedy=A_FOLDER)


def _read(archive: Path) -> Any:
    """What an archive holds, which its name must say."""
    found = read_archive(archive)
    if not isinstance(found, Saved) or found.archive_file != archive.name:
        raise InputError(f"holds a {type(found).__name__}", file=archive, remedy=A_FOLDER)
    return found
