"""What every calibration can do once it is made: give its law, its curves, be saved and be read again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .. import arguments
from .._archive import encode, read_archive
from .._errors import InputError
from .._format import table
from .._store import json_text, results
from ..campaign import Campaign, Curve, Finding, read_campaign
from ..effects import Variant
from ..law import MccLaw
from .curves import FittedCurve, fitted_curves, law_of
from .data import Selection, ranges_um, root_mean_squares
from .draws import Fit, named_population
from .estimates import estimate, finite, log_estimate, normal_estimate, quantities
from .judgement import CORRELATED_SHARE, LARGE_MISFIT, judged, unlike_others
from .numpyro_model import Model
from .population import COEFFICIENTS, Population

if TYPE_CHECKING:
    import pandas as pd

ARCHIVE, CONTENT, DISCOVERY_ARCHIVE = "calibration.msgpack", "calibration.json", "discovery.msgpack"
A_FOLDER = "Give a folder that a result's save, mcc-jax calibrate or mcc-jax discover wrote into."


class Saved:
    """What is written as JSON for people and as an archive that `mcc_jax.load` reads."""

    content_file: ClassVar[str]
    archive_file: ClassVar[str]
    content: Any
    """The contents of the JSON, worked out once: a cached property of every kind of result."""

    def to_json(self) -> dict[str, Any]:
        """The contents of the JSON."""
        return self.content

    def save(self, folder: str | Path) -> None:
        """Write the JSON and what `mcc_jax.load` reads into a folder: both, or `InputError` and nothing."""
        with results(arguments.file_path(folder, "folder")) as stage:
            self.write(stage.folder)

    def write(self, folder: Path, **more: Any) -> dict[str, Any]:
        """Write the files of `save` into an existing folder that appears as a whole; returns the contents of the JSON,
        which has `more` entries, such as provenance."""
        content = self.to_json() | more
        (folder / self.content_file).write_text(json_text(content), encoding="utf-8")
        (folder / self.archive_file).write_bytes(encode(self))
        return content


@dataclass(frozen=True, repr=False, kw_only=True)
class Calibration(Saved):
    """A calibration of any method: `law`, `curves`, `save`; `mcc_jax.load` reads what was saved.

    Attributes:
        campaign: the tests, checked; `campaign.raw` as they were given.
        seed, runtime_s: for the record; only a posterior is random.
        findings: what a reader must know of the tests and of the plausibility of the answer.
    """

    content_file, archive_file = CONTENT, ARCHIVE
    archived: ClassVar[tuple[str, ...]] = ("curves",)  # saved with the fields, so that they are not worked out again
    method: ClassVar[str]

    campaign: Campaign
    seed: int = 0
    runtime_s: float = 0.0
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        content = self.to_json()
        used = sum(entry["kept"] for entry in content["particles"])
        title = f"{type(self).__name__} of {used} of {len(content['particles'])} particles, "
        title += "converged" if content["converged"] else "NOT converged"
        rows = [(one.label, one.text) for one in quantities(content)]
        law = content["law"]
        rows.append(("law", f"unloading {law['unloading']}, strain scaling {law['strain_scaling']}"))
        rows += [("warning", text[:100]) for text in content.get("warnings", [])]
        return table(title, rows)

    @cached_property
    def content(self) -> dict[str, Any]:
        """The contents of `calibration.json`."""
        return {
            "schema": 1,
            "method": self.method,
            **self.answer(),
            "runtime_s": self.runtime_s,
            "seed": self.seed,
            **self._further_content(),
            "warnings": self.warnings(),
            "findings": [one.to_json() for one in self.findings],
        }

    @property
    def converged(self) -> bool:
        """Whether the numbers may be used."""
        return not self.failures()

    def warnings(self) -> list[str]:
        """What a reader of the numbers must know, one sentence each."""
        notes = [*self.failures(), *map(str, self.findings), *self._notes(), *self.misfit_notes()]
        if dropped := sum(reason is not None for reason in self.why_not):
            notes.append(f"{dropped} of {len(self.campaign)} particles could not be used")
        return notes

    def failures(self) -> list[str]:
        """Why the result must not be called converged, and what to do; empty if it may."""
        raise NotImplementedError

    def answer(self) -> dict[str, Any]:
        """Whether it converged, a and the modulus, as in `calibration.json`."""
        raise NotImplementedError

    @property
    def why_not(self) -> tuple[str | None, ...]:
        """Why each particle of the campaign took no part; None if it did."""
        raise NotImplementedError

    def _own_residuals(self) -> tuple[Sequence[str], np.ndarray, np.ndarray]:
        """Names of the particles that are compared, root mean square residual with their own coefficients and range of
        displacement [um]."""
        raise NotImplementedError

    @property
    def own_misfit(self) -> float:
        """Median over the particles of that residual, in shares of the range of displacement [-]."""
        _, rms, ranges = self._own_residuals()
        return float(np.median(rms / np.maximum(ranges, 1e-300)))

    def misfit_notes(self) -> list[str]:
        """A sentence if the law describes the tests badly even with each particle's own coefficients, else none."""
        if not self.own_misfit > LARGE_MISFIT:
            return []
        return [
            "even with its own C1, C3, C5 the law misses a test's displacements by "
            f"{100 * self.own_misfit:.0f} % of their range (median): "
            "either it describes these tests badly, or they are not compressions of single particles"
        ]

    def _notes(self) -> Iterator[str]:
        """What else a reader must know."""
        raise NotImplementedError

    def _further_content(self) -> dict[str, Any]:
        """The entries of `calibration.json` that differ from method to method."""
        raise NotImplementedError

    def judged(self, started: float, again: Callable[[Campaign], Calibration] | None) -> Any:
        """The same with findings, see `judgement.judged`, and the time it took; `again` calibrates a campaign."""
        answer_without = None if again is None else lambda some: again(some).answer()
        findings = judged(self.campaign, self.answer(), unlike_others(*self._own_residuals()), answer_without)
        return replace(self, findings=findings, runtime_s=time.perf_counter() - started)

    def _entries(self, numbers: Callable[[int], dict[str, Any]]) -> list[dict[str, Any]]:
        """Entries of all particles in files, from the numbers of each by its place in the campaign."""
        parts = zip(self.campaign.particles, self.campaign.curves, self.why_not, strict=True)
        return [
            {"particle": name, **numbers(i), "kept": why is None, "why_not": why, "force_zero_mN": _force_zero(curve)}
            for i, (name, curve, why) in enumerate(parts)
        ]

    def summary(self) -> pd.DataFrame:
        """Value, standard deviation and 95 % interval (columns) of the law's parameters (rows); NaN if unknown."""
        import pandas as pd

        rows = {}
        for one in quantities(self.to_json()):
            low, high = one.estimate["interval_95"] or (None, None)
            rows[one.name] = {"value": one.estimate["value"], "sd": one.estimate["sd"], "low_95": low, "high_95": high}
        return pd.DataFrame.from_dict(rows, orient="index", dtype=float)

    def law(self, particle: str | None = None) -> MccLaw:
        """The calibrated law.

        Args:
            particle: take this particle's own coefficients; if None those of the median particle, exp(mean of log C).

        Raises:
            InputError: for a particle that took no part, or parameters that the calibration does not have.
        """
        sizes = dict(zip(self.campaign.particles, self.campaign.diameters_um, strict=True))
        return law_of(self.to_json(), particle, None if particle is None else sizes.get(particle), self.variants)

    @property
    def variants(self) -> dict[str, Variant]:
        """The formulas of the law's effects by name, which need not be of the library."""
        return {}

    @cached_property
    def curves(self) -> tuple[FittedCurve, ...]:
        """Every test of the campaign from contact on: measured, compared, and as the law has it."""
        return fitted_curves(self.to_json(), self.campaign, self.compared(), self.predictions, self.variants)

    def compared(self) -> Mapping[int, tuple[np.ndarray, np.ndarray]]:
        """Of each particle that took part, by its place in the campaign: rows of its curve, and which are compared."""
        return {}

    def predictions(self, particle: str) -> np.ndarray | None:
        """Draws of what may be measured of a particle at its rows [um], shape (draws, rows); None without draws."""
        return None


