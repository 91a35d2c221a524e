"""The paper's law and particles, and comparison with printed numbers."""

from decimal import Decimal
from pathlib import Path

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from mcc_jax import InputError
from mcc_jax.campaign.paper import PAPER_DIAMETERS_UM, PAPER_LOG_C
from mcc_jax.effects import AbstractModulusAtPeak
from mcc_jax.geometry import Particle
from mcc_jax.law import LogNormal, MccLaw, Plastic, PlasticPopulation, StrainScaling, Unloading

SHARED = Path(__file__).resolve().parents[2] / "shared"


class _InstrumentFiles:
    """Files of real instruments, which are not the project's own: a test that needs one that is absent is skipped."""

    def __truediv__(self, name):
        file = SHARED / "data" / "testers" / name
        if not file.exists():
            pytest.skip("needs the instrument files beside the checkout")
        return file


INSTRUMENTS = _InstrumentFiles()
K1, K3, K5, A, EBAR = 7.0094, 27.235, 144.23, 1.43, 16000.0
FORMS = [(u, s) for u in Unloading for s in StrainScaling]
FORM_NAMES = [f"{u.value}-{s.value}" for u, s in FORMS]
ALL_FORMS = pytest.mark.parametrize(("unloading", "scaling"), FORMS, ids=FORM_NAMES)
# Each form and each way of the shape factor once, for derivatives, which compile for long.
SOME_FORMS = pytest.mark.parametrize(("unloading", "scaling"), FORMS[::4], ids=FORM_NAMES[::4])


EPS = {np.dtype("float64"): 2.0**-52, np.dtype("float32"): 2.0**-23}


def check(actual, printed, *, rel=4e-15, slack=1.0):
    """Assert that a number rounds to the printed text: within half of its last digit (times `slack`)."""
    half_digit = 0.5 * 10.0 ** Decimal(printed).as_tuple().exponent
    expected = float(printed)
    tolerance = slack * half_digit * (1 + 1e-6) + rel * abs(expected)
    assert abs(float(actual) - expected) <= tolerance, f"{float(actual)!r} is not {printed} (+- {tolerance:.1e})"


def close(actual, expected, *, rel=0.0, scale=0.0):
    """Assert equality to `rel` of each value plus an absolute `scale`."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    assert np.all(np.isfinite(actual) == np.isfinite(expected))
    off = np.abs(actual - expected) - rel * np.abs(expected) - scale
    worst = np.unravel_index(np.nanargmax(off), off.shape) if off.size else ()
    assert np.all(off <= 0), f"at {worst}: {actual[worst]!r} is not {expected[worst]!r}"


def refusal(read, *args, **kwargs):
    """The one line with which a call refuses its input."""
    with pytest.raises(InputError) as caught:
        read(*args, **kwargs)
    assert str(caught.value).isprintable()
    return str(caught.value)


def assert_holds(text, pieces):
    """Every piece is in the text."""
    missing = [piece for piece in pieces if piece not in text]
    assert not missing, (missing, text)


def assert_same_curves(found, expected):
    """Readings are equal to the last bit, signs of zero included."""
    for one, two in zip(found, expected, strict=True):
        for name in ("time_s", "force_mN", "displacement_um"):
            x, y = getattr(one, name), getattr(two, name)
            np.testing.assert_array_equal(x, y)
            np.testing.assert_array_equal(np.signbit(x), np.signbit(y))


def all_finite(tree):
    return all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(tree))


def paper_particle(number):
    """A particle by its number in the paper's Table 1, from 1."""
    return Particle(*PAPER_DIAMETERS_UM[number - 1])


def sphere(diameter=100.0):
    return Particle(diameter, diameter, diameter)


def particle_of_shape(eta, diameter=200.0, a=A):
    """A particle with D1 = D2 and the given plastic shape factor."""
    return Particle(diameter, diameter, diameter * np.sqrt(1 - (eta - 1) / a))


def paper_law(unloading=Unloading.PRINTED, scaling=StrainScaling.RAW, *, modulus=EBAR, plastic=None):
    """The law with the coefficients that the paper prints."""
    plastic = Plastic.from_polynomial(K1, K3, K5) if plastic is None else plastic
    return MccLaw(plastic, A, modulus, unloading, scaling)


def paper_population():
    return PlasticPopulation(*(LogNormal(*PAPER_LOG_C[c]) for c in ("C1", "C3", "C5")))


