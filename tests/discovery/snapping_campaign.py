"""A campaign in which two of the laws fall for a stretch: load control jumps over it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from campaigns import FULL, INSTRUMENT, N

from mcc_jax import Plastic
from mcc_jax.campaign import PAPER_DIAMETERS_UM
from mcc_jax.simulate import law_for_each, simulate_campaign

SMOOTH, SNAPPING = (6.5, 3.0, 2.7), (4.0, 3.0, 2.4)


def snapping():
    C = np.array([SNAPPING if i in (2, 5) else SMOOTH for i in range(N)]) * np.linspace(0.99, 1.01, N)[:, None]
    diameters = PAPER_DIAMETERS_UM[:N]
    D1, D2, D3 = diameters.T
    peaks = 12 * np.pi / 4 * (D1 * D2 / D3) ** 2 * 1e-3
    plastic = eqx.filter_vmap(Plastic)(*(jnp.asarray(column) for column in C.T))
    return simulate_campaign(
        law_for_each(plastic, 1.43, 16_000.0), diameters, peaks, FULL, instrument=INSTRUMENT, seed=3
    )
