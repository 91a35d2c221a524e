r"""Least squares over all particles at once, by Optimistix: every particle has parameters of its own, all share a few.

The Jacobian of such a problem is block diagonal but for the columns of the shared parameters. All particles' first
parameters can therefore be perturbed at once, and the whole Jacobian of N particles costs as many directional
derivatives as one particle's. Its normal equations

.. math:: \begin{pmatrix} D & B \\ B^T & S \end{pmatrix}
    \begin{pmatrix} \delta_{local} \\ \delta_{shared} \end{pmatrix} = -\begin{pmatrix} g_l \\ g_s \end{pmatrix}

are solved through the Schur complement :math:`S - B^T D^{-1} B`, in a time linear in N.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from .._types import Values
from .data import Tests
from .forward import Forms, Point, residuals
from .noise import Whitening
from .population import Population, Scatter, moments
from .running import compiled
from .small_matrices import Cholesky


class Parameters(NamedTuple):
    """Parameters of an arrow problem: one row per particle, and those that all share."""

    local: Float[Array, "particles P"]
    shared: Float[Array, " Q"]


class Normal(eqx.Module):
    """Normal equations of an arrow problem."""

    local: Float[Array, "particles P P"]
    border: Float[Array, "particles P Q"]
    shared: Float[Array, "Q Q"]
    gradient_local: Float[Array, "particles P"]
    gradient_shared: Float[Array, " Q"]

    def schur(self, damping: Any = 0.0) -> tuple[Cholesky, Float[Array, "particles P Q"], Float[Array, "Q Q"]]:
        """Factor of D, D^-1 B and the Schur complement, each diagonal enlarged by 1 + damping."""
        factor = Cholesky(_damped(self.local, damping))
        inner = jnp.stack([factor.solve(self.border[..., q]) for q in range(self.border.shape[-1])], -1)
        complement = _damped(self.shared, damping) - jnp.einsum("npq,npr->qr", self.border, inner)
        return factor, inner, complement

    def solve(self, damping: Any) -> Parameters:
        """The damped Gauss-Newton step."""
        factor, inner, complement = self.schur(damping)
        forward = factor.solve(self.gradient_local)
        right = self.gradient_shared - jnp.einsum("npq,np->q", self.border, forward)
        shared = -Cholesky(complement).solve(right)
        return Parameters(-forward - jnp.einsum("npq,q->np", inner, shared), shared)

    def covariance(self) -> tuple[Float[Array, "particles P P"], Float[Array, "particles P Q"], Float[Array, "Q Q"]]:
        """Blocks of the inverse: each particle's own, between it and the shared parameters, and of the shared ones."""
        factor, inner, complement = self.schur()
        shared = Cholesky(_damped(complement, 0.0)).inverse()
        between = -jnp.einsum("npq,qr->npr", inner, shared)
        return factor.inverse() - jnp.einsum("npq,noq->npo", between, inner), between, shared


def _damped(A: Float[Array, "*batch p p"], damping: Any) -> Float[Array, "*batch p p"]:
    diagonal = jnp.diagonal(A, axis1=-2, axis2=-1)
    # A direction that the data do not know at all gets a curvature of its own, so that it stays where it is.
    floor = jnp.where(diagonal > 1e-12, diagonal * (damping + 1e-14), 1.0)
    eye = jnp.broadcast_to(jnp.eye(A.shape[-1]), A.shape)
    return A + eye * floor[..., None, :]


def normal_equations(push: Callable[[Parameters], Any], residual: Any, y: Parameters) -> Normal:
    """The normal equations of a residual with the directional derivative `push`; leaves have the particles first."""
    count, P = y.local.shape

    def flat(tree: Any) -> Float[Array, "particles residuals"]:
        return jnp.concatenate([leaf.reshape(count, -1) for leaf in jax.tree.leaves(tree)], axis=1)

    def column(direction: Float[Array, " PQ"]) -> Float[Array, "particles residuals"]:
        return flat(push(Parameters(jnp.broadcast_to(direction[:P], (count, P)), direction[P:])))

    J = jax.vmap(column, out_axes=-1)(jnp.eye(P + len(y.shared)))
    whole, gradient = jnp.einsum("nkp,nkq->npq", J, J), jnp.einsum("nkp,nk->np", J, flat(residual))
    return Normal(whole[:, :P, :P], whole[:, :P, P:], whole[:, P:, P:].sum(0), gradient[:, :P], gradient[:, P:].sum(0))


