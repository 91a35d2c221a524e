r"""The log marginal likelihood of a hypothesis: a linear Gaussian model around a state, its scales at their mode.

Around the state every test i is

.. math:: y_i = J_i T v_i + \zeta_i + V_i S w_i + M_i \epsilon + B_i R g + A_i \theta + \text{noise}

with the particle's own deviations v, zero and further numbers w, what all particles share: population, further numbers
of the effects and weights of a misfit (epsilon, g), and the amplitudes theta. All but the amplitudes are standard
normal, once their scales T, S, R are taken into the columns. They are integrated out in closed form, particles first
(`eliminate`); an amplitude's prior is a mixture of half-normals, whose integral is closed, too. Scales and noise are at
their posterior mode, and their curvature is integrated by Laplace's method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jaxtyping import Array, Float

from ..calibrate.compiling import compiled
from ..calibrate.data import Tests
from ..calibrate.distributions import SCALES, SpreadCoordinate
from ..calibrate.forward import Linear
from ..calibrate.noise import Along, Correlation, Noise, whitening
from ..calibrate.small_matrices import eliminate
from .settings import NUMERICS


class Design(eqx.Module):
    """The columns of a hypothesis around a state, every number in units of its prior's standard deviation.

    Attributes:
        tests, linear: the tests, and how noise of force moves them.
        own: columns of each particle's own numbers: b1, b3, b5, e (per unit), the zero, further ones.
        common: of what all particles share: the population's five, further numbers of effects, misfits.
        amplitude: of the amplitudes, per unit of `unit`.
        data: what is explained [um].
        scale: each particle's own factor on the noise.
        group: which scale a common column has: 0 where it is fixed at 1, else its place among `misfits`.
        noise: prior of the four numbers of the noise: means and standard deviations of the logarithms, shape (2, 4).
        largest: largest scale of each amplitude's prior in its unit, over the smallest, which is the unit.
        spreads: scale and shape of the priors of the spreads of b1, b3, b5, e and of further own numbers.
        misfits: median and standard deviation of the logarithm of each misfit's scale.
        used: 1 for hyperparameters of the hypothesis, 0 for those that only make up shapes.
    """

    tests: Tests
    linear: Linear
    own: Float[Array, "particles points o"]
    common: Float[Array, "particles points c"]
    amplitude: Float[Array, "particles points k"]
    data: Float[Array, "particles points"]
    scale: Float[Array, " particles"]
    group: Any
    noise: Float[Array, "2 4"]
    largest: Float[Array, " k"]
    sign: Float[Array, " k"]
    misfits: Float[Array, "g 2"]
    used: Float[Array, " h"]
    kinds: Kinds = eqx.field(static=True)


@dataclass(frozen=True)
class Kinds:
    """What a compiled evidence depends on besides the shapes of its arrays.

    Attributes:
        spreads: priors of the spreads of b1, b3, b5, e, and of further own numbers.
        correlation, along: of the noise.
    """

    spreads: tuple[Any, ...]
    correlation: Correlation
    along: Along


@dataclass(frozen=True)
class NoiseKind:
    """How the noise that is not white hangs together.

    Attributes:
        correlation: how rough it is.
        along: what it runs along.
        length: its length's prior median over the model's own, whose unit may be another.
    """

    correlation: Correlation
    along: Along
    length: float = 1.0


def with_noise(design: Design, kind: NoiseKind) -> Design:
    """The design with noise of another kind."""
    kinds = replace(design.kinds, correlation=kind.correlation, along=kind.along)
    return replace(design, noise=design.noise.at[0, 3].add(float(np.log(kind.length))), kinds=kinds)


def with_amplitudes(design: Design, columns: Array) -> Design:
    """The design with other amplitudes, of either sign, whose priors nobody asks for."""
    count = columns.shape[-1]
    return replace(design, amplitude=columns, sign=jnp.zeros(count), largest=jnp.ones(count))


class Left(NamedTuple):
    """What the particles leave: Gram matrices of the common columns, the amplitudes and the data, and log integrals."""

    gram: Float[Array, "particles r r"]
    log_integral: Float[Array, " particles"]


def scales_of(free: Float[Array, " h"], design: Design) -> tuple[Noise, Array, Array]:
    """Noise, scales of the own columns and of the common ones, at the hyperparameters.

    They are logarithms of the noise's four numbers, the spreads' coordinates, and logarithms of the misfits' scales.
    """
    spreads = design.kinds.spreads
    noise = Noise.from_logs(free[:4], design.scale)
    x = free[4 : 4 + len(spreads)]
    tau = [SpreadCoordinate(prior).spread(x[j]) for j, prior in enumerate(spreads)]
    own = jnp.stack([*tau[:4], jnp.ones(()), *tau[4:]])
    misfit = jnp.concatenate([jnp.ones(1), jnp.exp(free[4 + len(spreads) :])])
    return noise, own, misfit[design.group]


def grams(free: Float[Array, " h"], design: Design) -> tuple[Array, Array]:
    """Gram matrix of every test's whitened and scaled columns, and its noise's log density at 0."""
    noise, own, common = scales_of(free, design)
    kinds = design.kinds
    columns = jnp.concatenate([design.own, design.common, design.amplitude, design.data[..., None]], -1)
    factor = jnp.concatenate([own, common, jnp.ones(design.amplitude.shape[-1] + 1)])

    def one(scale: Array, tests: Tests, linear: Linear, columns: Array) -> tuple[Array, Array]:
        filtered = whitening(noise, scale, tests, linear, kinds.correlation, kinds.along)
        white = filtered(columns) * factor[None]
        gram = (white.T @ white).at[-1, -1].add(filtered.reading)
        count = jnp.sum(jnp.where(tests.mask, 1.0, 0.0))
        return gram, -0.5 * (filtered.log_det + count * float(np.log(2 * np.pi)))

    return jax.vmap(one)(design.scale, design.tests, design.linear, columns)


def left_of(free: Float[Array, " h"], design: Design) -> Left:
    """Integrate every particle's own numbers out."""
    gram, log_density = grams(free, design)
    left, log_integral = without_first(gram, design.own.shape[-1])
    return Left(left, log_integral + log_density)


