"""Writing a campaign folder: all of it or nothing."""

from __future__ import annotations

import os

import numpy as np

from .. import arguments
from .._store import results
from .csv import CURVES, METADATA
from .curves import PARTICLES
from .metadata import format_metadata
from .schema import Campaign
from .validate import check_campaign


def write_campaign(campaign: Campaign, folder: str | os.PathLike[str]) -> None:
    """Write a campaign so that `read_campaign` gives back exactly the same numbers and texts.

    The three files appear in `folder` together or not at all; other files there are left alone.

    Args:
        campaign: what to write; it is checked first.
        folder: the folder to make or to replace the campaign in.

    Raises:
        InputError: if the campaign could not be read back, or the folder cannot be written.
    """
    path = arguments.file_path(folder, "folder")
    check_campaign(campaign, file=path)
    texts = {
        PARTICLES: _format_particles(campaign),
        CURVES: _format_curves(campaign),
        METADATA: format_metadata(campaign.metadata, path / METADATA),
    }
    with results(path) as stage:
        for name, text in texts.items():
            (stage.folder / name).write_bytes(text.encode("utf-8"))


def _cell(text: str) -> str:
    if any(mark in text for mark in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


def _format_particles(campaign: Campaign) -> str:
    lines = [",".join(["particle", "D1_um", "D2_um", "D3_um", *map(_cell, campaign.columns)])]
    further = list(campaign.columns.values())
    for i, (name, diameters) in enumerate(zip(campaign.particles, campaign.diameters_um.tolist(), strict=True)):
        lines.append(",".join([_cell(name), *map(repr, diameters), *(_cell(values[i]) for values in further)]))
    return "\n".join(lines) + "\n"


def _format_curves(campaign: Campaign) -> str:
    lines = ["particle,time_s,force_mN,displacement_um"]
    for name, curve in zip(campaign.particles, campaign.curves, strict=True):
        cell = _cell(name)
        columns = (np.asarray(c, float).tolist() for c in (curve.time_s, curve.force_mN, curve.displacement_um))
        lines.extend(f"{cell},{t!r},{f!r},{d!r}" for t, f, d in zip(*columns, strict=True))
    return "\n".join(lines) + "\n"
