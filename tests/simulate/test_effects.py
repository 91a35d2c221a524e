"""Effects hidden in simulated campaigns."""

import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import HiddenEffect, Instrument, Programme, drive, paper_campaign, paper_law
from mcc_jax.campaign import particle_batch
from mcc_jax.effects import LIBRARY
from mcc_jax.geometry import Particle
from mcc_jax.simulate import read_effect, simulate_batch

PROGRAMME = Programme.cycles(levels=(0.5, 1.0), unload_to=0.1, hold_s=20.0, points=80)


def quiet(**arguments):
    return paper_campaign(4, instrument=Instrument(), programme=PROGRAMME, **arguments)


def test_effects_reach_the_curves_with_their_time():
    plain = quiet()
    both = quiet(effects=(read_effect("frame_compliance=0.002"), read_effect("thermal_drift=0.001")))
    drift = np.array([float(v) for v in both.columns["true_thermal_drift_drift_um_per_s"]])
    assert 0.4e-3 < drift.std() < 1.6e-3
    assert drift.min() < 0 < drift.max()
    for one, other, speed in zip(plain.curves, both.curves, drift, strict=True):
        added = 0.002 * one.force_mN + speed * one.time_s
        np.testing.assert_allclose(other.displacement_um, one.displacement_um + added, atol=1e-9)
    described = both.metadata.other["simulation"]["effects"]
    assert described[0] == {
        "mechanism": "frame_compliance", "variant": "linear", "compliance_um_per_mN": 0.002, "random_per_test": []
    }  # fmt: skip
    assert described[1]["random_per_test"] == ["drift_um_per_s"]


def test_the_seed_decides_and_each_test_has_a_stream_of_its_own():
    effect = read_effect("pop_in=0.5")
    one, same, longer, other = (effect.draw(*a)[1] for a in ((3, 0, 5), (3, 0, 5), (3, 0, 9), (4, 0, 5)))
    np.testing.assert_array_equal(one["location_MPa"], same["location_MPa"])
    np.testing.assert_array_equal(one["location_MPa"], longer["location_MPa"][:5])
    assert len({*one["location_MPa"], *other["location_MPa"]}) == 10
    assert (one["jump_um"] == 0.5).all()
    fixed = read_effect("pop_in:sharp,location_MPa=2").draw(3, 0, 5)[1]
    assert (fixed["location_MPa"] == 2).all()


@pytest.mark.extended
def test_displacement_control_works_with_effects():
    programme = Programme.cycles(control="displacement", rate=1.0, points=40)
    both = ((), (read_effect("frame_compliance=0.01"),))
    plain, softer = (paper_campaign(4, instrument=Instrument(), programme=programme, effects=e) for e in both)
    for one, other in zip(plain.curves, softer.curves, strict=True):
        np.testing.assert_array_equal(one.displacement_um, other.displacement_um)
        assert other.force_mN.max() < one.force_mN.max()


def test_humidity_needs_humidities():
    with pytest.raises(ValueError, match="relative_humidity_percent"):
        quiet(effects=(read_effect("humidity"),))
    humidity = np.linspace(20, 70, 20)
    wet = quiet(effects=(read_effect("humidity:flow=0.01"),), relative_humidity_percent=humidity)
    assert wet.columns["relative_humidity_percent"][0] == "20.0"
    gain = [w.displacement_um.max() - p.displacement_um.max() for w, p in zip(wet.curves, quiet().curves, strict=True)]
    assert gain[0] < 0 < gain[-1]


def test_text_becomes_an_effect():
    effect = read_effect("creep:logarithmic=2e-4,tau_s=5")
    assert (effect.variant.name, effect.amplitude, effect.nuisance) == ("logarithmic", 2e-4, {"tau_s": 5.0})
    assert read_effect("creep").strength == LIBRARY["creep"].variants[0].typical
    assert read_effect("creep,creep_compliance_per_MPa=1e-4").amplitude == 1e-4
    bad = {
        "wobble": "no mechanism 'wobble'. Known: frame",
        "creep:x": "it has: kelvin_voigt",
        "creep=x": "not parameter=number",
        "creep=nan": "finite number",
        "creep=-1e-4": ">= 0",
        "creep,x=1": "no parameter 'x'; it has: creep_compliance_per_MPa, tau_s",
        "creep,tau_s": "not parameter=number",
        "creep,tau_s=1,tau_s=2": "twice",
        "creep=1e-4,creep_compliance_per_MPa=1": "twice",
        "creep,tau_s=0": "> 0",
    }
    for text, words in bad.items():
        with pytest.raises(ValueError, match=words):
            read_effect(text)
    with pytest.raises(ValueError, match=">= 0"):
        HiddenEffect(LIBRARY["creep"].variants[0], -1.0)


def test_times_go_with_effects_only():
    law, particle, path = paper_law(), Particle(200.0, 190.0, 160.0), jnp.linspace(0.0, 50.0, 5)
    creeping = law.with_effects("creep")
    with pytest.raises(ValueError, match="needs the times"):
        drive(creeping, particle, path, control="load")
    with pytest.raises(ValueError, match="only a law with effects"):
        drive(law, particle, path, time=path, control="load")
    with pytest.raises(ValueError, match="only a law with effects"):
        simulate_batch(law, particle_batch(np.array([[200.0, 190, 160]])), path[None], times=path[None])
