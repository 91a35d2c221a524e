"""A packing between walls: balance of forces and momentum, friction, new lists, damage reported, derivatives."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from packed import CAPACITY, DIE_RADIUS, PRESSING, SKIN, dense, forces_of, loose, motion, packing, squeezed

from mcc_jax import InputError, MccLaw, paper_law
from mcc_jax.dem import (
    Cylinder,
    Interaction,
    Motion,
    Packing,
    Plane,
    advance,
    close_pairs,
    die,
    list_edges,
    not_monotone,
    pair_force,
    rebuild_list,
    relative_density,
    replay,
    run,
    scattered,
    set_velocity,
    sides_of,
    spheres,
    stable_time_step,
    start,
    step,
)
from mcc_jax.simulate import paper_population

STEP = jax.jit(step)


def stirred(state, seed=0):
    """The state with velocities, so that damping and friction act."""
    rng = np.random.default_rng(seed)
    velocity, spin = (jnp.asarray(rng.normal(0, size, state.position.shape)) for size in (0.3, 3e3))
    return replace(state, velocity=velocity, spin=spin)


@pytest.mark.extended
def test_wall_and_body_forces_sum_to_zero():
    """T8: and so do torques about the origin."""
    state = stirred(dense())
    _, forces = STEP(packing(), motion(), state)
    size = np.abs(forces.force).max()
    assert size > 1e-3
    assert np.abs(forces.force.sum(0) + forces.on_wall.sum(0)).max() <= 1e-13 * size * len(state.position)


def test_pairs_conserve_momentum_and_angular_momentum():
    # Far away walls: only pairs act, with friction and damping.
    state = eqx.tree_at(lambda s: s.walls, stirred(dense()), (Plane([0.0, 0, -1.0], [0.0, 0, 1], [0.0, 0, 0]),))
    state = eqx.tree_at(lambda s: s.wall_history, state, jax.tree.map(lambda x: x[:, :1], state.wall_history))
    _, forces = STEP(packing(), motion(), state)
    assert np.abs(forces.on_wall).max() == 0
    size = np.abs(forces.force).max() * DIE_RADIUS
    moment = np.cross(state.position, forces.force).sum(0) + np.asarray(forces.torque).sum(0)
    assert np.abs(forces.torque).max() > 1e-3 * size
    assert np.abs(moment).max() <= 1e-12 * size * len(state.position)


def test_colliding_pairs_conserve_angular_momentum():
    """To rounding over 1e4 steps, with friction, damping, unequal spheres, spin, and an impact off the centre."""
    pack = spheres(paper_law(), jnp.asarray([100.0, 70.0]))
    position = jnp.asarray([[0.0, 0.0, 0.0], [86e-6, 20e-6, 0.0]])
    walls = (Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]),)
    state = start(pack, walls, position, SKIN)
    state = eqx.tree_at(
        lambda s: (s.velocity, s.spin),
        state,
        (jnp.asarray([[0.1, 0.0, 0.02], [-0.3, 0.1, 0.0]]), jnp.asarray([[0.0, 2e3, -1e3], [3e3, 0.0, 1e3]])),
    )
    move = Motion.of(stable_time_step(pack) / 5, Interaction(damping=0.1, friction=0.4))

    def angular_momentum(state):
        mass = pack.mass[:, None]
        inertia = 0.4 * mass * pack.radius[:, None] ** 2
        return (jnp.cross(state.position, mass * state.velocity) + inertia * state.spin).sum(0)

    @jax.jit
    def many(state):
        def one(state, _):
            state, forces = step(pack, move, state)
            return state, jnp.abs(forces.torque).max()

        return jax.lax.scan(one, state, None, length=10_000)

    after, torque = many(state)
    assert float(torque.max()) > 0
    before = angular_momentum(state)
    assert np.abs(angular_momentum(after) - before).max() <= 1e-10 * np.abs(before).max()


def two_spheres(friction, normal_overlap=4e-6):
    pack = spheres(paper_law(), jnp.asarray([100.0, 100.0]))
    position = jnp.asarray([[0.0, 0.0, 0.0], [100e-6 - normal_overlap, 0.0, 0.0]])
    state = start(pack, (), position, SKIN)
    move = Motion.of(1e-9, Interaction(friction=friction))
    return pack, move, state


def test_friction_sticks_then_slides():
    """Coulomb with memory: the tangential force grows with slip, stays at its limit, and remembers on the way back."""
    pack, move, state = two_spheres(friction=0.3)
    sliding = eqx.tree_at(lambda s: s.velocity, state, jnp.asarray([[0.0, 0, 0], [0.0, 0.06, 0]]))

    def held(state, steps):
        """Driven at constant velocity, the centres kept where they are: only the contact's memory moves on."""
        ratio = []
        for _ in range(steps):
            forces, edges, history = forces_of(pack, move, state, time_step=jnp.asarray(1e-6))
            state = eqx.tree_at(lambda s: (s.edges, s.wall_history), state, (edges, history))
            ratio.append(float(forces.force[0, 1] / -forces.force[0, 0]))
        return state, ratio

    state, ratio = held(sliding, 40)
    k = float(pack.sides.k1[0]) / 2 * 0.8
    push = -float(STEP(pack, move, sliding)[1].force[0, 0])
    np.testing.assert_allclose(ratio[:5], k * 0.06e-6 * np.arange(1, 6) / push, rtol=1e-9)  # the elastic part
    np.testing.assert_allclose(ratio[-5:], 0.3, rtol=1e-12)  # j drags i along, at Coulomb's limit
    back = eqx.tree_at(lambda s: s.velocity, state, -state.velocity)
    _, ratio = held(back, 3)
    assert 0.25 < ratio[0] < 0.3  # one step back from the limit, not from zero
    assert ratio[2] < ratio[1] < ratio[0]


