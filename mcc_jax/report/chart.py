"""The interactive chart: which particles it shows, and Bokeh's figures, which the page's own script fills with them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import fields, replace
from importlib.resources import files
from typing import Any

import numpy as np

from ..calibrate.curves import KINDS, FittedCurve, measured_curves
from ..plots.style import BLACK, BLUE, GREEN, GREY, ORANGE, SKY, VERMILION
from .read import Results

LOOKS = {
    "load": ("circle", BLUE, "loading"),
    "hold": ("diamond", ORANGE, "hold"),
    "unload": ("triangle", VERMILION, "unloading"),
    "reload": ("square", GREEN, "reloading"),
}
"""Marker, colour (Okabe and Ito) and word of every kind of segment: never distinguished by colour alone."""

COLUMNS = ("displacement", "force", "residual", "marker", "colour", "alpha", "particle", "segment", "time", "compared")
DECIMALS = {"time_s": 4, "force_mN": 5, "displacement_um": 6, "own_um": 6, "typical_um": 4, "low_um": 6, "high_um": 6}
LOADED_FROM = re.compile(r"https://(?:cdn\.jsdelivr\.net|maps\.googleapis\.com)/[^\"'`\\\s]*")
"""What Bokeh's script would load from elsewhere: MathJax, icons and maps, none of which the page uses."""
POINTS = 40_000  # about so many in all, shared among the particles: they make a page of 3 MB that still scrolls
FEWEST = 40  # of one particle, at least; of more particles than that allows, those that the law misses by most


