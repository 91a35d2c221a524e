"""The figures of the joint calibrations: they draw for campaigns of every size, and show what the calibration holds."""

import dataclasses
import functools
import re

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.quiver import Quiver
from reading_figures import check_layout, check_words, panels, texts
from scipy.stats import nakagami

from mcc_jax.calibrate import least_squares, sample
from mcc_jax.plots import (
    least_squares_figures,
    plot_bands,
    plot_fits,
    plot_new_particle,
    plot_pairs,
    plot_shrinkage,
    plot_whitened,
    posterior_figures,
    save_figures,
)
from mcc_jax.plots.posterior import density, draw_forest, prior_near, shrinkage
from mcc_jax.plots.style import spread_over
from mcc_jax.simulate import paper_campaign

KINDS = ("paper", "one")
STEMS = ["pairs", "prior_posterior", "forest", "shrinkage", "bands", "new_particle", "whitened", "fits", "estimates"]

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def calibrated(paper_posterior):
    """Posterior and least squares of 20 particles or of one, which compiles again, where they are first asked for."""

    @functools.cache
    def calibrated(kind):
        if kind == "paper":
            return paper_posterior, least_squares(paper_campaign(0))
        one = paper_campaign(0).select(np.arange(20) == 3)
        return sample(one, draws=200, chains=2), least_squares(one)

    return calibrated


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def figures(calibrated, kind, tmp_path_factory):
    """Every figure, drawn and written."""
    posterior, squares = calibrated(kind)
    settings = dict(mpl.rcParams)
    found = posterior_figures(posterior) | least_squares_figures(squares)
    files = save_figures(found, tmp_path_factory.mktemp(kind), dpi=100)
    assert all(5000 < file.stat().st_size < 1_000_000 for file in files)
    assert dict(mpl.rcParams) == settings
    return found


# ---- all figures -----------------------------------------------------------------------------------------------------


def test_every_figure_has_its_panels(figures, kind):
    assert list(figures) == STEMS
    cells = 1 if kind == "one" else 12
    expected = {
        "pairs": 8 * 9 // 2,
        "prior_posterior": 2 * 9,
        "forest": 3,
        "shrinkage": 3,
        "bands": 2 * cells,
        "new_particle": 2,
        "whitened": 3,
        "fits": 2 * cells,
        "estimates": 3,
    }
    assert {stem: len(panels(figure)) for stem, figure in figures.items()} == expected


def test_words_and_layout(figures):
    check_words(figures)
    check_layout(figures, ticks=True)


def test_what_must_not_be_relied_on_is_said(calibrated):
    posterior, squares = calibrated("one")
    assert not posterior.converged
    assert any("\nNot converged: " in t for t in texts(plot_pairs(posterior)))
    assert any("\nThe data leave this combination open: " in t for t in texts(plot_whitened(squares)))
    good = dataclasses.replace(
        posterior, rhat={"a": 1.0}, ess_bulk={"a": 1e3}, divergences=0, pareto_k=np.zeros(1), pareto_k_joint=None
    )
    assert good.converged
    assert not any("converged" in t for t in texts(plot_pairs(good)))


# ---- coefficients ----------------------------------------------------------------------------------------------------


def test_forest_has_a_row_for_every_particle(figures, calibrated, kind):
    posterior, squares = calibrated(kind)
    for stem, calibration in (("forest", posterior), ("estimates", squares)):
        count = len(calibration.particles)
        first = panels(figures[stem])[0]
        assert len(first.get_yticklabels()) == count
        for j, ax in enumerate(panels(figures[stem])):
            (dots,) = [one for one in ax.lines if one.get_marker() == "o"]
            assert len(dots.get_xdata()) == count
            if stem == "forest":
                np.testing.assert_allclose(dots.get_xdata(), np.median(posterior.C[..., j], axis=(0, 1)))
            else:
                entries = squares.to_json()["particles"]
                np.testing.assert_allclose(dots.get_xdata(), [e[("C1", "C3", "C5")[j]]["value"] for e in entries])


