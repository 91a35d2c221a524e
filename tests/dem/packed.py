"""Small packings for the tests, made once."""

import functools

import equinox as eqx
import jax
import numpy as np

from mcc_jax import paper_law
from mcc_jax.dem import Interaction, Motion, contact_forces, die, scattered, spheres, stable_time_step, start

DIE_RADIUS = 2.2e-4
SKIN = 2e-5
CAPACITY = 320
"""Enough for all pairs of 24 spheres: with one length of list everything compiles once."""
PRESSING = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])


@functools.cache
def packing():
    diameter = jax.random.uniform(jax.random.key(1), (24,), minval=80.0, maxval=120.0)
    return spheres(paper_law(), diameter)


def squeezed(position, share):
    """The positions with their heights scaled."""
    return position.at[:, 2].multiply(share)


@functools.cache
def loose(squeeze=1.0):
    position, height = scattered(jax.random.key(0), packing().radius, DIE_RADIUS)
    return start(packing(), die(DIE_RADIUS, squeeze * height), squeezed(position, squeeze), SKIN, CAPACITY)


def dense():
    """A state in which every particle presses on its neighbours: a loose packing squeezed along z at one stroke."""
    return loose(0.72)


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
