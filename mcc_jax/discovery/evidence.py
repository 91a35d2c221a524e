r"""The log marginal likelihood of a hypothesis: a linear Gaussian model around a state, its scales at their mode.

Around the state every test i is

.. math:: y_i = J_i T v_i + \zeta_i + V_i S w_i + M_i \epsilon + B_i R g + A_i \theta + \text{noise}

with the particle's own deviations v, zero and random effects w, what all particles share (population, further numbers
of the effects and weights of a misfit: epsilon, g), and the amplitudes theta. All but the amplitudes are standard
normal, once their scales T, S, R are taken into the columns. They are integrated out in closed form, particles first;
an amplitude's prior is a mixture of half-normals, whose integral is closed, too. Scales and noise are at their
posterior mode, and their curvature is integrated by Laplace's method. Together these hyperparameters are `hyper`:
logarithms of the noise's four numbers, coordinates of the spreads, and logarithms of the misfits' scales.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import log_ndtr

from ..calibrate.priors import SCALES, SpreadCoordinate
from .design import LOG_2PI, Columns, Design
from .settings import LENGTH_FACTORS, NOISE_FACTORS, STRONG

LITTLE = 0.1  # factor on correlated noise that has swallowed a gap, where what explains it begins to be fitted
FLAT = 0.2  # slope at which a mode is reached, per expected standard deviation: 0.02 nats away
ITERATIONS = 40  # of L-BFGS at most
ALL = slice(None)  # particles
ASIDE = 0.1  # how far from the mode slopes are compared for its curvature, in expected standard deviations


ValueAndSlope = Callable[[np.ndarray], tuple[float, np.ndarray]]


class Spreads(NamedTuple):
    """Spreads at their coordinates and the log densities of the coordinates, of either sign together, with slopes."""

    value: np.ndarray
    slope: np.ndarray
    log_prob: np.ndarray
    log_prob_slope: np.ndarray


@lru_cache
def _constants(priors: tuple[Any, ...]) -> tuple[np.ndarray, ...]:
    """Power, unit and constant of the spreads' coordinates, and the priors' standard deviations."""
    each = [SpreadCoordinate(prior) for prior in priors]
    numbers = [[float(getattr(one, name)) for one in each] for name in ("power", "unit", "constant")]
    return *map(np.array, numbers), np.array([prior.sd for prior in priors], float)


def spreads_of(x: np.ndarray, priors: tuple[Any, ...]) -> Spreads:
    """The spreads at their coordinates."""
    power, unit, constant, sd = _constants(priors)
    size = np.abs(x)
    value = unit * np.sinh(size) ** power
    slope = unit * power * np.sinh(np.maximum(size, 1e-300)) ** (power - 1) * np.cosh(size) * np.sign(x)
    log_prob = constant + np.log(2) - 0.5 * (value / sd) ** 2 + np.logaddexp(x, -x) - np.log(2)
    return Spreads(value, slope, log_prob, np.tanh(x) - value / sd**2 * slope)


def _parts(hyper: np.ndarray, design: Design) -> list[np.ndarray]:
    """The hyperparameters of the noise, of the spreads, and of the misfits."""
    return np.split(hyper, [4, 4 + len(design.spreads)])


def scales_of(hyper: np.ndarray, design: Design) -> tuple[np.ndarray, np.ndarray]:
    """Scales of the own columns and of the common ones."""
    _, spreads, misfits = _parts(hyper, design)
    own = np.insert(spreads_of(spreads, design.spreads).value, 4, 1.0)  # the zero's is in its column
    return own, np.append(1.0, np.exp(misfits))[design.group]


def _scaled(form: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Quadratic forms whose columns are scaled."""
    return form * factor * factor[:, None]


def _root(matrix: np.ndarray) -> np.ndarray:
    """The Cholesky factor of positive definite matrices; not a number where one is not positive definite."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full(matrix.shape, np.nan)


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solutions of linear systems; not a number where one counts as singular, as at a step beyond arithmetic."""
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full((*np.broadcast_shapes(matrix.shape[:-2], right.shape[:-2]), *right.shape[-2:]), np.nan)


