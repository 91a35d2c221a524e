"""The NumPyro model: its distributions, its priors, its density with and without effects, and its mode."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.handlers
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from joint_cases import NOISE, random_marginal, simulated
from numpyro.infer import Predictive
from numpyro.infer.util import constrain_fn, potential_energy, unconstrain_fn
from scipy.integrate import trapezoid
from scipy.stats import kstest, lognorm, nakagami, norm

from mcc_jax import InputError, Model, Priors, Programme
from mcc_jax.calibrate import NakagamiPrior, NormalPrior, select_tests
from mcc_jax.calibrate.draws import coordinates_of
from mcc_jax.calibrate.forward import Point
from mcc_jax.calibrate.mode import LogPosterior, Shapes, most_probable, populations, seeded
from mcc_jax.calibrate.noise import standard_promotion
from mcc_jax.calibrate.priors import Amplitude, SpreadCoordinate, check_prior_of_a, nuisance_prior, population_sites
from mcc_jax.effects import LIBRARY, find_variant

EFFECTS = Model().with_effects("creep:logarithmic", "unloading_shape:symmetric_bow", varying="creep")
MODELS = {"effects": EFFECTS, "plain": Model(modulus_scatter=True, shape_scatter=True)}
models = pytest.mark.parametrize("model", list(MODELS.values()), ids=MODELS)
FLAT = np.random.default_rng(0).uniform(0.05, 0.5, 12)


@pytest.fixture(scope="module")
def tests():
    programme = Programme.cycles(levels=(0.5, 1.0), hold_s=30.0, points=60)
    return select_tests(simulated(instrument=NOISE, programme=programme))


# ---- distributions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [0.5, 0.125])
def test_a_spread_has_the_prior_of_nakagami(shape):
    law = SpreadCoordinate(NakagamiPrior(0.2, shape))
    theirs = nakagami(shape, scale=0.2 * np.sqrt(2 * shape))
    tau = np.asarray(law.spread(law.sample(jax.random.key(0), (20_000,))))
    assert kstest(tau, theirs.cdf).pvalue > 1e-3
    # The density of the coordinate is that of the spread, of both signs, times the slope of the map.
    x = jnp.asarray([1e-3, 0.1, 0.7, 2.0, 3.0])
    slope = jax.vmap(jax.grad(law.spread))(x)
    expected = theirs.logpdf(law.spread(x)) + np.log(slope) - np.log(2)
    np.testing.assert_allclose(law.log_prob(x), expected, rtol=1e-9)
    np.testing.assert_allclose(law.log_prob(-x), law.log_prob(x), rtol=1e-12)
    np.testing.assert_allclose(law.coordinate(law.spread(x)), x, rtol=1e-9)
    assert np.all(np.isfinite(jax.vmap(jax.grad(law.log_prob))(jnp.asarray([0.0, 1e-300, 50.0]))))


@pytest.mark.extended
@pytest.mark.parametrize("variant", EFFECTS.effects, ids=["one sign", "both signs"])
def test_an_amplitude_may_be_of_any_size_that_is_plausible(variant):
    law, most = Amplitude(variant), variant.plausible[1] / variant.plausible[0]
    drawn = np.asarray(law.sample(jax.random.key(1), (20_000,)))
    grid = np.concatenate([-np.geomspace(10 * most, 1e-4, 20_000), np.geomspace(1e-4, 10 * most, 20_000)])
    density = np.exp(law.log_prob(jnp.asarray(grid)))
    if variant.sign:
        assert drawn.min() >= 0
        density = np.where(grid > 0, density, 0.0)
    np.testing.assert_allclose(trapezoid(density, grid), 1.0, atol=2e-3)
    for share in (0.25, 0.5, 0.9):
        at = np.quantile(drawn, share)
        np.testing.assert_allclose(trapezoid(np.where(grid < at, density, 0.0), grid), share, atol=0.015)
    # The logarithm of its size is nearly even over what is plausible.
    sizes = np.mean(np.abs(drawn)[:, None] < np.geomspace(1, most, 5), axis=0)
    assert np.all(np.diff(sizes) > 0.1)


@pytest.mark.extended
def test_a_further_number_lies_within_what_is_plausible():
    for variant in (v for m in LIBRARY.values() for v in m):
        for nuisance in variant.nuisances:
            low, high = nuisance.plausible
            with standard_promotion():
                drawn = np.asarray(nuisance_prior(nuisance).sample(jax.random.key(0), (2000,)))
            assert np.mean((drawn >= low) & (drawn <= high)) > 0.9
            middle = np.exp(np.log(drawn).mean()) if low > 0 else drawn.mean()
            expected = np.sqrt(low * high) if low > 0 else (low + high) / 2
            np.testing.assert_allclose(middle, expected, rtol=0.1, atol=0.05 * (high - low) * (low <= 0))


# ---- the model -------------------------------------------------------------------------------------------------------


@pytest.mark.extended
@models
def test_potential_and_gradient_are_finite_from_prior_draws_on(model, tests):
    """Of the model that users hand to NumPyro, noise and particles' own numbers sampled."""

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def expanded(key):
        with standard_promotion():
            trace = numpyro.handlers.trace(numpyro.handlers.seed(model, key)).get_trace(tests)
            sites = {n: s["value"] for n, s in trace.items() if s["type"] == "sample" and not s["is_observed"]}
            free = unconstrain_fn(model, (tests,), {}, sites)
            return jax.value_and_grad(lambda x: potential_energy(model, (tests,), {}, x))(free)

    for key in jax.random.split(jax.random.key(0), 20):
        value, slope = expanded(key)
        assert np.isfinite(float(value))
        for name, one in slope.items():
            assert np.all(np.isfinite(one)), name
    for name in ("noise_displacement_um", "b3", "zero_um", "deviation"):
        assert np.any(np.asarray(slope[name]) != 0), name


