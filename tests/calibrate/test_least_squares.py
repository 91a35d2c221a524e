"""Joint least squares: what it recovers, what it calls open, and SciPy on the same residuals."""

import json

import faulty
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from joint_cases import eight_particles, true_coefficients
from scipy.optimize import least_squares as scipy_least_squares

from mcc_jax import least_squares
from mcc_jax.calibrate.pooled_fit import Parameters, minimise, pooled_residual, robust


@pytest.fixture(scope="module")
def result():
    return least_squares(eight_particles())


@pytest.fixture(scope="module")
def content(result):
    return json.loads(json.dumps(result.to_json(), allow_nan=False))


@pytest.mark.extended
def test_the_truth_is_within_four_standard_deviations(result, content):
    assert content["converged"], content["reason"]
    truth = {"a": 1.43, "effective_modulus_MPa": 16_000.0}
    for name, value in truth.items():
        found = content[name]
        assert abs(found["value"] - value) < 4 * found["sd"], found
        assert found["sd"] < 0.02 * value
    off = []
    for particle, C in zip(content["particles"], true_coefficients(result.campaign), strict=True):
        off += [(particle[f"C{j}"]["value"] - c) / particle[f"C{j}"]["sd"] for j, c in zip((1, 3, 5), C, strict=True)]
        assert abs(particle["zero_um"]["value"]) < 5 * particle["zero_um"]["sd"]
    off = np.abs(off)
    assert np.mean(off < 2) > 0.85
    assert off.max() < 5
    for j, name in enumerate(("C1", "C3", "C5")):
        mean = content[f"log_{name}"]["mean"]
        expected = np.log(true_coefficients(result.campaign)[:, j]).mean()
        assert abs(mean["value"] - expected) < 4 * mean["sd"]


def test_the_spread_of_well_known_coefficients_is_as_uncertain_as_that_of_normal_numbers(content):
    """Each log C1 is known to a percent, their spread to tau/sqrt(2 (N - 1))."""
    spread, count = content["log_C1"]["sd"], len(content["particles"])
    assert spread["sd"] == pytest.approx(spread["value"] / np.sqrt(2 * (count - 1)), rel=0.15)


def test_residuals_are_as_large_as_the_noise(result, content):
    assert 0.8 < content["diagnostics"]["chi2_per_dof"] < 1.2
    rms = np.array([p["rms_um"] for p in content["particles"]])
    assert np.all((rms > 0.015) & (rms < 0.06))
    np.testing.assert_allclose(content["noise"]["displacement_um"]["value"], 0.02, rtol=0.2)
    np.testing.assert_allclose(content["noise"]["force_mN"]["value"], 0.05, rtol=0.5)


@pytest.mark.extended
def test_nothing_is_open_and_all_starts_agree(content):
    assert content["diagnostics"]["open_combinations"] == []
    agree, count = content["diagnostics"]["agreeing_starts"]
    assert agree == count >= 3
    assert content["method"] == "least-squares"


def dense(result):
    """The pooled residuals as a function of one vector."""
    weight = jnp.ones(len(result.selection.tests))
    residual = pooled_residual(result.settings, result.selection.tests, weight)
    count, own = np.asarray(result.solution.value.local).shape

    @jax.jit
    def flat(x):
        parts = residual(Parameters(x[: count * own].reshape(count, own), x[count * own :]))
        return jnp.concatenate([part.ravel() for part in parts])

    x = np.concatenate([np.ravel(result.solution.value.local), np.asarray(result.solution.value.shared)])
    return flat, x, (count, own)


@pytest.fixture(scope="module")
def by_scipy(result):
    flat, x, sizes = dense(result)
    jacobian = jax.jit(jax.jacfwd(flat))
    rng = np.random.default_rng(0)
    start, tolerances = x + 0.02 * rng.standard_normal(len(x)), {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-12}

    def at(function):
        return lambda v: np.asarray(function(jnp.asarray(v)))

    found = scipy_least_squares(at(flat), start, at(jacobian), x_scale="jac", max_nfev=500, **tolerances)
    return found, x, sizes


@pytest.mark.extended
def test_the_optimum_is_scipy_s(result, by_scipy):
    found, x, _ = by_scipy
    np.testing.assert_allclose(float(result.solution.loss), found.cost, rtol=1e-6)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    assert np.all(np.abs(x - found.x) < 0.02 * np.sqrt(np.diag(covariance)))


