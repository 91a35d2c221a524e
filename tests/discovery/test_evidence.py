"""The log evidence of a hypothesis: what the multivariate normal distribution says."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from campaigns import base_of, cached, with_curves
from scipy.integrate import quad
from scipy.special import softmax
from scipy.stats import multivariate_normal, norm

from mcc_jax import Model, sample
from mcc_jax.calibrate.noise import Along, Correlation
from mcc_jax.calibrate.priors import SCALES, nuisance_moments
from mcc_jax.discovery.answer import population_under
from mcc_jax.discovery.design import ExtraColumns, design_of
from mcc_jax.discovery.evidence import (
    LinearModel,
    amplitudes,
    around,
    log_joint,
    optimise,
    residual_of,
    scales_of,
    value_and_gradient,
    whitened,
)
from mcc_jax.discovery.fit import between, fit_hypothesis, moved, with_likely_noise
from mcc_jax.discovery.settings import POPULATION
from mcc_jax.effects import find_variant

pytestmark = pytest.mark.extended

COMPLIANCE = 0.004


@pytest.fixture(scope="module")
def base():
    return base_of(cached(f"frame_compliance={COMPLIANCE}"))


@pytest.fixture(scope="module")
def design(base):
    return design_of(base, base.state)


def covariance(design, hyper):
    """Of all tests together: noise, every particle's own numbers, and what all share."""
    own, common = scales_of(hyper, design)
    N, P = design.data.shape
    mask = np.asarray(design.tests.mask)
    unit = np.broadcast_to(np.eye(P), (N, P, P))
    columns = [whitened(hyper, design, unit[:, :, k])[0] for k in range(P)]
    whole = np.zeros((N * P, N * P))
    for i in range(N):
        W = np.stack([column[i] for column in columns], 1)[np.ix_(mask[i], mask[i])]
        at = i * P + np.flatnonzero(mask[i])
        X = np.asarray(design.own[i])[mask[i]] * np.asarray(own)
        whole[np.ix_(at, at)] = np.linalg.inv(W.T @ W) + X @ X.T
    B = (np.asarray(design.common) * np.asarray(common)).reshape(N * P, -1)
    rows = np.flatnonzero(mask.ravel())
    return (whole + B @ B.T)[np.ix_(rows, rows)], np.asarray(design.data).ravel()[rows]


def test_it_is_the_density_of_the_multivariate_normal(base, design):
    """Particles first, then what all share: integrals in closed form. Readings of a display add a known constant."""
    names = ("tests", "linear", "own", "common", "amplitude", "data", "scale")
    small = replace(design, **{name: jax.tree.map(lambda x: x[:3], getattr(design, name)) for name in names})
    hyper = base.hyperparameters
    found = LinearModel(hyper, small).log_evidence()
    matrix, data = covariance(small, hyper)
    wanted = multivariate_normal(np.zeros(len(data)), matrix, allow_singular=False).logpdf(data)
    assert found == pytest.approx(wanted, abs=0.5)  # the finite steps of a display


@pytest.mark.parametrize("sign", [-1, 0, 1])
def test_an_amplitude_is_integrated_over_its_mixture_of_half_normals(sign):
    gram, score, ratio = 0.7, 1.3 * (sign or 1), 50.0
    left = np.array([[gram, score], [score, 0.0]])
    value = amplitudes(left, np.array([float(sign)]), np.array([ratio])).log_integral
    scales = np.geomspace(1, ratio, SCALES)

    def density(theta):
        prior = np.mean([norm.pdf(theta, scale=s) for s in scales]) * (2 if sign else 1)
        return np.exp(score * theta - 0.5 * gram * theta**2) * (prior if sign * theta >= 0 else 0.0)

    total = quad(density, -400, 0, limit=400)[0] + quad(density, 0, 400, limit=400)[0]
    assert value == pytest.approx(np.log(total), rel=1e-6)


def test_its_derivatives_are_those_of_differences(base, design):
    """By the noise, the spreads, and a misfit's scale, with two amplitudes of which one is cut."""
    variants = find_variant("frame_compliance:linear"), find_variant("thermal_drift:linear")
    rng, mask = np.random.default_rng(1), np.asarray(base.tests.mask)
    basis = rng.normal(scale=0.1, size=(*mask.shape, 3)) * mask[..., None]
    sizes = [(-1.0, 1.0, np.inf), (-2.0, 0.8, np.inf)]
    more = ExtraColumns(misfits=(basis[..., :2], basis[..., 2:]), sizes=sizes)
    two = design_of(base, base.state.with_numbers(np.zeros(2)), variants, more)
    for one, hyper in ((design, base.hyperparameters), (two, np.append(base.hyperparameters, [-1.0, -2.0]))):
        value, slope = value_and_gradient(hyper, one)
        assert value == pytest.approx(log_joint(hyper, one), rel=1e-12)
        steps = 1e-5 * np.eye(len(hyper))
        wanted = [(log_joint(hyper + e, one) - log_joint(hyper - e, one)) / 2e-5 for e in steps]
        np.testing.assert_allclose(slope, wanted, rtol=1e-4, atol=1e-3)