class ArrowDescent(optx.AbstractDescent[Parameters, optx.FunctionInfo.ResidualJac, Normal]):
    """The damped Gauss-Newton step of an arrow problem, each parameter damped on its own scale."""

    def init(self, y: Parameters, f_info_struct: Any) -> Normal:
        """Normal equations of the right shapes, all zero."""
        (count, P), Q = y.local.shape, len(y.shared)
        return Normal(*(jnp.zeros(s) for s in ((count, P, P), (count, P, Q), (Q, Q), (count, P), (Q,))))

    def query(self, y: Parameters, f_info: Any, state: Normal) -> Normal:
        """The normal equations at `y`."""
        return normal_equations(f_info.jac.mv, f_info.residual, y)

    def step(self, step_size: Float[Array, ""], state: Normal) -> tuple[Parameters, optx.RESULTS]:
        """The step whose damping is one over the step size."""
        return state.solve(1 / step_size), optx.RESULTS.successful


class ArrowLevenbergMarquardt(optx.AbstractGaussNewton[Parameters, Any, Any]):
    """Levenberg-Marquardt for arrow problems, in the trust-region form of Optimistix."""

    rtol: float = 1e-9
    atol: float = 1e-9
    norm: Callable[[Any], Float[Array, ""]] = optx.max_norm
    descent: ArrowDescent = ArrowDescent()  # pyright: ignore[reportIncompatibleVariableOverride]
    search: optx.ClassicalTrustRegion[Parameters] = optx.ClassicalTrustRegion(high_constant=10.0)  # pyright: ignore[reportIncompatibleVariableOverride]
    verbose: Callable[..., None] = eqx.field(static=True, default=lambda **_: None)


class Solution(eqx.Module):
    """Where the optimiser ended, with residuals and normal equations there, and half the sum of squares."""

    value: Parameters
    residual: Any
    normal: Normal
    loss: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Any

    def first(self, count: int) -> Solution:
        """The same of the first `count` particles."""
        value, n = self.value._replace(local=self.value.local[:count]), self.normal
        normal = replace(n, local=n.local[:count], border=n.border[:count], gradient_local=n.gradient_local[:count])
        return replace(self, value=value, normal=normal, residual=jax.tree.map(lambda x: x[:count], self.residual))


def minimise(
    residual: Callable[[Parameters], Any], start: Parameters, *, max_steps: int = 100, tolerance: float = 1e-9
) -> Solution:
    """Minimise the sum of squares of an arrow problem's residuals, a pytree whose leaves have the particles first."""
    solver = ArrowLevenbergMarquardt(rtol=tolerance, atol=tolerance)
    found = optx.least_squares(lambda y, _: residual(y), solver, start, max_steps=max_steps, throw=False)
    # What the solver linearised last, at the value it returns: no second linearisation to compile and to compute.
    at, normal = found.state.f_info.residual, found.state.descent_state
    loss = 0.5 * sum((jnp.sum(leaf**2) for leaf in jax.tree.leaves(at)), jnp.zeros(()))
    converged = found.result == optx.RESULTS.successful
    return Solution(found.value, at, normal, loss, converged, found.stats["num_steps"])


# ---- the campaign as such a problem ----------------------------------------------------------------------------------


def robust(loss: str, r: Values) -> Values:
    """A residual whose square is the robust loss: 2 (sqrt(1 + r^2) - 1), or log(1 + r^2)."""
    if loss == "linear":
        return r
    square = r * r
    if loss == "soft_l1":
        return r * jnp.sqrt(2 / (jnp.sqrt(1 + square) + 1))
    # The quotient log(1 + r^2)/r^2 keeps value and derivative finite at 0.
    small = square < 1e-6
    safe = jnp.where(small, 1.0, square)
    return r * jnp.sqrt(jnp.where(small, 1 - square / 2, jnp.log1p(safe) / safe))


LEAST_SPREAD = 1e-4  # least standard deviation of log C in the residuals: with any smaller they are badly scaled


