"""The version of this package, as it was installed."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def own_version() -> str:
    """The version, or "(not installed)" where the package runs from a folder only."""
    try:
        return version("mcc-jax")
    except PackageNotFoundError:
        return "(not installed)"
