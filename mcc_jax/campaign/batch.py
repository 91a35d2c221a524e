"""A campaign as arrays: particles with a batch axis, curves of unequal length padded to one and masked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .. import arguments
from .._types import Scalar
from ..geometry import Particle
from .schema import Campaign
from .validate import check_campaign


def particle_batch(diameters_um: Any) -> Particle:
    """One `Particle` whose fields have a leading axis N, from diameters [um] of shape (N, 3).

    Raises:
        InputError: for another shape, or a diameter that is not positive and finite; traced ones pass.
    """
    sizes = diameters_um if arguments.is_traced(diameters_um) else arguments.diameters(diameters_um)
    D1, D2, D3 = jnp.asarray(sizes, dtype=float).T
    return eqx.filter_vmap(Particle)(D1, D2, D3)


def of_each_particle(diameters_um: Any, quantity: Callable[[Particle], Scalar]) -> np.ndarray:
    """A quantity of every particle, shape (N,).

    Args:
        diameters_um: D1, D2, D3 [um], shape (N, 3).
        quantity: function of one `Particle`, for instance its flatness or its plastic shape factor.
    """
    # What files and figures show is in double precision, whatever precision the caller computes in.
    with jax.enable_x64(True):
        return np.array(eqx.filter_vmap(quantity)(particle_batch(diameters_um)))


class Batch(eqx.Module):
    """N tests as rectangular arrays, for `vmap`.

    Shorter tests are padded with their last point: valid values, never NaN, so that masked entries cannot poison a
    gradient.

    Attributes:
        particle: sizes and shapes, leading axis N.
        time: time [s].
        force: force [mN].
        displacement: displacement [um].
        mask: True where a point was measured, False where it is padding.
    """

    particle: Particle
    time: Float[Array, "particles points"]
    force: Float[Array, "particles points"]
    displacement: Float[Array, "particles points"]
    mask: Bool[Array, "particles points"]


def batch(campaign: Campaign, *, multiple: int = 1) -> Batch:
    """Pad a campaign's curves to the longest.

    Args:
        campaign: at least one particle.
        multiple: round the length up to a multiple of this, so that campaigns of similar length share one compilation.
    """
    check_campaign(campaign)
    multiple = arguments.whole(multiple, "multiple", least=1)
    longest = max(len(curve) for curve in campaign.curves)
    longest += -longest % multiple

    def padded(name: str) -> Array:
        rows = (getattr(curve, name) for curve in campaign.curves)
        return jnp.asarray(np.stack([np.pad(row, (0, longest - len(row)), mode="edge") for row in rows]), dtype=float)

    lengths = np.array([len(curve) for curve in campaign.curves])
    return Batch(
        particle_batch(campaign.diameters_um),
        padded("time_s"),
        padded("force_mN"),
        padded("displacement_um"),
        jnp.asarray(np.arange(longest) < lengths[:, None]),
    )
