"""Rigid walls that particles press against: planes, and a cylinder open at its rim."""

from __future__ import annotations

from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import arguments
from .._errors import InputError
from .._format import described
from .._numerics import recompute
from .._types import Scalar, checked, scalar

Vector = Float[Array, " 3"]


def _vector(value: Any) -> Vector:
    array = arguments.values(value, "a vector", shape="three numbers")
    if array.shape[-1:] != (3,):
        raise InputError(f"a vector has three components, got the shape {array.shape}")
    return array


def dot(one: Vector, other: Vector) -> Scalar:
    """Inner product, written out: a CPU adds up the rows of a table one number at a time."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def length_of(square: Scalar) -> Scalar:
    """Length of a vector, from its square, with a finite derivative at zero."""
    some = square > 0
    return jnp.where(some, recompute(jnp.sqrt(jnp.where(some, square, 1.0))), 0.0)


class Plane(eqx.Module):
    """A plane through a point [m]; its normal, a unit vector, points to the particles; it moves at a velocity [m/s]."""

    point: Vector = eqx.field(converter=_vector)
    normal: Vector = eqx.field(converter=_vector)
    velocity: Vector = eqx.field(converter=_vector)

    __repr__ = described(point="m", velocity="m/s")

    def distance(self, position: Vector) -> Scalar:
        """Distance [m] of a point from the wall, negative behind it."""
        return dot(position - self.point, self.normal)

    def normal_at(self, position: Vector) -> Vector:
        """Direction in which the wall pushes a particle there."""
        return self.normal

    def moved(self, time: Scalar) -> Plane:
        """The wall after that time [s]."""
        return eqx.tree_at(lambda w: w.point, self, self.point + time * self.velocity)


class Cylinder(eqx.Module):
    r"""The inside of a cylinder about the z axis, widening above its rim so that a tablet can leave.

    .. math:: \text{distance} = R + t \max(z - z_{rim}, 0) - \sqrt{x^2 + y^2}

    The rim, above which the chamfer t starts, may be infinite [m]. The velocity [m/s] moves it along z, and acts as a
    whole in friction.
    """

    radius: Scalar = eqx.field(converter=checked(arguments.positive, "the radius of a cylinder [m]"))
    rim: Scalar = eqx.field(converter=scalar)
    chamfer: Scalar = eqx.field(converter=checked(arguments.positive, "chamfer", zero=True))
    velocity: Vector = eqx.field(converter=_vector)

    __repr__ = described(radius="m", rim="m", velocity="m/s")

    def __check_init__(self) -> None:
        if not (arguments.is_traced(self.rim) or self.rim > -jnp.inf):
            raise InputError(f"rim must be a height [m], or infinite for none; got {float(self.rim):g}")

    def distance(self, position: Vector) -> Scalar:
        """Distance [m] of a point from the wall, negative outside."""
        above = jnp.maximum(position[2] - self.rim, 0.0)
        opening = jnp.where(above > 0, self.chamfer * above, 0.0)
        return self.radius + opening - length_of(position[0] * position[0] + position[1] * position[1])

    def normal_at(self, position: Vector) -> Vector:
        """Direction in which the wall pushes a particle there: towards the axis."""
        flat = jnp.stack([position[0], position[1], jnp.zeros_like(position[2])])
        length = length_of(dot(flat, flat))
        return -flat * recompute(1 / jnp.where(length > 0, length, 1.0))

    def moved(self, time: Scalar) -> Cylinder:
        """The wall after that time [s]."""
        return eqx.tree_at(lambda w: w.rim, self, self.rim + time * self.velocity[2])


Wall: TypeAlias = Plane | Cylinder
Walls: TypeAlias = tuple[Wall, ...]


def die(radius: float, height: float) -> Walls:
    """A closed die at rest: bottom punch at z = 0, top punch and rim of the cylinder at the height [m]."""
    height = arguments.number(height, "the height of a die [m]", above=0)
    rest, up = jnp.zeros(3), jnp.asarray([0.0, 0.0, 1.0])
    barrel = Cylinder(radius, height, 0.05, rest)
    return Plane(rest, up, rest), Plane(height * up, -up, rest), barrel


def set_velocity(walls: Walls, velocity: Any) -> Walls:
    """The walls with these velocities [m/s], three components for every wall."""
    velocity = arguments.values(velocity, "velocity", shape="three components [m/s] for every wall")
    if velocity.shape != (len(walls), 3):
        raise InputError(f"velocity has the shape {velocity.shape} where ({len(walls)}, 3) is expected")
    pairs = zip(walls, velocity, strict=True)
    return tuple(eqx.tree_at(lambda w: w.velocity, wall, v.astype(wall.velocity.dtype)) for wall, v in pairs)