class Pooled(eqx.Module):
    """Settings of the pooled least squares; priors are mean and standard deviation."""

    whitening: Whitening
    population: Population
    zero_prior: Float[Array, " 2"]  # of the offsets from the recorded contact [um]
    further: Float[Array, "further 2"]  # of every further parameter of an effect; of its logarithm if it is positive
    forms: Forms
    scatter: Scatter = eqx.field(static=True)
    loss: str = eqx.field(static=True, default="linear")  # of whitened residuals


SHARED = ("a", "log effective modulus", "mu_C1", "mu_C3", "mu_C5")
"""The shared parameters; the effects' amplitudes and the logarithms of their further numbers come behind them."""


def unpack(y: Parameters, settings: Pooled, tests: Tests) -> Point:
    """Every particle's parameters: local are b1, b3, b5, zero and, where they differ, e and amplitudes."""
    scatter, size = settings.scatter, len(settings.forms.effects)
    log_eta = jnp.log(jnp.maximum(1 + y.shared[0] * tests.flatness, 1e-3))
    e = y.local[:, 4] if scatter.modulus else y.shared[1] + scatter.power * log_eta
    latent, own = jnp.concatenate([y.local[:, :3], e[:, None]], 1), y.local[:, 4 + scatter.modulus :]
    amplitudes, further = y.shared[len(SHARED) :][:size], y.shared[len(SHARED) + size :]
    positive = settings.forms.positive
    theta = jnp.concatenate([amplitudes, jnp.where(positive, jnp.exp(jnp.where(positive, further, 0.0)), further)])
    theta = jnp.broadcast_to(theta, (len(latent), len(theta)))
    for j, (k, _) in enumerate(scatter.varying):
        theta = theta.at[:, k].set(own[:, j])
    return Point(latent, y.local[:, 3], theta)


def pooled_residual(
    settings: Pooled, tests: Tests, weight: Float[Array, " particles"]
) -> Callable[[Parameters], tuple[Array, ...]]:
    """Residuals as a function of the parameters: whitened ones of displacement, deviations of the particles from the
    population, of the zeros from the recorded contacts, and of the effects' further parameters from their priors, in
    standard deviations. Weights are 1 of particles, 0 of padding."""
    scatter, at = settings.scatter, settings.population
    size = 3 + scatter.modulus
    tau, modulus = (jnp.maximum(spread, LEAST_SPREAD) for spread in (at.tau, at.modulus_scatter))
    mean_zero, sd_zero = settings.zero_prior

    def residual(y: Parameters):
        point = unpack(y, settings, tests)
        away = residuals(point, tests, settings.forms)
        data = jax.vmap(lambda f, r: f(r[:, None])[:, 0])(settings.whitening, away)
        moved = replace(at, a=y.shared[0], log_modulus=y.shared[1], mu=y.shared[2:5], tau=tau, modulus_scatter=modulus)
        mean, factor = moments(moved, tests.flatness, scatter)
        covariance = jnp.einsum("npk,nqk->npq", factor, factor)[:, :size, :size]
        pooled = Cholesky(covariance).forward((point.latent - mean)[:, :size])
        zero = ((point.zero - tests.contact - mean_zero) / sd_zero)[:, None]
        found = [robust(settings.loss, data), pooled, zero]
        for j, (k, signed) in enumerate(scatter.varying):
            shared = y.shared[len(SHARED) + k]
            unit = jnp.maximum(at.theta_scatter[j], LEAST_SPREAD) * (1.0 if signed else jnp.abs(at.theta[k]))
            found.append(((point.theta[:, k] - shared) / unit)[:, None])
        if len(settings.further):
            # A prior that all share, in equal parts of all particles.
            logs = y.shared[len(SHARED) + len(settings.forms.effects) :]
            part = (logs - settings.further[:, 0]) / (settings.further[:, 1] * jnp.sqrt(jnp.sum(weight)))
            found.append(jnp.broadcast_to(part, (len(tests), len(part))))
        return tuple(one * weight[:, None] for one in found)

    return residual


@compiled
def fit_pooled(tests: Tests, settings: Pooled, start: Parameters, weight: Float[Array, " particles"]) -> Solution:
    """Minimise the pooled residuals."""
    return minimise(pooled_residual(settings, tests, weight), start, max_steps=300, tolerance=1e-7)
