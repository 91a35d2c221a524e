"""A campaign as the joint calibration sees it: rectangular arrays, and which points and particles take part."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .. import arguments
from .._format import described
from ..campaign import (
    THRESHOLD_MPA,
    Campaign,
    Curve,
    Finding,
    Segment,
    campaign_segments,
    check_tests,
    particle_batch,
    stress_and_strain,
    turning_forces,
)
from ..campaign.adjustment import SHOWN, far_apart, no_curve, no_loading, refusal
from ..campaign.findings import named
from ..campaign.record import humidities, record_columns
from ..campaign.segments import contact_index
from ..campaign.signal import point_noise
from ..effects import Record
from ..geometry import Particle

MOST_POINTS = 400  # longer records are thinned to about so many rows
# Points of unloading below this share of the peak stress are left out: strain there depends on stress with an infinite
# slope.
UNLOADED_FROM = 0.05
# What no record of displacement is better than [um]: counted as misfit at every point, so that the noise of a record
# without any, of a simulation say, is small but not nothing.
READING_UM = 2e-4
LEAST_POINTS = 12  # fewer usable points cannot carry three coefficients, a zero and their noise
# Of records with more segments than one for so many rows that are kept, hundreds of cycles, whole cycles are left out:
# turning points that are always kept would be most of what is left.
TURNS_SHARE = 4
# Records are padded to one of these lengths, beyond them in steps of the last: similar campaigns share a compilation.
LENGTHS = (64, 128, 192, 320, 448)


class Tests(eqx.Module):
    """N tests as rectangular arrays; shorter ones are padded with their last point, which is masked."""

    __test__ = False  # no test of ours, whatever pytest thinks of the name

    particle: Particle  # sizes and shapes, leading axis N
    record: Record  # what the instrument did, point by point; its forces are those of `turning_forces`
    displacement: Float[Array, "particles points"] | None  # measured displacement [um], raw; None to predict it
    mask: Bool[Array, "particles points"]  # which points are compared with the law
    loading: Bool[Array, "particles points"]  # which of them lie on virgin loading
    contact: Float[Array, " particles"]  # displacement at which the record says that the platen touches [um]
    # where a point is on its path of force: the sum of all changes of force up to it, in shares of the largest force
    # [-]. Correlated residuals live along it
    path: Float[Array, "particles points"]
    # index of the point from which a point's branch starts; its own on virgin loading
    branch: Int[Array, "particles points"]
    reading: Bool[Array, "particles points"]  # whether a point's force is a reading of its own
    # standard error of the force from which its branch starts, in those of a reading [-]
    peak_error: Float[Array, "particles points"]
    # standard deviation of each test's zero of force [mN]; None where none was measured
    force_zero_sd: Float[Array, " particles"] | None = None
    # standard deviation of the force of each point's branch peak where it was worked out otherwise, from readings that
    # saturate [mN]; None where none was
    peak_sd: Float[Array, "particles points"] | None = None
    # by how much the white noise of a point is less in variance [-]; None where all are alike
    reading_weight: Float[Array, "particles points"] | None = None

    __repr__ = described(displacement="um", contact="um")

    @property
    def force(self) -> Float[Array, "*particles points"]:
        """Force [mN] of every point."""
        return self.record.force

    def unobserved(self) -> Tests:
        """The same tests without their displacements: a model predicts them."""
        return replace(self, displacement=None)

    def __len__(self) -> int:
        return self.force.shape[0]

    @property
    def flatness(self) -> Float[Array, " particles"]:
        """1 - D3^2/(D1 D2) of every particle [-], through which `a` acts."""
        return eqx.filter_vmap(lambda particle: particle.flatness)(self.particle)

    @property
    def effective_diameter(self) -> Float[Array, " particles"]:
        """D1 D2/D3 of every particle [um]."""
        return eqx.filter_vmap(lambda particle: particle.effective_diameter)(self.particle)


def padded_length(points: int) -> int:
    """The length that records of so many points are padded to."""
    return next((length for length in LENGTHS if length >= points), points + -points % LENGTHS[-1])


@dataclass(frozen=True)
class Selection:
    """Which particles take part, and which points of each."""

    tests: Tests  # the arrays of those that do
    kept: tuple[int, ...]  # their positions in the campaign
    reasons: tuple[Finding | None, ...]  # for each particle of the campaign, None if kept, else why it is not
    # for each kept particle, the rows of its curve, as `check_tests` left it, that are in `tests`
    rows: tuple[np.ndarray, ...]
    notes: tuple[str, ...]  # what a reader must know about particles that are kept

    @property
    def why_not(self) -> tuple[str | None, ...]:
        """The reasons in words."""
        return tuple(None if one is None else one.reason for one in self.reasons)


def select_tests(campaign: Campaign, *, threshold_MPa: float = THRESHOLD_MPA) -> Tests:
    """The tests as a `Model` takes them: points and particles chosen, padded to rectangular arrays; see `select`."""
    return select(campaign, threshold_MPa=threshold_MPa).tests


def select(campaign: Campaign, *, threshold_MPa: float = THRESHOLD_MPA, most_points: int = MOST_POINTS) -> Selection:
    """Choose what the joint calibration uses.

    Points count from the threshold stress on, below which surface asperities and not the particle deform. On unloading
    and reloading they count from `UNLOADED_FROM` of the peak, below which displacement depends on force with an
    infinite slope. The approach never counts. Of records longer than `most_points` every n-th row is used, turning
    points always. Raises `InputError` if no particle can be used, `RuntimeError` in single precision.
    """
    campaign = check_tests(campaign)
    threshold_MPa = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    arguments.double_precision("the joint calibration")
    segments = campaign_segments(campaign)
    tests = zip(campaign.curves, campaign.diameters_um, segments, strict=True)
    prepared = dict(enumerate(_prepare(*test, threshold_MPa, most_points) for test in tests))
    ends = {i: (one.stress_max_MPa, one.strain_range) for i, one in prepared.items() if isinstance(one, _Prepared)}
    prepared |= far_apart(ends)
    reasons = tuple(one if isinstance(one, Finding) else None for one in prepared.values())
    used = {i: one for i, one in prepared.items() if isinstance(one, _Prepared)}
    if not used:
        raise refusal(campaign, "no particle can be used", reasons)
    kept, rows = tuple(used), tuple(one.rows for one in used.values())
    longest = padded_length(max(map(len, rows)))

    def padded(values: Iterable[np.ndarray], mode: Literal["edge", "constant"] = "constant") -> Array:
        return jnp.asarray(np.stack([np.pad(v, (0, longest - len(v)), mode=mode) for v in values]))

    record, reading, error = records_of(campaign, kept, segments, rows, longest)
    force = np.asarray(record.force)
    branch = _branches(np.asarray(record.peak), error > 0)
    changes = np.abs(np.diff(force, axis=1, prepend=force[:, :1]))
    tests = Tests(
        particle_batch(campaign.diameters_um[list(kept)]),
        record,
        padded((campaign.curves[i].displacement_um[one.rows].astype(float) for i, one in used.items()), "edge"),
        padded(one.mask for one in used.values()),
        padded(one.loading for one in used.values()),
        jnp.asarray([one.contact for one in used.values()]),
        jnp.asarray(np.cumsum(changes, axis=1) / force.max(axis=1, keepdims=True)),
        jnp.asarray(branch),
        jnp.asarray(reading),
        jnp.asarray(error),
        *_errors_of_force([campaign.curves[i] for i in kept], rows, branch),
    )
    return Selection(tests, kept, reasons, rows, tuple(_notes(campaign, used, most_points)))


def _errors_of_force(
    curves: Sequence[Curve], rows: Sequence[np.ndarray], branch: np.ndarray
) -> tuple[Array | None, Array | None]:
    """Errors of the zeros of force, and of the peaks of branches that were worked out; None where there are none."""
    zero, peak = np.zeros(len(curves)), np.zeros(branch.shape)
    for k, curve in enumerate(curves):
        if curve.checked is not None:
            zero[k] = curve.checked.force_zero_sd_mN
            peak[k, : len(rows[k])] = curve.checked.force_sd_mN[rows[k]]
    # A branch starts at its peak or one reading behind it.
    peak = np.maximum(*(np.take_along_axis(peak, np.maximum(branch - back, 0), axis=1) for back in (0, 1)))
    return (jnp.asarray(zero) if zero.any() else None), (jnp.asarray(peak) if peak.any() else None)


def _branches(levels: np.ndarray, elastic: np.ndarray) -> np.ndarray:
    """Index of the first point of every branch: points that start from one peak share it, loading has its own."""
    same = np.zeros_like(elastic)
    same[:, 1:] = elastic[:, 1:] & elastic[:, :-1] & (levels[:, 1:] == levels[:, :-1])
    return np.maximum.accumulate(np.where(same, 0, np.arange(levels.shape[1])), axis=1)


def records_of(
    campaign: Campaign,
    places: Sequence[int],
    segments: Sequence[tuple[Segment, ...]],
    rows: Sequence[np.ndarray],
    longest: int,
) -> tuple[Record, np.ndarray, np.ndarray]:
    """Records of the tests at some places of a campaign, at some rows of each, padded with the last to a length, with
    the forces and peaks of `turning_forces`; and its `reading` and `error`, shape (N, points)."""
    humidity = humidities(campaign)
    found = []
    for i, some in zip(places, rows, strict=True):
        own = None if humidity is None else float(humidity[i])
        turning = turning_forces(campaign.curves[i], segments[i])
        columns = record_columns(campaign.curves[i], segments[i], relative_humidity_percent=own)
        columns |= {"force": turning.force, "peak": turning.peak, "reading": turning.reading, "error": turning.error}
        chosen = np.concatenate((some, np.full(longest - len(some), some[-1])))
        found.append({name: x[chosen] if x.ndim else x for name, x in columns.items()})
    together = {name: np.stack([one[name] for one in found]) for name in found[0]}
    reading, error = together.pop("reading"), together.pop("error")
    return Record(**{name: jnp.asarray(x) for name, x in together.items()}), reading, error


class _Prepared(NamedTuple):
    rows: np.ndarray
    mask: np.ndarray
    loading: np.ndarray
    contact: float
    stress_max_MPa: float
    strain_range: float
    unloading_hidden: bool


def rows_from_contact(curve: Curve, segments: tuple[Segment, ...], most_points: int) -> np.ndarray:
    """Rows of a test behind its approach; of longer records every n-th, turning points and the largest force always. Of
    hundreds of cycles some elastic parts are left out, but for the loading before them: the law knows the largest force
    only."""
    start = contact_index(segments)
    rows = np.arange(start, len(curve))
    if len(rows) <= most_points:
        return rows
    most_parts = most_points // TURNS_SHARE
    parts, thinned = segments, [rows[:: -(-len(rows) // most_points)]]
    turns = [int(np.argmax(curve.force_mN))]
    if len(segments) > most_parts:
        kind, force = row_kinds(segments), np.asarray(curve.force_mN)
        elastic = [part for part in segments if part.kind in ("hold", "unload", "reload")]
        parts = tuple(elastic[:: -(-len(elastic) // most_parts)])
        # The largest force before each, from which the law unloads.
        highest = np.maximum.accumulate(np.where(force >= np.maximum.accumulate(force), np.arange(len(force)), 0))
        turns += [int(highest[part.start]) for part in parts]
        kept = np.concatenate([np.arange(part.start, part.stop) for part in parts])
        # Half of the rows for each: the one loading of many cycles is short.
        shares = rows[kind[rows] == "load"], kept[kept >= start]
        thinned = [some[:: -(-len(some) * 2 // most_points) or 1] for some in shares]
    turns += [part.start for part in parts] + [part.stop - 1 for part in parts]
    return np.unique(np.concatenate([*thinned, [t for t in turns if t >= start]]).astype(int))


def row_kinds(segments: tuple[Segment, ...]) -> np.ndarray:
    """The kind of segment of every row of a test."""
    return np.repeat([part.kind for part in segments], [len(part) for part in segments])


def _prepare(
    curve: Curve, diameters: np.ndarray, segments: tuple[Segment, ...], threshold: float, most_points: int
) -> _Prepared | Finding:
    """The rows of one test that are used, or why there are none."""
    stress, strain = stress_and_strain(curve, diameters, segments)
    kind = row_kinds(segments)
    if not (kind == "load").any():
        return no_loading(curve, segments, stress, threshold)
    rows = rows_from_contact(curve, segments, most_points)
    kind, at, compared = kind[rows], stress[rows], curve.compared[rows]
    peak = np.maximum.accumulate(at)
    loading = (kind == "load") & (at >= threshold) & (at > 0)
    elastic = np.isin(kind, ("hold", "unload", "reload")) & (at >= threshold) & (at >= UNLOADED_FROM * peak)
    elastic &= peak > 0
    hidden = bool(elastic.any() and not elastic[compared].any())
    loading, elastic = loading & compared, elastic & compared
    climb, noise = curve.displacement_um[rows[loading]], max(point_noise(curve.displacement_um), READING_UM)
    reason = no_curve(climb, float(stress.max()), threshold, least_points=LEAST_POINTS, noise_um=noise)
    if reason is not None:
        return reason
    contact, mask = float(curve.displacement_um[contact_index(segments)]), loading | elastic
    return _Prepared(rows, mask, loading, contact, float(at[mask].max()), float(np.ptp(strain[rows][mask])), hidden)


def ranges_um(tests: Tests) -> np.ndarray:
    """Range of the displacements that are compared, of every test [um], shape (N,)."""
    mask, measured = np.asarray(tests.mask), np.asarray(tests.displacement)
    return np.where(mask, measured, -np.inf).max(1) - np.where(mask, measured, np.inf).min(1)


def root_mean_squares(tests: Tests, residual: Array | np.ndarray) -> np.ndarray:
    """Root mean square of every test's residuals [um], shape (N,); residuals are 0 where masked."""
    count = np.maximum(np.asarray(tests.mask).sum(1), 1)
    return np.sqrt((np.asarray(residual) ** 2).sum(1) / count)


def _notes(campaign: Campaign, used: Mapping[int, _Prepared], most_points: int) -> Iterator[str]:
    thinned = sum(len(one.rows) < len(campaign.curves[i]) - 1 for i, one in used.items())
    if any(len(campaign.curves[i]) > most_points for i in used):
        yield f"{thinned} records were thinned to about {most_points} rows"
    silent = [(repr(campaign.particles[i]), one) for i, one in used.items() if not (one.mask & ~one.loading).any()]
    for hidden, what in ((False, "never unloaded"), (True, "no unloading that can be compared with the law")):
        names = tuple(name for name, one in silent if one.unloading_hidden is hidden)
        if names:
            yield f"{named(names, len(used), SHOWN)}: {what}, so no information on the modulus"
    seen: dict[bytes, str] = {}
    for i in used:
        curve, name = campaign.curves[i], campaign.particles[i]
        first = seen.setdefault(curve.force_mN.tobytes() + curve.displacement_um.tobytes(), name)
        if first != name:
            yield (
                f"particles {first!r} and {name!r} have the same curve to the last digit: "
                "one test counted twice makes everything look too certain"
            )