def without_first(gram: Array, count: int) -> tuple[Array, Array]:
    """Integrate the first columns out, whose numbers are standard normal: what is left of the form, log integral."""
    return eliminate(gram, range(count), jnp.ones((*gram.shape[:-2], count)), written_out=False)


def amplitudes(left: Array, sign: Array, largest: Array) -> tuple[Array, Array, Array]:
    """Log integral over amplitudes, and their mean and standard deviation under the best scales.

    Each has an equal mixture of half-normal priors (normal where both signs are physical), whose scales are spread
    evenly in the logarithm from 1 to `largest`. Where several are cut, the corner's probability is taken for the
    product of the single ones.
    """
    count = len(sign)
    if not count:
        return -0.5 * left[-1, -1], jnp.zeros(0), jnp.zeros(0)
    gram, score = left[:-1, :-1], left[:-1, -1]
    steps = jnp.asarray(np.linspace(0, 1, SCALES))
    axes = jnp.meshgrid(*(steps for _ in range(count)), indexing="ij")
    scale = jnp.exp(jnp.stack([a.ravel() for a in axes], -1) * jnp.log(largest)[None])

    def one(s: Array) -> tuple[Array, Array, Array]:
        precision = gram + jnp.diag(s**-2.0)
        root = jnp.linalg.cholesky(precision)
        covariance = jax.scipy.linalg.cho_solve((root, True), jnp.eye(count))
        mean = covariance @ score
        sd = jnp.sqrt(jnp.diagonal(covariance))
        value = 0.5 * score @ mean - jnp.sum(jnp.log(jnp.diagonal(root))) - jnp.sum(jnp.log(s))
        cut = jnp.where(sign == 0, 0.0, float(np.log(2)) + log_ndtr(sign * mean / sd))
        return value + jnp.sum(cut), mean, sd

    value, mean, sd = jax.vmap(one)(scale)
    best = jnp.argmax(value)
    total = logsumexp(value) - count * float(np.log(SCALES)) - 0.5 * left[-1, -1]
    return total, mean[best], sd[best]


