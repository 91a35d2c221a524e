"""Several campaigns of one material as one."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from .._errors import InputError
from .schema import Campaign, Metadata
from .validate import check_campaign

_ALIKE = ("control", "punch_diameter_um", "corrections")
_COARSEST = ("force_resolution_mN", "displacement_resolution_um")


def join_campaigns(first: Campaign, *further: Campaign) -> Campaign:
    """The tests of several campaigns as one, for instance those that a discovery proposed beside those it had.

    Programmes of load may differ. What is read from `campaign.toml` must agree where the law or the search depend on
    it; of resolutions the coarsest counts, provenances stand one after the other, and of further entries with one name
    the first campaign's stays.

    Args:
        first: a campaign; its particles come first.
        further: other ones, of the same material.

    Raises:
        InputError: if two particles have the same name, a column is not in all campaigns, or control, punch or
            corrections differ.
    """
    campaigns = tuple(check_campaign(one, f"campaign {i}") for i, one in enumerate((first, *further), start=1))
    for other in further:
        _check_alike(first, other)
    names = [name for campaign in campaigns for name in campaign.particles]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        at = next(c for c in reversed(campaigns) if twice[0] in c.particles)
        raise InputError(
            f"the particle {twice[0]!r} is in another of the campaigns, too",
            file=at.source or None,
            column="particle",
            remedy="Give every particle a name of its own",
        )
    joined = {name: tuple(v for c in campaigns for v in c.columns[name]) for name in first.columns}
    return Campaign(
        tuple(names),
        np.concatenate([campaign.diameters_um for campaign in campaigns]),
        tuple(curve for campaign in campaigns for curve in campaign.curves),
        joined,
        _metadata([campaign.metadata for campaign in campaigns]),
        ", ".join(dict.fromkeys(campaign.source for campaign in campaigns if campaign.source)),
    )


def _check_alike(first: Campaign, other: Campaign) -> None:
    for name in sorted(first.columns.keys() ^ other.columns.keys()):
        lacking = other if name in first.columns else first
        raise InputError(
            "the column is in another of the campaigns only",
            file=lacking.source or None,
            column=name,
            remedy="Enter it for all particles, or leave it out everywhere",
        )
    for name in _ALIKE:
        one, another = getattr(first.metadata, name), getattr(other.metadata, name)
        if one != another:
            raise InputError(
                f"{name} is {another!r} here and {one!r} in the first campaign",
                file=other.source or None,
                remedy="Such tests are not of one kind; judge them apart, or correct the entry",
            )


def _metadata(each: list[Metadata]) -> Metadata:
    coarsest = {}
    for name in _COARSEST:
        known = [value for m in each if (value := getattr(m, name)) is not None]
        coarsest[name] = max(known, default=None)
    told = dict.fromkeys(m.provenance for m in each if m.provenance)
    other = {name: value for m in reversed(each) for name, value in m.other.items()}
    return replace(each[0], **coarsest, provenance="; ".join(told) or None, other=other)
