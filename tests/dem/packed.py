"""Small packings for the tests, made once."""

import functools

import equinox as eqx
import jax
import numpy as np

from mcc_jax import paper_law
from mcc_jax.dem import (
    Interaction,
    Motion,
    contact_forces,
    die,
    scattered,
    spheres,
    stable_time_step,
    start,
)

DIE_RADIUS = 2.2e-4
SKIN = 2e-5
CAPACITY = 320
"""Room for all pairs of 24 spheres: with one length of list everything compiles once."""
PRESSING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])


@functools.cache
def packing(count=24):
    diameter = jax.random.uniform(jax.random.key(1), (count,), minval=80.0, maxval=120.0)
    return spheres(paper_law(), diameter)


def squeezed(position, share):
    """The positions with their heights scaled."""
    return position.at[:, 2].multiply(share)


@functools.cache
def dense(count=24):
    """A state in which every particle presses on its neighbours: a loose packing squeezed along z at one stroke."""
    spheres_ = packing(count)
    position, height = scattered(jax.random.key(0), spheres_.radius, DIE_RADIUS)
    squeeze = 0.72
    return start(spheres_, die(DIE_RADIUS, squeeze * height), squeezed(position, squeeze), SKIN, CAPACITY)


@functools.cache
def loose(count=24):
    spheres_ = packing(count)
    position, height = scattered(jax.random.key(0), spheres_.radius, DIE_RADIUS)
    return start(spheres_, die(DIE_RADIUS, height), position, SKIN, CAPACITY)


@functools.cache
def resolved():
    """Time step of the packing [s]."""
    return stable_time_step(packing())


def motion(friction=0.3, damping=0.1, share=1.0, **further):
    interaction = Interaction(damping=damping, friction=friction, wall_friction=friction)
    return Motion.of(share * resolved(), interaction, **further)


FORCES = jax.jit(contact_forces)


def forces_of(pack, move, state, edges=None, time_step=None):
    """Forces of a state's contacts, on other edges or over another time step if given, and what they remember."""
    state = state if edges is None else eqx.tree_at(lambda s: s.edges, state, edges)
    return FORCES(pack, move if time_step is None else eqx.tree_at(lambda m: m.time_step, move, time_step), state)