class Marginalised(NamedTuple):
    """Quadratic forms of columns and data after their first numbers, standard normal, are integrated out."""

    schur: np.ndarray  # the form in the other numbers and the data: the Schur complement
    log_integral: Any
    root: np.ndarray  # of the precision of the first numbers
    weights: np.ndarray  # of the first numbers' means on the others

    @property
    def information(self) -> np.ndarray:
        """Information on the other numbers."""
        return self.schur[..., :-1, :-1]

    @property
    def score(self) -> np.ndarray:
        """Scores of the other numbers at zero."""
        return self.schur[..., :-1, -1]

    def slope(self, of_schur: np.ndarray) -> np.ndarray:
        """Derivatives by the whole form, of something plus the log integral, from those of something by `schur`."""
        down = -np.swapaxes(self.weights, -1, -2)
        cross = down @ of_schur
        eye = np.eye(self.root.shape[-1])
        half = _solve(self.root, np.broadcast_to(eye, self.root.shape))
        inner = cross @ np.swapaxes(down, -1, -2) - 0.5 * np.swapaxes(half, -1, -2) @ half
        outer = np.broadcast_to(of_schur, (*inner.shape[:-2], *of_schur.shape[-2:]))
        return np.block([[inner, cross], [np.swapaxes(cross, -1, -2), outer]])


def marginalise(gram: np.ndarray, count: int) -> Marginalised:
    """Integrate the first numbers out, which are standard normal."""
    root = _root(gram[..., :count, :count] + np.eye(count))
    half = _solve(root, gram[..., :count, count:])
    schur = gram[..., count:, count:] - np.swapaxes(half, -1, -2) @ half
    log_integral = -np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), -1)
    weights = np.swapaxes(_solve(np.swapaxes(root, -1, -2), half), -1, -2)
    return Marginalised(schur, log_integral, root, weights)


class Amplitudes(NamedTuple):
    """Log integral over amplitudes, its derivatives by the quadratic form, and mean and sd under the best scales."""

    log_integral: float
    mean: np.ndarray
    sd: np.ndarray
    slope: np.ndarray


def amplitudes(left: np.ndarray, sign: np.ndarray, largest: np.ndarray) -> Amplitudes:
    """Integrate amplitudes out under an equal mixture of half-normal priors (normal if both signs are physical).

    Their scales are spread evenly in the logarithm from 1 to `largest`. Where several are cut, the corner's probability
    is taken for the product of the single ones.
    """
    count, gram, score = len(sign), left[:-1, :-1], left[:-1, -1]
    axes = np.meshgrid(*[np.linspace(0, 1, SCALES)] * count, indexing="ij")
    scale = np.exp(np.stack([a.ravel() for a in axes], -1) * np.log(largest)) if count else np.ones((1, 0))
    root = _root(gram + np.eye(count) * scale[:, None, :] ** -2.0)
    half = _solve(root, np.broadcast_to(np.eye(count), root.shape))
    covariance = np.swapaxes(half, 1, 2) @ half
    mean, sd = covariance @ score, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    z = sign * mean / sd
    cut = np.where(sign == 0, 0.0, np.log(2) + log_ndtr(z))
    value = 0.5 * mean @ score + np.sum(np.log(np.diagonal(half, axis1=1, axis2=2)) - np.log(scale) + cut, 1)
    total = float(np.logaddexp.reduce(value))
    weight = np.exp(value - total)[:, None, None]
    # Of mean and standard deviation by the form: the covariance's change is -C dG C, the mean's C ds - C dG m.
    ratio = np.where(sign == 0, 0.0, np.exp(-0.5 * z**2 - 0.5 * LOG_2PI - log_ndtr(z)))
    by_mean = (covariance @ (ratio * sign / sd)[..., None])[..., 0]
    by_variance = (covariance * (ratio * z / (2 * sd**2))[:, None, :]) @ covariance
    outer = (mean[:, :, None] * (mean + 2 * by_mean)[:, None, :]).transpose(0, 2, 1)
    by_gram = np.sum(weight * (-0.5 * (outer + covariance) + by_variance), 0)
    by_score = np.sum(weight[..., 0] * (mean + by_mean), 0)
    slope = np.full(left.shape, -0.5)
    slope[:-1, :-1] = (by_gram + by_gram.T) / 2
    slope[:-1, -1] = slope[-1, :-1] = by_score / 2
    best = int(np.argmax(value))
    return Amplitudes(total - count * float(np.log(SCALES)) - 0.5 * left[-1, -1], mean[best], sd[best], slope)


