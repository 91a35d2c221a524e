"""Campaigns as they come: ragged, weak, noisy, without unloading, doubled, tiny. Nothing becomes NaN or silent."""

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from joint_cases import COEFFICIENTS, DIAMETERS, NOISE, simulated, true_coefficients

from mcc_jax import Curve, InputError, Programme, Ramp, least_squares, sample
from mcc_jax.calibrate.data import select
from mcc_jax.campaign import join_campaigns

pytestmark = pytest.mark.extended

METHODS = {
    "bayes": partial(sample, draws=200, chains=2, without_flagged=False),
    "least-squares": partial(least_squares, without_flagged=False),
}
methods = pytest.mark.parametrize("method", list(METHODS))


def one(name, which, **options):
    some = slice(which, which + 1)
    return simulated(COEFFICIENTS[some], DIAMETERS[some], instrument=NOISE, particles=[name], seed=which, **options)


def with_displacement(campaign, displacement, force=None):
    (curve,) = campaign.curves
    curve = Curve(curve.time_s, curve.force_mN if force is None else force, displacement)
    return replace(campaign, curves=(curve,))


def renamed(campaign, name):
    return replace(campaign, particles=(name,))


def ragged():
    plain = one("plain", 0, programme=Programme.cycles(points=220))
    rng = np.random.default_rng(9)
    noise = one("noise", 3, programme=Programme.cycles(points=120))
    n = len(noise.curves[0])
    return join_campaigns(
        plain,
        one("cycles", 1, programme=Programme.cycles(levels=(0.3, 0.6, 1.0), unload_to=0.2, points=250)),
        one("hold", 2, programme=Programme.cycles(hold_s=20.0, points=90)),
        one("weak", 3, peak_MPa=0.15),
        one("loading", 3, programme=Programme("load", (Ramp(1.0, 2.0),), points=80)),
        with_displacement(noise, 3 * rng.standard_normal(n)),
        with_displacement(renamed(noise, "nothing"), 0.02 * rng.standard_normal(n), 0.05 * rng.standard_normal(n)),
        renamed(plain, "twin"),
    )


KEPT = ("plain", "cycles", "hold", "loading", "twin")


def check_contract(content, campaign):
    """No NaN anywhere, every particle listed, and each either has numbers or a reason."""
    text = json.dumps(content, allow_nan=False)
    assert json.loads(text) == content
    assert [p["particle"] for p in content["particles"]] == list(campaign.particles)
    for particle in content["particles"]:
        assert particle["kept"] is (particle["why_not"] is None)
        for name in ("C1", "C3", "C5", "zero_um", "eta_p"):
            value = particle[name]["value"]
            if particle["kept"]:
                assert value is not None, (particle["particle"], name)
                assert math.isfinite(value)
                assert name == "zero_um" or value > 0
            else:
                assert value is None
    assert content["a"]["value"] is not None
    assert content["effective_modulus_MPa"]["value"] > 0


@pytest.fixture(scope="module")
def campaign():
    return ragged()


@pytest.fixture(scope="module")
def contents(campaign):
    return {name: method(campaign).to_json() for name, method in METHODS.items()}


@methods
def test_every_particle_has_numbers_or_a_reason(campaign, contents, method):
    content = contents[method]
    check_contract(content, campaign)
    kept = tuple(p["particle"] for p in content["particles"] if p["kept"])
    assert kept == KEPT
    why = {p["particle"]: p["why_not"] for p in content["particles"]}
    assert "threshold of 0.2 MPa" in why["weak"]
    assert why["noise"]
    assert why["nothing"]
    assert any("3 of 8 particles could not be used" in note for note in content["warnings"])


@methods
def test_notes_name_the_particles_they_are_about(contents, method):
    notes = contents[method]["warnings"]
    assert any("'loading'" in note and "never unloaded" in note for note in notes)
    assert any("'plain'" in note and "'twin'" in note for note in notes)
    assert not any("'hold'" in note and "never unloaded" in note for note in notes)


@methods
def test_the_good_particles_are_recovered_all_the_same(campaign, contents, method):
    truth = true_coefficients(campaign)
    for particle, C in zip(contents[method]["particles"], truth, strict=True):
        if particle["kept"]:
            for j, name in enumerate(("C1", "C3", "C5")):
                assert abs(particle[name]["value"] - C[j]) < 0.25 * C[j], (particle["particle"], name)
    modulus = contents[method]["effective_modulus_MPa"]
    assert abs(modulus["value"] - 16_000) < 5 * modulus["sd"]
    assert abs(contents[method]["a"]["value"] - 1.43) < 1.0


