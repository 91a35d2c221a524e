"""Quasi-static compaction: the plate test, equilibrium, lists, Euler's identity, gradients, band, inverse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import InputError, MccLaw, Plastic, paper_law
from mcc_jax.calibrate import Model, Posterior
from mcc_jax.calibrate.population import Population
from mcc_jax.dem import (
    Solver,
    compact,
    die,
    first_order_band,
    fit_compaction,
    half_contact,
    population_packing,
    punch_sensitivity,
    relaxed,
    replay_compaction,
    rescaled,
    scattered,
    spheres,
    start,
    wall_force,
)
from mcc_jax.dem import quasistatic as quasistatic
from mcc_jax.dem.equilibrium import Problem, balance, forces
from mcc_jax.dem.quasistatic import BOTTOM, TOP
from mcc_jax.geometry import Particle

LAW = paper_law()
DIAMETERS = jnp.asarray(np.random.default_rng(0).uniform(80.0, 120.0, 12))
SOLVER = Solver()


def packing_of(values, diameters=DIAMETERS):
    """The paper's law with C1 and Ebar times the exponentials of the two values."""
    C1, modulus = LAW.plastic.C1 * jnp.exp(values[0]), LAW.effective_modulus * jnp.exp(values[1])
    law = eqx.tree_at(lambda law: (law.plastic.C1, law.effective_modulus), LAW, (C1, modulus))
    return spheres(law, diameters)


@pytest.fixture(scope="module")
def pressed():
    """Twelve spheres: packing, start, heights (pressed, released a little), end, rows, tape."""
    packing = packing_of(jnp.zeros(2))
    radius = float(packing.radius.mean())
    barrel = 2.3 * radius
    height = float(packing.volume) / (np.pi * barrel**2 * 0.45)
    position, tall = scattered(jax.random.key(1), packing.radius, barrel)
    state = relaxed(packing, die(barrel, height), position.at[:, 2].multiply(height / tall))
    heights = height * np.concatenate([1 - 0.4 * np.arange(1, 9) / 8, 0.6 + 0.006 * np.arange(1, 3)])
    tape = []
    end, rows = compact(packing, state, heights, SOLVER, tape)
    return packing, state, heights, end, rows, tape


@pytest.fixture(scope="module")
def sensitivity(pressed):
    _, state, _, _, _, tape = pressed
    return punch_sensitivity(packing_of, jnp.zeros(2), state, tape, SOLVER)


def test_chain_between_punches_is_the_plate_test():
    n, diameter = len(DIAMETERS), 100.0
    packing = packing_of(jnp.zeros(2), jnp.full(n, diameter))  # like the other: compiled once
    radius = 0.5e-6 * diameter
    position = jnp.zeros((n, 3)).at[:, 2].set(jnp.asarray((2 * np.arange(n) + 1) * radius))
    state = start(packing, die(radius, 2 * n * radius), position, 0.5 * radius)
    strain = np.concatenate([np.linspace(0.02, 0.3, 5), np.linspace(0.295, 0.28, 3), np.linspace(0.3, 0.4, 2)])
    _, rows = compact(packing, state, 2 * n * radius * (1 - strain), Solver(springs=(1e-2, 1e-4, 1e-6)))
    side, before = half_contact(LAW, Particle(diameter, diameter, diameter)), np.maximum.accumulate(strain * radius)
    expected = jax.vmap(wall_force, (None, 0, 0))(side, jnp.asarray(before), jnp.asarray(strain * radius))
    assert rows.converged.all()
    # The weakest springs hold a share of the force; the rest is the law.
    pressed = np.asarray(expected) > 1e-3 * np.max(expected)
    assert pressed.sum() >= 8
    error = np.abs(0.5 * (rows.top + rows.bottom) / expected - 1)[pressed]
    assert np.all(error <= 2 * rows.proximal_share[pressed])
    assert np.all(rows.proximal_share[pressed] < 1e-3)