@pytest.mark.extended
def test_rolling_without_slip_needs_no_friction():
    pack, move, state = two_spheres(friction=0.5)
    # Both surfaces move alike at the contact: equal and opposite spins, like cogs, and no relative translation.
    spin = jnp.asarray([[0.0, 0.0, 50.0], [0.0, 0.0, -50.0]])
    _, forces = STEP(pack, move, eqx.tree_at(lambda s: s.spin, state, spin))
    assert np.abs(forces.force[:, 1:]).max() <= 1e-15 * np.abs(forces.force).max()
    _, forces = STEP(pack, move, eqx.tree_at(lambda s: s.spin, state, jnp.abs(spin)))
    assert np.abs(forces.force[:, 1]).max() > 0


@pytest.mark.extended
def test_no_friction_is_friction_of_zero():
    """None leaves the tangential part out; the forces are those of a coefficient of zero."""
    state = stirred(dense())
    zero, none = (Motion.of(1e-9, Interaction(damping=0.1, friction=f, wall_friction=f)) for f in (0.0, None))
    (with_zero, forces), (without, plain) = STEP(packing(), zero, state), STEP(packing(), none, state)
    np.testing.assert_allclose(plain.force, forces.force, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(plain.on_wall, forces.on_wall, rtol=1e-12, atol=1e-15)
    assert np.abs(plain.torque).max() == 0
    np.testing.assert_array_equal(without.edges.overlap_max, with_zero.edges.overlap_max)


@pytest.mark.extended
def test_damping_never_pulls():
    pack, _, state = two_spheres(friction=0.0, normal_overlap=1e-8)
    parting = eqx.tree_at(lambda s: s.velocity, state, jnp.asarray([[0.0, 0, 0], [5.0, 0, 0]]))
    _, forces = STEP(pack, Motion.of(1e-9, Interaction(damping=0.5)), parting)
    assert forces.force[0, 0] == 0


@pytest.mark.extended
def test_coincident_centres_are_no_nan():
    state, move = dense(), motion()
    state = eqx.tree_at(lambda s: s.position, state, state.position.at[1].set(state.position[0]))

    def total(position):
        return step(packing(), move, eqx.tree_at(lambda s: s.position, state, position))[1].force.sum()

    value, slope = jax.jit(jax.value_and_grad(total))(state.position)
    assert np.isfinite(value)
    assert np.all(np.isfinite(slope))


@pytest.mark.extended
def test_lists_made_anew_miss_nothing():
    """The same motion with lists made rarely and with a list of all pairs."""
    fine = 4e-6
    begin = start(packing(), dense().walls, dense().position, fine, CAPACITY)
    end, rows = advance(packing(), motion(), begin, PRESSING, 3, 100, fine)
    everything = start(packing(), dense().walls, dense().position, 1.0, CAPACITY)
    expected, rows_all = advance(packing(), motion(), everything, PRESSING, 3, 100, 1.0)
    assert rows.lists[-1] > 0
    assert rows_all.lists[-1] == 0
    assert rows.contacts[-1] > 5
    np.testing.assert_allclose(end.position, expected.position, rtol=0, atol=1e-13)
    np.testing.assert_allclose(rows.on_wall, rows_all.on_wall, rtol=1e-6, atol=1e-9)


@pytest.mark.extended
def test_a_larger_skin_makes_a_new_list_first():
    """A list made with a small skin lacks pairs on which a larger one relies."""
    near = start(packing(), dense().walls, dense().position, 1e-8, CAPACITY)
    assert near.edges.active.sum() < dense().edges.active.sum()
    end, rows = advance(packing(), motion(), near, PRESSING, 1, 60, SKIN)
    expected, _ = advance(packing(), motion(), dense(), PRESSING, 1, 60, SKIN)
    assert rows.lists[0] >= 1
    np.testing.assert_allclose(end.position, expected.position, rtol=0, atol=1e-15)


@pytest.mark.extended
def test_list_grows_when_full():
    """A list made for fewer pairs gets more room, by itself where none was asked for, and never loses a pair."""
    pairs = close_pairs(np.asarray(dense().position), np.asarray(packing().radius), SKIN)
    few = eqx.tree_at(lambda s: s.edges, dense(), list_edges(pairs[:10], len(dense().position), 10))
    grown = rebuild_list(packing(), few, SKIN)
    assert grown.edges.capacity > len(pairs)
    assert grown.edges.active.sum() == len(pairs)


@pytest.mark.extended
def test_press_release_and_eject():
    """Load, unload, eject: force on the punch rises and falls, the tablet leaves the die over its chamfer."""
    move = motion(friction=0.1, drag=2e4)
    state, load = advance(packing(), move, dense(), PRESSING, 5, 100, SKIN)
    assert load.on_wall[-1, 1, 2] > 0 > load.on_wall[-1, 0, 2]
    state, unload = advance(packing(), move, state, -PRESSING, 5, 100, SKIN)
    assert unload.on_wall[-1, 1, 2] < 0.2 * load.on_wall[-1, 1, 2]
    top = float(state.walls[2].rim)
    # The bottom punch pushes it out, the top punch leads.
    both = np.array([[0.0, 0.0, 20.0], [0.0, 0.0, 40.0], [0.0, 0.0, 0.0]])
    state, eject = advance(packing(), move, state, both, 12, 100, SKIN)
    assert float(jnp.max(state.position[:, 2])) > top
    assert np.all(np.isfinite(eject.on_wall))


def test_particles_outside_are_named():
    for move, wall in (([0, 0, -1e-3], "wall 0 .Plane"), ([1e-3, 0, 0], "wall 2 .Cylinder")):
        position = loose().position.at[3].add(jnp.asarray(move))
        with pytest.raises(InputError, match=f"particle 3 is outside {wall}"):
            start(packing(), loose().walls, position, SKIN)


@pytest.mark.extended
def test_nan_is_named_and_the_state_is_intact():
    with pytest.raises(InputError, match="particle 5 is not finite"):
        start(packing(), loose().walls, loose().position.at[5, 1].set(jnp.nan), SKIN)
    state = dense()
    copy = jax.tree.map(lambda x: np.array(x), state)
    with pytest.raises(InputError, match=r"not finite|outside"):
        advance(packing(), motion(share=300.0), state, 300 * PRESSING, 3, 100, SKIN)
    assert eqx.tree_equal(jax.tree.map(np.asarray, state), copy)


@pytest.mark.extended
def test_not_monotone_particles_are_named():
    laws = jax.vmap(lambda p: MccLaw(p, 1.43, 16000.0))(paper_population().sample(jax.random.key(3), 300))
    pack = spheres(laws, jnp.full(300, 100.0))
    flagged = not_monotone(pack)
    assert 0 < flagged.sum() < 30
    np.testing.assert_array_equal(flagged, ~np.asarray(jax.vmap(lambda law: law.is_monotone)(laws)))
    np.testing.assert_allclose(pack.sides.k1 / laws.plastic.C1, pack.sides.k1[0] / laws.plastic.C1[0])
    assert not not_monotone(packing()).any()
    soft = sides_of(pack.sides, np.flatnonzero(flagged))  # no unique split, but numbers
    force = jax.jit(jax.vmap(pair_force))(soft, soft, jnp.zeros_like(soft.k1), 2 * soft.tested)
    assert np.all(np.isfinite(force))


def test_particles_that_resist_nothing_are_named():
    pack = packing()
    bad = Packing(pack.radius, pack.mass, eqx.tree_at(lambda s: s.k1, pack.sides, pack.sides.k1.at[2].set(-1.0)))
    with pytest.raises(InputError, match="particle 2 has no positive"):
        start(bad, loose().walls, loose().position, SKIN)
    with pytest.raises(InputError, match="narrower"):
        scattered(jax.random.key(0), pack.radius, 1e-5)


@pytest.mark.extended
def test_beyond_the_tested_range_is_said():
    _, rows = advance(packing(), motion(), dense(), 0 * PRESSING, 1, 1, SKIN)
    assert rows.beyond_tested[0] == 0
    # Squeezed to nearly no pores, overlaps are beyond what the paper's tests saw.
    height = 0.45 * float(dense().walls[1].point[2])
    state = start(packing(), die(DIE_RADIUS, height), squeezed(dense().position, 0.45), SKIN, CAPACITY)
    _, rows = advance(packing(), motion(share=1e-3), state, 0 * PRESSING, 1, 1, SKIN)
    assert rows.beyond_tested[0] > 0


def harder(pack, log_c1):
    """The packing with every C1 scaled: k1 is proportional to it."""
    sides = eqx.tree_at(lambda s: s.k1, pack.sides, pack.sides.k1 * jnp.exp(log_c1))
    return Packing(pack.radius, pack.mass, sides)


@functools.cache
def recorded():
    """A short motion with lists made anew on the way: its start with moving walls, end and tape."""
    fine, tape = 4e-6, []
    begin = start(packing(), dense().walls, dense().position, fine, CAPACITY)
    end, rows = advance(packing(), motion(), begin, PRESSING, 2, 40, fine, tape=tape)
    assert rows.lists[-1] >= 2
    moving = eqx.tree_at(lambda s: s.walls, begin, set_velocity(begin.walls, jnp.asarray(PRESSING)))
    return moving, end, tape


def mean_height(log_c1):
    """Mean height [um] at the end of the recorded motion, replayed with other particles."""
    moving, _, tape = recorded()
    return jnp.mean(replay(harder(packing(), log_c1), motion(), moving, tape).position[:, 2] * 1e6)


@pytest.mark.extended
def test_replay_is_the_motion_and_has_its_derivative():
    """T7 on a trajectory: replayed over recorded lists; reverse mode and forward mode."""
    _, end, tape = recorded()
    assert len(tape) > 2
    zero, h = jnp.zeros(()), 1e-5  # within which no contact opens or begins to slip
    value, slope = jax.jit(jax.value_and_grad(mean_height))(zero)
    np.testing.assert_allclose(value, 1e6 * jnp.mean(end.position[:, 2]), rtol=1e-12)
    compiled = jax.jit(lambda t: jax.jvp(mean_height, (t,), (jnp.ones(()),)))
    difference = (compiled(zero + h)[0] - compiled(zero - h)[0]) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-4)
    np.testing.assert_allclose(compiled(zero)[1], slope, rtol=1e-9)


