"""What a result says of where it comes from: data, settings, versions. Imported once the command runs."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from .._version import own_version
from ..campaign import file_checksums

PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "numpyro", "arviz", "numpy", "scipy")


def provenance(command: str, campaign: Path, settings: Mapping[str, Any], *, told: str | None = None) -> dict[str, Any]:
    """Folder and checksums of the campaign, settings of the command, versions of what computed.

    Args:
        command: the command's name.
        campaign: the folder that was read.
        settings: the options in force, by name.
        told: the folder as the result shall name it; the absolute path if None.
    """
    return {
        "campaign": {"folder": told or str(campaign.resolve()), "sha256": file_checksums(campaign)},
        "settings": {"command": command} | {name: _plain(value) for name, value in settings.items()},
        "versions": {
            "mcc_jax": own_version(),
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        },
    }


def _plain(value: Any) -> Any:
    if isinstance(value, Path):
        return value.name
    return list(value) if isinstance(value, tuple) else value