@pytest.mark.parametrize(("count", "rows"), [(40, 40), (41, 41), (120, 120), (5000, 200)])
def test_many_particles_stand_in_order_without_labels(count, rows):
    rng = np.random.default_rng(0)
    centre = rng.lognormal(size=(count, 3))
    wide = centre * np.array([0.9, 1.1])[:, None, None]
    figure, _ = draw_forest([f"particle {i}" for i in range(count)], centre, wide, np.ones(3), np.ones((2, 3)))
    for j, ax in enumerate(panels(figure)):
        (dots,) = [one for one in ax.lines if one.get_marker() == "o"]
        (intervals,) = [c for c in ax.collections if isinstance(c, LineCollection)]
        assert len(dots.get_xdata()) == len(intervals.get_segments()) == rows
        if count > 40:
            x = dots.get_xdata()
            assert np.all(np.diff(x) >= 0)
            assert (x[0], x[-1]) == (centre[:, j].min(), centre[:, j].max())
    assert figure.get_size_inches()[1] < 9
    assert (f"particle {count - 1}" in texts(figure)) == (count <= 40)


def test_arrows_lead_from_each_particle_alone_to_its_posterior_mean(calibrated):
    posterior = calibrated("paper")[0]
    alone, together = shrinkage(posterior)
    for ax, (i, j) in zip(panels(plot_shrinkage(posterior)), ((0, 1), (2, 1), (0, 2)), strict=True):
        (arrows,) = [c for c in ax.collections if isinstance(c, Quiver)]
        np.testing.assert_allclose(arrows.get_offsets(), alone[:, [i, j]])
        np.testing.assert_allclose(arrows.U + alone[:, i], together[:, i])
    # All of one C3, as the paper has it: alone they scatter, together hardly.
    assert np.std(together[:, 1]) < np.std(alone[:, 1])


# ---- curves ----------------------------------------------------------------------------------------------------------


def test_grids_show_every_used_point(calibrated):
    posterior, squares = calibrated("paper")
    for plot, calibration in ((plot_bands, posterior), (plot_fits, squares)):
        strips = panels(plot(calibration))[1::2]
        tests = calibration.selection.tests
        for strip, row in zip(strips, spread_over(20, 12), strict=True):
            dots = [one for one in strip.lines if one.get_marker() == "."]
            assert sum(len(one.get_xdata()) for one in dots) == int(tests.mask[row].sum())
            forces = np.sort(np.concatenate([one.get_ydata() for one in dots]))
            rows = calibration.selection.rows[row]
            read = calibration.campaign.curves[calibration.selection.kept[row]].force_mN[rows]
            np.testing.assert_array_equal(forces, np.sort(read[np.asarray(tests.mask[row])[: len(rows)]]))


def test_the_band_holds_the_measured_points(calibrated):
    titles = [ax.get_title(loc="left") for ax in panels(plot_bands(calibrated("paper")[0]))[::2]]
    inside = [float(re.search(r"(\d+) % inside", title).group(1)) for title in titles]
    assert 92 < np.mean(inside) < 98


def test_new_particle(calibrated):
    posterior = calibrated("paper")[0]
    up, down = panels(plot_new_particle(posterior, (150.0, 140.0, 120.0)))
    loading, unloading = up.lines[-1], down.lines[-1]
    assert loading.get_xdata()[-1] == unloading.get_xdata()[0]
    assert np.all(np.diff(loading.get_xdata()) > 0)
    assert np.all(np.diff(unloading.get_xdata()) < 0)
    for bad in ((150.0, 140.0), (150.0, 140.0, 0.0)):
        with pytest.raises(ValueError, match="three positive diameters"):
            plot_new_particle(posterior, bad)


def test_whitened_residuals_are_standard(calibrated):
    squares = calibrated("paper")[1]
    figure = plot_whitened(squares)
    drawn = sum(len(ax.collections[0].get_offsets()) for ax in panels(figure)[:2])
    assert drawn == int(squares.selection.tests.mask.sum())
    (title,) = [t for t in texts(figure) if t.startswith("Residuals of 20 particles: rms ")]
    assert float(title.split()[-1]) == pytest.approx(1, abs=0.1)
    robust = dataclasses.replace(squares, loss="cauchy")
    assert any("cauchy loss" in t for t in texts(plot_whitened(robust)))


# ---- helpers ---------------------------------------------------------------------------------------------------------


def test_a_prior_that_piles_up_at_zero_is_no_level_line_where_it_is_enlarged():
    prior = nakagami.rvs(0.125, size=20_000, random_state=0)
    x, y = density(prior_near(prior, 0.01))
    assert y.argmax() == 0
    assert x[-1] <= 0.02
    assert np.interp(0.01, x, y) < 0.2
    assert prior_near(prior[:50], 0.01).max() > 0.02  # too few draws near by: all of them
