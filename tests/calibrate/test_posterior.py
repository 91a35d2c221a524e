"""The joint posterior of a simulated campaign against its truth, against the plain joint sampler, and as it is kept."""

import json

import equinox as eqx
import numpy as np
import pytest
from joint_cases import NOISE, Programme, flatness, simulated, true_coefficients

from mcc_jax import paper_campaign, predict_measured, predict_new_particle, sample
from mcc_jax.calibrate import compare_with_paper, sample_laws
from mcc_jax.calibrate.importance import ordered_resample, pareto_k, smoothed_weights


@pytest.fixture(scope="module")
def result(paper_posterior):
    return paper_posterior


@pytest.fixture(scope="module")
def content(result):
    return json.loads(json.dumps(result.to_json(), allow_nan=False))


def inside(draws, truth, share):
    low, high = np.quantile(draws, [(1 - share) / 2, (1 + share) / 2], axis=(0, 1))
    return (low <= truth) & (truth <= high)


# ---- the truth -------------------------------------------------------------------------------------------------------


def test_it_converges(result):
    assert result.converged, result.failures()
    assert result.divergences == 0


def test_what_all_particles_share_is_recovered(result):
    named = result.named_population()
    assert inside(named["a"], 1.43, 0.99)
    assert inside(named["effective_modulus_MPa"], 16_000.0, 0.99)
    assert inside(named["noise_factor"], 1.0, 0.99)
    log_C = np.log(true_coefficients(result.campaign))
    for j, name in enumerate(("C1", "C3", "C5")):
        # This campaign's own particles are what the population is inferred from.
        assert inside(named[f"mu_{name}"], log_C[:, j].mean(), 0.99)
    assert inside(named["tau_C1"], 0.2985, 0.99)
    assert inside(named["tau_C5"], 0.0797, 0.99)
    assert np.quantile(named["tau_C3"], 0.95) < 0.02  # the truth is zero


def test_particles_are_recovered(result):
    truth = true_coefficients(result.campaign)
    covered = inside(result.C, truth, 0.95)
    assert covered.mean() >= 0.9
    assert inside(result.C, truth, 0.9999).all()
    # The data are good: not by wide intervals.
    assert np.all(result.C.std((0, 1)) < 0.1 * truth)
    assert inside(result.zero_um, np.zeros(20), 0.95).mean() >= 0.8
    assert inside(result.shape_factor, 1 + 1.43 * flatness(result.campaign.diameters_um), 0.99).all()


def test_residuals_are_as_large_as_the_noise(result, content):
    assert np.all((result.rms_um() > 0.015) & (result.rms_um() < 0.06))
    low, high = content["noise"]["displacement_um"]["interval_95"]
    assert low < 0.02 < high
    low, high = content["noise"]["force_mN"]["interval_95"]
    assert 0.5 * low < 0.05 < 2 * high


# ---- what is written -------------------------------------------------------------------------------------------------


def test_json_keeps_the_contract(result, content):
    keys = "schema method mode converged runtime_s seed law a effective_modulus_MPa log_C1 log_C3 log_C5 noise priors"
    keys += " yield_stress_MPa probability_not_monotone particles warnings diagnostics"
    assert set(keys.split()) <= set(content)
    assert (content["schema"], content["method"], content["modulus_scatter"]) == (1, "bayes", None)
    assert content["law"] == {"unloading": "printed", "strain_scaling": "raw"}
    for found in (content["a"], content["effective_modulus_MPa"], content["log_C1"]["mean"], content["log_C5"]["sd"]):
        assert set(found) == {"value", "sd", "interval_95"}
        low, high = found["interval_95"]
        assert low < found["value"] < high
    assert [p["particle"] for p in content["particles"]] == [str(i + 1) for i in range(20)]
    names = {"eta_p", "C1", "C3", "C5", "zero_um", "rms_um", "noise_scale", "pareto_k"}
    for particle in content["particles"]:
        assert names <= set(particle)
        assert (particle["kept"], particle["why_not"]) == (True, None)
    diagnostics = content["diagnostics"]
    assert diagnostics["failures"] == []
    assert diagnostics["rhat_max"] == pytest.approx(max(result.rhat.values()))
    assert {"ess_bulk_min", "divergences", "pareto_k_max"} <= set(diagnostics)


