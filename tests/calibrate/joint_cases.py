"""Simulated campaigns with known truth, and random problems, for the tests of the joint calibration."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mcc_jax import (
    Instrument,
    Plastic,
    Programme,
    StrainScaling,
    Unloading,
    law_for_each,
    simulate_campaign,
)
from mcc_jax.calibrate.data import select_tests
from mcc_jax.calibrate.forward import Point
from mcc_jax.calibrate.marginal import Marginal
from mcc_jax.calibrate.population import Population

A, EBAR = 1.43, 16_000.0
NOISE = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05)
DIAMETERS = np.array([(213.0, 196.0, 186.0), (155.0, 217.0, 137.0), (97.0, 101.0, 69.0), (160.0, 168.0, 151.0)])
COEFFICIENTS = np.array([(6.5, 3.0, 2.70), (8.0, 3.05, 2.60), (5.5, 2.9, 2.75), (7.0, 3.02, 2.66)])
SNAPPING = np.array([4.0, 3.0, 2.4])
"""9 C3^6 is 1.03 times 20 C1 C5^5: the curve falls for a stretch, and load control jumps over it."""
PROGRAMME = Programme.cycles(points=200)


def modulus_of(unloading):
    """A modulus that gives about the same unloading in every form."""
    return EBAR if unloading is Unloading.PRINTED else 500.0


def effective_diameter(diameters):
    return diameters[:, 0] * diameters[:, 1] / diameters[:, 2]


def flatness(diameters):
    return 1 - diameters[:, 2] ** 2 / (diameters[:, 0] * diameters[:, 1])


def peak_force(diameters, stress_MPa):
    return 1e-3 * np.pi * effective_diameter(diameters) ** 2 / 4 * stress_MPa


def simulated(
    C=COEFFICIENTS,
    diameters=DIAMETERS,
    *,
    unloading=Unloading.PRINTED,
    scaling=StrainScaling.RAW,
    peak_MPa=10.0,
    programme=PROGRAMME,
    instrument=None,
    seed=0,
    particles=None,
):
    """A campaign of particles with the given C1, C3, C5; noise-free unless an instrument is given."""
    C = np.asarray(C, float)
    plastic = eqx.filter_vmap(Plastic)(*(jnp.asarray(column) for column in C.T))
    laws = law_for_each(plastic, A, modulus_of(unloading), unloading, scaling)
    peaks = peak_force(diameters, peak_MPa)
    return simulate_campaign(
        laws, np.asarray(diameters), peaks, programme, instrument=instrument, particles=particles, seed=seed
    )


def five_particles(seed=0):
    """Five particles, one of which snaps through."""
    C = np.concatenate([COEFFICIENTS, SNAPPING[None]])
    return simulated(C, DIAMETERS[[0, 1, 2, 3, 0]], instrument=NOISE, programme=Programme.cycles(points=40), seed=seed)


def five_tests():
    """What the joint calibration sees of them."""
    return select_tests(five_particles())


def true_latent(C=COEFFICIENTS, diameters=DIAMETERS, *, unloading=Unloading.PRINTED, scaling=StrainScaling.RAW):
    """b1, b3, b5 and e of every particle, shape (N, 4)."""
    log_eta = np.log(1 + A * flatness(diameters))[:, None]
    # The printed form knows Ebar eta^p, the punch forms Ebar^2 eta^p: their modulus takes in only half of the power.
    power = scaling.power if unloading is Unloading.PRINTED else scaling.power / 2
    e = np.log(modulus_of(unloading)) + power * log_eta
    return np.concatenate([np.log(np.asarray(C, float)) + log_eta, e], axis=1)


def true_coefficients(campaign):
    return np.array([[float(v) for v in campaign.columns[f"true_C{j}"]] for j in (1, 3, 5)]).T


def random_precision(rng, count, size, *, spread=1.0):
    """Positive definite matrices whose eigenvalues scatter by a factor."""
    Q = np.linalg.qr(rng.standard_normal((count, size, size)))[0]
    values = np.exp(spread * rng.standard_normal((count, size)))
    return np.einsum("nij,nj,nkj->nik", Q, values, Q)


def random_marginal(rng, scatter, flatness, *, precision=8.0, numbers=0):
    """The tests of particles with all entries at random, and so many numbers of effects."""
    count, size = len(flatness), 4 + numbers
    A = precision * random_precision(rng, count, size)
    score = rng.standard_normal((count, size))
    square = np.einsum("np,npq,nq->n", score, np.linalg.inv(A), score) + 20 + 5 * rng.random(count)
    gram = np.concatenate([A, score[:, None]], 1)
    gram = np.concatenate([gram, np.concatenate([score, square[:, None]], 1)[..., None]], 2)
    point = Point(*(jnp.asarray(0.3 * rng.standard_normal(s)) for s in ((count, 4), count, (count, numbers))))
    return Marginal(
        point=point,
        gram=jnp.asarray(gram),
        log_scale=jnp.asarray(rng.standard_normal(count)),
        count=jnp.asarray(np.floor(20 + 5 * rng.random(count))),
        zero=point.zero,
        zero_slope=jnp.asarray(rng.standard_normal((count, size))),
        zero_sd=jnp.asarray(0.1 + rng.random(count)),
        flatness=jnp.asarray(flatness),
        weight=None,
        scatter=scatter,
    )


def random_population(rng, scatter, **changes):
    """A population at random, with what scatters."""
    numbers = {
        "a": 1.2 + 0.2 * rng.standard_normal(),
        "log_modulus": 0.2 * rng.standard_normal(),
        "mu": 0.2 * rng.standard_normal(3),
        "tau": 0.2 + 0.4 * rng.random(3),
        "modulus_scatter": 0.3 if scatter.modulus else 0.0,
        "shape_scatter": 0.2 if scatter.shape else 0.0,
        "log_noise": 0.2 * rng.standard_normal(),
        "theta": np.zeros(0),
        "theta_scatter": np.zeros(0),
    }
    return Population(**{name: jnp.asarray(value) for name, value in {**numbers, **changes}.items()})