@pytest.mark.extended
@pytest.mark.parametrize("model", [Model(modulus_scatter=True), EFFECTS], ids=["plain", "effects"])
def test_prior_draws_have_the_moments_of_the_priors(model, tests):
    count, p = 400, model.chosen_priors

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def predict(key):
        with standard_promotion():
            return Predictive(model, num_samples=count, parallel=True)(key, tests.unobserved())

    drawn = predict(jax.random.key(3))
    drawn = {name: np.asarray(values) for name, values in drawn.items()}
    flat = np.asarray(tests.flatness)
    shift = np.mean(np.log1p(drawn["a"][:, None] * flat), 1)
    softening = np.log(9 / 20) + 6 * drawn["b3"] - drawn["b1"] - 5 * drawn["b5"]
    normal = {
        "C1": (drawn["b1"] - shift, np.log(p.C1.median), p.C1.log_sd),
        "C5": (drawn["b5"] - shift, np.log(p.C5.median), p.C5.log_sd),
        "softening": (softening, np.log(p.softening.median), p.softening.log_sd),
        "modulus": (drawn["log_modulus"], np.log(p.effective_modulus_MPa.median), p.effective_modulus_MPa.log_sd),
        "noise": (np.log(drawn["noise_force_mN"]), np.log(p.noise_force_mN.median), p.noise_force_mN.log_sd),
        "zero": ((drawn["zero_um"] - np.asarray(tests.contact)).ravel(), p.zero_um.mean, p.zero_um.sd),
        "deviation": (drawn["deviation"].ravel(), 0.0, 1.0),
    }
    for name, (values, mean, sd) in normal.items():
        assert kstest(values, norm(mean, sd).cdf).pvalue > 1e-3, name
    np.testing.assert_allclose(drawn["C1_median"], np.exp(drawn["b1"] - shift), rtol=1e-9)
    assert np.all(1 + drawn["a"][:, None] * flat > 0)
    spread = nakagami(p.tau_C5.shape, scale=p.tau_C5.sd * np.sqrt(2 * p.tau_C5.shape))
    assert kstest(drawn["tau_C5"], spread.cdf).pvalue > 1e-3
    # A test is predicted where it counts, and nowhere else.
    predicted = drawn["displacement_um"]
    np.testing.assert_array_equal(np.isfinite(predicted).all(0), tests.mask)
    assert not np.isfinite(predicted[:, ~np.asarray(tests.mask)]).any()
    if model.effects:
        creep = find_variant("creep:logarithmic")
        assert np.all(drawn["creep"] > 0)
        np.testing.assert_allclose(drawn["creep"], drawn["creep_size"] * creep.plausible[0], rtol=1e-9)
        low, high = creep.nuisances[0].plausible
        law = lognorm(np.log(high / low) / 4, scale=np.sqrt(low * high))
        assert kstest(drawn["creep.tau_s"], law.cdf).pvalue > 1e-3


