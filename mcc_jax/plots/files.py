"""All figures of a calibration, and writing them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from .. import arguments
from .._errors import InputError
from ..calibrate import PaperCalibration
from .collapse import plot_collapse
from .curves import plot_curves
from .dimensions import plot_dimensions
from .elastic import plot_elastic
from .law import plot_law
from .master import plot_master
from .particles import particle_pages, plot_particles
from .residuals import plot_residuals
from .style import RC, of_its_kind


@of_its_kind
def paper_figures(calibration: PaperCalibration) -> dict[str, Figure]:
    """Every figure of the calibration, by the stem of its file's name.

    Returns:
        `curves`, `dimensions`, `collapse`, `master`, `law`, `particles` (then `particles_2`, ... with more than 20
        particles), `elastic`, `residuals`.
    """
    figures = {
        "curves": plot_curves(calibration),
        "dimensions": plot_dimensions(calibration.campaign),
        "collapse": plot_collapse(calibration),
        "master": plot_master(calibration),
        "law": plot_law(calibration),
    }
    for page in range(1, particle_pages(calibration) + 1):
        figures["particles" if page == 1 else f"particles_{page}"] = plot_particles(calibration, page)
    figures["elastic"] = plot_elastic(calibration)
    figures["residuals"] = plot_residuals(calibration)
    return figures


@rc_context(RC)
def save_figures(figures: Mapping[str, Figure], directory: str | Path, *, dpi: int = 150) -> list[Path]:
    """Write figures as `<stem>.png` into a directory that exists.

    Args:
        figures: figures by stem, as `paper_figures` gives them.
        directory: where to; files of these names are overwritten.
        dpi: resolution [dots per inch].

    Returns:
        The files, in the order of the figures.
    """
    remedy = "Give a dictionary of figures by stem, as mcc_jax.plots.paper_figures makes it."
    arguments.instance(figures, Mapping, "figures", remedy)
    for stem, figure in figures.items():
        arguments.instance(figure, Figure, f"the figure {stem!r}", remedy)
    folder = arguments.file_path(directory, "directory")
    dpi = arguments.whole(dpi, "dpi", least=1)
    if not folder.is_dir():
        raise InputError("no such folder", file=folder, remedy="Make it first.")
    files = []
    for stem, figure in figures.items():
        file = folder / f"{stem}.png"
        figure.savefig(file, format="png", dpi=dpi)
        files.append(file)
    return files