def log_prior(free: Float[Array, " h"], design: Design) -> Array:
    """Log prior of the hyperparameters, of a spread's coordinate of either sign together; of those that only make up
    shapes it is standard normal, which Laplace's method integrates to 1."""
    spreads = design.kinds.spreads
    log_2pi = float(np.log(2 * np.pi))
    z = (free[:4] - design.noise[0]) / design.noise[1]
    each = [-0.5 * z**2 - jnp.log(design.noise[1]) - 0.5 * log_2pi]
    if spreads:
        of_spreads = [SpreadCoordinate(prior).log_prob(free[4 + j]) for j, prior in enumerate(spreads)]
        each.append(float(np.log(2)) + jnp.stack(of_spreads))
    m = (free[4 + len(spreads) :] - design.misfits[:, 0]) / design.misfits[:, 1]
    each.append(-0.5 * m**2 - jnp.log(design.misfits[:, 1]) - 0.5 * log_2pi)
    nothing = -0.5 * free**2 - 0.5 * log_2pi
    return jnp.sum(jnp.where(design.used > 0, jnp.concatenate(each), nothing))


def log_joint(free: Float[Array, " h"], design: Design) -> Array:
    """Log marginal likelihood at the hyperparameters, times their prior."""
    left = left_of(free, design)
    gram, integral = without_first(jnp.sum(left.gram, 0), design.common.shape[-1])
    return (
        jnp.sum(left.log_integral)
        + integral
        + amplitudes(gram, design.sign, design.largest)[0]
        + log_prior(free, design)
    )


def filled_up(free: np.ndarray, design: Design) -> np.ndarray:
    """Hyperparameters with zeros for those that only make up shapes."""
    return np.concatenate([free, np.zeros(len(design.used) - len(free))])


def with_little_noise(free: np.ndarray) -> np.ndarray:
    """Hyperparameters with correlated noise that has not swallowed a gap."""
    at = free.copy()
    at[2] += np.log(NUMERICS.little)
    return at


value_and_gradient = compiled(jax.value_and_grad(log_joint))
left_by_particle = compiled(left_of)
prior_density = compiled(log_prior)


class Solution(NamedTuple):
    """Posterior means at the hyperparameters.

    Attributes:
        own: of every particle's own numbers, in units of `Design.own`.
        common: of what all share, in units of `Design.common`.
        amplitude, sd: of the amplitudes.
    """

    own: Float[Array, "particles o"]
    common: Float[Array, " c"]
    amplitude: Float[Array, " k"]
    sd: Float[Array, " k"]


def _solved(matrix: Array, values: Array) -> Array:
    """The solution of positive definite equations."""
    root = jnp.linalg.cholesky(matrix)
    half = jax.scipy.linalg.solve_triangular(root, values, lower=True)
    return jax.scipy.linalg.solve_triangular(root, half, lower=True, trans=1)


@compiled
def solve(free: Float[Array, " h"], design: Design) -> Solution:
    """Posterior means of all numbers, an amplitude of a forbidden sign at zero."""
    _, own, common = scales_of(free, design)
    gram, _ = grams(free, design)
    o, c = design.own.shape[-1], design.common.shape[-1]
    left, _ = without_first(gram, o)
    total = jnp.sum(left, 0)
    after, _ = without_first(total, c)
    _, theta, sd = amplitudes(after, design.sign, design.largest)
    theta = jnp.where(design.sign * theta < 0, 0.0, theta)
    data = total[:c, -1] - total[:c, c:-1] @ theta
    epsilon = _solved(total[:c, :c] + jnp.eye(c), data[:, None])[:, 0]
    rest = gram[:, :o, -1] - gram[:, :o, o + c : -1] @ theta - gram[:, :o, o : o + c] @ epsilon
    v = _solved(gram[:, :o, :o] + jnp.eye(o)[None], rest[..., None])[..., 0]
    return Solution(v * own[None], epsilon * common, theta, sd)


