"""Arrow-shaped least squares against dense linear algebra and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax.calibrate.hierarchical import Normal, Parameters, minimise, normal_equations

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


def normal_of(A, B, r, shared=Q):
    def push(y):
        moved = jnp.einsum("nkp,np->nk", A, y.local) + jnp.einsum("nkq,q->nk", B[..., :shared], y.shared)
        # Two leaves, one with a further axis, as the pooled residuals have.
        return moved[:, :3], moved[:, 3:].reshape(N, 2, 2)

    residual = (jnp.asarray(r[:, :3]), jnp.asarray(r[:, 3:].reshape(N, 2, 2)))
    return normal_equations(push, residual, Parameters(jnp.zeros((N, P)), jnp.zeros(shared)))


def flat(parameters):
    return np.concatenate([np.asarray(parameters.local).ravel(), np.asarray(parameters.shared)])


def test_normal_equations_are_the_dense_ones(linear):
    *parts, dense = linear
    normal = normal_of(*parts)
    H, g = dense.T @ dense, dense.T @ parts[2].ravel()
    for n in range(N):
        own = slice(n * P, (n + 1) * P)
        np.testing.assert_allclose(normal.local[n], H[own, own], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(normal.border[n], H[own, N * P :], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(normal.shared, H[N * P :, N * P :], rtol=1e-12)
    np.testing.assert_allclose(flat(Parameters(normal.gradient_local, normal.gradient_shared)), g, rtol=1e-11)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_the_step_is_the_dense_one(linear, damping):
    *parts, dense = linear
    H, g = dense.T @ dense, dense.T @ parts[2].ravel()
    expected = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    np.testing.assert_allclose(flat(normal_of(*parts).solve(damping)), expected, rtol=1e-9, atol=1e-11)


def test_the_step_without_shared_parameters(linear):
    A, B, r, _ = linear
    step = normal_of(A, B, r, shared=0).solve(0.0)
    assert step.shared.shape == (0,)
    for n in range(N):
        expected = -np.linalg.lstsq(A[n], r[n], rcond=None)[0]
        np.testing.assert_allclose(step.local[n], expected, rtol=1e-9)


def test_the_covariance_is_the_inverse(linear):
    *parts, dense = linear
    own, between, shared = normal_of(*parts).covariance()
    expected = np.linalg.inv(dense.T @ dense)
    for n in range(N):
        rows = slice(n * P, (n + 1) * P)
        np.testing.assert_allclose(own[n], expected[rows, rows], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(between[n], expected[rows, N * P :], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(shared, expected[N * P :, N * P :], rtol=1e-9, atol=1e-11)


# ---- a small nonlinear problem: decays of own height and level, with a rate and a drift that all share ---------------

TIME = np.linspace(0.0, 2.0, 12)


def decays():
    rng = np.random.default_rng(5)
    local, shared = 1 + rng.random((N, 2)), np.array([1.3, 0.2])
    clean = local[:, :1] * np.exp(-shared[0] * TIME) + local[:, 1:] + shared[1] * TIME**2
    return clean + 0.05 * rng.standard_normal(clean.shape)


def residual(y, data, extra=0):
    """`extra` shared parameters and as many own ones that no residual depends on come last."""
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


def test_a_particle_without_any_data_leaves_the_others_alone(linear):
    A, B, r, _ = linear
    A, B, r = A.copy(), B.copy(), r.copy()
    A[1], B[1], r[1] = 0.0, 0.0, 0.0
    normal = normal_of(A, B, r)
    step = normal.solve(0.0)
    np.testing.assert_array_equal(step.local[1], 0.0)
    keep = np.arange(N) != 1
    parts = (normal.local, normal.border, normal.gradient_local)
    local, border, gradient = (jnp.asarray(np.asarray(v)[keep]) for v in parts)
    alone = Normal(local, border, normal.shared, gradient, normal.gradient_shared).solve(0.0)
    np.testing.assert_allclose(step.shared, alone.shared, rtol=1e-10)
    np.testing.assert_allclose(np.asarray(step.local)[keep], alone.local, rtol=1e-10)