def test_numbers_are_those_of_the_draws(result, content):
    a = np.asarray(result.population.a)
    assert content["a"]["value"] == pytest.approx(a.mean())
    assert content["a"]["sd"] == pytest.approx(a.std())
    np.testing.assert_allclose(content["a"]["interval_95"], np.quantile(a, [0.025, 0.975]))
    assert content["particles"][3]["C5"]["value"] == pytest.approx(result.C[:, :, 3, 2].mean())
    tau, mu = np.asarray(result.population.tau)[..., 0], np.asarray(result.population.mu)[..., 0]
    expected = np.exp(mu + tau**2 / 2).mean() / 17.16
    assert content["yield_stress_MPa"]["value"] == pytest.approx(expected)


def test_probability_not_monotone_is_that_of_draws_from_the_population(result):
    laws = sample_laws(result, 4000, seed=3)
    share = 1 - np.mean(np.asarray(eqx.filter_vmap(lambda law: law.is_monotone)(laws)))
    expected = result.probability_not_monotone().mean()
    assert share == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / 4000) + 0.002)


# ---- predictions -----------------------------------------------------------------------------------------------------


def test_measured_points_lie_in_the_predicted_band(result):
    shares = []
    for row, name in enumerate(result.particles[:4]):
        curves = predict_measured(result, name, count=200)
        low, high = curves.band(0.95, observed=True)
        mask = np.asarray(result.selection.tests.mask[row])[: len(low)]
        measured = np.asarray(result.selection.tests.displacement[row])[: len(low)]
        shares.append(np.mean((low <= measured)[mask] & (measured <= high)[mask]))
    assert 0.9 < np.mean(shares) < 0.99


def test_a_particle_never_measured_is_predicted_with_the_scatter_of_the_population(result):
    force = np.concatenate([np.linspace(0, 200, 40), np.linspace(200, 0, 20)])
    curves = predict_new_particle(result, (200.0, 200.0, 160.0), force, count=400, seed=1)
    assert curves.displacement_um.shape == (400, 60)
    low, high = curves.band(0.95)
    assert np.all(low <= high)
    assert curves.observed_um is None
    # tau of log C1 is 0.3, so the spread of displacement is tens of percent.
    assert 0.1 < (high[30] - low[30]) / np.median(curves.displacement_um[:, 30]) < 1.5
    with pytest.raises(ValueError, match="positive diameters"):
        predict_new_particle(result, (200.0, 0.0, 160.0), force)
    with pytest.raises(ValueError, match="without noise"):
        curves.band(0.95, observed=True)
    with pytest.raises(ValueError, match="99"):
        predict_measured(result, "99")


def test_the_paper_s_table_stands_beside_ours(result):
    rows = {row["quantity"]: row for row in compare_with_paper(result)}
    assert rows["a"]["paper"] == 1.43
    assert rows["effective_modulus_MPa"]["paper"] == 16_000.0
    assert rows["mu_C1"]["paper"] == 1.9027
    assert rows["a"]["value"] == pytest.approx(1.43, abs=0.02)


# ---- ArviZ -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tree(result):
    return result.to_arviz()


