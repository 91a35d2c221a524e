"""What is in a figure, as a test reads it."""

import itertools
import re

import matplotlib as mpl

UNIT = re.compile(r"\[(MPa|GPa|mN|µm|-)\]$")


def texts(figure):
    return [t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_text()]


def panels(figure):
    """Axes with data, without colour bars and panels left blank."""
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>" and ax.axison]


def shown_ticks(axis):
    """Tick labels that are drawn: those within the axis."""
    low, high = sorted(axis.get_view_interval())
    labels = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    return [label for label in labels if label.get_visible() and label.get_text()]


def check_words(figures):
    """Every axis has its unit, and simulated data are called so once."""
    for stem, figure in figures.items():
        assert texts(figure).count("simulated data") == 1, stem
        for ax in panels(figure):
            shown = [label for label in (ax.get_xlabel(), ax.get_ylabel()) if label]
            assert all(UNIT.search(label) for label in shown), (stem, shown)


def check_layout(figures, *, ticks):
    """Text stays on the page; labels of a panel stay off the data of all, and if asked for, off each other."""
    for stem, figure in figures.items():
        page = figure.bbox.padded(1)

        def on_page(text, page=page):
            box = text.get_window_extent()
            return page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1

        for text in [*figure.texts, *(t for one in figure.legends for t in one.get_texts())]:
            assert on_page(text), (stem, text)
        for ax in panels(figure):
            for text in [t for t in (ax.xaxis.label, ax.yaxis.label, ax.title, ax._left_title) if t.get_text()]:
                box = text.get_window_extent()
                assert on_page(text), (stem, text)
                assert not any(box.overlaps(other.bbox) for other in figure.axes if other.axison), (stem, text)
            if ticks:
                assert all(map(on_page, [*shown_ticks(ax.xaxis), *shown_ticks(ax.yaxis)])), stem
                boxes = sorted((t.get_window_extent() for t in shown_ticks(ax.xaxis)), key=lambda b: b.x0)
                assert all(a.x1 <= b.x0 for a, b in itertools.pairwise(boxes)), (stem, ax.get_xlabel())