def compare(results: Results) -> list[FittedCurve]:
    """Every particle, or those that the law misses by most if there are too many; empty without tests."""
    if results.saved is not None:
        curves = results.saved.curves
    elif results.campaign is not None:
        curves = measured_curves(results.campaign)
    else:
        return []
    worst_first = np.argsort([-(one.rms_um or 0.0) for one in curves], kind="stable")
    chosen = np.sort(worst_first[: POINTS // FEWEST])
    most = max(POINTS // len(chosen), FEWEST)
    return [_thinned(curves[i], most) for i in chosen]


def _thinned(one: FittedCurve, most: int) -> FittedCurve:
    """At most about so many points; the ends of segments always."""
    count = len(one.kind)
    if count <= most:
        return one
    turns = np.flatnonzero(np.diff(one.kind)) + 1
    rows = np.unique(np.concatenate([np.arange(0, count, -(-count // most)), turns, turns - 1, [count - 1]]))
    columns = [f.name for f in fields(one) if f.name not in ("name", "why_not")]
    return replace(one, **{name: getattr(one, name)[rows] for name in columns})


def chart_scripts() -> str:
    """Bokeh's own script, which cannot end its element early and loads nothing from elsewhere."""
    script = files("bokeh").joinpath("server", "static", "js", "bokeh.min.js").read_text(encoding="utf-8")
    return LOADED_FROM.sub("about:blank", re.sub(r"</(script)", r"<\\/\1", script, flags=re.IGNORECASE))


def chart_items() -> dict[str, Any]:
    """Documents and render items for `Bokeh.embed.embed_items`: the same in every process.

    The data sources `points`, `lines` and `bands`, and the figures `curve` and `residual`, are found by these names.
    """
    from bokeh.core.json_encoder import serialize_json
    from bokeh.document import Document
    from bokeh.models import ColumnDataSource, HoverTool, Span

    points = ColumnDataSource({name: [] for name in COLUMNS}, name="points")
    lines = ColumnDataSource({name: [] for name in ("force", "own", "typical")}, name="lines")
    bands = ColumnDataSource({name: [] for name in ("displacement", "force", "time", "away")}, name="bands")
    curve = _figure("curve", "displacement [µm]", "force [mN]")
    residual = _figure("residual", "time [s]", "test − law [µm]")
    curve.patches("displacement", "force", source=bands, color=SKY, alpha=0.45, line_width=0)
    residual.patches("time", "away", source=bands, color=SKY, alpha=0.45, line_width=0)
    residual.add_layout(Span(location=0, dimension="width", line_color=BLACK, line_width=1.3))
    # Pale and broad, not dashed: where a test goes back on its own path dashes fill each other's gaps.
    curve.line("typical", "force", source=lines, color=GREY, line_alpha=0.55, line_width=2.6)
    curve.line("own", "force", source=lines, color=BLACK, line_width=1.3)
    tips = {"particle": "@particle", "segment": "@segment", "force": "@force{0.000} mN"}
    tips |= {"displacement": "@displacement{0.000} µm", "test − law": "@residual{0.0000} µm"}
    tips |= {"time": "@time{0.0} s", "compared": "@compared"}
    for figure, x, y in ((curve, "displacement", "force"), (residual, "time", "residual")):
        marks = figure.scatter(x, y, source=points, marker="marker", color="colour", alpha="alpha", size=6)
        hover = HoverTool(tooltips=list(tips.items()), renderers=[marks], limit=1, description="Values of a point")
        figure.add_tools(hover)
    document = Document()
    for root in (curve, residual):
        document.add_root(root)
    # Bokeh numbers models by what the process drew before; in their own order the same page gets the same names.
    text = serialize_json(document.to_json())
    names = {name: f"model-{i}" for i, name in enumerate(dict.fromkeys(re.findall(r'"id": ?"([^"]+)"', text)))}
    for name, other in names.items():
        text = text.replace(f'"{name}"', f'"{other}"')
    roots = {names[curve.id]: "chart-curve", names[residual.id]: "chart-residual"}
    items = [{"docid": "chart", "roots": roots, "root_ids": list(roots)}]
    return {"docs": {"chart": json.loads(text)}, "items": items}


def _figure(name: str, across: str, up: str) -> Any:
    from bokeh.models import BasicTicker, Range1d
    from bokeh.plotting import figure

    plot = figure(
        name=name,
        height=400,
        sizing_mode="stretch_width",
        x_range=Range1d(start=0, end=1),
        y_range=Range1d(start=0, end=1),
        x_axis_label=across,
        y_axis_label=up,
        tools="box_zoom,pan,wheel_zoom,reset,save",
        active_drag="box_zoom",
        # A wheel, or a finger, that moves the page must not be caught by a chart on its way.
        active_scroll=None,
        toolbar_location="above",
        min_border_right=12,
    )
    plot.toolbar.logo = None
    for axis in (*plot.xaxis, *plot.yaxis):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "13px"
        axis.axis_label_text_font = axis.major_label_text_font = "system-ui, sans-serif"
        axis.ticker = BasicTicker(desired_num_ticks=5)
        axis.minor_tick_line_color = None
        axis.axis_label_text_color = axis.major_label_text_color = "#222222"
    return plot


def chart(shown: list[FittedCurve], labels: list[str], facts: Iterable[str]) -> dict[str, Any]:
    """What the page's script needs: Bokeh's empty figures, every particle's columns, how kinds of segments look."""
    data = {
        "kinds": [dict(zip(("marker", "colour", "word"), LOOKS[kind], strict=True)) for kind in KINDS],
        "particles": [
            {
                "label": label,
                "facts": fact,
                **{name.partition("_")[0]: _rounded(getattr(one, name), digits) for name, digits in DECIMALS.items()},
                "kind": one.kind.tolist(),
                "used": one.used.astype(int).tolist(),
            }
            for one, label, fact in zip(shown, labels, facts, strict=True)
        ],
    }
    return {"bokeh": chart_items(), "data": data}


def _rounded(values: np.ndarray, decimals: int) -> list[float | None] | None:
    """What JSON can hold of a column; None if there is nothing."""
    if not np.isfinite(values).any():
        return None
    return [value if math.isfinite(value) else None for value in np.round(values, decimals).tolist()]
