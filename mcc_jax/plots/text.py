"""Text that comes from outside, made fit for a figure: names of particles, warnings, notes."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.font_manager import findfont, get_font

from ..campaign import Metadata

FONT = "DejaVu Sans"
"""Comes with matplotlib, so that a figure looks the same everywhere."""


def plain(text: str, longest: int = 24) -> str:
    """Any text as one short line that matplotlib draws as it stands.

    White space and characters that do not print become single blanks, characters that the font lacks the replacement
    character, a long text loses its middle, and `$` is escaped, which would begin mathematics.
    """
    font = get_font(findfont(FONT))
    visible = "".join(c if c.isprintable() else " " for c in text)
    drawn = "".join(
        c if font.get_char_index(ord(c)) else "\N{REPLACEMENT CHARACTER}" for c in " ".join(visible.split())
    )
    if len(drawn) > longest:
        head = longest // 2
        drawn = drawn[:head].rstrip() + "…" + drawn[len(drawn) - (longest - head - 1) :].lstrip()
    return drawn.replace("$", r"\$")


def particle_labels(names: Sequence[str], longest: int = 24) -> list[str]:
    """Names of particles for a figure, all different.

    A bare number becomes "particle 7"; where two look the same, or part cannot be drawn, the position in the campaign
    is added.
    """
    labels = [f"particle {name}" if name.isdecimal() and len(name) < 8 else plain(name, longest) for name in names]
    repeated = {label for label in labels if labels.count(label) > 1} if len(set(labels)) < len(labels) else set()
    return [
        f"{label} (no. {i})".strip()
        if not label or label in repeated or "\N{REPLACEMENT CHARACTER}" in label
        else label
        for i, label in enumerate(labels, start=1)
    ]


def is_simulated(metadata: Metadata) -> bool:
    """Whether the metadata say that nobody measured these data."""
    return "simulation" in metadata.other or "not a measurement" in (metadata.provenance or "")