def test_selected_points_are_those_of_the_record(campaign):
    selection = select(campaign)
    tests = selection.tests
    assert tests.force.shape == (5, 320)
    assert tuple(campaign.particles[i] for i in selection.kept) == KEPT
    for row, i in enumerate(selection.kept):
        rows = selection.rows[row]
        read = np.asarray(tests.reading[row])[: len(rows)]
        force, raw = np.asarray(tests.force[row])[: len(rows)], campaign.curves[i].force_mN[rows]
        assert read.mean() > 0.8  # all but turning points and holds
        np.testing.assert_allclose(force[read], np.minimum(raw, np.asarray(tests.record.peak[row])[: len(rows)])[read])
        mask, loading = np.asarray(tests.mask[row]), np.asarray(tests.loading[row])
        assert not mask[len(rows) :].any()
        assert np.all(mask[loading])
        stress = np.asarray(tests.particle.D3[row] ** 2 / (tests.particle.D1[row] * tests.particle.D2[row]) ** 2)
        stress = stress * 4e3 / np.pi * np.asarray(tests.force[row])
        assert np.all(stress[mask] >= 0.2)
    cycles = KEPT.index("cycles")
    # All three loadings count as virgin only beyond what was reached before.
    loading = np.asarray(tests.loading[cycles])
    force = np.asarray(tests.force[cycles])
    highest = np.maximum.accumulate(force)
    assert np.all(force[loading] > highest[loading] - 0.05 * highest.max())


@methods
def test_one_particle_alone(method):
    campaign = one("alone", 1)
    content = METHODS[method](campaign).to_json()
    check_contract(content, campaign)
    eta = content["particles"][0]["eta_p"]["value"]
    b = np.array([content["particles"][0][name]["value"] for name in ("C1", "C3", "C5")]) * eta
    true_eta = 1 + 1.43 * (1 - 137.0**2 / (155.0 * 217.0))
    # The curve says what C eta is, whatever a may be.
    np.testing.assert_allclose(b, COEFFICIENTS[1] * true_eta, rtol=0.15)
    assert content["effective_modulus_MPa"]["value"] == pytest.approx(16_000, rel=0.1)
    if method == "least-squares":
        assert content["diagnostics"]["open_combinations"]
        assert content["a"]["sd"] is None
        assert content["particles"][0]["C1"]["sd"] is None
        assert content["log_C1"]["sd"] == {"value": None, "sd": None, "interval_95": None}
        assert any("nothing of the scatter" in note for note in content["warnings"])
    else:
        assert any("spread is mostly the prior" in note for note in content["warnings"])
        assert any("a is its prior" in note for note in content["warnings"])
        assert content["a"]["sd"] > 0.5  # the prior's is 1


@methods
@pytest.mark.parametrize("ratios", [(150.0, 160.0, 120.0), (150.0, 150.0, 150.0)], ids=["flat", "spheres"])
def test_two_particles_of_one_shape(method, ratios):
    """Of spheres flatness is exactly zero: a is in no equation at all."""
    campaign = simulated(COEFFICIENTS[:2], np.outer((1.0, 1.2), ratios), instrument=NOISE)
    content = METHODS[method](campaign).to_json()
    check_contract(content, campaign)
    if np.ptp(ratios) == 0:
        for particle, C in zip(content["particles"], COEFFICIENTS[:2], strict=True):
            assert particle["eta_p"]["value"] == 1.0
            np.testing.assert_allclose([particle[n]["value"] for n in ("C1", "C3", "C5")], C, rtol=0.15)
    elif method == "least-squares":
        assert any("open" in note and " a" in note for note in content["warnings"])
        assert "a" in content["diagnostics"]["open_combinations"][0]
        assert content["a"]["sd"] is None
        # What the curves do say stays: the modulus enters without the shape factor here.
        modulus = content["effective_modulus_MPa"]
        assert abs(modulus["value"] - 16_000) < 5 * modulus["sd"]
    else:
        assert any("2 particles say little" in note for note in content["warnings"])
        assert any("same shape" in note and "a is its prior" in note for note in content["warnings"])
        assert content["a"]["sd"] > 0.5


def test_no_usable_particle_is_named():
    weak = join_campaigns(one("feather", 0, peak_MPa=0.1), one("dust", 1, peak_MPa=0.15))
    with pytest.raises(InputError, match=r"'feather'.*0\.2 MPa.*'dust'"):
        select(weak)
