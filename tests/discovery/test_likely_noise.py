"""Noise that wanders in time is taken for what it is, and no particle for noisier than it is."""

import numpy as np
import pytest
from campaigns import base_of, cached, with_curves

from mcc_jax.calibrate.noise import Along, Correlation
from mcc_jax.discovery.likely_noise import with_likely_noise

pytestmark = pytest.mark.extended

WANDER_UM, LENGTH_S = 0.3, 25.0


def wandering(whole, smooth, seed=3):
    """The same tests with noise that is correlated in time, of one size in all of them."""
    rng = np.random.default_rng(seed)

    def noise(time_s):
        x = np.abs(time_s[:, None] - time_s) / LENGTH_S
        kernel = (1 + np.sqrt(3) * x) * np.exp(-np.sqrt(3) * x) if smooth else np.exp(-x)
        return WANDER_UM * np.linalg.cholesky(kernel + 1e-9 * np.eye(len(x))) @ rng.standard_normal(len(x))

    return with_curves(whole, lambda c: (c.time_s, c.force_mN, c.displacement_um + noise(c.time_s)))


@pytest.mark.parametrize(("smooth", "correlation"), [(True, Correlation.MATERN_32), (False, Correlation.EXPONENTIAL)])
def test_noise_that_wanders_in_time(smooth, correlation):
    base, optimum = with_likely_noise(base_of(wandering(cached(seed=1), smooth)))
    assert (base.model.correlation, base.model.along) == (correlation, Along.TIME)
    wander, length = np.exp(optimum.hyper[2:4])
    assert wander * np.median(base.scale) == pytest.approx(WANDER_UM, rel=0.3)
    assert length == pytest.approx(LENGTH_S, rel=0.5)
    assert np.std(np.log(base.scale)) < 0.1  # 0.2 to 0.3 under noise along the load