@pytest.mark.extended
def test_an_amplitude_keeps_its_physical_sign():
    down = replace(find_variant("creep:logarithmic"), sign=-1)
    model = Model().with_effects(down, "unloading_shape:symmetric_bow")
    target = LogPosterior(model, at_random(np.random.default_rng(0), model))
    free = jnp.asarray([-5.0, 0.0, 5.0])[:, None] * jnp.ones((1, len(target.names)))
    creep, bow = np.asarray(populations(free, target).theta)[:, :2].T
    assert np.all(creep < 0)
    assert bow[0] < 0 < bow[2]


# ---- the density of the population -----------------------------------------------------------------------------------


def at_random(rng, model, scale=0.03):
    """Tests of twelve particles of a population, each number known to about `scale`."""
    log_eta = np.log(1 + 1.4 * FLAT)[:, None]
    latent = np.array([1.9, 1.1, 1.0, 9.6]) + rng.standard_normal((12, 4)) * np.array([0.3, 0.03, 0.08, 0.01])
    latent[:, :3] += log_eta
    typical = [v.typical for v in model.effects] + [n.middle for v in model.effects for n in v.nuisances]
    point = Point(jnp.asarray(latent), jnp.zeros(12), jnp.asarray(np.tile(np.reshape(typical, (1, -1)), (12, 1))))
    marginal = random_marginal(rng, model.scatter, point, FLAT, scale=scale)
    # Every number of an effect is known to a share of itself.
    unit = 1 / np.concatenate([np.ones(4), typical, [1.0]])
    return replace(marginal, gram=marginal.gram * (unit * unit[:, None])[None])


@pytest.fixture(scope="module", params=list(MODELS.values()), ids=MODELS)
def target(request):
    return LogPosterior(request.param, at_random(np.random.default_rng(5), request.param))


@pytest.fixture(scope="module")
def density(target):
    return eqx.filter_jit(jax.value_and_grad(lambda free: target.log_density(free)))


def values_at(free, target):
    with standard_promotion():
        return constrain_fn(seeded(target.model.population), (target.marginal,), {}, target.sites(free))


def test_the_density_is_priors_times_likelihood_times_volume(target, density):
    """Priors of the sites as `population_sites` has them; the volume is that of the map from unbounded coordinates."""

    @eqx.filter_jit
    def parts(free):
        def sites(x):
            return jnp.stack([values_at(x, target)[name] for name in target.names])

        population = target.population(free)
        return jax.jacfwd(sites)(free), population, jnp.sum(target.marginal.log_likelihood(population))

    rng = np.random.default_rng(1)
    for _ in range(3):
        free = jnp.asarray(0.7 * rng.standard_normal(len(target.names)))
        jacobian, population, expected = parts(free)
        one = jax.tree.map(lambda x: np.asarray(x)[None], population)
        known = coordinates_of(one, target.model)
        sites = population_sites(target.model, np.asarray(target.marginal.flatness), known)
        expected += sum(v[0] for v in sites.log_densities().values())
        expected += np.linalg.slogdet(np.asarray(jacobian))[1]
        np.testing.assert_allclose(float(density(free)[0]), expected, rtol=1e-9)


