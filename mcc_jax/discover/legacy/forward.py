r"""The forward model of every joint calibration: displacement at measured force.

The tester controls force and noise lives in displacement, so a test of particle i is

.. math:: d_{ik} = z_i + \gamma(F_{i1} \dots F_{ik};\, b_i, e_i) + \text{noise}

with its zero z, and the law's displacement under load control. The law knows the coefficients only through products
with the shape factor: :math:`b_j = \log(C_j \eta_p)`, and the modulus through :math:`e = \log(\bar E \eta_p^p)` with
the power p of the strain scaling (half of it in the punch forms, where the modulus is squared). So the data of one
particle never contain the shape parameter `a`: it enters through what particles of different shapes have in common
(`population`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._numerics import running_max
from ..._types import Path, Scalar
from ...effects import AbstractEffect
from ...geometry import Particle
from ...law import MccLaw, Plastic, Unloading
from .data import Tests

Latent = Float[Array, " 4"]
"""b1, b3, b5 and e of one particle."""


def law_of(latent: Latent, unloading: Unloading, effects: tuple[AbstractEffect, ...] = ()) -> MccLaw:
    """The law that has taken in its particle's shape: a = 0, coefficients times the shape factor."""
    b1, b3, b5, e = latent
    plastic = Plastic(jnp.exp(b1), jnp.exp(b3), jnp.exp(b5))
    return MccLaw(plastic, 0.0, jnp.exp(e), unloading, effects=effects)


def displacement(latent: Latent, particle: Particle, force: Path, unloading: Unloading) -> Path:
    """Displacement [um] of a virgin particle along a path of forces [mN], from its own zero."""
    law = law_of(latent, unloading)
    return law.path_load(particle, law.init(particle), force)[1]


def raw_residual(
    latent: Float[Array, "particles 4"], zero: Float[Array, " particles"], tests: Tests, unloading: Unloading
) -> Float[Array, "particles points"]:
    """Measured less predicted displacement [um], 0 where masked."""
    predicted = jax.vmap(lambda w, p, f: displacement(w, p, f, unloading))(latent, tests.particle, tests.force)
    return jnp.where(tests.mask, tests.displacement - predicted - zero[:, None], 0.0)


def linearise(
    latent: Float[Array, "particles 4"], zero: Float[Array, " particles"], tests: Tests, unloading: Unloading
) -> tuple[Float[Array, "particles points"], Float[Array, "particles points 5"]]:
    """Residuals [um] and their derivatives with respect to each particle's b1, b3, b5, e and zero."""
    residual, J, _, _ = _linearise(latent, zero, tests, unloading, False)
    return residual, J


def linearise_with_force(
    latent: Float[Array, "particles 4"], zero: Float[Array, " particles"], tests: Tests, unloading: Unloading
) -> tuple[
    Float[Array, "particles points"],
    Float[Array, "particles points 5"],
    Float[Array, "particles points"],
    Float[Array, "particles points"],
]:
    """The same, and the change of each prediction with its own force and with its branch's peak force [um/mN]."""
    return _linearise(latent, zero, tests, unloading, True)


def _linearise(latent, zero, tests, unloading, with_force):
    count = len(tests)

    def predicted(w, force):
        return jax.vmap(lambda *one: displacement(one[0], one[1], one[2], unloading))(w, tests.particle, force)

    value, push = jax.linearize(predicted, latent, tests.force)
    still = jnp.zeros_like(tests.force)
    record = tests.force >= jax.vmap(running_max)(tests.force)
    directions = jnp.broadcast_to(jnp.eye(4)[:, None], (4, count, 4))
    forces = [still] * 4
    if with_force:
        directions = jnp.concatenate([directions, jnp.zeros((2, count, 4))])
        # Behind a peak a prediction moves with the peak's force, too; that part is taken off again.
        forces += [jnp.ones_like(still), jnp.where(record, 1.0, 0.0)]
    columns = jax.vmap(push)(directions, jnp.stack(forces))
    used = tests.mask
    J = jnp.where(used[..., None], -jnp.moveaxis(columns[:4], 0, -1), 0.0)
    own = jnp.where(used, -1.0, 0.0)[..., None]
    residual = jnp.where(used, tests.displacement - value - zero[:, None], 0.0)
    if not with_force:
        return residual, jnp.concatenate([J, own], -1), still, still
    moved = jnp.where(record, columns[4], columns[4] - columns[5])
    return residual, jnp.concatenate([J, own], -1), moved, jnp.where(record, 0.0, columns[5])


def snap(latent: Latent, particle: Particle) -> Scalar:
    """Logarithm of the force [mN] at which loading snaps through; infinite if the law is monotone."""
    law = law_of(latent, Unloading.PRINTED)
    K1, K3, K5 = law.plastic.polynomial
    falls = 9 * K3 * K3 > 20 * K1 * K5
    root = jnp.sqrt(jnp.where(falls, 9 * K3 * K3 - 20 * K1 * K5, 1.0))
    square = 2 * K1 / (3 * K3 + root)  # of the scaled strain at the peak
    force = particle.force(jnp.sqrt(square) * (K1 - square * (K3 - square * K5)))
    return jnp.where(falls, jnp.log(jnp.where(falls, force, 1.0)), jnp.inf)
