"""The figures of a discovery: they draw with a gap and without one, and show what the discovery holds."""

import dataclasses

import matplotlib as mpl
import numpy as np
import pytest
from campaigns import found_in

from mcc_jax.effects import LIBRARY
from mcc_jax.plots import discovery_figures, plot_before_after, plot_gap, plot_ranking, save_figures

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def found():
    """With a compliant frame and without one."""
    return {"frame": dataclasses.replace(found_in("frame_compliance=0.004"), posterior=None), "null": found_in(seed=1)}


def texts(figure):
    figure.draw_without_rendering()  # ticks have no words before
    return [t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_text()]


@pytest.mark.parametrize("kind", ["frame", "null"])
def test_figures_are_drawn_and_settings_stay(found, kind, tmp_path):
    settings = dict(mpl.rcParams)
    figures = discovery_figures(found[kind])
    always = {"where", "before_after", "ranking", "similarity"}
    expected = always | {"gap", "shifts"} if kind == "frame" else always
    assert set(figures) == {f"discovery_{stem}" for stem in expected}
    files = save_figures(figures, tmp_path, dpi=80)
    assert all(5000 < file.stat().st_size < 1_000_000 for file in files)
    assert dict(mpl.rcParams) == settings
    assert all("simulated data" in texts(figure) for figure in figures.values())


def test_without_a_base_fit_there_are_no_figures(found):
    failed = dataclasses.replace(found["frame"], residuals=None, verdict="FIT_NOT_CONVERGED")
    assert discovery_figures(failed) == {}
    with pytest.raises(ValueError, match="not fitted well enough"):
        plot_before_after(failed)


def test_what_is_left_is_less_with_the_effect_and_the_same_without(found):
    left = found["frame"].residuals
    before, after = (np.sum(white**2) for white in (left.white_before, left.white_after))
    assert after < 0.7 * before
    for values in (left.before, left.after, left.white_before, left.white_after):
        assert np.isfinite(values).all()
    assert after / left.used.sum() < 1.5
    nothing = found["null"].residuals
    np.testing.assert_array_equal(nothing.before, nothing.after)
    assert np.sum(nothing.white_before**2) / nothing.used.sum() == pytest.approx(1.0, abs=0.15)


def test_map_and_likeness_are_complete(found):
    places = found["frame"].places
    assert {place.segment for place in places} == {"loading", "hold", "unloading", "reloading"}
    assert np.nansum([place.share for place in places]) == pytest.approx(1)
    names, both = found["frame"].likeness.names, found["frame"].likeness.correlation
    shared = {e["mechanism"] for e in found["frame"].ranking} - {"thermal_drift", "pop_in"}
    assert set(names) == shared  # what differs from test to test is like nothing that all share
    assert names[0] == found["frame"].effects[0].mechanism
    np.testing.assert_allclose(np.diagonal(both), 1.0)
    np.testing.assert_allclose(both, both.T, atol=1e-12)
    assert np.abs(both).max() <= 1 + 1e-9


def test_ranking_and_gap_show_limits_what_is_untestable_and_every_step(found):
    shown = texts(plot_ranking(found["frame"]))
    assert {name.replace("_", " ") for name in LIBRARY} <= set(shown)
    assert any(text.startswith("needs a column relative_humidity_percent") for text in shown)
    assert any("limit" in text and "um/mN" in text for text in shown)
    shown = texts(plot_gap(found["frame"]))
    assert "law alone" in shown
    assert f"+ {found['frame'].effects[0].mechanism.replace('_', ' ')}" in shown
    assert "floor: noise alone" in shown
    assert any("no gap was found" in text for text in texts(plot_gap(found["null"])))