@pytest.mark.extended
def test_the_covariance_is_that_of_scipy_s_jacobian(result, by_scipy):
    found, _, (count, own) = by_scipy
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    blocks = result.solution.normal.covariance()
    scale = np.sqrt(np.diag(covariance))
    for n in range(count):
        rows = slice(n * own, (n + 1) * own)
        size = scale[rows, None] * scale[rows]
        np.testing.assert_allclose(np.asarray(blocks[0][n]) / size, covariance[rows, rows] / size, atol=2e-3)
    shared = slice(count * own, None)
    size = scale[shared, None] * scale[shared]
    np.testing.assert_allclose(np.asarray(blocks[2]) / size, covariance[shared, shared] / size, atol=2e-3)
    sd = result.to_json()["a"]["sd"]
    np.testing.assert_allclose(sd, scale[count * own], rtol=1e-3)


@pytest.mark.extended
@pytest.mark.parametrize("max_steps", [100, 2])
def test_a_parameter_without_data_stays_where_it_is(max_steps):
    """Decays of their own height and level, with a rate and a drift that all share; and two steps are not enough."""
    time, rng = np.linspace(0.0, 2.0, 12), np.random.default_rng(5)
    local = 1 + rng.random((4, 2))
    decays = local[:, :1] * np.exp(-1.3 * time) + local[:, 1:] + 0.2 * time**2 + 0.05 * rng.standard_normal((4, 12))

    def residual(y):
        model = y.local[:, :1] * jnp.exp(-y.shared[0] * time)[None] + y.local[:, 1:2] + (y.shared[1] * time**2)[None]
        return (decays - model,)

    start = Parameters(jnp.ones((4, 3)).at[:, 2].set(7.0), jnp.asarray([0.5, 0.0, -3.0]))
    found = jax.jit(lambda y: minimise(residual, y, max_steps=max_steps))(start)
    assert bool(found.converged) is (max_steps > 2)
    np.testing.assert_array_equal(found.value.local[:, 2], 7.0)
    assert float(found.value.shared[2]) == -3.0
    for block in found.normal.covariance():
        assert np.all(np.isfinite(np.asarray(block)))


@pytest.fixture(scope="module")
def with_outliers():
    rng = np.random.default_rng(5)

    def displaced(time, force, path):
        # Four at a time: one or two far readings are spikes, which never reach the fit.
        groups = -(-len(path) // 4)
        away = np.where(rng.random(groups) < 0.05, 5.0 * rng.choice([-1.0, 1.0], groups), 0.0)
        return time, force, path + np.repeat(away, 4)[: len(path)]

    return faulty.changed(eight_particles(), displaced)


@pytest.mark.extended
@pytest.mark.parametrize("loss", ["soft_l1", "cauchy"])
def test_a_robust_loss_resists_outliers(with_outliers, loss):
    found = least_squares(with_outliers, loss=loss)
    linear = least_squares(with_outliers)
    content = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert content["loss"] == loss
    truth = np.log(true_coefficients(with_outliers))

    def error(result):
        return np.abs(
            np.log([[p[f"C{j}"]["value"] for j in (1, 3, 5)] for p in result.to_json()["particles"]]) - truth
        ).max()

    assert abs(content["a"]["value"] - 1.43) < 0.05
    assert error(found) < 0.05
    assert error(linear) > 2 * error(found)


@pytest.mark.parametrize("loss", ["linear", "soft_l1", "cauchy"])
def test_robust_residuals_are_the_losses_in_words(loss):
    r = np.concatenate([-np.geomspace(1e-9, 1e6, 40), [0.0], np.geomspace(1e-9, 1e6, 40)])
    expected = {
        "linear": r**2,
        "soft_l1": 2 * r**2 / (np.sqrt(1 + r**2) + 1),
        "cauchy": np.log1p(r**2),
    }[loss]
    actual = np.asarray(robust(loss, jnp.asarray(r)))
    np.testing.assert_allclose(actual**2, expected, rtol=1e-10)
    np.testing.assert_array_equal(np.sign(actual), np.sign(r))
    slope = np.asarray(jax.vmap(jax.grad(lambda x: robust(loss, x)))(jnp.asarray(r)))
    assert np.all(np.isfinite(slope))
    assert np.all(slope > -1e-12)
    assert slope[40] == 1.0
