"""No contact gives back more energy than it took, at any peak, along any path; above small peaks all is as printed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ALL_FORMS, EBAR, K1, K3, K5, A, paper_law, paper_particle, sphere

from mcc_jax.law import Plastic, StrainScaling, Unloading
from mcc_jax.law._recovery import energy_ratio

PEAKS = np.concatenate([np.geomspace(1e-9, 0.2, 200), np.linspace(0.2, 1.2, 100)])
PARTICLES = {"flat": paper_particle(8), "sphere": sphere(), "tall": type(sphere())(180.0, 190.0, 205.0)}


@ALL_FORMS
@pytest.mark.parametrize("particle", PARTICLES.values(), ids=PARTICLES)
@pytest.mark.parametrize("modulus", [EBAR, 400.0])
def test_recovered_work_at_every_peak(unloading, scaling, particle, modulus):
    law = paper_law(unloading, scaling, modulus=modulus)
    peaks = jnp.asarray(PEAKS) * particle.effective_diameter
    taken = jax.vmap(lambda d: law.loading_work(particle, d))(peaks)
    given = jax.vmap(lambda d: law.energy(particle, law.init(particle), d).recoverable)(peaks)
    assert np.all(np.asarray(given) <= np.asarray(taken) * (1 + 1e-13))
    left = jax.vmap(lambda d: d - particle.displacement(law.recoverable_strain(particle, particle.strain(d))))(peaks)
    assert np.all(np.asarray(left) >= -1e-13 * np.asarray(peaks))  # nor more displacement than there was


@ALL_FORMS
def test_formula_is_as_printed_above_the_peak_from_which_it_recovers_all(unloading, scaling):
    law, particle = paper_law(unloading, scaling), paper_particle(8)
    eta = float(law.shape_factor(particle))
    strain = np.linspace(0.015, 0.7, 500)
    x = eta * strain
    stress = K1 * x - K3 * x**3 + K5 * x**5
    n, k = unloading.stress_power, unloading.constant
    printed = np.sqrt((stress / EBAR) ** n / (k * eta**scaling.power * strain))
    found = np.asarray(law.recoverable_strain(particle, jnp.asarray(strain)))
    np.testing.assert_allclose(found, printed, rtol=1e-14)


def test_where_the_printed_formula_ends():
    """About 0.01, or 0.2 MPa, with the paper's numbers: K1 / (4.12 E) at a sphere, where loading is still linear."""
    law, particle = paper_law(), sphere()
    edge = np.sqrt(K1 / (4.12 * EBAR))
    below, above = jnp.asarray(0.98 * edge), jnp.asarray(1.02 * edge)
    assert float(law.recoverable_strain(particle, below)) == pytest.approx(0.98 * edge, rel=1e-12)
    assert float(law.recoverable_strain(particle, above)) < 1.02 * edge
    assert 0.009 < edge < 0.011


def random_paths(key, count, steps, least, most):
    """Random displacements with many turns: log-uniform depths, so small peaks are as frequent as large ones."""
    one, two = jax.random.split(key)
    top = jnp.exp(jax.random.uniform(one, (count, 1), minval=jnp.log(least), maxval=jnp.log(most)))
    level = jax.random.uniform(two, (count, steps)) ** 2 * 1.2 - 0.15
    return top * jnp.concatenate([jnp.zeros((count, 1)), level, -0.2 * jnp.ones((count, 1))], axis=1)


def work_between(potential, force_at, path):
    """Work done on a contact along a path that ends without force; loading in closed form, branches by their energy."""
    return potential(path[-1]) + 0 * force_at


@ALL_FORMS
def test_random_paths(unloading, scaling):
    """Work put in less work got back, by fine quadrature of the force itself, is never negative on the way."""
    law, particle = paper_law(unloading, scaling), paper_particle(8)
    turns = random_paths(jax.random.key(1), 64, 12, 1e-4, 1.0) * particle.effective_diameter

    @eqx.filter_jit
    def balance(turns):
        t = jnp.linspace(0.0, 1.0, 400, endpoint=False)
        ease = t * t * (3 - 2 * t)
        path = (turns[:-1, None] + (turns[1:] - turns[:-1])[:, None] * ease[None]).ravel()
        force = law.path(particle, law.init(particle), path)[1]
        steps = jnp.diff(path)
        work = jnp.cumsum((force[1:] + force[:-1]) / 2 * steps)
        return work, jnp.sum(jnp.abs((force[1:] - force[:-1]) * steps))

    work, rounding = jax.vmap(balance)(turns)
    assert np.all(np.asarray(work).min(axis=1) >= -np.asarray(rounding) - 1e-300)
    assert np.all(np.asarray(work)[:, -1] >= -1e-3 * np.asarray(work).max(axis=1))


@ALL_FORMS
@pytest.mark.parametrize("strain", [1e-6, 0.005, 0.02])
def test_derivatives_around_the_switch(unloading, scaling, strain):
    """Values under displacement and load control agree, and derivatives are those of differences."""
    particle = paper_particle(8)
    peak = strain * float(particle.effective_diameter)

    def force(log_modulus, C1, peak, now):
        law = paper_law(unloading, scaling, plastic=Plastic(C1, K3 ** (1 / 3), K5**0.2))
        law = eqx.tree_at(lambda one: one.effective_modulus, law, jnp.exp(log_modulus))
        return law.path(particle, law.init(particle), jnp.stack([peak, now]))[1][1]

    at = tuple(jnp.asarray(v) for v in (np.log(EBAR), K1, peak, 0.999 * peak))
    forward = jax.jacfwd(force, argnums=(0, 1, 2, 3))(*at)
    backward = jax.jacrev(force, argnums=(0, 1, 2, 3))(*at)
    np.testing.assert_allclose(forward, backward, rtol=1e-12)
    for i, value in enumerate(at):
        h = 1e-6 * abs(float(value)) if i < 2 else 1e-7 * peak
        low, high = (force(*at[:i], value + sign * h, *at[i + 1 :]) for sign in (-1, 1))
        scale = abs(float(force(*at))) / max(abs(float(value)), 1e-12)
        np.testing.assert_allclose(forward[i], (high - low) / (2 * h), rtol=2e-5, atol=2e-5 * scale)
    law = paper_law(unloading, scaling)
    path = jnp.stack([jnp.asarray(peak), jnp.asarray(0.999 * peak)])
    forces = law.path(particle, law.init(particle), path)[1]
    back = law.path_load(particle, law.init(particle), forces)[1]
    held = np.asarray(forces) > 0  # a punch form has long let go by then
    np.testing.assert_allclose(np.asarray(back)[held], np.asarray(path)[held], rtol=1e-9)


def test_the_energy_of_a_full_release_is_the_constant_of_the_formula():
    np.testing.assert_allclose(energy_ratio(jnp.asarray(0.0)), 4 / (3 * np.pi), rtol=1e-15)
    assert {u.stress_power for u in Unloading} == {1, 2}
    assert A > 0
    assert {s.power for s in StrainScaling} == {0, 1, 3}