def log_prior(hyper: np.ndarray, design: Design) -> tuple[float, np.ndarray]:
    """Log prior of the hyperparameters, and its derivatives; of a spread's coordinate of either sign together."""
    noise, at, misfits = _parts(hyper, design)
    spreads = spreads_of(at, design.spreads)
    means, sds = np.concatenate([design.noise, design.misfits[:, :2].T], 1)
    z = (np.append(noise, misfits) - means) / sds
    normal, slope = -0.5 * z**2 - np.log(sds) - 0.5 * LOG_2PI, -z / sds
    total = np.sum(np.concatenate([normal[:4], spreads.log_prob, normal[4:]]))
    return float(total), np.concatenate([slope[:4], spreads.log_prob_slope, slope[4:]])


def _of_shared(gram: np.ndarray, design: Design) -> tuple[float, float, np.ndarray]:
    """Log integrals over common numbers and over amplitudes, and the derivatives of their sum by the scaled form."""
    shared = marginalise(gram, design.common.shape[-1])
    effects = amplitudes(shared.schur, design.sign, design.largest)
    return shared.log_integral, effects.log_integral, shared.slope(effects.slope)


def value_and_gradient(hyper: np.ndarray, design: Design, *, of_noise: bool = True) -> tuple[float, np.ndarray]:
    """Log marginal likelihood times prior, and its derivatives; by the noise, which cost most, only if `of_noise`."""
    o, c = design.own.shape[-1], design.common.shape[-1]
    with np.errstate(all="ignore"):  # of steps into numbers beyond arithmetic
        model = LinearModel(hyper, design)
        common, effects, of_schur = _of_shared(model.particles.schur.sum(0), design)
        prior, slope = log_prior(hyper, design)
        of_gram = model.particles.slope(of_schur)
        by_noise = design.columns.slope(hyper, _scaled(of_gram, model.factor)) if of_noise else np.zeros(4)
        of_log = 2 * np.sum(of_gram * model.gram, (0, 2))  # derivatives by the logarithms of the columns' scales
        spreads = spreads_of(_parts(hyper, design)[1], design.spreads)
        by_spreads = np.delete(of_log[:o], 4) * spreads.slope / np.maximum(spreads.value, 1e-300)
        by_misfits = np.bincount(design.group, of_log[o : o + c], len(design.misfits) + 1)[1:]
        value = float(model.log_integral.sum() + common) + effects + prior
    return value, slope + np.concatenate([by_noise, by_spreads, by_misfits])


class Solution(NamedTuple):
    """Posterior means at the hyperparameters, in units of the columns of the design."""

    own: Float[np.ndarray, "particles o"]
    common: Float[np.ndarray, " c"]
    amplitude: Float[np.ndarray, " k"]
    sd: Float[np.ndarray, " k"]  # of the amplitudes


