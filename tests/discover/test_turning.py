"""What curvature adds to the scores: against the logarithm of the determinant itself, and what is found without it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from campaigns import MODEL, SINGLE, campaign, monotone_draws, peaks_at

from mcc_jax.campaign import PAPER_DIAMETERS_UM
from mcc_jax.discover.legacy.fit import population_at
from mcc_jax.discover.legacy.population import moments
from mcc_jax.discover.linear_model import base_fit, build_system, signals_of
from mcc_jax.discover.normal_equations import own_rows
from mcc_jax.discover.score import project
from mcc_jax.effects import LIBRARY, Mechanism
from mcc_jax.simulate import Instrument, law_for_each, simulate_campaign

pytestmark = pytest.mark.long  # compiles for long

CHOSEN = {"frame_compliance": "linear", "misalignment": "edge", "damage": "exponential", "unloading_shape": "tail_bow"}
SMALL = {n: Mechanism(n, LIBRARY[n].explanation, (LIBRARY[n][v],)) for n, v in CHOSEN.items()}


@pytest.fixture(scope="module")
def fitted():
    base = base_fit(campaign(), MODEL, threshold_MPa=0.0)
    signals = signals_of(base, SMALL, turned=True)
    return base, signals, build_system(base, signals)


def log_determinant(base, particle, own_change, theta, slopes):
    """Half the logarithm of the curvature's determinant, a particle's own parameters and a column moved."""
    population = population_at(base.fit.mode, base.fit.numbers, base.legacy_model.scatter)
    factor = moments(population, base.tests.flatness, base.legacy_model.scatter)[1]
    S = factor[particle]
    k = S.shape[-1]
    latent = base.fit.latent.at[particle].add(S @ own_change[:k])
    J = base.linear(latent).jacobian[particle]
    by_latent = J[:, :4] + theta * jnp.asarray(slopes.T, J.dtype)
    rows = own_rows(jnp.concatenate([by_latent, J[:, 4:]], 1), S)
    white = jax.tree.map(lambda leaf: leaf[particle], base.fit.filters)
    X = jax.vmap(white)(jnp.where(base.tests.mask[particle][None], rows, 0.0))
    prior = jnp.concatenate([jnp.ones(k), 1 / base.legacy_model.zero_sd[None] ** 2])
    return X, float(0.5 * jnp.linalg.slogdet(X @ X.T + jnp.diag(prior))[1]), prior, white


@pytest.mark.parametrize("particle", [0, 6])
@pytest.mark.parametrize("k", range(4))
def test_curvature_adds_the_slope_of_the_logarithm_of_the_determinant(fitted, particle, k):
    r""":math:`\tfrac12 d\log|H|/d\theta` along :math:`\hat b = -\theta H^{-1} X^T x`, by differences."""
    base, signals, system = fitted
    slopes = signals.turned.signals[particle, :, k]
    still = jnp.zeros(base.legacy_model.scatter.size)
    X, _, prior, white = log_determinant(base, particle, still, 0.0, 0 * slopes)
    x = white(jnp.where(base.tests.mask[particle], signals.added[particle, k], 0.0))
    change = -jnp.linalg.solve(X @ X.T + jnp.diag(prior), X @ x)
    # A step that moves parameters by less than the range in which the determinant is close to a straight line.
    h = 1e-3 / float(jnp.abs(change).max())
    up, down = (log_determinant(base, particle, sign * h * change, sign * h, slopes)[1] for sign in (1, -1))
    expected = (up - down) / (2 * h)
    assert system.turned[particle, system.column(k)] == pytest.approx(
        expected, rel=5e-3, abs=1e-4 * float(x @ x) ** 0.5
    )


def test_curvature_adds_to_products_with_the_residual_alone(fitted):
    base, _, system = fitted
    plain = build_system(base, signals_of(base, SMALL))
    np.testing.assert_array_equal(system.gram[:, 1:, 1:], plain.gram[:, 1:, 1:])
    np.testing.assert_array_equal(system.gram[:, 0, 0], plain.gram[:, 0, 0])
    added = system.gram[:, 0] - plain.gram[:, 0]
    scale = np.sqrt(plain.gram[:, 0, 0][:, None] * np.einsum("nqq->nq", plain.gram)) + 1e-300
    np.testing.assert_allclose(added / scale, system.turned / scale, atol=1e-9)
    assert np.abs(system.turned[:, system.candidate_columns]).max() > 1e-3
    assert not plain.turned.any()


def test_where_particles_have_more_parameters_of_their_own_curvature_is_left_out(fitted):
    base, _, system = fitted
    plain = build_system(base, signals_of(base, SMALL))
    columns = system.candidate_columns[:1]
    absorbed = system.absorbing(columns)
    scale = np.abs(plain.gram).max()
    np.testing.assert_allclose(absorbed.gram / scale, plain.absorbing(columns).gram / scale, atol=1e-12)
    assert absorbed.turned is None
    assert absorbed.curved([0]) is None


def test_curvature_of_chosen_columns_is_that_of_all_usable_particles(fitted):
    _, _, system = fitted
    added = system.curved([2, 0])
    columns = [*system.globals.tolist(), system.column(2), system.column(0)]
    np.testing.assert_allclose(added, system.turned[:, columns].sum(0), rtol=1e-12)


def scattering(seed, count=60):
    """One loading of particles whose stiffness scatters by 20 %, in more noise than tells it from a word by shape."""
    rng = np.random.default_rng(seed)
    laws = law_for_each(monotone_draws(seed, count), 1.43, 16_000.0)
    moduli = laws.effective_modulus * jnp.exp(0.2 * rng.standard_normal(count))
    diameters = PAPER_DIAMETERS_UM[rng.integers(20, size=count)]
    return simulate_campaign(
        eqx.tree_at(lambda law: law.effective_modulus, laws, moduli),
        diameters,
        peaks_at(10.0, diameters),
        SINGLE,
        instrument=Instrument(displacement_noise_um=0.4, zero_um=0.5),
        seed=seed,
    )


@pytest.mark.long
@pytest.mark.parametrize("seeds", [(0,), tuple(range(1, 9))], ids=["one", "more"])
def test_stiffness_that_scatters_is_no_word(seeds):
    """A displacement of one size would make particles more alike: without curvature, that looks like a missing word."""
    plain, curved = [], []
    for seed in seeds:
        base = base_fit(scattering(seed), MODEL, threshold_MPa=0.0)
        for found, turned in ((plain, False), (curved, True)):
            system = build_system(base, signals_of(base, SMALL, turned=turned))
            column = next(c for c in system.word_columns.tolist() if system.word(c).text == "(1 - u)")
            found.append(float(project(system, np.array([column])).gaussian[0]))
    assert (np.subtract(plain, curved) > 2.5).all()
    assert abs(np.sum(curved)) < 2.5 * len(seeds) ** 0.5