def test_groups_dimensions_and_units(tree):
    groups = "posterior log_likelihood sample_stats prior prior_predictive posterior_predictive"
    assert set(f"{groups} observed_data constant_data".split()) <= set(tree.children)
    for group, name, dims in (
        ("posterior", "C", ("chain", "draw", "particle", "coefficient")),
        ("posterior", "mu", ("chain", "draw", "coefficient")),
        ("posterior", "zero_um", ("chain", "draw", "particle")),
        ("log_likelihood", "test", ("chain", "draw", "particle")),
        ("observed_data", "displacement_um", ("particle", "point")),
        ("posterior_predictive", "displacement_um", ("chain", "draw", "particle", "point")),
    ):
        assert tree[group][name].dims == dims
    assert list(tree["posterior"]["coefficient"].values) == ["C1", "C3", "C5"]
    assert list(tree["posterior"]["particle"].values) == [str(i + 1) for i in range(20)]
    for group, dataset in tree.children.items():
        for name, variable in dataset.data_vars.items():
            assert "units" in variable.attrs, f"{group}/{name} has no unit"
    assert tree["posterior"]["effective_modulus_MPa"].attrs["units"] == "MPa"


def test_padded_points_are_nan_and_no_others(result, tree):
    mask = np.asarray(result.selection.tests.mask)
    for group in ("observed_data", "posterior_predictive", "prior_predictive"):
        values = tree[group]["displacement_um"].values
        np.testing.assert_array_equal(np.isfinite(values), np.broadcast_to(mask, values.shape), err_msg=group)
    assert np.all(np.isfinite(tree["posterior"]["C"].values))
    assert np.all(np.isfinite(tree["log_likelihood"]["test"].values))


def test_the_file_comes_back_as_it_was_and_twice_the_same(result, tree, tmp_path):
    import xarray

    one, two = tmp_path / "one.nc", tmp_path / "two.nc"
    tree.to_netcdf(one, engine="h5netcdf")
    result.to_arviz().to_netcdf(two, engine="h5netcdf")
    assert one.read_bytes() == two.read_bytes()
    with xarray.open_datatree(one, engine="h5netcdf") as back:
        assert set(tree.children) <= set(back.children)
        for group in tree.children:
            for name, variable in tree[group].data_vars.items():
                np.testing.assert_array_equal(back[group][name].values, variable.values)
                assert back[group][name].attrs == variable.attrs
        assert back.attrs["seed"] == 0
        assert back.attrs["method"] == "bayes"


# ---- against the plain joint sampler, and the gate -------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    return simulated(instrument=NOISE, programme=Programme.cycles(points=60))


@pytest.fixture(scope="module")
def both(small):
    return [sample(small, mode=mode) for mode in ("fast", "joint")]


def gap(one, two):
    """Differences of mean and of log sd of two sets of draws, in sds, and the standard errors of these."""
    from arviz_stats.base import array_stats

    sd = two.std()
    axes = {"chain_axis": 0, "draw_axis": 1}
    error = [float(array_stats.mcse(d, method="mean", **axes)) / sd for d in (one, two)]
    of_sd = [float(array_stats.mcse(d, method="sd", **axes)) / sd for d in (one, two)]
    away, wider = abs(one.mean() - two.mean()) / sd, abs(np.log(one.std() / sd))
    return away, wider, float(np.hypot(*error)), float(np.hypot(*of_sd))


@pytest.mark.extended
def test_the_fast_mode_gives_the_joint_posterior(both):
    fast, joint = both
    pairs = [(name, fast.named_population()[name], draws) for name, draws in joint.named_population().items()]
    for row, particle in enumerate(joint.particles):
        pairs.append((f"zero of {particle}", fast.zero_um[:, :, row], joint.zero_um[:, :, row]))
        for j in range(3):
            pairs.append((f"C of {particle}, {j}", fast.C[:, :, row, j], joint.C[:, :, row, j]))
            # What the curve itself says, without the uncertainty of the shape factor in front.
            b = [np.log(r.C[:, :, row, j] * r.shape_factor[:, :, row]) for r in both]
            pairs.append((f"b of {particle}, {j}", *b))
    for name, one, two in pairs:
        mean, width, error, error_of_sd = gap(one, two)
        assert mean < 0.15 + 3 * error, (name, mean, error)
        assert width < 0.15 + 3 * error_of_sd, (name, width, error_of_sd)


