"""What every campaign must satisfy, read from files, made in memory or joined from several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from .._errors import InputError
from .columns import LARGEST_MAGNITUDE
from .schema import Campaign, Curve, Metadata, remembered

SMALLEST_DIAMETER_UM = 1e-6


def check_magnitudes(
    values: np.ndarray, file: str | Path, rows: Sequence[int], column: str, *, diameter: bool = False
) -> None:
    """Refuse values that are too large to be measured, and diameters that are not positive, at the first of them.

    `values` are in canonical units, shape (n,); `rows` are the rows of the file that they are from.
    """
    bad = ~(np.abs(values) <= LARGEST_MAGNITUDE)
    if diameter:
        bad |= ~(values >= SMALLEST_DIAMETER_UM)
    if not bad.any():
        return
    i = int(np.argmax(bad))
    value, remedy = float(values[i]), "Check the number and the column's unit"
    problem = f"{value:.4g} (in mN, um or s) is too {'small' if abs(value) < 1 else 'large'} to be real"
    if diameter and value <= 0:
        problem, remedy = f"the diameter {value:.10g} um is not positive", "Enter the measured diameter"
    raise InputError(problem, file=file, row=rows[i], column=column, remedy=remedy)


class Fault(NamedTuple):
    """Why no test can be as it is, and the first reading and the channel concerned; that is empty for all of them."""

    problem: str
    remedy: str
    reading: int = 0
    channel: str = ""


def fault_of(name: str, curve: Curve) -> Fault | None:
    """What is wrong with a test whatever its particle is: readings that are no numbers, or too few, times, zeros."""
    channels = {"time": curve.time_s, "force": curve.force_mN, "displacement": curve.displacement_um}
    for channel, values in channels.items():
        bad = np.flatnonzero(~(np.abs(values) <= LARGEST_MAGNITUDE))
        if bad.size:
            remedy = "Leave that sample out, or check the unit if all are so large"
            return Fault(f"the {channel} of test {name!r} is {values[bad[0]]}", remedy, int(bad[0]), channel)
    if len(curve) < 2:
        remedy = "A curve needs at least two rows; add them or remove the particle"
        return Fault(f"the test {name!r} has one row only", remedy)
    back = np.flatnonzero(np.diff(curve.time_s) < 0)
    if back.size:
        i = int(back[0])
        problem = f"the time of test {name!r} goes back, from {curve.time_s[i]:.10g} s to {curve.time_s[i + 1]:.10g} s"
        return Fault(problem, "Keep the rows of a test in the order of time; two tests need two names", i + 1, "time")
    for channel in ("force", "displacement"):
        if not channels[channel].any():
            problem = f"every {channel} of test {name!r} is zero, so it holds no data"
            return Fault(problem, "Export the test again or remove the particle", 0, channel)
    return None


def check_campaign(campaign: Any, name: str = "campaign", *, file: str | Path = "") -> Campaign:
    """The campaign, if it is one that could have come from files: checked as strictly as one that did.

    Raises `InputError` if names, shapes or values are unfit, naming `file` or the place where the campaign was read;
    given a path, it shows how to read it.
    """
    if isinstance(campaign, str | PurePath):
        remedy = f"Read it first: mcc_jax.read_campaign({str(campaign)!r})."
        raise InputError(f"{name} must be a Campaign, got the path {str(campaign)!r}", remedy=remedy)
    remembered(campaign, "valid", lambda: _check(campaign, file or campaign.source or f"the {name}"))
    return campaign


def _check(campaign: Campaign, place: str | Path) -> None:
    def fail(problem: str, remedy: str = "Correct the campaign before it is used") -> InputError:
        return InputError(problem, file=place, remedy=remedy)

    if not len(campaign):
        raise fail("there is no particle")
    name, times = Counter(campaign.particles).most_common(1)[0]
    if times > 1:
        raise fail(f"the particle {name!r} appears {times} times")
    for name, triple, curve in zip(campaign.particles, campaign.diameters_um, campaign.curves, strict=True):
        _check_text(name, f"the particle's name {name!r}", fail)
        if not name.strip():
            raise fail("a particle's name is empty")
        if not ((triple >= SMALLEST_DIAMETER_UM) & (triple <= LARGEST_MAGNITUDE)).all():
            raise fail(f"the diameters {triple.tolist()} um of particle {name!r} are not all positive and finite")
        if (fault := fault_of(name, curve)) is not None:
            raise fail(f"{fault.problem} (sample {fault.reading + 1})", fault.remedy)
    for column, cells in campaign.columns.items():
        taken = column == "particle" or column.startswith(("D1_", "D2_", "D3_"))
        if taken or not column or column != column.strip() or "\ufeff" in column:
            raise fail(f"{column!r} cannot be the name of a further column")
        for text in (column, *cells):
            _check_text(text, f"the text {text!r} of column {column!r}", fail)


def _check_text(text: str, what: str, fail: Callable[[str], InputError]) -> None:
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        raise fail(f"{what} is no valid Unicode text") from None
    if "\0" in text:
        raise fail(f"{what} holds a NUL character")


_ALIKE = ("control", "punch_diameter_um", "corrections")
_COARSEST = ("force_resolution_mN", "displacement_resolution_um")


def join_campaigns(first: Campaign, *further: Campaign) -> Campaign:
    """The tests of several campaigns as one, for instance those that a discovery proposed in addition to those it had.

    Programmes of load may differ. What is read from `campaign.toml` must agree where the law or the search depend on
    it; of resolutions the coarsest counts, provenances are listed, and of further entries with one name the first
    campaign's stays. The same name twice, a column that is not in all campaigns, and different control, punch or
    corrections raise `InputError`.
    """
    campaigns = tuple(check_campaign(one, f"campaign {i}") for i, one in enumerate((first, *further), start=1))
    for other in further:
        _check_alike(first, other)
    names = [name for campaign in campaigns for name in campaign.particles]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        at = next(c for c in reversed(campaigns) if twice[0] in c.particles)
        problem = f"the particle {twice[0]!r} is in another of the campaigns, too"
        remedy = "Give every particle its own name"
        raise InputError(problem, file=at.source or None, column="particle", remedy=remedy)
    return Campaign(
        names,
        np.concatenate([campaign.diameters_um for campaign in campaigns]),
        [curve for campaign in campaigns for curve in campaign.curves],
        {name: [cell for c in campaigns for cell in c.columns[name]] for name in first.columns},
        _metadata([campaign.metadata for campaign in campaigns]),
        ", ".join(dict.fromkeys(campaign.source for campaign in campaigns if campaign.source)),
    )


def _check_alike(first: Campaign, other: Campaign) -> None:
    for name in sorted(first.columns.keys() ^ other.columns.keys()):
        lacking = other if name in first.columns else first
        problem = "the column is in another of the campaigns only"
        remedy = "Enter it for all particles, or leave it out everywhere"
        raise InputError(problem, file=lacking.source or None, column=name, remedy=remedy)
    for name in _ALIKE:
        one, another = getattr(first.metadata, name), getattr(other.metadata, name)
        if one != another:
            problem = f"{name} is {another!r} here and {one!r} in the first campaign"
            remedy = "Such tests are not of one kind; evaluate them separately, or correct the entry"
            raise InputError(problem, file=other.source or None, remedy=remedy)


def _metadata(each: list[Metadata]) -> Metadata:
    coarsest = {
        name: max((value for m in each if (value := getattr(m, name)) is not None), default=None) for name in _COARSEST
    }
    sources = dict.fromkeys(m.provenance for m in each if m.provenance)
    other = {name: value for m in reversed(each) for name, value in m.other.items()}
    return replace(each[0], **coarsest, provenance="; ".join(sources) or None, other=other)