@dataclass(frozen=True, repr=False, kw_only=True)
class JointCalibration(Calibration):
    """A calibration of all particles at once, which began with a fit."""

    selection: Selection  # which particles and points took part
    model: Model  # what was assumed
    fit: Fit  # the joint fit it started from
    notes: tuple[str, ...] = ()  # what else a reader must know

    @property
    def variants(self) -> dict[str, Variant]:
        """The formulas of the law's effects by name."""
        return self.model.variants

    @property
    def particles(self) -> tuple[str, ...]:
        """Names of the particles that took part."""
        return tuple(self.campaign.particles[i] for i in self.selection.kept)

    def compared(self) -> Mapping[int, tuple[np.ndarray, np.ndarray]]:
        """Rows of every particle's curve that are in the tests, and which of them are compared."""
        mask = np.asarray(self.selection.tests.mask)
        both = zip(self.selection.kept, self.selection.rows, mask, strict=True)
        return {place: (rows, used[: len(rows)]) for place, rows, used in both}

    def residual(self) -> np.ndarray:
        """Measured less predicted displacement [um] at the mode, shape (N, points), 0 where masked."""
        return np.asarray(self.fit.residual)

    def rms_um(self) -> np.ndarray:
        """Root mean square residual of every particle [um], shape (N,)."""
        return root_mean_squares(self.selection.tests, self.residual())

    def _own_residuals(self) -> tuple[Sequence[str], np.ndarray, np.ndarray]:
        return self.particles, self.rms_um(), ranges_um(self.selection.tests)

    @property
    def why_not(self) -> tuple[str | None, ...]:
        """Why each particle of the campaign took no part; None if it did."""
        return self.selection.why_not

    @property
    def _missed(self) -> str:
        """How far the law is from the tests, in words."""
        return f"{np.median(self.rms_um()):.2g} um, {100 * self.own_misfit:.2g} % of their range (medians)"

    @property
    def noise_share(self) -> float:
        """Share of the residual variance that the fit attributes to correlated noise [-]: noise of read-out and force
        is white, so a large share is rather what the law misses."""
        variance, correlated = self._variances()
        return float(np.median(correlated / variance))

    def at_noise_level(self) -> bool:
        """Whether what the law misses is mostly white noise of read-out and force: correlated noise and a common factor
        on the noise, which grow with a misfit, do not count."""
        variance, correlated = self._variances()
        return bool(np.median((1 - CORRELATED_SHARE) * self.rms_um() ** 2 - (variance - correlated)) <= 0)

    def _variances(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean variance of every test's noise [um^2], and of its correlated part."""
        noise, mask = self.fit.noise.noise, np.asarray(self.fit.tests.mask)
        variance = np.where(mask, np.asarray(self.fit.filters.solver.matrix.diag.d), 0.0).sum(1)
        correlated = (np.asarray(noise.scale) * float(noise.correlated)) ** 2
        return variance / np.maximum(mask.sum(1), 1), correlated

    def _notes(self) -> Iterator[str]:
        yield from (*self.selection.notes, *self.notes)
        if self.noise_share > CORRELATED_SHARE:
            yield (
                f"the law misses displacements by {self._missed}; {100 * self.noise_share:.0f} % of that is correlated "
                "along a test: more likely something that the law lacks than noise of the instrument; mcc_jax.discover "
                "looks for what it is"
            )

    def _noise_numbers(self) -> dict[str, Any]:
        """Estimates of the noise by their names in files."""
        noise = self.fit.noise
        names = ("displacement_um", "force_mN", "correlated_um", "correlation_length")
        numbers = zip(names, np.asarray(noise.noise.logs), noise.log_sd, strict=True)
        return {name: log_estimate(m, s) if np.isfinite(m) else estimate(0.0) for name, m, s in numbers}

    def _entries_of_tests(self, numbers: Callable[[int], dict[str, Any]], **more: np.ndarray) -> list[dict[str, Any]]:
        """The same from estimates of a row of the tests, and further values of all rows."""
        row_of = {i: row for row, i in enumerate(self.selection.kept)}
        further = {"rms_um": self.rms_um(), "noise_scale": np.asarray(self.fit.noise.noise.scale)} | more
        nothing = dict.fromkeys(("eta_p", *COEFFICIENTS, "zero_um"), estimate(None)) | dict.fromkeys(further)

        def of_particle(i: int) -> dict[str, Any]:
            row = row_of.get(i)
            if row is None:
                return nothing
            return numbers(row) | {key: finite(values[row]) for key, values in further.items()}

        return self._entries(of_particle)


def _force_zero(curve: Curve) -> dict[str, Any]:
    """The zero of force [mN] that was taken off a test; null where no reading before contact shows it."""
    checked = curve.checked
    if checked is None or not (checked.force_zero_mN or checked.force_zero_sd_mN):
        return estimate(None)
    return normal_estimate(checked.force_zero_mN, checked.force_zero_sd_mN)


@dataclass(frozen=True, repr=False, kw_only=True)
class PosteriorDraws(JointCalibration):
    """A calibration by draws of a posterior, as predictions need it; see `Posterior` for its attributes."""

    population: Population
    C: np.ndarray
    modulus_MPa: np.ndarray
    zero_um: np.ndarray
    shape_factor: np.ndarray
    theta: np.ndarray
    log_likelihood: np.ndarray
    pareto_k: np.ndarray

    def named_population(self) -> dict[str, np.ndarray]:
        """Draws of the population by the names used in files, shape (chains, draws)."""
        return named_population(self.population, self.model)


def load(folder: str | Path) -> Any:
    """What a folder holds: a discovery, else a calibration, else a campaign, as it was saved.

    A discovery next to a calibration has it as its `before`.

    Args:
        folder: where `save`, `mcc-jax calibrate` or `mcc-jax discover` wrote; or one of the `.msgpack` files in it.

    Returns:
        A `Discovery`, a `PaperCalibration`, `LeastSquares`, `Posterior`, or a `Campaign`.

    Raises:
        InputError: if the folder holds none, or a file is damaged, foreign or of a newer version.
    """
    path = arguments.file_path(folder, "folder")
    if path.is_file():
        return read_saved(path)
    if not path.is_dir():
        raise InputError("there is no such folder", file=path, remedy=A_FOLDER)
    there = {entry.name for entry in path.iterdir()}
    saved = [read_saved(path / archive) for archive in (DISCOVERY_ARCHIVE, ARCHIVE) if archive in there]
    if len(saved) == 2:
        return replace(saved[0], before=saved[1])
    if saved:
        return saved[0]
    if {"particles.csv", "curves.csv"} <= there:
        return read_campaign(path)
    raise InputError(f"{ARCHIVE} is missing: holds no result and no campaign", file=path, remedy=A_FOLDER)


def read_saved(archive: Path) -> Any:
    """The result in an archive, whose name says of which kind it is; raises `InputError` as `load` does."""
    found = read_archive(archive)
    if not isinstance(found, Saved) or found.archive_file != archive.name:
        raise InputError(f"holds a {type(found).__name__}", file=archive, remedy=A_FOLDER)
    return found
