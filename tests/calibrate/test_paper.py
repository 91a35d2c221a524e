"""The paper's calibration as a whole: what it recovers, what it writes, what it says of data it does not fit."""

import json

import numpy as np
import pytest
from helpers import INSTRUMENTS

from mcc_jax import InputError, Instrument, Programme, Ramp, calibrate_paper, paper_campaign
from mcc_jax.campaign import read_instrument_file


@pytest.fixture(scope="module")
def result():
    return calibrate_paper(paper_campaign(0))


@pytest.mark.extended
def test_one_material_is_recovered_whole():
    one_material = calibrate_paper(paper_campaign(0, shared_material=True), threshold_MPa=0.0)
    assert one_material.converged
    assert one_material.a == pytest.approx(1.43, abs=0.02)
    assert one_material.shape_reference.a == pytest.approx(1.43, abs=0.02)
    assert one_material.elastic.effective_modulus_MPa == pytest.approx(16e3, rel=0.03)
    np.testing.assert_allclose(one_material.plastic.polynomial, (7.0094, 27.235, 144.23), rtol=0.01)
    assert float(one_material.plastic.population.yield_stress) == pytest.approx(0.4085, rel=0.01)
    for particle in one_material.particles:
        assert particle.rms_um < 0.2
        np.testing.assert_allclose(particle.plastic, (7.0094, 27.235 ** (1 / 3), 144.23**0.2), rtol=0.05)


def test_particles_with_their_own_coefficients_are_described_by_them(result):
    for i, particle in enumerate(result.particles):
        assert particle.own_rms_um < 0.5 * particle.rms_um or particle.own_rms_um < 0.5
        assert particle.measured_um.shape == particle.predicted_um.shape == particle.own_um.shape
        assert len(particle.measured_um) == len(result.campaign.curves[i])


def test_the_reference_can_be_named_and_used(result):
    with pytest.raises(InputError, match="no particle '99'"):
        calibrate_paper(result.campaign, reference="99")
    named = calibrate_paper(result.campaign, objective="reference", reference="5")
    assert named.shape_reference.reference == 4
    assert named.a == named.shape_reference.a
    assert named.a != result.a
    assert named.to_json()["reference_particle"] == "5"


@pytest.mark.extended
def test_particles_left_out_are_listed_with_the_reason_and_are_no_reference():
    weak = paper_campaign(0, programme=Programme.cycles(levels=(0.02,)), instrument=Instrument())
    content = calibrate_paper(weak).to_json()
    left_out = [p for p in content["particles"] if not p["kept"]]
    assert left_out
    with pytest.raises(InputError, match="cannot be used"):
        calibrate_paper(weak, reference=left_out[0]["particle"])
    for particle in left_out:
        assert "not the threshold" in particle["why_not"]
        assert particle["C1"]["value"] is None
        assert particle["rms_um"] is None
    assert any("could not be used" in note for note in content["warnings"])


def test_too_few_particles_are_told():
    campaign = paper_campaign(0).select(np.arange(20) == 3)
    with pytest.raises(InputError, match="two usable particles or more, 1 can be used"):
        calibrate_paper(campaign)


@pytest.mark.extended
def test_without_unloading_there_is_no_modulus_and_the_rest_stands():
    campaign = paper_campaign(0, programme=Programme("load", (Ramp(1.0, 2.0),), points=150))
    content = calibrate_paper(campaign).to_json()
    assert content["effective_modulus_MPa"]["value"] is None
    assert not content["converged"]
    assert any("no unloading" in note for note in content["warnings"])
    assert content["a"]["value"] is not None


@pytest.mark.extended
def test_indentation_of_another_material_runs_and_is_called_badly_described():
    campaign = read_instrument_file(INSTRUMENTS / "FS1.txt", diameters_um=(60.0, 60.0, 60.0))
    result = calibrate_paper(campaign, threshold_MPa=0.2)
    content = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert len(content["particles"]) == 10
    assert len(result.elastic.branches) == 80
    assert result.own_misfit > 0.05
    assert any("describes these tests badly" in note for note in content["warnings"])
    noise = content["noise"]["displacement_um"]["value"]
    assert all(p["rms_um"] > 100 * noise for p in content["particles"])