@pytest.mark.extended
def test_net_force_is_minus_the_gradient_of_the_energy_and_has_its_stiffness(pressed):
    packing, _, _, end, _, _ = pressed
    shift = 1e-3 * packing.radius[:, None] * jax.random.normal(jax.random.key(0), end.position.shape)
    held = Problem(packing, end.walls, end.edges, end.wall_history, end.position, jnp.asarray(3.0))
    at, net_and_walls = jax.jit(balance), jax.jit(forces)
    position, along = end.position + shift, 1e-5 * shift
    ahead, here, behind = (at(held, position + s * along) for s in (1, 0, -1))
    net, on_wall = net_and_walls(held, position)
    np.testing.assert_allclose(here.net, net, atol=1e-12 * float(here.scale))
    np.testing.assert_allclose(here.on_wall, on_wall, atol=1e-12 * float(here.scale))
    work = 0.5 * float(ahead.energy - behind.energy)
    assert work == pytest.approx(-float(jnp.sum(here.net * along)), rel=1e-5)
    change = 0.5 * np.asarray(behind.net - ahead.net)
    np.testing.assert_allclose(here.stiffness(along), change, atol=1e-6 * np.abs(change).max())
    dense = (here.stiffness.dense() @ along.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(dense, here.stiffness(along), atol=1e-12 * np.abs(change).max())
    assert np.linalg.eigvalsh(here.material.dense()).min() > 0


@pytest.mark.extended
def test_every_row_is_an_equilibrium_and_punches_differ_by_the_springs(pressed):
    _, _, heights, end, rows, tape = pressed
    assert rows.converged.all()
    assert rows.residual.max() < 1e-9
    assert np.all(np.abs(rows.top - rows.bottom) <= rows.proximal_share * rows.top * 1.001)
    np.testing.assert_allclose(rows.height, heights)
    assert rows.top[:8].argmax() == 7
    assert rows.top[9] < rows.top[8] < rows.top[7]  # unloading is elastic
    assert sum(step.last for step in tape) == len(heights)
    assert rows.load_steps.sum() == len(tape)
    assert not np.asarray(end.velocity).any()


@pytest.mark.extended
def test_lists_do_not_change_the_compaction(pressed):
    packing, state, heights, _, rows, _ = pressed
    again = start(packing, state.walls, state.position, 1.2 * float(packing.radius.mean()))
    _, longer = compact(packing, again, heights, Solver(skin=1.2))
    np.testing.assert_allclose(longer.top, rows.top, rtol=1e-7)


@pytest.mark.extended
def test_a_step_that_does_not_settle_is_halved_and_marked(pressed, monkeypatch):
    packing, state, heights, _, _, _ = pressed
    settle = quasistatic._find_equilibrium

    def fails_in_the_lower_half(held, guess, rtol, max_steps):
        settled = settle(held, guess, rtol, max_steps)
        lower = held.walls[TOP].point[2] < 0.5 * (heights[0] + heights[1])
        return settled._replace(converged=settled.converged & ~lower)

    monkeypatch.setattr(quasistatic, "_find_equilibrium", fails_in_the_lower_half)
    tape = []
    _, rows = compact(packing, state, heights[:2], Solver(halvings=2), tape)
    assert rows.converged.tolist() == [True, False]
    assert rows.load_steps.tolist() == [1, 3]  # the upper half in one, the lower in two that fail
    assert [step.last for step in tape] == [True, False, False, True]
    assert np.isfinite(rows.top).all()


@pytest.mark.extended
def test_replay_is_the_compaction(pressed):
    packing, state, _, end, rows, tape = pressed
    again = replay_compaction(packing, state, tape, SOLVER)
    last = np.array([step.last for step in tape])
    assert bool(again.converged.all())
    np.testing.assert_allclose(again.on_wall[last, TOP], rows.top, rtol=1e-8)
    np.testing.assert_allclose(again.on_wall[last, BOTTOM], rows.bottom, rtol=1e-8)
    np.testing.assert_allclose(again.position[-1], end.position, atol=1e-8 * float(packing.radius.max()))
    np.testing.assert_allclose(again.wall_history.overlap_max, end.wall_history.overlap_max, atol=1e-15)


@pytest.mark.extended
def test_euler_identity(sensitivity, pressed):
    _, _, _, _, rows, _ = pressed
    assert sensitivity.converged.all()
    assert sensitivity.euler_defect.max() < 1e-8
    np.testing.assert_allclose(sensitivity.force, rows.top, rtol=1e-8)
    np.testing.assert_allclose(sensitivity.proximal_share, rows.proximal_share, rtol=1e-6)
    # C1 and Ebar asked for as parameters are the same as the first and fourth stress.
    np.testing.assert_allclose(sensitivity.by_parameter, sensitivity.by_stress[:, [0, 3]], atol=1e-10 * rows.top.max())


@pytest.mark.extended
def test_sensitivities_are_those_of_finite_differences(sensitivity, pressed):
    packing, state, _, _, _, tape = pressed
    last, h = np.array([step.last for step in tape]), 1e-5
    for stress in range(4):
        ends = [
            np.asarray(replay_compaction(rescaled(packing, jnp.zeros(4).at[stress].set(s)), state, tape).on_wall)
            for s in (h, -h)
        ]
        difference = ((ends[0] - ends[1]) / (2 * h))[last, TOP]
        np.testing.assert_allclose(sensitivity.by_stress[:, stress], difference, atol=1e-5 * np.abs(difference).max())


@pytest.mark.extended
def test_reverse_mode_gives_the_same_sensitivities(sensitivity, pressed):
    packing, state, _, _, _, tape = pressed
    last = np.array([step.last for step in tape])

    def total(logs):
        return jnp.sum(replay_compaction(rescaled(packing, logs), state, tape).on_wall[last, TOP])

    expected = sensitivity.by_stress[:, :4].sum(axis=0)
    np.testing.assert_allclose(jax.grad(total)(jnp.zeros(4)), expected, rtol=1e-8)


def posterior(scatter, effect=None):
    """A calibration of which only the population's draws, one chain of five, and the model are known."""
    model = Model().with_effects(*([effect] if effect else []), varying=[effect] if effect else ())
    numbers = jnp.asarray(0.01 * (1 + np.arange(len(model.forms.names))))

    def drawn(k):
        at = 0.01 * k
        return Population(
            a=1.43 + at,
            log_modulus=jnp.log(16000.0) + at,
            mu=jnp.log(jnp.asarray([7.0, 3.0, 2.7])) + at,
            tau=jnp.full(3, scatter),
            modulus_scatter=jnp.asarray(scatter),
            shape_scatter=jnp.asarray(0.0),
            log_noise=jnp.asarray(0.0),
            theta=numbers,
            theta_scatter=jnp.full(len(model.varying), scatter),
        )

    found = object.__new__(Posterior)
    for name, value in (("model", model), ("population", jax.vmap(jax.vmap(drawn))(jnp.arange(5.0)[None]))):
        object.__setattr__(found, name, value)
    return found


@pytest.mark.extended
def test_packing_of_a_population_without_scatter_is_one_law():
    made = population_packing(posterior(0.0), np.asarray(DIAMETERS))
    assert made.draws.shape == (5, len(made.names))
    values = jnp.asarray(made.draws[3])
    law = MccLaw(Plastic(*(x * jnp.exp(0.03) for x in (7.0, 3.0, 2.7))), 1.46, 16000 * jnp.exp(0.03))
    for got, expected in zip(
        jax.tree.leaves(made.packing_of(values)), jax.tree.leaves(spheres(law, DIAMETERS)), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-12)


@pytest.mark.extended
def test_packing_of_a_population_scatters_the_same_particles_in_every_draw():
    made = population_packing(posterior(0.2), np.asarray(DIAMETERS), seed=1)
    first, second = (np.asarray(made.packing_of(jnp.asarray(made.draws[k])).sides.k1) for k in (0, 4))
    np.testing.assert_allclose(second / first, np.exp(0.04), rtol=1e-12)
    assert np.log(first / np.asarray(DIAMETERS)).std() > 0.1
    slope = jax.jacfwd(made.packing_of)(jnp.asarray(made.draws[0])).sides.k1[:, made.names.index("mu1")]
    np.testing.assert_allclose(slope, first, rtol=1e-12)


@pytest.mark.extended
def test_packing_of_a_population_has_the_effects_of_its_model_or_refuses_them():
    made = population_packing(posterior(0.2, "damage"), np.asarray(DIAMETERS), seed=1)
    assert made.draws.shape == (5, len(made.names))
    assert "scatter of damage" in made.names
    (effect,) = made.packing_of(jnp.asarray(made.draws[0])).sides.effects
    amplitude = np.log(np.asarray(effect.amplitude) / 0.01)
    assert amplitude.std() > 0.1
    assert abs(amplitude.mean()) < 0.2
    with pytest.raises(InputError, match="creep"):
        population_packing(posterior(0.0, "creep"), np.asarray(DIAMETERS))


@pytest.mark.extended
def test_the_band_of_small_scatter_is_that_of_a_compaction_for_every_draw(pressed):
    _, state, heights, _, rows, _ = pressed
    draws = np.random.default_rng(1).normal(0.0, 0.01, (8, 2))
    band = first_order_band(packing_of, draws, state, heights, solver=SOLVER)
    every = [compact(packing_of(jnp.asarray(values)), state, heights, SOLVER)[1] for values in draws]
    assert band.converged.all()
    assert all(one.converged.all() for one in every)
    top = np.stack([one.top for one in every])
    np.testing.assert_allclose(band.standard_deviation, top.std(axis=0, ddof=1), rtol=0.03)
    np.testing.assert_allclose(band.quantiles[1], np.median(top, axis=0), atol=0.02 * rows.top.max())
    assert np.all(np.diff(band.quantiles, axis=0) > 0)


@pytest.mark.extended
def test_fit_recovers_the_mean_C1_and_modulus(pressed):
    _, state, heights, _, rows, _ = pressed
    fit = fit_compaction(packing_of, np.array([0.05, -0.1]), state, heights, rows.top, solver=SOLVER)
    assert fit.converged
    np.testing.assert_allclose(fit.values, 0.0, atol=1e-5)
    assert fit.misfit < 1e-6


@pytest.mark.extended
def test_bad_input_is_named(pressed):
    packing, state, heights, _, rows, _ = pressed
    with pytest.raises(InputError, match="height"):
        compact(packing, state, [1e-3, -1e-3])
    with pytest.raises(InputError, match="die"):
        compact(packing, eqx.tree_at(lambda s: s.walls, state, state.walls[:2]), heights)
    with pytest.raises(InputError, match="springs"):
        Solver(springs=())
    with pytest.raises(InputError, match="empty tape"):
        replay_compaction(packing, state, [])
    with pytest.raises(InputError, match="forces"):
        fit_compaction(packing_of, np.zeros(2), state, heights, rows.top[:-1])
    with pytest.raises(InputError, match="draws"):
        first_order_band(packing_of, np.zeros((1, 2)), state, heights)