@pytest.mark.extended
def test_coordinates_and_back(target):
    free = np.random.default_rng(2).standard_normal(len(target.names))
    free[target.signed()] = np.abs(free[target.signed()])
    free = jnp.asarray(free)
    population = target.population(free)
    again = target.unconstrain(values_at(free, target))
    np.testing.assert_allclose(again, free, rtol=1e-8, atol=1e-8)
    many = populations(jnp.stack([free, free]), target)
    for one, both in zip(jax.tree.leaves(population), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(both, np.stack([one, one]), rtol=1e-12)


@pytest.mark.extended
@settings(max_examples=40)
@given(
    st.floats(-800, 800), st.sampled_from([0.0, 1e-300, 1e-8, 0.3]), st.floats(-3, 3), st.sampled_from([-1.0, 0.0, 1.0])
)
def test_at_the_bounds_of_a_and_without_spreads_nothing_is_nan(target, density, unit, tau, mu, log_noise):
    values = {"a": unit, "log_modulus": 9.0, "b1": 1.8 + mu, "b3": 1.1, "b5": 1.0, "log_noise_factor": log_noise}
    free = [values.get(name, tau if name.endswith("coordinate") else 0.0) for name in target.names]
    value, slope = density(jnp.asarray(free))
    assert np.isfinite(float(value))
    assert np.all(np.isfinite(np.asarray(slope)))


@pytest.mark.extended
@pytest.mark.parametrize("flat", [[0.0, 0.0], [0.6, 0.2], [-0.3, -0.1], [-0.4, 0.7], [-3.0, 0.99]])
def test_within_the_bounds_of_a_every_shape_factor_is_positive(flat):
    shapes = Shapes(jnp.asarray(flat))
    with standard_promotion():
        prior = numpyro.handlers.seed(Model().population, jax.random.key(0))
        a = numpyro.handlers.trace(prior).get_trace(shapes)["a"]["fn"].support
    assert float(a.lower_bound) < float(a.upper_bound)
    for bound in (a.lower_bound, a.upper_bound):
        assert np.all(1 + float(bound) * np.asarray(flat) > 0.01)


@pytest.mark.parametrize(("mean", "flat"), [(2.0, [-0.8, 0.3]), (-4.0, [0.3, 0.6])])
def test_a_prior_of_a_that_contradicts_the_shapes_is_told(mean, flat):
    """Particles for which every believable `a` would give a shape factor below zero."""
    with pytest.raises(InputError, match="no value under which every particle's shape factor is positive"):
        check_prior_of_a(Priors(a=NormalPrior(mean, 0.05)), np.array(flat))


# ---- its mode --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mode(target):
    start = jnp.asarray([0.3 if name.endswith("coordinate") else 0.0 for name in target.names])
    for name, value in {"log_modulus": 9.4, "b1": 2.1, "b3": 1.3, "b5": 1.2}.items():
        start = start.at[target.names.index(name)].set(value)
    return start, most_probable(start, target)


@pytest.mark.extended
def test_the_mode_is_one_and_the_covariance_the_inverse_curvature(density, mode):
    start, (free, covariance, converged) = mode
    assert converged
    value, slope = density(free)
    width = np.sqrt(np.diag(np.asarray(covariance)))
    # Found by differences, so that third derivatives move it: by less than 3 % of a standard deviation.
    assert slope @ covariance @ slope < 0.03**2
    assert float(value) > float(density(start)[0])
    rows = []
    for direction in np.diag(width):
        for sign in (-1, 1):
            assert float(density(free + 0.3 * sign * direction)[0]) < float(value)
        down, up = (np.asarray(density(free + s * 1e-3 * direction)[1]) for s in (-1, 1))
        rows.append((down - up) / 2e-3 * width)
    assert np.all(np.linalg.eigvalsh(np.asarray(covariance)) > 0)
    product = np.asarray(covariance) / width / width[:, None] @ np.array(rows)
    np.testing.assert_allclose(product, np.eye(len(width)), atol=3e-2)
