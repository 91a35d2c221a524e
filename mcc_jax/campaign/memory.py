"""What was found of a test or a campaign is kept with it: checks, selection and findings all ask for the same."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any

from .schema import Campaign, Curve


def remembered[T](of: Curve | Campaign, question: Hashable, find: Callable[[], T]) -> T:
    """What was found of a curve or a campaign, or is found now; found anew once a number has changed.

    Args:
        of: the test or the campaign.
        question: what was looked for, with all settings.
        find: looks for it.
    """
    mark = _mark(of)
    known: dict[Hashable, tuple[int, Any]] = vars(of).setdefault("_found", {})
    if (kept := known.get(question)) is None or kept[0] != mark:
        kept = known[question] = mark, find()
    return kept[1]


def _mark(of: Curve | Campaign) -> int:
    """A number that changes with any number measured."""
    if isinstance(of, Campaign):
        return hash((of.diameters_um.tobytes(), *map(_mark, of.curves)))
    return hash((of.time_s.tobytes(), of.force_mN.tobytes(), of.displacement_um.tobytes()))
