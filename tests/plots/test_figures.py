"""What the figures show is what the calibration holds, for campaigns of every kind."""

import dataclasses
import re
from pathlib import Path

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib._pylab_helpers import Gcf
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.image import imread
from reading_figures import check_layout, check_words, panels, texts

from mcc_jax import plots
from mcc_jax.calibrate.paper_steps import ElasticFit
from mcc_jax.campaign import Metadata
from mcc_jax.plots import (
    paper_figures,
    plot_collapse,
    plot_curves,
    plot_dimensions,
    plot_elastic,
    plot_law,
    plot_master,
    plot_particles,
    plot_residuals,
    save_figures,
)
from mcc_jax.plots.paper import adjusted_curve, law_strain, stretches_outside

KINDS = ["paper", "cycles", "two", "dropped"]


def line(ax, label):
    (found,) = [one for one in ax.lines if one.get_label() == label]
    return found


def band(ax, label):
    (found,) = [c for c in ax.collections if isinstance(c, FillBetweenPolyCollection) and c.get_label() == label]
    return found.get_paths()[0].vertices


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture
def calibration(calibrated, kind):
    return calibrated(kind)


@pytest.fixture(scope="module")
def saved(calibrated, kind, tmp_path_factory):
    """All figures of a calibration, drawn, and their files."""
    settings = dict(mpl.rcParams)
    figures = paper_figures(calibrated(kind))
    files = save_figures(figures, tmp_path_factory.mktemp(kind), dpi=100)
    assert dict(mpl.rcParams) == settings
    return figures, files


@pytest.fixture
def paper(calibrated):
    return calibrated("paper")


# ---- all figures -----------------------------------------------------------------------------------------------------


def test_every_figure_is_written_as_png(saved):
    figures, files = saved
    assert set(figures) == {"curves", "dimensions", "collapse", "master", "law", "particles", "elastic", "residuals"}
    assert [f.name for f in files] == [f"{stem}.png" for stem in figures]
    assert sorted(files[0].parent.iterdir()) == sorted(files)
    for file, figure in zip(files, figures.values(), strict=True):
        pixels = imread(file)
        width, height = figure.get_size_inches()
        assert pixels.shape[:2] == pytest.approx((height * 100, width * 100), abs=1)
        assert pixels[..., :3].std() > 0.02  # something is drawn
        assert 5000 < file.stat().st_size < 1_000_000
    check_words(figures)


@pytest.mark.extended
def test_nothing_is_clipped_and_no_panels_overlap(saved):
    check_layout(saved[0], ticks=False)


