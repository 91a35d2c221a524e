"""Arrow-shaped least squares against dense linear algebra and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax.calibrate.pooled_fit import Parameters, minimise, normal_equations

pytestmark = pytest.mark.extended

N, P, Q, K = 4, 3, 2, 7


@pytest.fixture(scope="module")
def linear():
    """A linear arrow problem r = A x + B s - y, and its dense Jacobian, particles first."""
    rng = np.random.default_rng(3)
    A, B = rng.standard_normal((N, K, P)), rng.standard_normal((N, K, Q))
    r = rng.standard_normal((N, K))
    dense = np.zeros((N * K, N * P + Q))
    for n in range(N):
        dense[n * K : (n + 1) * K, n * P : (n + 1) * P] = A[n]
        dense[n * K : (n + 1) * K, N * P :] = B[n]
    return A, B, r, dense


def normal_of(A, B, r):
    def push(y):
        moved = jnp.einsum("nkp,np->nk", A, y.local) + jnp.einsum("nkq,q->nk", B, y.shared)
        # Two leaves, one with a further axis, as the pooled residuals have.
        return moved[:, :3], moved[:, 3:].reshape(N, 2, 2)

    residual = (jnp.asarray(r[:, :3]), jnp.asarray(r[:, 3:].reshape(N, 2, 2)))
    return normal_equations(push, residual, Parameters(jnp.zeros((N, P)), jnp.zeros(Q)))


def flat(parameters):
    return np.concatenate([np.asarray(parameters.local).ravel(), np.asarray(parameters.shared)])


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_the_step_is_the_dense_one(linear, damping):
    *parts, dense = linear
    H, g = dense.T @ dense, dense.T @ parts[2].ravel()
    expected = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    np.testing.assert_allclose(flat(normal_of(*parts).solve(damping)), expected, rtol=1e-9, atol=1e-11)


# ---- a small nonlinear problem: decays of own height and level, with a rate and a drift that all share ---------------

TIME = np.linspace(0.0, 2.0, 12)


def decays():
    rng = np.random.default_rng(5)
    local, shared = 1 + rng.random((N, 2)), np.array([1.3, 0.2])
    clean = local[:, :1] * np.exp(-shared[0] * TIME) + local[:, 1:] + shared[1] * TIME**2
    return clean + 0.05 * rng.standard_normal(clean.shape)


def residual(y, data):
    model = y.local[:, :1] * jnp.exp(-y.shared[0] * TIME)[None] + y.local[:, 1:2] + (y.shared[1] * TIME**2)[None]
    return (data - model,)


def test_a_parameter_without_data_stays_where_it_is():
    start = Parameters(jnp.ones((N, 3)).at[:, 2].set(7.0), jnp.asarray([0.5, 0.0, -3.0]))
    found = jax.jit(lambda d: minimise(lambda y: residual(y, d), start))(jnp.asarray(decays()))
    assert bool(found.converged)
    np.testing.assert_array_equal(found.value.local[:, 2], 7.0)
    assert float(found.value.shared[2]) == -3.0
    for block in found.normal.covariance():
        assert np.all(np.isfinite(np.asarray(block)))


def test_too_few_steps_are_no_convergence():
    found = jax.jit(
        lambda d: minimise(lambda y: residual(y, d), Parameters(jnp.ones((N, 2)), jnp.asarray([0.5, 0.0])), max_steps=2)
    )(jnp.asarray(decays()))
    assert not bool(found.converged)