@dataclass(frozen=True)
class Optimum:
    """The mode of the hyperparameters.

    Attributes:
        free: the hyperparameters.
        log_evidence: log marginal likelihood, the hyperparameters integrated out by Laplace's method.
        log_joint: at the mode.
        evaluations: of the density.
    """

    free: np.ndarray
    log_evidence: float
    log_joint: float
    evaluations: int


def optimise(design: Design, start: np.ndarray, *, curvature: bool = True, without: Optimum | None = None) -> Optimum:
    """The mode of the hyperparameters by L-BFGS, in coordinates scaled by their expected curvature.

    Args:
        design: of a hypothesis.
        start: hyperparameters to begin with; those that only make up shapes may be left out.
        curvature: whether they are integrated out; if not, `log_evidence` is the log posterior at the mode.
        without: the optimum without misfits, whose curvature is taken for that of the hyperparameters it has.

    Raises:
        FloatingPointError: if it has no evidence where it begins.
    """
    from scipy.optimize import minimize

    count = float(np.asarray(design.tests.mask).sum())
    used = np.asarray(design.used) > 0
    start = filled_up(start, design)
    spreads = len(design.kinds.spreads)
    expected = np.full(len(start), 2.0)
    expected[:4] = count * np.array([1.5, 0.2, 0.1, 0.02])
    expected[4 : 4 + spreads] = 2.0 * len(design.tests)
    scale = 1 / np.sqrt(np.where(used, expected, 1.0))

    def down(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = value_and_gradient(jnp.asarray(x * scale), design)
        if not (np.isfinite(float(value)) and np.isfinite(np.asarray(slope)).all()):
            return 1e30, np.zeros(len(x))  # a step into numbers beyond arithmetic is taken back
        return -float(value), -np.asarray(slope) * scale

    options = {"ftol": 1e-9, "gtol": 0.1, "maxiter": 40}
    found = minimize(down, start / scale, jac=True, method="L-BFGS-B", options=options)
    joint = -float(found.fun)
    if joint < -1e29:
        raise FloatingPointError("the evidence of a hypothesis is no number")
    evidence, free = joint, found.x * scale
    if curvature:
        wanted = np.flatnonzero(used)
        if without is not None:
            wanted = wanted[wanted >= 4 + spreads]
            evidence += without.log_evidence - without.log_joint
        columns = []
        for j in wanted:
            e = np.where(np.arange(len(start)) == j, 0.3, 0.0)
            columns.append((down(found.x + e)[1] - down(found.x - e)[1])[wanted] / 0.6)
        hessian = (np.array(columns) + np.array(columns).T) / 2
        values = np.maximum(np.linalg.eigvalsh(hessian), 1e-3)
        evidence += 0.5 * len(wanted) * np.log(2 * np.pi) - 0.5 * np.sum(np.log(values)) + np.sum(np.log(scale[wanted]))
        if without is None:  # of those that only make up shapes
            evidence += 0.5 * np.sum(~used) * np.log(2 * np.pi)
        else:
            evidence += 0.5 * (np.sum(~used) - np.sum(~used[: 4 + spreads])) * np.log(2 * np.pi)
    return Optimum(free, float(evidence), joint, int(found.nfev))


@compiled
def residual_of(solution: Solution, design: Design) -> Float[Array, "particles points"]:
    """What a solution leaves of the data [um]."""
    taken = jnp.einsum("npo,no->np", design.own, solution.own)
    taken += jnp.einsum("npc,c->np", design.common, solution.common)
    return design.data - taken - jnp.einsum("npk,k->np", design.amplitude, solution.amplitude)


@compiled
def whitened(free: Float[Array, " h"], design: Design, values: Array) -> tuple[Array, Array]:
    """Values over the points [um], independent and of variance 1, and the standard deviation of each point given those
    before it."""
    noise, _, _ = scales_of(free, design)
    kinds = design.kinds

    def one(scale: Array, tests: Tests, linear: Linear, values: Array) -> tuple[Array, Array]:
        filtered = whitening(noise, scale, tests, linear, kinds.correlation, kinds.along)
        return filtered(values[:, None])[:, 0], filtered.solver.factor.diag.d

    return jax.vmap(one)(design.scale, design.tests, design.linear, values)