class LinearModel:
    """A hypothesis at fixed hyperparameters: linear and Gaussian, each particle's own numbers integrated out."""

    def __init__(self, hyper: np.ndarray, design: Design) -> None:
        gram, log_density = design.columns.gram(hyper)
        self.hyper, self.design, self.scales = hyper, design, scales_of(hyper, design)
        self.factor = np.concatenate([*self.scales, np.ones(design.amplitude.shape[-1] + 1)])
        self.gram = _scaled(gram, self.factor)
        self.particles = marginalise(self.gram, design.own.shape[-1])
        self.log_integral = self.particles.log_integral + log_density

    def shared(self, rows: Any = ALL) -> Marginalised:
        """What some particles say of the amplitudes, once what all particles share is integrated out, too."""
        return marginalise(self.particles.schur[rows].sum(0), self.design.common.shape[-1])

    def log_evidence(self, rows: Any = ALL) -> float:
        """Log marginal likelihood of some particles."""
        shared = self.shared(rows)
        effects = amplitudes(shared.schur, self.design.sign, self.design.largest)
        return float(self.log_integral[rows].sum() + shared.log_integral) + effects.log_integral

    def numbers(self, rows: Any = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Means of the scaled common numbers and of the amplitudes by some particles, and the amplitudes' errors."""
        shared = self.shared(rows)
        found = amplitudes(shared.schur, self.design.sign, self.design.largest)
        theta = np.where(self.design.sign * found.mean < 0, 0.0, found.mean)  # none of a forbidden sign
        return np.concatenate([np.append(-theta, 1.0) @ shared.weights, theta]), found.sd

    def solve(self) -> Solution:
        """Posterior means of all numbers."""
        numbers, sd = self.numbers()
        own, c = np.append(-numbers, 1.0) @ self.particles.weights, self.design.common.shape[-1]
        return Solution(own * self.scales[0], numbers[:c] * self.scales[1], numbers[c:], sd)

    def covariance(self) -> np.ndarray:
        """Posterior covariance of the scaled common numbers and of the amplitudes, these with their widest prior."""
        information = self.particles.schur.sum(0)[:-1, :-1]
        prior = np.concatenate([np.ones(self.design.common.shape[-1]), 1 / self.design.largest**2])
        return np.linalg.inv(information + np.diag(prior))


def log_joint(hyper: np.ndarray, design: Design) -> float:
    """Log marginal likelihood at the hyperparameters, times their prior."""
    return LinearModel(hyper, design).log_evidence() + log_prior(hyper, design)[0]


def with_little_noise(hyper: np.ndarray) -> np.ndarray:
    """Hyperparameters with correlated noise that has not swallowed a gap."""
    at = hyper.copy()
    at[2] += np.log(LITTLE)
    return at


@dataclass(frozen=True)
class Optimum:
    """The mode of the hyperparameters."""

    hyper: np.ndarray
    log_evidence: float  # log marginal likelihood, the hyperparameters integrated out by Laplace's method
    log_joint: float  # at the mode


class _Surface:
    """Minus the log posterior of a design's hyperparameters, in coordinates scaled by their expected curvature."""

    def __init__(self, design: Design) -> None:
        count, spreads = float(np.asarray(design.tests.mask).sum()), len(design.spreads)
        self.design, self.first = design, 4 + spreads  # hyperparameters that are no scales of misfits
        noise = count * np.array([1.5, 0.2, 0.1, 0.02])
        expected = [noise, np.full(spreads, 2.0 * len(design.tests)), np.full(len(design.misfits), 2.0)]
        self.scale = 1 / np.sqrt(np.concatenate(expected))  # unit of each coordinate
        self.most = np.concatenate([np.full(self.first, np.inf), design.misfits[:, 2]]) / self.scale
        self.options: Any = {"ftol": 1e-7, "gtol": FLAT, "maxiter": ITERATIONS}

    def _minimise(self, function: ValueAndSlope, start: np.ndarray, **more: Any) -> Any:
        from scipy.optimize import minimize

        return minimize(function, start, jac=True, method="L-BFGS-B", options=self.options, **more)

    def _negative(self, value: float, slope: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus value and slope; a step beyond arithmetic is taken back."""
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return 1e30, np.zeros(len(slope))
        return -value, -slope * self.scale[len(self.scale) - len(slope) :]

    def at(self, x: np.ndarray, *, of_noise: bool = True) -> tuple[float, np.ndarray]:
        """Value and slope, as of `value_and_gradient`."""
        return self._negative(*value_and_gradient(x * self.scale, self.design, of_noise=of_noise))

    def of_misfits(self, x: np.ndarray) -> ValueAndSlope:
        """Value and slope as a function of the scales of misfits alone: at fixed noise and spreads it costs nothing."""
        design, hyper = self.design, x * self.scale
        o, c = design.own.shape[-1], design.common.shape[-1]
        whole, log_density = design.columns.gram(hyper)
        own, _ = scales_of(hyper, design)
        particles = marginalise(_scaled(whole, np.append(own, np.ones(whole.shape[-1] - o))), o)
        integral, form = float((particles.log_integral + log_density).sum()), particles.schur.sum(0)

        def at(y: np.ndarray) -> tuple[float, np.ndarray]:
            hyper = np.append(x[: self.first], y) * self.scale
            scales = np.append(scales_of(hyper, design)[1], np.ones(len(form) - c))
            with np.errstate(all="ignore"):
                gram = _scaled(form, scales)
                common, effects, of_gram = _of_shared(gram, design)
                prior, slope = log_prior(hyper, design)
                of_log = 2 * np.sum(of_gram * gram, 0)[:c]
            of_scales = np.bincount(design.group, of_log, len(y) + 1)[1:]
            return self._negative(integral + float(common) + effects + prior, slope[self.first :] + of_scales)

        return at

    def followed(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Where the scales of misfits are at their mode, all else as it is: the value there, and all coordinates."""
        bounds = [(None, None if np.isinf(one) else one) for one in self.most[self.first :]]
        found = self._minimise(self.of_misfits(x), x[self.first :], bounds=bounds)
        return float(found.fun), np.append(x[: self.first], found.x)

    def mode(self, start: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """The lowest point met by L-BFGS: value, coordinates and slope."""
        x = start.copy()
        least: list[Any] = [1e30, x.copy(), np.zeros(len(x))]

        def down(y: np.ndarray) -> tuple[float, np.ndarray]:
            # Scales of misfits cost nothing while noise and spreads stay: they follow, and at their mode have no slope.
            x[: self.first] = y
            if len(self.design.misfits):
                x[:] = self.followed(x)[1]
            value, slope = self.at(x)
            if value < least[0]:
                least[:] = value, x.copy(), slope
            return value, slope[: self.first]

        self._minimise(down, x[: self.first].copy())
        value, at, slope = least
        return value, at, slope

    def curvature(self, x: np.ndarray, jac: np.ndarray, known: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Eigenvalues and eigenvectors of the curvature at a mode of slope `jac`, by all but the first `known`
        hyperparameters and those at their bound, and which ones these are."""
        wanted = np.flatnonzero(~self.bound(x))
        wanted = wanted[wanted >= known]
        columns = np.zeros((len(wanted), len(wanted)))
        for row, j in enumerate(wanted.tolist()):
            e = np.where(np.arange(len(x)) == j, ASIDE, 0.0)
            columns[row] = (self.at(x + e, of_noise=j < 4)[1] - jac)[wanted] / ASIDE
        noise = int(np.sum(wanted < 4))
        columns[noise:, :noise] = columns[:noise, noise:].T
        values, vectors = np.linalg.eigh((columns + columns.T) / 2)
        return np.maximum(values, 1e-3), vectors, wanted

    def bound(self, x: np.ndarray) -> np.ndarray:
        """Which hyperparameters are as large as they may be."""
        return x * self.scale >= self.most * self.scale - 1e-6

    def log_volume(self, x: np.ndarray, jac: np.ndarray, known: int) -> float:
        """What Laplace's method adds for all but the first `known` hyperparameters at their mode, of slope `jac`."""
        scale, first, bound = self.scale, self.first, self.bound(x)
        volume = -float(np.sum(np.log(np.maximum(-jac[bound] / scale[bound], 1.0))))  # an exponential, cut off
        values, vectors, wanted = self.curvature(x, jac, known)
        # A spread's coordinate is of either sign: close to zero, both are the same.
        of_spreads = (wanted >= 4) & (wanted < first)
        sd = np.sqrt(np.sum(vectors**2 / values, 1))
        volume += float(np.sum(log_ndtr(np.abs(x[wanted]) / sd)[of_spreads]))
        normal = 0.5 * len(wanted) * np.log(2 * np.pi) - 0.5 * np.sum(np.log(values)) + np.sum(np.log(scale[wanted]))
        return volume + float(normal)


def likely_start(design: Design, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Where to look for the mode of a hypothesis with misfits, and the log posterior there: at the start, or at another
    setting of correlated noise, which may have swallowed what misfits explain."""
    surface = _Surface(design)
    x, unit = np.minimum(start / surface.scale, surface.most), surface.scale[2:4]
    factors = np.log([(1.0, 1.0), *((factor, LENGTH_FACTORS[-1]) for factor in NOISE_FACTORS[1:])])
    some = [surface.followed(np.concatenate([x[:2], x[2:4] + by / unit, x[4:]])) for by in factors]
    best = min(some, key=lambda one: one[0])
    value, x = best if best[0] < some[0][0] - STRONG else some[0]
    return x * surface.scale, -value


def optimise(design: Design, start: np.ndarray, *, curvature: bool = True, without: Optimum | None = None) -> Optimum:
    """The mode of the hyperparameters by L-BFGS, in coordinates scaled by their expected curvature.

    Without `curvature`, `log_evidence` is the log posterior at the mode. The curvature of an optimum `without` misfits
    is taken for that of the hyperparameters it has. Raises FloatingPointError where there is no evidence at the start.
    """
    surface = _Surface(design)
    value, x, jac = surface.mode(np.minimum(start / surface.scale, surface.most))
    evidence = joint = -float(value)
    if joint < -1e29:
        raise FloatingPointError("the evidence of a hypothesis is no number")
    if curvature:
        known = 0 if without is None else len(without.hyper)
        evidence += surface.log_volume(x, jac, known)
        evidence += 0.0 if without is None else without.log_evidence - without.log_joint
    return Optimum(x * surface.scale, float(evidence), joint)


def around(hyper: np.ndarray, design: Design) -> list[tuple[np.ndarray, np.ndarray]]:
    """Hyperparameters a standard deviation to either side of their mode, along each axis of their posterior."""
    surface = _Surface(design)
    x = hyper / surface.scale
    values, vectors, wanted = surface.curvature(x, surface.at(x)[1])
    steps = np.zeros((len(wanted), len(x)))
    steps[:, wanted] = (vectors / np.sqrt(values)).T
    either = [np.minimum(np.array([x + step, x - step]), surface.most) * surface.scale for step in steps]
    return [(above, below) for above, below in either]


def visible(hyper: np.ndarray, design: Design, curves: np.ndarray) -> np.ndarray:
    """What the particles' own numbers and the population leave of each curve [um], as a share, in units of noise."""
    model = LinearModel(hyper, design.with_amplitudes(curves))
    whole = np.diagonal(model.gram.sum(0))[-1 - curves.shape[-1] : -1]
    return np.sqrt(np.clip(np.diagonal(model.shared().information) / np.maximum(whole, 1e-300), 0.0, 1.0))


def residual_of(solution: Solution, design: Design) -> Float[np.ndarray, "particles points"]:
    """What a solution leaves of the data [um]."""
    own = np.einsum("npo,no->np", design.own, solution.own)
    return design.data - own - design.common @ solution.common - design.amplitude @ solution.amplitude


def whitened(hyper: np.ndarray, design: Design, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values over the points [um], independent and of variance 1, and the sd of each point given those before it."""
    white = Columns(values[..., None], design).white(hyper)
    return white.columns[..., 0], white.sd