def test_nothing_is_left_with_pyplot(saved):
    assert not Gcf.figs
    for file in Path(plots.__file__).parent.glob("*.py"):
        assert not re.search(r"^\s*(import|from)\b.*pyplot", file.read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.extended
def test_a_measured_campaign_is_not_called_simulated_and_says_nothing_of_cellulose(paper):
    measured = dataclasses.replace(paper.campaign, metadata=Metadata(provenance="tester file x.tri"))
    for figure in paper_figures(dataclasses.replace(paper, campaign=measured)).values():
        assert not any("simulated" in t or "cellulose" in t.lower() or "MCC" in t for t in texts(figure))


# ---- curves ----------------------------------------------------------------------------------------------------------


def test_curves_span_the_shape_factors(paper):
    figure = plot_curves(paper)
    whole, toe = panels(figure)
    labels = [t.get_text() for t in whole.get_legend().get_texts()]
    eta = 1 + paper.a * paper.table.flatness
    low, high = paper.campaign.particles[np.argmin(eta)], paper.campaign.particles[np.argmax(eta)]
    assert labels[0].startswith(f"particle {low} ")
    assert labels[2].startswith(f"particle {high} ")
    assert labels[3:] == ["as measured", "adjusted"]
    assert len(whole.lines) == len(toe.lines) - 1 == 3 * 2 + 1  # the threshold, and in `toe` the strain there


@pytest.mark.extended
def test_adjusted_curves_meet_at_the_threshold(calibrated):
    r = calibrated("dropped")
    for i in np.flatnonzero(r.adjustment.kept):
        strain, stress = adjusted_curve(r, int(i))
        assert (strain[0], stress[0]) == (0, 0)
        assert (strain[1], stress[1]) == (r.adjustment.strain, r.adjustment.threshold_MPa)
        assert stress[2] > r.adjustment.threshold_MPa
        rest = r.particles[i].measured_um[-len(strain) + 2 :]
        diameters = r.campaign.diameters_um[i]
        np.testing.assert_allclose(strain[2:] * diameters[0] * diameters[1] / diameters[2], rest, rtol=1e-12)


# ---- dimensions ------------------------------------------------------------------------------------------------------


def test_dimensions_say_what_the_table_gives(paper):
    figure = plot_dimensions(paper.campaign)
    (ax,) = panels(figure)
    average, effective = ax.collections[0].get_offsets().T
    np.testing.assert_allclose(average, paper.campaign.diameters_um.mean(axis=1))
    for ratio, mean, sd in ((average / effective, 0.77864, 0.1164), (effective / average, 1.31315, 0.2064)):
        np.testing.assert_allclose((ratio.mean(), ratio.std(ddof=1)), (mean, sd), atol=6e-5)
    shown = "\n".join(texts(figure))
    assert "mean of $D_e$/average: 1.31 ± 0.21" in shown
    assert "mean of average/$D_e$: 0.78 ± 0.12" in shown
    assert "$D_e$ = 1.256 × average" in shown
    assert "correlation: 0.89" in shown
    x, y = line(ax, "1:1").get_data()
    np.testing.assert_array_equal(x, y)


def test_dimensions_of_one_particle_claim_no_spread(paper):
    one = paper.campaign.select(np.arange(20) == 3)
    shown = "\n".join(texts(plot_dimensions(one)))
    assert "±" not in shown
    assert "correlation" not in shown
    assert "nan" not in shown


# ---- collapse, master curve, law -------------------------------------------------------------------------------------


def test_collapse_draws_every_curve_before_and_after_scaling(calibration):
    before, after = panels(plot_collapse(calibration))
    eta = calibration.table.shape_factor(calibration.a)
    for row, i in enumerate(calibration.table.index):
        curve = calibration.adjustment.curves[i]
        np.testing.assert_array_equal(before.lines[row].get_xdata(), curve.strain)
        np.testing.assert_array_equal(after.lines[row].get_xdata(), eta[row] * curve.strain)
    assert len(before.lines) == len(after.lines) == len(eta) + 1
    assert before.get_legend().get_title().get_text() == f"objective {calibration.shape.objective_at_zero:.4g}"
    assert after.get_legend().get_title().get_text() == f"objective {calibration.shape.objective:.4g}"


def test_collapse_shows_the_objective_in_use(paper):
    r = dataclasses.replace(paper, objective="reference")
    assert r.shape_reference.objective != paper.shape.objective
    assert f"objective {r.shape_reference.objective:.4g}" in texts(plot_collapse(r))


def test_master_curve(calibration):
    upper, lower = panels(plot_master(calibration))
    master = calibration.master
    x, y = line(upper, "mean").get_data()
    np.testing.assert_array_equal((x, y), (master.stress_MPa, master.mean))
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), master.count)
    known = np.isfinite(master.sd)
    edge = band(upper, "mean ± 1 sd")
    assert edge[:, 1].max() == pytest.approx((master.mean + master.sd)[known].max(), rel=1e-12)
    assert edge[:, 1].min() == pytest.approx((master.mean - master.sd)[known].min(), abs=1e-12)
    assert len(upper.lines) == len(calibration.table.index) + 1