@pytest.mark.extended
def test_too_few_draws_are_not_called_converged():
    short = sample(paper_campaign(0), draws=20, warmup=20)
    assert not short.converged
    content = json.loads(json.dumps(short.to_json(), allow_nan=False))
    assert content["converged"] is False
    told = " ".join(content["diagnostics"]["failures"])
    assert "ESS" in told
    assert "draw longer" in told
    assert "--draws" in told
    assert set(content["diagnostics"]["failures"]) <= set(content["warnings"])


# ---- weights ---------------------------------------------------------------------------------------------------------


def test_resampling_keeps_the_order_and_the_shares():
    rng = np.random.default_rng(0)
    weight = rng.gamma(0.5, size=200)
    chosen = ordered_resample(weight, 1000)
    assert np.all(np.diff(chosen) >= 0)
    expected = 1000 * weight / weight.sum()
    assert np.all(np.abs(np.bincount(chosen, minlength=200) - expected) <= 1)


@pytest.mark.parametrize("weight", [np.zeros(10), np.eye(10)[3], np.eye(10)[9], np.full(10, 1e-300)])
def test_resampling_by_extreme_weights(weight):
    chosen = ordered_resample(weight, 10)
    assert chosen.shape == (10,)
    assert np.all((chosen >= 0) & (chosen < 10))
    if np.count_nonzero(weight) == 1:
        assert np.all(chosen == np.argmax(weight))


def test_weights_turn_draws_of_one_distribution_into_those_of_another():
    """N(0, 1) weighted into N(1, 1): the mean tells a weight from its reciprocal."""
    x = np.random.default_rng(2).standard_normal(20_000)
    weight, k = smoothed_weights(x - 0.5)
    assert weight.sum() == pytest.approx(1)
    assert k < 0.7
    assert (weight * x).sum() == pytest.approx(1.0, abs=0.1)
    chosen = ordered_resample(weight, 20_000)
    assert x[chosen].mean() == pytest.approx(1.0, abs=0.1)
    assert x[chosen].std() == pytest.approx(1.0, abs=0.1)


def test_pareto_k_is_the_index_of_the_upper_tail():
    rng = np.random.default_rng(1)
    exponential = rng.standard_exponential((4000, 2))
    # The exponential of k times an exponential variable is Pareto distributed with index k.
    np.testing.assert_allclose(pareto_k(exponential * np.array([1.2, 0.3])), [1.2, 0.3], atol=0.3)
    # A lower tail, weights that nearly vanish, does no harm.
    assert pareto_k(-1.5 * exponential)[0] < 0.3
    # Where a quarter of the draws have all weight, or one has, there is no tail to fit, and no answer to believe.
    log_weight = rng.normal(size=(4000, 3))
    log_weight[:, 1] = np.where(np.arange(4000) < 1000, 0.0, -5.0)
    log_weight[:, 2] = np.where(np.arange(4000) == 7, 0.0, -np.inf)
    k = pareto_k(log_weight)
    assert k[0] < 0.7
    assert np.isinf(k[1:]).all()
    # Where all are equal there is none either, and no doubt.
    assert pareto_k(np.zeros((400, 1))) == [0.0]
    np.testing.assert_allclose(smoothed_weights(np.zeros(400))[0], 1 / 400)


def test_a_draw_that_is_impossible_gets_no_weight_and_does_no_other_harm():
    rng = np.random.default_rng(1)
    log_weight = 0.1 * rng.standard_normal(4000)
    before = pareto_k(log_weight[:, None])[0]
    log_weight[7] = -np.inf
    assert pareto_k(log_weight[:, None])[0] == pytest.approx(before, abs=0.1)
    weight, k = smoothed_weights(log_weight)
    assert k < 0.5
    assert np.all(np.isfinite(weight))
    assert weight.sum() == pytest.approx(1)
    assert weight[7] < 1e-12
