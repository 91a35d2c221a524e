import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from mcc_jax import InputError, Instrument, Plastic, Programme, paper_campaign, simulate_campaign
from mcc_jax.simulate import PAPER_PEAK_STRESS_MPA, law_for_each


def quiet(**arguments):
    return paper_campaign(instrument=Instrument(), **arguments)


def peak_stresses(campaign):
    D1, D2, D3 = campaign.diameters_um.T
    force = np.array([curve.force_mN.max() for curve in campaign.curves])
    return 1e3 * force / (np.pi * (D1 * D2 / D3 / 2) ** 2)


def laws_of(C1, C3=3.0, C5=2.7, modulus=16e3):
    """One law for each of several C1."""
    plastic = eqx.filter_vmap(lambda c1, c5: Plastic(c1, C3, c5))(jnp.array(C1), jnp.full(len(C1), C5))
    return law_for_each(plastic, 1.43, modulus)


def test_paper_campaign_follows_the_paper():
    campaign = quiet(seed=5)
    assert len(campaign) == 20
    assert campaign.metadata.control == "load"
    assert "not a measurement" in campaign.metadata.provenance
    low, high = PAPER_PEAK_STRESS_MPA
    assert np.all((peak_stresses(campaign) >= low) & (peak_stresses(campaign) <= high))
    for curve in campaign.curves:
        np.testing.assert_allclose(np.abs(np.diff(curve.force_mN) / np.diff(curve.time_s)), 2.0, rtol=1e-9)


def test_same_seed_same_campaign_and_another_seed_another():
    one, two, other = paper_campaign(7), paper_campaign(7), paper_campaign(8)
    pd.testing.assert_frame_equal(one.to_dataframe(), two.to_dataframe(), check_exact=True)
    assert one.columns == two.columns
    assert not np.array_equal(one.curves[0].displacement_um, other.curves[0].displacement_um)


def test_noise_has_the_asked_size_and_the_truth_stays():
    truth, noisy = quiet(seed=2), paper_campaign(2)
    pairs = list(zip(noisy.curves, truth.curves, strict=True))
    gamma = np.concatenate([n.displacement_um - t.displacement_um for n, t in pairs])
    force = np.concatenate([n.force_mN - t.force_mN for n, t in pairs])
    assert gamma.std() == pytest.approx(0.02, rel=0.05)
    assert force.std() == pytest.approx(0.05, rel=0.05)
    assert abs(np.corrcoef(gamma, force)[0, 1]) < 0.05


def test_resolution_and_zero():
    instrument = Instrument(displacement_resolution_um=0.01, force_resolution_mN=0.5, zero_um=3.0)
    read = paper_campaign(2, instrument=instrument)
    for curve in read.curves:
        np.testing.assert_allclose(curve.displacement_um / 0.01, np.round(curve.displacement_um / 0.01), atol=1e-6)
        np.testing.assert_allclose(curve.force_mN / 0.5, np.round(curve.force_mN / 0.5), atol=1e-9)
    zeros = [curve.displacement_um[0] for curve in read.curves]
    assert 1.0 < np.std(zeros) < 6.0


def test_switching_one_read_out_effect_on_leaves_the_others_draws_alone():
    plain = paper_campaign(4, instrument=Instrument(displacement_noise_um=0.02))
    both = paper_campaign(4, instrument=Instrument(displacement_noise_um=0.02, force_noise_mN=0.05))
    np.testing.assert_array_equal(plain.curves[3].displacement_um, both.curves[3].displacement_um)


def test_displacement_control_reaches_the_asked_stress():
    campaign = quiet(seed=1, programme=Programme.cycles(control="displacement", rate=1.0, points=200))
    low, high = PAPER_PEAK_STRESS_MPA
    assert np.all((peak_stresses(campaign) >= 0.999 * low) & (peak_stresses(campaign) <= 1.001 * high))


def test_padding_changes_no_particle():
    # The same particle alone, and next to one whose test is ten times as long.
    sizes, programme = np.array([[200.0, 190, 160]] * 2), Programme.cycles(interval_s=1.0)
    two = simulate_campaign(laws_of([7.0, 7.0]), sizes, np.array([50.0, 500.0]), programme)
    one = simulate_campaign(laws_of([7.0]), sizes[:1], np.array([50.0]), programme)
    np.testing.assert_allclose(two.curves[0].displacement_um, one.curves[0].displacement_um, rtol=1e-14)
    assert len(two.curves[1]) > 5 * len(two.curves[0])


def test_particles_whose_law_is_not_monotone_are_marked():
    laws = laws_of([4.0, 7.0], C5=2.4)
    campaign = simulate_campaign(laws, np.full((2, 3), 150.0), np.array([60.0, 60.0]), Programme.cycles())
    assert campaign.columns["true_monotone"] == ("no", "yes")


@pytest.mark.parametrize(
    ("count", "modulus", "message"), [(2, 16e3, "3 particles need as many"), (3, jnp.asarray(-5.0), "must be positive")]
)
def test_laws_that_do_not_fit_are_refused(count, modulus, message):
    laws = laws_of([7.0] * count, modulus=modulus)
    with pytest.raises(InputError, match=message):
        simulate_campaign(laws, np.full((3, 3), 100.0), np.ones(3), Programme.cycles())