def with_dtype(tree, dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype) if eqx.is_inexact_array(x) else x, tree)


class Softer(AbstractModulusAtPeak):
    """A user's own: E / (1 + kappa eps_P sigma_P)."""

    def factor(self, strain, stress):
        return 1 / (1 + self.amplitude * jnp.maximum(strain, 0.0) ** 2 * jnp.sqrt(stress))


@eqx.filter_jit
def force_along(law, particle, displacements):
    """Forces [mN] along a path of displacements [um] that starts on a fresh contact."""
    return law.path(particle, law.init(particle), displacements)[1]


@eqx.filter_jit
def displacement_along(law, particle, forces):
    """Displacements [um] along a path of forces [mN] that starts on a fresh contact."""
    return law.path_load(particle, law.init(particle), forces)[1]


@eqx.filter_jit
def master_stress(plastic, x):
    """Stress [MPa] of the master curve at scaled strains."""
    return plastic.stress(x)


@eqx.filter_jit
def master_strain(plastic, stress):
    """Scaled strain of the master curve at stresses [MPa]."""
    return plastic.strain(stress)


# ---- a law and a particle as one vector, for derivatives and random trials -------------------------------------------

THETA = ("C1", "C3", "C5", "a", "modulus", "D1", "D2", "D3")


def unpack(theta, unloading=Unloading.PRINTED, scaling=StrainScaling.RAW):
    """Law and particle of the eight numbers `THETA`."""
    C1, C3, C5, a, modulus, D1, D2, D3 = theta
    return MccLaw(Plastic(C1, C3, C5), a, modulus, unloading, scaling), Particle(D1, D2, D3)


PAPER_THETA = np.array([K1, K3 ** (1 / 3), K5**0.2, A, EBAR, 213.54, 196.07, 186.33])


def between(low, high):
    return st.floats(low, high, allow_subnormal=False)


MONOTONE = between(0.0, 0.98)


@st.composite
def thetas(draw, *, softening=MONOTONE):
    """Random laws and particles; `softening` is 9 C3^6 / (20 C1 C5^5), above 1 for laws that are not monotone."""
    C1, C5 = draw(between(2, 20)), draw(between(1.8, 4))
    C3 = (draw(softening) * 20 / 9 * C1 * C5**5) ** (1 / 6)
    D1, D2 = draw(between(40, 400)), draw(between(40, 400))
    D3 = np.sqrt(D1 * D2) * draw(between(0.55, 1.1))
    return np.array([C1, C3, C5, draw(between(-0.85, 2)), 10 ** draw(between(2.5, 4.5)), D1, D2, D3])


def scaled_paths(steps=32, low=-0.05, high=0.7):
    """Random paths of scaled strain with holds and revisited levels, so with ties."""
    level = between(low, high)
    return st.builds(
        lambda levels, picks: np.array(levels)[picks],
        st.lists(level, min_size=steps // 2, max_size=steps // 2),
        st.lists(st.integers(0, steps // 2 - 1), min_size=steps, max_size=steps),
    )


def shape_factor(theta):
    """eta_p and D_e of a `THETA` vector, in numpy."""
    a, (D1, D2, D3) = theta[3], theta[5:]
    return 1 + a * (1 - D3**2 / (D1 * D2)), D1 * D2 / D3


@mpmath.workdps(40)
def exact_elastic_shape_factor(ratio):
    """Hertz: Johnson's eqs. 4.26-4.28 as they stand, with mpmath's elliptic integrals; D1/D2 > 1."""
    curvature = mpmath.mpf(ratio) ** 2

    def excess(q):
        b = mpmath.exp(-q)
        K, E = mpmath.ellipk(1 - b * b), mpmath.ellipe(1 - b * b)
        return mpmath.log((E / b**2 - K) / (K - E) / curvature)

    start = mpmath.log(ratio)
    b = mpmath.exp(-mpmath.findroot(excess, (start * 1.02, start * 1.34), solver="anderson", tol=1e-35))
    m = 1 - b * b
    K, E = mpmath.ellipk(m), mpmath.ellipe(m)
    F1 = mpmath.cbrt(4 / (mpmath.pi * m) * b ** mpmath.mpf(1.5) * mpmath.sqrt((E / b**2 - K) * (K - E)))
    return float(mpmath.pi / 2 / mpmath.sqrt(b) * F1 / K)
