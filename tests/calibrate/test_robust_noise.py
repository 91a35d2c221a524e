"""Robust noise: spikes neither move nor widen the answer, and clean data lose little."""

import faulty
import jax
import numpy as np
import numpyro
import pytest
from joint_cases import eight_particles
from numpyro.infer.util import log_density

from mcc_jax import InputError, Model, compare, least_squares, sample
from mcc_jax.calibrate import select_tests
from mcc_jax.calibrate.noise import standard_promotion, student_weights

SPIKED, SPIKE_UM = 0.05, 0.5


@pytest.fixture(scope="module")
def clean():
    return eight_particles()


@pytest.fixture(scope="module")
def spiked(clean):
    """The same with spikes in one reading of twenty."""
    rng = np.random.default_rng(1)

    def spoiled(time, force, path):
        hit = rng.random(len(path)) < SPIKED
        return time, force, path + np.where(hit, SPIKE_UM * rng.standard_normal(len(path)), 0.0)

    return faulty.changed(clean, spoiled)


def modulus(result):
    found = result.to_json()["effective_modulus_MPa"]
    return found["value"], found["sd"]


@pytest.mark.extended
@pytest.mark.parametrize("calibrate", [least_squares, sample])
def test_spikes_count_for_little(clean, spiked, calibrate):
    without, plain, robust = (
        modulus(calibrate(campaign, Model(robust=weigh), without_flagged=False))
        for campaign, weigh in ((clean, False), (spiked, False), (spiked, True))
    )
    assert robust[1] < 1.3 * without[1] < 0.5 * plain[1]
    assert abs(robust[0] - without[0]) < 1.5 * without[1]
    assert abs(robust[0] - 16_000) < 3 * robust[1]


@pytest.mark.extended
@pytest.mark.parametrize("freedom", [3, 10, 1000])
def test_weights_say_what_a_mean_is_known_by(freedom):
    """The weighted mean of Student numbers scatters as the corrected weights say."""
    rng = np.random.default_rng(0)
    claimed, means = [], []
    for _ in range(300):
        draws, scale, mean = rng.standard_t(freedom, 200), 1.0, 0.0
        for _ in range(60):
            weight, overstated = student_weights(((draws - mean) / scale)[None] ** 2, np.ones((1, 200), bool))
            mean = np.average(draws, weights=weight[0])
            scale = np.sqrt(np.mean(weight[0] * (draws - mean) ** 2))
        means.append(mean)
        claimed.append(scale**2 * overstated / weight.sum())
    assert np.mean(claimed) == pytest.approx(np.var(means), rel=0.25)


@pytest.mark.extended
def test_explicit_model_samples_the_weights(clean):
    """Without a fit the weight of every reading is a number of the model."""
    tests = select_tests(clean)
    with standard_promotion(), numpyro.handlers.seed(rng_seed=0):
        trace = numpyro.handlers.trace(Model(robust=True)).get_trace(tests)
    values = {name: site["value"] for name, site in trace.items() if site["type"] == "sample"}
    assert values["reading_weight"].shape == tests.mask.shape
    with standard_promotion():
        density = jax.jit(lambda v: log_density(Model(robust=True), (tests,), {}, v)[0])(values)
    assert np.isfinite(density)


def test_what_cannot_be_is_refused(clean):
    with pytest.raises(InputError, match="exclude each other"):
        least_squares(clean, Model(robust=True), loss="cauchy")
    with pytest.raises(InputError, match="robust=False"):
        compare(clean, [Model(), Model(robust=True)])
