"""Simulated campaigns with known truth, and random problems, for the tests of the joint calibration."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mcc_jax import Instrument, Plastic, Programme, Unloading, paper_campaign, simulate_campaign
from mcc_jax.calibrate.data import Tests, select_tests
from mcc_jax.calibrate.forward import Linear, Straight
from mcc_jax.calibrate.marginal import Marginal
from mcc_jax.calibrate.noise import Along, Correlation
from mcc_jax.calibrate.population import Population
from mcc_jax.campaign import particle_batch
from mcc_jax.effects import Record
from mcc_jax.law import StrainScaling
from mcc_jax.simulate import law_for_each

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
    **more,
):
    """A campaign of particles with the given C1, C3, C5; noise-free unless an instrument is given."""
    C = np.asarray(C, float)
    plastic = eqx.filter_vmap(Plastic)(*(jnp.asarray(column) for column in C.T))
    laws = law_for_each(plastic, A, modulus_of(unloading), unloading, scaling)
    peaks = peak_force(diameters, peak_MPa)
    return simulate_campaign(
        laws, np.asarray(diameters), peaks, programme, instrument=instrument, particles=particles, seed=seed, **more
    )


def eight_particles():
    """Those of the paper that come first."""
    return paper_campaign(0, instrument=NOISE).select(np.arange(20) < 8)


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


def random_marginal(rng, scatter, point, flatness, *, scale=1.0):
    """Tests with all entries at random that know each number to about `scale`."""
    count, size = len(flatness), 4 + point.theta.shape[1]
    A = random_precision(rng, count, size) / scale**2
    score = rng.standard_normal((count, size, 1)) / scale
    square = 20 + 5 * rng.random((count, 1, 1)) + np.einsum("npk,npq,nqk->nk", score, np.linalg.inv(A), score)[:, None]
    return Marginal(
        point=point,
        straight=Straight.of(count, *2 * (np.zeros(size - 4),)),
        gram=jnp.asarray(np.block([[A, score], [np.swapaxes(score, 1, 2), square]])),
        log_scale=jnp.asarray(rng.standard_normal(count)),
        count=jnp.asarray(np.floor(20 + 5 * rng.random(count))),
        zero=jnp.asarray(rng.standard_normal(count)),
        zero_slope=jnp.asarray(rng.standard_normal((count, size)) / scale),
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


# ---- tests without a law behind them ---------------------------------------------------------------------------------

POINTS = 12
# Loading, a branch behind its peak, loading on, and another branch; of loading every point is a branch of its own.
ELASTIC = np.repeat([False, True, False, True], POINTS // 4)
BRANCH = np.where(ELASTIC, np.repeat([0, 3, 6, 9], POINTS // 4), np.arange(POINTS))
AT_THE_END = np.arange(POINTS) >= POINTS // 2
KINDS = [
    (Correlation.EXPONENTIAL, Along.LOAD),
    (Correlation.MATERN_32, Along.TIME),
    (Correlation.MATERN_52, Along.LOAD),
]
RHO = {
    Correlation.EXPONENTIAL: lambda x: np.exp(-x),
    Correlation.MATERN_32: lambda x: (1 + np.sqrt(3) * x) * np.exp(-np.sqrt(3) * x),
    Correlation.MATERN_52: lambda x: (1 + np.sqrt(5) * x + 5 * x**2 / 3) * np.exp(-np.sqrt(5) * x),
}


def random_tests(rng, *, count=1, elastic=AT_THE_END, masked=0.2, zero_sd=None, peak_sd=None, points=POINTS):
    """Tests with paths, times, branches and derivatives by force at random; no law is behind them."""
    shape = (count, points)
    step = rng.random(shape) / 4 * (rng.random(shape) < 0.9)  # some points repeat the one before
    branch = BRANCH if elastic is ELASTIC else np.where(elastic, np.argmax(elastic), np.arange(points))
    still = [jnp.zeros(shape)] * 9
    tests = Tests(
        particle_batch(np.full((count, 3), 200.0)),
        Record(
            still[0], jnp.asarray(np.cumsum(rng.random(shape), 1)), *[jnp.zeros(shape, int)] * 3, *still[:5], still[5]
        ),
        jnp.zeros(shape),
        jnp.asarray(rng.random(shape) >= masked),
        jnp.asarray(np.broadcast_to(~elastic, shape)),
        jnp.zeros(count),
        jnp.asarray(np.cumsum(step, 1)),
        jnp.asarray(np.broadcast_to(branch, shape)),
        jnp.asarray(rng.random(shape) < 0.8),
        jnp.asarray(np.where(elastic, 0.3 + rng.random(shape), 0.0)),
        None if zero_sd is None else jnp.full(count, zero_sd),
        None if peak_sd is None else jnp.asarray(np.where(elastic, peak_sd, 0.0) * np.ones(shape)),
    )
    by_force, by_peak = rng.standard_normal((2, *shape))
    columns, residual = rng.standard_normal((*shape, 4)), rng.standard_normal(shape)
    own = np.asarray(tests.mask)
    zeros = (np.where(own, x, 0.0) for x in (residual, by_force, by_peak, by_force + by_peak))
    residual, *derivatives = map(jnp.asarray, zeros)
    return tests, Linear(residual, jnp.asarray(np.where(own[..., None], columns, 0.0)), *derivatives)


def dense(four, scale, tests, linear, i=0, kind=KINDS[0]):
    """The covariance in the docstring of `noise`, written out, of the points that count."""
    white, force, correlated, length = four
    correlation, along = kind
    place = np.asarray(tests.path[i] if along is Along.LOAD else tests.record.time[i])
    total = correlated**2 * RHO[correlation](np.abs(place[:, None] - place) / length)
    total = scale**2 * (total + np.diag(white**2 + (force * np.asarray(linear.by_force[i])) ** 2))
    variance = (scale * force * np.asarray(tests.peak_error[i])) ** 2
    variance += 0.0 if tests.peak_sd is None else np.asarray(tests.peak_sd[i]) ** 2
    branch = np.asarray(tests.branch[i])
    for b in np.unique(branch):
        c = np.where(branch == b, np.sqrt(variance) * np.asarray(linear.by_peak[i]), 0.0)
        total += np.outer(c, c)
    if tests.force_zero_sd is not None:
        c = float(tests.force_zero_sd[i]) * np.asarray(linear.by_offset[i])
        total += np.outer(c, c)
    return total