def test_a_run_takes_the_steps_asked_for():
    move = motion()
    five = jax.jit(run, static_argnums=3)(packing(), move, dense(), 8, 5)
    expected = dense()
    for _ in range(5):
        expected, _ = STEP(packing(), move, expected)
    np.testing.assert_allclose(five.position, expected.position, rtol=0, atol=1e-16)
    assert float(five.time) == pytest.approx(5 * float(move.time_step))


@pytest.mark.extended
@pytest.mark.parametrize("gravity", [(-9.81,), (0.0, -9.81), (0.0, 0.0, float("nan"))])
def test_gravity_is_three_finite_components(gravity):
    with pytest.raises(InputError, match="three finite components"):
        Motion.of(1e-8, gravity=gravity)


def test_scattered_spheres_do_not_touch():
    pack = packing()
    position, height = scattered(jax.random.key(4), pack.radius, DIE_RADIUS)
    gap = np.linalg.norm(position[:, None] - position[None], axis=2) - pack.radius[:, None] - pack.radius[None]
    assert (gap[~np.eye(len(gap), dtype=bool)] > 0).all()
    for wall in die(DIE_RADIUS, height):
        assert (jax.vmap(wall.distance)(position) > pack.radius).all()
    assert 0.05 < relative_density(pack, DIE_RADIUS, 0.0, height) < 0.5


@pytest.mark.extended
def test_cylinder_opens_above_its_rim():
    wall = Cylinder(1.0, 2.0, 0.1, jnp.zeros(3))
    assert wall.distance(jnp.asarray([0.3, 0.4, 1.0])) == pytest.approx(0.5)
    assert wall.distance(jnp.asarray([0.3, 0.4, 3.0])) == pytest.approx(0.6)
    np.testing.assert_allclose(wall.normal_at(jnp.asarray([0.3, 0.4, 1.0])), [-0.6, -0.8, 0.0], atol=1e-15)
    on_axis = jnp.asarray([0.0, 0.0, 1.0])
    assert np.all(np.isfinite(jax.grad(wall.distance)(on_axis)))
    closed = Cylinder(1.0, jnp.inf, 0.1, jnp.zeros(3))
    assert closed.distance(jnp.asarray([0.0, 0.0, 9.0])) == 1.0