def test_columns_of_nothing_have_no_say(base, design):
    """A misfit whose columns are zero: the same evidence, the same numbers."""
    nothing = ExtraColumns(misfits=(np.zeros((*design.data.shape, 3)),), sizes=[(0.0, 1.0, np.inf)])
    roomy = design_of(base, base.state, (), nothing)
    one, other = optimise(design, base.hyperparameters), optimise(roomy, np.append(base.hyperparameters, 0.0))
    assert other.log_evidence == pytest.approx(one.log_evidence, abs=0.02)
    np.testing.assert_allclose(other.hyper[:8], one.hyper, atol=0.02)
    both = optimise(roomy, np.append(one.hyper, 0.0), without=one)
    assert both.log_evidence == pytest.approx(one.log_evidence, abs=0.02)


def test_what_a_solution_leaves_is_what_the_law_leaves_there(base):
    """One Gauss-Newton step on, the exact residuals are those of the linear model to second order."""
    variant = find_variant("frame_compliance:linear")
    state = base.state.with_numbers(np.zeros(1))
    design = design_of(base, state, (variant,))
    solution = LinearModel(base.hyperparameters, design).solve()
    there = design_of(base, moved(base, state, (variant,), solution), (variant,))
    still = residual_of(LinearModel(base.hyperparameters, there).solve(), there)
    mask = np.asarray(base.tests.mask)
    assert np.sqrt(np.mean((residual_of(solution, design) - still)[mask] ** 2)) < 0.02
    half = between(state, moved(base, state, (variant,), solution))
    assert float(half.point.theta[0, 0]) == pytest.approx(0.5 * float(solution.amplitude[0]) * variant.plausible[0])


def test_a_step_that_is_cut_short_is_cut_for_all_numbers(base):
    """An amplitude that is right at the solution is wrong beside a time on the way there: steps that cut the time alone
    went to and fro, and could end with an amplitude of zero."""
    variant = find_variant("creep:kelvin_voigt")
    (time,), unit = variant.nuisances, variant.plausible[0]
    state = base.state.with_numbers(np.array([unit, 100.0]))
    found = LinearModel(base.hyperparameters, design_of(base, state, (variant,))).solve()
    mean, sd = nuisance_moments(time)
    common = found.common.copy()
    common[POPULATION] = (np.log(100.0) + 3.0 - mean) / sd  # three powers of e away
    there = moved(base, state, (variant,), found._replace(common=common, amplitude=np.array([4.0])))
    np.testing.assert_allclose(there.point.theta[0], [2.0 * unit, 100.0 * np.e], rtol=1e-6)
    # Where the amplitude is zero nothing tells of the time: it stays, and the others go all the way.
    nothing = base.state.with_numbers(np.array([0.0, 100.0]))
    there = moved(base, nothing, (variant,), found._replace(common=common, amplitude=np.array([4.0])))
    np.testing.assert_allclose(there.point.theta[0], [4.0 * unit, 100.0], rtol=1e-6)


def test_it_prefers_a_model_as_much_as_importance_sampling_does(base):
    campaign = cached(f"frame_compliance={COMPLIANCE}")
    model = Model(modulus_scatter=True)
    found = [sample(campaign, m).log_evidence[0] for m in (model, model.with_effects("frame_compliance:linear"))]
    nothing = fit_hypothesis(base, base.state, (), np.zeros(0), base.hyperparameters)
    variant = find_variant("frame_compliance:linear")
    frame = fit_hypothesis(base, nothing.state, (variant,), np.zeros(1), nothing.optimum.hyper)
    assert frame.theta[0] == pytest.approx(COMPLIANCE, rel=0.1)
    assert frame.log_evidence - nothing.log_evidence == pytest.approx(found[1] - found[0], rel=0.1)


def test_errors_of_parameters_allow_for_those_of_the_hyperparameters(base, design):
    """The law of total variance, by importance sampling of the hyperparameters."""
    mode = optimise(design, base.hyperparameters)
    _, sd, _ = population_under(base, None, mode.hyper, design)
    axes = np.array([(above - below) / 2 for above, below in around(mode.hyper, design)])
    normal = np.random.default_rng(0).standard_normal((600, len(axes)))
    means, variances, logs = [], [], []
    for z in normal:
        model = LinearModel(mode.hyper + z @ axes, design)
        factor = base.population_prior[1]
        means.append(factor @ model.solve().common[:POPULATION])
        variances.append(np.diagonal(factor @ model.covariance()[:POPULATION, :POPULATION] @ factor.T))
        logs.append(log_joint(model.hyper, design) + z @ z / 2)
    weights = softmax(logs)
    assert 1 / np.sum(weights**2) > 60
    total = weights @ np.array(variances) + weights @ np.array(means) ** 2 - (weights @ np.array(means)) ** 2
    np.testing.assert_allclose(sd[:POPULATION], np.sqrt(total), rtol=0.1)
    alone = np.diagonal(LinearModel(mode.hyper, design).covariance())[:POPULATION]
    assert np.any(total > 1.02 * np.diagonal(factor @ np.diag(alone) @ factor.T))


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
