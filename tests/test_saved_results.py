"""What a calibration or a discovery saved comes back to the last bit, is reported and exported, and its law drives."""

import jax.numpy as jnp
import numpy as np
import pytest

import mcc_jax as mcc
from mcc_jax import InputError
from mcc_jax._archive import encode
from mcc_jax.discovery import Discovery
from mcc_jax.export import read_calibration, write_export
from mcc_jax.report import read_results, report_page
from mcc_jax.simulate import read_effect

METHODS = {
    "paper": mcc.calibrate_paper,
    "least-squares": mcc.least_squares,
    "bayes": lambda campaign: mcc.sample(campaign, draws=300),
}
SIZES = mcc.Particle(200.0, 190.0, 160.0)


@pytest.fixture(scope="module")
def campaign():
    whole = mcc.paper_campaign(0)
    return whole.select(np.arange(len(whole)) < 8)


@pytest.fixture(scope="module", params=METHODS)
def calibration(request, campaign):
    return METHODS[request.param](campaign)


def test_it_comes_back_to_the_last_bit(calibration, tmp_path):
    calibration.save(tmp_path)
    again = mcc.load(tmp_path)
    assert encode(again) == encode(calibration)
    assert again.to_json() == calibration.to_json()
    assert repr(again) == repr(calibration)


def test_a_discovery_in_its_folder_has_it_as_its_before(calibration, tmp_path):
    calibration.save(tmp_path)
    Discovery("NO_GAP", "Nothing is missing.", None, None, 0, 0.0).save(tmp_path)
    again = mcc.load(tmp_path)
    assert again.verdict == "NO_GAP"
    assert encode(again.before) == encode(calibration)
    assert encode(mcc.load(tmp_path / "calibration.msgpack")) == encode(calibration)
    with pytest.raises(InputError, match="is no result of mcc_jax"):
        mcc.load(tmp_path / "discovery.json")


@pytest.mark.extended
def test_its_law_drives_and_is_exported(calibration, tmp_path):
    calibration.save(tmp_path)
    law = mcc.load(tmp_path).law()
    force = mcc.drive(law, SIZES, jnp.linspace(0.0, 60.0, 20)).force
    assert float(force[-1]) > 100
    exported, particle, origin = read_calibration(tmp_path, particle="2")
    assert origin.calibration["method"] == calibration.to_json()["method"]
    own = mcc.load(tmp_path).law("2")
    for name in ("C1", "C3", "C5"):
        assert float(getattr(exported.plastic, name)) == float(getattr(own.plastic, name))
    assert write_export("json", exported, particle, tmp_path, origin=origin)


def test_curves_are_those_that_were_compared(calibration, campaign, tmp_path):
    """The mask, and what the law leaves, are the calibration's own."""
    calibration.save(tmp_path)
    content = calibration.to_json()
    for one, entry in zip(mcc.load(tmp_path).curves, content["particles"], strict=True):
        rows = np.searchsorted(campaign.curves[campaign.index(one.name)].time_s, one.time_s)
        assert (np.diff(rows) > 0).all()
        rms = entry["own_rms_um"] if content["method"] == "paper" else entry["rms_um"]
        assert one.rms_um == pytest.approx(rms, rel=1e-6 if content["method"] != "bayes" else 0.2)
        assert 0 < one.used.sum() <= len(one.used)


@pytest.mark.extended
def test_the_page_shows_it(calibration, tmp_path):
    calibration.save(tmp_path)
    found = read_results(tmp_path)
    assert found.cautions == ()
    page = report_page(found)
    assert "chart-data" in page
    assert ("band" in page) or calibration.to_json()["method"] != "bayes"


def test_a_campaign_is_loaded_too_and_an_empty_folder_is_one_line(campaign, tmp_path):
    with pytest.raises(mcc.InputError, match="no result and no campaign"):
        mcc.load(tmp_path)
    mcc.write_campaign(campaign, tmp_path)
    again = mcc.load(tmp_path)
    assert again.particles == campaign.particles
    np.testing.assert_array_equal(again.curves[3].force_mN, campaign.curves[3].force_mN)


@pytest.mark.extended
def test_a_discovery_comes_back_with_its_law(tmp_path):
    programme = mcc.Programme.cycles(levels=(0.5, 1.0), hold_s=30.0)
    campaign = mcc.paper_campaign(1, programme=programme, effects=[read_effect("frame_compliance")])
    library = {name: mcc.LIBRARY[name] for name in ("frame_compliance", "creep", "damage")}
    found = mcc.discover(campaign, library=library)
    assert found.verdict == "NAMED"
    found.save(tmp_path)
    again = mcc.load(tmp_path)
    assert encode(again) == encode(found)
    assert again.to_json() == found.to_json()
    law = again.law()
    assert [effect.name for effect in law.effects] == ["frame_compliance:linear"]
    force, time = jnp.linspace(0.0, 100.0, 30), jnp.arange(30.0)
    with_frame = mcc.drive(law, SIZES, force, time=time, control="load").displacement
    alone = mcc.drive(law.of_particle(), SIZES, force, control="load").displacement
    np.testing.assert_allclose(with_frame - alone, found.effects[0].amplitude * force, rtol=1e-9, atol=1e-12)
    exported, _, origin = read_calibration(tmp_path)
    assert exported.effects == ()
    assert any("frame_compliance" in note for note in origin.warnings)
    assert "frame" in report_page(read_results(tmp_path))
