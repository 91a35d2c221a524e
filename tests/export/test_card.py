import json
import math

import equinox as eqx
import jax.numpy as jnp
import pytest
from asserting import estimate
from calibrations import write
from compiling import PARTICLE

from mcc_jax import Particle, Unloading, paper_law
from mcc_jax.export import card, read_calibration
from mcc_jax.law import StrainScaling


@pytest.mark.parametrize("unloading", Unloading)
@pytest.mark.parametrize("scaling", StrainScaling)
def test_the_formulae_in_words_are_the_law(unloading, scaling):
    """Coded again from the card's numbers and sentences alone, on loading and unloading."""
    law = paper_law(unloading, scaling)
    written = json.loads(json.dumps(card(law, PARTICLE)))
    C1, C3, C5, a, E = (written["parameters"][k]["value"] for k in ("C1", "C3", "C5", "a", "effective_modulus_MPa"))
    k, n, p = (written["law"][key] for key in "knp")
    size = written["particle"]
    D1, D2, D3 = (size[f"D{i}_um"] for i in (1, 2, 3))
    diameter, eta = D1 * D2 / D3, 1 + a * (1 - D3**2 / (D1 * D2))
    assert size["effective_diameter_um"] == pytest.approx(diameter, rel=1e-14)
    assert size["eta_p"] == pytest.approx(eta, rel=1e-14)

    def loading(displacement):
        x = eta * displacement / diameter
        return C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5

    peak = 0.8 * size["displacement_valid_um"]
    strain, stress = peak / diameter, loading(peak)
    delta = math.sqrt((stress / E) ** n / (k * eta**p * strain))
    s = 0.3
    unloaded = stress * 2 / math.pi * (math.acos(s) - s * math.sqrt(1 - s * s))
    want = [float(law.loading_stress(PARTICLE, jnp.asarray(strain)))]
    want.append(float(law.unloading_stress(PARTICLE, jnp.asarray(strain - s * delta), jnp.asarray(strain))))
    assert [stress, unloaded] == pytest.approx(want, rel=1e-12)
    assert written["validity"]["stress_there_MPa"] == pytest.approx(loading(size["displacement_valid_um"]), rel=1e-12)


def test_checksum_is_that_of_the_numbers():
    nearly = eqx.tree_at(lambda law: law.a, paper_law(), jnp.nextafter(paper_law().a, 2.0))
    base, other, punch = (card(law, PARTICLE)["sha256"] for law in (paper_law(), nearly, paper_law(Unloading.PUNCH)))
    assert card(paper_law(), Particle(200.0, 190.0, 160.0))["sha256"] == base
    assert len({base, other, punch}) == 3


def test_population_has_the_medians_and_their_uncertainty(tmp_path):
    law, particle, origin = read_calibration(write(tmp_path / "fit"))
    written = card(law, particle, origin=origin)
    assert written["parameters"]["C1"]["value"] == pytest.approx(6.7, rel=1e-12)
    assert written["parameters"]["C1"]["sd"] == pytest.approx(6.7 * 0.05, rel=1e-12)
    low, high = written["parameters"]["C1"]["interval_95"]
    assert (low * high, high / low) == pytest.approx((6.7**2, math.exp(2 * 1.96 * 0.05)), rel=1e-12)
    assert written["population"]["log_C1"]["sd"]["value"] == 0.3
    assert written["law"]["unloading"] == "punch"
    assert written["provenance"]["calibration"]["method"] == "bayes"
    assert written["particle"]["D1_um"] == 150.0  # the mean of the campaign
    assert origin.geometry == "mean diameters of the 4 particles of the calibrated campaign"
    assert written["warnings"] == []


def test_a_particle_has_its_own_coefficients_and_size(tmp_path):
    """And where shapes scatter its own shape factor."""
    folder = write(tmp_path / "fit", shape_scatter=estimate(0.1))
    law, particle, origin = read_calibration(folder, particle="b c")
    assert [float(v) for v in (law.plastic.C1, law.plastic.C3, law.plastic.C5)] == [9.0, 3.1, 2.5]
    assert float(particle.D3) == 130.0
    assert float(law.shape_factor(particle)) == pytest.approx(1.3, rel=1e-12)
    written = card(law, particle, origin=origin)
    assert written["coefficients_of"] == "b c"
    assert written["parameters"]["C1"] == {**estimate(9.0, 0.1), "unit": "1"}
    assert written["parameters"]["a"]["sd"] is None
    assert float(read_calibration(folder)[0].a) == 1.4
