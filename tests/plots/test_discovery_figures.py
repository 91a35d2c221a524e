"""The figures of a discovery: they draw with a gap and without one, and show what the discovery holds."""

import dataclasses

import jax
import matplotlib as mpl
import numpy as np
import pytest

from mcc_jax.campaign import PAPER_DIAMETERS_UM
from mcc_jax.discover import discover
from mcc_jax.effects import LIBRARY, find_variant
from mcc_jax.plots import discovery_figures, plot_before_after, plot_gap, plot_ranking, save_figures
from mcc_jax.simulate import (
    HiddenEffect,
    Instrument,
    Programme,
    law_for_each,
    paper_population,
    simulate_campaign,
)

pytestmark = pytest.mark.extended

COUNT = 10


@pytest.fixture(scope="module")
def found():
    """With a compliant frame and without one."""
    sizes = PAPER_DIAMETERS_UM[:COUNT]
    laws = law_for_each(paper_population().sample(jax.random.key(2), COUNT), 1.43, 16000.0)
    peaks = np.linspace(8, 14, COUNT) * np.pi / 4 * (sizes[:, 0] * sizes[:, 1] / sizes[:, 2]) ** 2 * 1e-3
    programme = Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=30.0, points=150)
    instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05, zero_um=1.0)
    hidden = {"frame": (HiddenEffect(find_variant("frame_compliance"), 0.004),), "null": ()}
    return {
        kind: discover(
            simulate_campaign(laws, sizes, peaks, programme, instrument=instrument, effects=effects, seed=5),
            experiments=False,
            posterior=False,
        )
        for kind, effects in hidden.items()
    }


def texts(figure):
    return [t.get_text() for t in figure.findobj(mpl.text.Text) if t.get_text()]


def test_verdicts_are_what_the_figures_are_to_show(found):
    assert found["frame"].verdict in {"NAMED", "SET"}
    assert found["null"].verdict == "NO_GAP"


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


def test_map_has_every_kind_of_segment(found):
    places = found["frame"].places
    assert {place.segment for place in places} == {"loading", "hold", "unloading", "reloading"}
    assert sum(place.segment == "hold" for place in places) == 1
    assert np.nansum([place.share for place in places]) == pytest.approx(1)
    assert {place.sign for place in places} <= {-1, 0, 1}


def test_likeness_is_a_correlation_with_the_set_first(found):
    names, both = found["frame"].likeness.names, found["frame"].likeness.correlation
    shared = {e["mechanism"] for e in found["frame"].ranking} - {"thermal_drift", "pop_in"}
    assert set(names) == shared  # what differs from test to test is like nothing that all share
    assert names[0] == found["frame"].effects[0].mechanism
    np.testing.assert_allclose(np.diagonal(both), 1.0)
    np.testing.assert_allclose(both, both.T, atol=1e-12)
    assert np.abs(both).max() <= 1 + 1e-9


def test_ranking_tells_limits_and_what_is_untestable(found):
    shown = texts(plot_ranking(found["frame"]))
    for name in LIBRARY:
        assert name.replace("_", " ") in shown
    assert any(text.startswith("needs a column relative_humidity_percent") for text in shown)
    assert any("limit" in text and "um/mN" in text for text in shown)


def test_gap_shows_every_step_and_the_floor(found):
    shown = texts(plot_gap(found["frame"]))
    assert "law alone" in shown
    assert f"+ {found['frame'].effects[0].mechanism.replace('_', ' ')}" in shown
    assert "floor: noise alone" in shown
    assert "no gap was found" in texts(plot_gap(found["null"]))
