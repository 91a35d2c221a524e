"""Small simulated campaigns of one shape, so that all tests of a module share what is compiled."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax import Plastic
from mcc_jax.calibrate import Model
from mcc_jax.campaign import PAPER_DIAMETERS_UM, Campaign, Curve
from mcc_jax.discovery import discover
from mcc_jax.discovery.base import base_fit
from mcc_jax.simulate import Instrument, Programme, law_for_each, paper_population, read_effect, simulate_campaign

N, POINTS = 10, 150
INSTRUMENT = Instrument(displacement_noise_um=0.05, force_noise_mN=0.02, zero_um=0.5)
FULL = Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=30.0, points=POINTS)
"""Two cycles, holds and a reload."""

SINGLE = Programme.cycles(points=POINTS)

QUICK = {"confirm": False, "experiments": False, "posterior": False}


def monotone_draws(seed, count):
    """Draws of the paper's coefficients, without those whose law falls in part of its loading."""
    plastic = paper_population().sample(jax.random.key(seed), 4 * count)
    C = np.stack([np.asarray(plastic.C1), np.asarray(plastic.C3), np.asarray(plastic.C5)])
    smooth = np.flatnonzero(20 * C[0] * C[2] ** 5 > 1.2 * 9 * C[1] ** 6)[:count]
    return jax.tree.map(lambda leaf: leaf[smooth], plastic)


def peaks_at(stress_MPa, diameters):
    """Forces at which particles are under a stress [mN]."""
    D1, D2, D3 = diameters.T
    return stress_MPa * np.pi / 4 * (D1 * D2 / D3) ** 2 * 1e-3


def campaign(
    *effects, seed=0, programme=FULL, particles=N, peaks_MPa=None, humidity=None, instrument=INSTRUMENT,
    form=(16_000.0, "printed"),
):  # fmt: skip
    """Particles of the paper's sizes, monotone draws of its coefficients, effects as text."""
    rng = np.random.default_rng([seed, 5])
    diameters = PAPER_DIAMETERS_UM[rng.permutation(20)[:particles]]
    stress = rng.uniform(7, 16, particles) if peaks_MPa is None else np.asarray(peaks_MPa, float)
    return simulate_campaign(
        law_for_each(monotone_draws(seed, particles), 1.43, *form),
        diameters,
        peaks_at(stress, diameters),
        programme,
        instrument=instrument,
        effects=tuple(read_effect(e) for e in effects),
        relative_humidity_percent=humidity,
        seed=seed,
    )


def snapping():
    """The third and the sixth of the laws fall in part of their loading: load control jumps over it."""
    C = np.array([(4.0, 3.0, 2.4) if i in (2, 5) else (6.5, 3.0, 2.7) for i in range(N)])
    plastic = eqx.filter_vmap(Plastic)(*map(jnp.asarray, (C * np.linspace(0.99, 1.01, N)[:, None]).T))
    diameters = PAPER_DIAMETERS_UM[:N]
    laws = law_for_each(plastic, 1.43, 16_000.0)
    return simulate_campaign(laws, diameters, peaks_at(12, diameters), FULL, instrument=INSTRUMENT, seed=3)


def subset(whole, chosen):
    """The same campaign with some of its particles."""
    return Campaign(
        tuple(whole.particles[i] for i in chosen),
        whole.diameters_um[list(chosen)],
        tuple(whole.curves[i] for i in chosen),
        {name: tuple(values[i] for i in chosen) for name, values in whole.columns.items()},
        whole.metadata,
    )


def with_curves(whole, change):
    """The same campaign with each curve's time, force and displacement changed."""
    curves = tuple(Curve(*change(c)) for c in whole.curves)
    return Campaign(whole.particles, whole.diameters_um, curves, whole.columns, whole.metadata)


cached = functools.cache(campaign)


@functools.cache
def found_in(*effects, seed=0):
    """What is found among all mechanisms of the library, once for all modules."""
    return discover(cached(*effects, seed=seed), experiments=False)


MODEL = Model(modulus_scatter=True)


def base_of(whole):
    """The base fit of a campaign, all points counting."""
    return base_fit(whole, MODEL, threshold_MPa=0.0, progress=lambda _: None)
