"""Cholesky factors written out entry by entry against LAPACK."""

import jax
import numpy as np
import pytest
from joint_cases import random_precision

from mcc_jax.calibrate.small_matrices import Cholesky

pytestmark = pytest.mark.extended


@jax.jit
def everything(A, b):
    factor = Cholesky(A)
    return factor.solve(b), factor.forward(b), factor.backward(b), factor.inverse(), factor.log_det()


@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("size", [1, 2, 5])
@pytest.mark.parametrize("spread", [0.0, 1.0, 3.0])
def test_a_factor_solves_inverts_and_has_the_determinant(size, batch, spread):
    rng = np.random.default_rng(size)
    A = random_precision(rng, int(np.prod(batch)), size, spread=spread).reshape(*batch, size, size)
    b, tolerance = rng.standard_normal((*batch, size)), np.linalg.cond(A).max() * size * 1e-14
    solved, forward, backward, inverse, log_det = (np.asarray(v) for v in everything(A, b))
    assert (solved.shape, inverse.shape, log_det.shape) == (b.shape, A.shape, batch)
    expected, L = np.linalg.inv(A), np.linalg.cholesky(A)
    scale, scale_of_L = np.abs(expected).max(), np.abs(np.linalg.inv(L)).max()
    np.testing.assert_allclose(inverse, expected, rtol=0, atol=tolerance * scale)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(A)[1], rtol=0, atol=1e-12 + tolerance)
    for found, matrix, unit in ((solved, A, scale), (forward, L, scale_of_L), (backward, L.mT, scale_of_L)):
        wanted = np.linalg.solve(matrix, b[..., None])[..., 0]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=10 * tolerance * unit)