def test_law(calibration):
    (ax,) = panels(plot_law(calibration))
    master, population = calibration.master, calibration.plastic.population
    x, y = line(ax, "mean law").get_data()
    K1, K3, K5 = calibration.plastic.polynomial
    np.testing.assert_allclose(y, np.maximum(K1 * x - K3 * x**3 + K5 * x**5, 0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        line(ax, "± 1 sd of stress").get_ydata() - y, population.stress_sd(jnp.asarray(x)), atol=1e-12
    )
    np.testing.assert_allclose(line(ax, "first term only").get_ydata(), K1 * x)
    np.testing.assert_array_equal(line(ax, "sample mean").get_data(), (master.mean, master.stress_MPa))
    assert len(band(ax, "sample mean ± 1 sd of strain")) > 10
    (beyond,) = [p for p in ax.patches if p.get_label() == "beyond the tests"]
    tested = max(
        eta * calibration.table.strain[row].max()
        for row, eta in enumerate(calibration.table.shape_factor(calibration.a))
    )
    assert beyond.get_x() == pytest.approx(tested)


def test_law_says_where_it_leaves_the_data(paper):
    assert stretches_outside(paper) == []
    shifted = dataclasses.replace(
        paper, master=dataclasses.replace(paper.master, mean=law_strain(paper) + 2 * paper.master.sd)
    )
    ((first, last),) = stretches_outside(shifted)
    stress = paper.master.stress_MPa
    assert stress[first - 1] <= paper.adjustment.threshold_MPa < stress[first]
    assert last == len(stress) - 1
    figure = plot_law(shifted)
    assert any(
        f"more than 1 sd off the sample at {stress[first]:.2g} to {stress[last]:.2g} MPa" in t for t in texts(figure)
    )
    assert set(line(panels(figure)[0], "law off by > 1 sd").get_ydata()) <= set(stress[first:])


# ---- particles -------------------------------------------------------------------------------------------------------


@pytest.mark.extended
def test_pages(paper, monkeypatch):
    monkeypatch.setattr("mcc_jax.plots.curves.PAGE", 12)
    assert {"particles", "particles_2"} <= set(paper_figures(paper))
    second = plot_particles(paper, 2)
    assert len(panels(second)) == 8
    assert second.get_suptitle() == "Measured and predicted, page 2 of 2"
    assert any(t.startswith("particle 13\n") for t in texts(second))
    for page in (0, 3):
        with pytest.raises(ValueError, match=f"no page {page}; there are 2"):
            plot_particles(paper, page)


def test_panels_show_measured_and_predicted(paper):
    for i, ax in enumerate(panels(plot_particles(paper))):
        curve = paper.curves[i]
        left_out, *dots, mean, own = ax.lines
        force, used = curve.force_mN, curve.used
        np.testing.assert_array_equal(left_out.get_xdata(), curve.displacement_um[~used])
        shown = np.concatenate([one.get_xdata() for one in dots])
        assert set(shown) <= set(curve.displacement_um[used])
        assert len(shown) > 40
        np.testing.assert_array_equal(mean.get_data(), (curve.typical_um, force))
        np.testing.assert_array_equal(own.get_data(), (np.where(used, curve.own_um, np.nan), force))
        rms = paper.particles[i].rms_um
        assert ax.get_title(loc="left") == (
            f"particle {i + 1}\n$\\eta_p$ = {1 + paper.a * paper.table.flatness[i]:.2f}, rms {rms:.2g} µm"
        )


@pytest.mark.extended
def test_particles_that_were_not_kept_show_the_reason(calibrated):
    r = calibrated("dropped")
    shown = panels(plot_particles(r))
    assert [len(ax.lines) > 3 for ax in shown] == r.adjustment.kept.tolist()
    for ax, curve, reason in zip(shown, r.curves, r.adjustment.why_not, strict=True):
        if reason is not None:
            np.testing.assert_array_equal(ax.lines[0].get_xdata(), curve.displacement_um)
            assert ax.texts[0].get_text().replace("\n", " ") == reason
            assert ax.get_title(loc="left").endswith("not used")


@pytest.mark.extended
def test_a_law_that_misses_the_data_is_said_so(calibrated):
    r = calibrated("two")
    assert not any("misses" in t for t in texts(plot_particles(r)))
    off = (dict.fromkeys(("predicted_um", "own_um"), p.measured_um + 50.0) for p in r.particles)
    bad = tuple(dataclasses.replace(p, **away) for p, away in zip(r.particles, off, strict=True))
    bad = dataclasses.replace(r, particles=bad)
    (warning,) = [w for w in bad.warnings() if "misses" in w]
    figure = plot_particles(bad)
    assert warning[1:] in figure.get_suptitle().replace("\n", " ")
    figure.draw_without_rendering()
    check_layout({"particles": figure}, ticks=False)


# ---- elastic branches, residuals -------------------------------------------------------------------------------------


def test_elastic_branches_collapse(calibration):
    left, right = panels(plot_elastic(calibration))
    fit = calibration.elastic
    assert len(left.lines) == len(fit.branches) + 2
    ratios = (b.stress_MPa / b.stress_max_MPa for b in fit.branches)
    curve = line(left, "law, $f(s)$")
    off = np.concatenate(
        [s - np.interp(-r, -curve.get_ydata(), curve.get_xdata()) for s, r in zip(fit.recovered, ratios, strict=True)]
    )
    assert np.sqrt(np.mean(off**2)) < 0.03  # the noise of the read-out over a few um of recovery
    np.testing.assert_allclose(right.collections[0].get_offsets()[:, 1], fit.per_branch_MPa / 1e3)
    assert right.lines[0].get_ydata()[0] == pytest.approx(fit.effective_modulus_MPa / 1e3)


def test_a_wide_spread_of_moduli_is_drawn_on_a_logarithmic_axis(paper):
    wide = paper.elastic.per_branch_MPa * np.geomspace(0.01, 100, 20)
    wide[3] = np.nan
    figure = plot_elastic(dataclasses.replace(paper, elastic=dataclasses.replace(paper.elastic, per_branch_MPa=wide)))
    assert panels(figure)[1].get_yscale() == "log"
    assert "1 branches give no modulus alone" not in texts(figure)
    assert "1 branch gives no modulus alone" in texts(figure)
    figure.draw_without_rendering()


def test_residuals(calibration):
    mean, own = panels(plot_residuals(calibration))
    kept = [i for i, p in enumerate(calibration.particles) if p is not None]
    for ax, name in ((mean, "predicted_um"), (own, "own_um")):
        assert len(ax.lines) == len(kept) + 1
        for one, i in zip(ax.lines, kept, strict=False):
            fit = calibration.particles[i]
            expected = np.where(fit.used, fit.measured_um - getattr(fit, name), np.nan)
            np.testing.assert_array_equal(one.get_ydata(), expected)
            np.testing.assert_array_equal(one.get_xdata(), calibration.campaign.curves[i].force_mN)
        (noise,) = ax.patches
        assert noise.get_height() == pytest.approx(2 * calibration.displacement_noise_um)


def test_what_is_missing_is_said(paper):
    """No unloading, no offset step, no shape parameter, a single shape."""
    elastic = ElasticFit(None, np.nan, np.empty(0), (), (), "no unloading branch was measured")
    r = dataclasses.replace(
        paper,
        elastic=elastic,
        adjustment=dataclasses.replace(paper.adjustment, threshold_MPa=0.0, strain=0.0),
        shape=dataclasses.replace(paper.shape, reason="for no reason"),
        campaign=dataclasses.replace(paper.campaign, diameters_um=np.full((20, 3), 150.0)),
        table=dataclasses.replace(paper.table, flatness=np.zeros(20)),
    )
    figures = paper_figures(r)
    for stem in ("curves", "dimensions", "collapse", "elastic"):
        figures[stem].draw_without_rendering()
    assert texts(figures["elastic"]).count(elastic.reason) == 2
    assert "adjusted" not in texts(figures["curves"])
    assert "The fit of a did not succeed: for no reason" in texts(figures["collapse"])
