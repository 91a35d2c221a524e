import jax
import numpy as np
import pytest

from mcc_jax.campaign import PAPER_DIAMETERS_UM, of_each_particle
from mcc_jax.geometry import plastic_shape_factor


@pytest.mark.parametrize("x64", [False, True])
def test_of_each_particle_is_in_double_precision_whatever_the_caller_computes_in(x64):
    D1, D2, D3 = PAPER_DIAMETERS_UM.T
    flatness = 1 - D3**2 / (D1 * D2)
    with jax.enable_x64(x64):
        actual = of_each_particle(PAPER_DIAMETERS_UM, lambda p: p.flatness)
        factors = of_each_particle(PAPER_DIAMETERS_UM, lambda p: plastic_shape_factor(p, 1.43))
        assert jax.numpy.zeros(1).dtype == ("float64" if x64 else "float32")
    assert actual.dtype == factors.dtype == np.float64
    np.testing.assert_allclose(actual, flatness, rtol=1e-15, atol=1e-16)
    np.testing.assert_allclose(factors, 1 + 1.43 * flatness, rtol=1e-15)


def test_of_each_particle_knows_integers():
    assert of_each_particle(np.array([[200, 100, 50]]), lambda p: p.effective_diameter).tolist() == [400.0]
