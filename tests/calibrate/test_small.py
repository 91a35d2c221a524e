"""Cholesky factors written out entry by entry against LAPACK."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
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


@settings(max_examples=40)
@given(SIZES, SEEDS, SPREADS)
def test_backward_gives_draws_with_the_inverse_as_covariance(size, seed, spread):
    A, _, tolerance = problem(size, (), seed, spread)
    columns = np.asarray(everything(np.broadcast_to(A, (size, size, size)), np.eye(size))[2]).T
    expected = np.linalg.inv(A)
    np.testing.assert_allclose(columns @ columns.T, expected, rtol=0, atol=10 * tolerance * np.abs(expected).max())


@pytest.mark.parametrize("size", [1, 4])
def test_the_determinant_s_derivative_is_the_inverse(size):
    A = random_precision(np.random.default_rng(1), 1, size)[0]
    slope = np.asarray(jax.grad(lambda M: Cholesky(M).log_det())(jnp.asarray(A)))
    # Only the lower triangle is read, so an entry below the diagonal stands for two.
    np.testing.assert_allclose((slope + slope.T) / 2, np.linalg.inv(A), rtol=1e-10, atol=1e-12)
    assert np.all(np.triu(slope, 1) == 0)


def test_an_indefinite_matrix_does_not_pass_for_a_definite_one():
    assert np.isnan(np.asarray(Cholesky(jnp.asarray([[1.0, 2.0], [2.0, 1.0]])).solve(jnp.ones(2)))).any()
