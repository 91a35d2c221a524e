"""Cholesky factors written out entry by entry against LAPACK."""

import hypothesis.strategies as st
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from joint_cases import random_precision

from mcc_jax.calibrate.small_matrices import Cholesky

pytestmark = pytest.mark.extended

SIZES = st.sampled_from([1, 2, 5])
BATCHES = st.sampled_from([(), (2, 3)])
SEEDS = st.integers(0, 2**32 - 1)
SPREADS = st.floats(0.0, 3.0)


def problem(size, batch, seed, spread):
    rng = np.random.default_rng(seed)
    count = int(np.prod(batch))
    A = random_precision(rng, count, size, spread=spread).reshape(*batch, size, size)
    b = rng.standard_normal((*batch, size))
    return A, b, np.linalg.cond(A).max() * size * 1e-14


@jax.jit
def everything(A, b):
    factor = Cholesky(A)
    return factor.solve(b), factor.forward(b), factor.backward(b), factor.inverse(), factor.log_det()


@settings(max_examples=60)
@given(SIZES, BATCHES, SEEDS, SPREADS)
def test_solve_inverse_and_determinant(size, batch, seed, spread):
    A, b, tolerance = problem(size, batch, seed, spread)
    solved, _, _, inverse, log_det = (np.asarray(v) for v in everything(A, b))
    assert solved.shape == b.shape
    assert inverse.shape == A.shape
    assert log_det.shape == batch
    expected = np.linalg.inv(A)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(inverse, expected, rtol=0, atol=tolerance * scale)
    np.testing.assert_allclose(solved, np.linalg.solve(A, b[..., None])[..., 0], rtol=0, atol=10 * tolerance * scale)
    np.testing.assert_allclose(log_det, np.linalg.slogdet(A)[1], rtol=0, atol=1e-12 + tolerance)


@settings(max_examples=60)
@given(SIZES, BATCHES, SEEDS, SPREADS)
def test_forward_and_backward_are_the_factor_and_its_transpose(size, batch, seed, spread):
    A, b, tolerance = problem(size, batch, seed, spread)
    _, forward, backward, _, _ = (np.asarray(v) for v in everything(A, b))
    L = np.linalg.cholesky(A)
    scale = np.abs(np.linalg.inv(L)).max()
    np.testing.assert_allclose(forward, np.linalg.solve(L, b[..., None])[..., 0], rtol=0, atol=10 * tolerance * scale)
    transposed = np.linalg.solve(np.swapaxes(L, -1, -2), b[..., None])[..., 0]
    np.testing.assert_allclose(backward, transposed, rtol=0, atol=10 * tolerance * scale)
