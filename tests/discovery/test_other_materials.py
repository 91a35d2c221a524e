"""A material that the law was not made for: hard spheres with a soft contact, loaded until they break."""

import numpy as np
import pytest

from mcc_jax.calibrate import Model
from mcc_jax.campaign import Campaign, Curve, check_tests
from mcc_jax.discovery import discover
from mcc_jax.discovery.base import base_fit
from mcc_jax.discovery.misfit import informative
from mcc_jax.discovery.settings import DECISIONS
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.extended

RIVALS = ("toe_asperity", "misalignment", "frame_compliance", "finite_hardening_exponent")
GIVEN = {"library": {name: LIBRARY[name] for name in RIVALS}, "posterior": False, "experiments": False}


def hard_spheres(count, toe, seed=0, rows=300):
    """Spheres of 1 mm whose loading curve is of the law's form, a soft contact, and a wander of each one's own.

    The instrument drives the displacement at one speed; half of the spheres give way before the record ends.
    """
    rng = np.random.default_rng(seed)
    diameters = 1000.0 * rng.uniform(0.95, 1.05, (count, 1)) * np.ones(3)
    curves = []
    for k, diameter in enumerate(diameters[:, 0]):
        strain = np.linspace(1e-5, 0.016, 4000)
        x, strength = strain / 0.016, 40.0 * np.exp(0.2 * rng.standard_normal())
        stress = strength * (1.3 * x - 0.6 * x**3 + 0.3 * x**5)
        wander = sum(0.01 * rng.standard_normal() / n * np.sin(np.pi * n * x) for n in range(1, 6))
        path = diameter * (strain + 0.016 * wander + toe * -np.expm1(-stress / 3.0))
        force = np.pi * (diameter / 2) ** 2 * stress * 1e-3
        closing = np.linspace(path[0], path[-1], rows)
        force = np.interp(closing, path, force)
        if k % 2:  # it gives way, and the platens go on
            more = np.arange(1, 16)
            closing = np.concatenate([closing, closing[-1] + more * (closing[1] - closing[0])])
            force = np.concatenate([force, force[-1] * (1 - 0.008 * more)])
        noise = 0.005 * rng.standard_normal(len(closing))
        curves.append(Curve((closing - closing[0]) / 100.0, force, closing + noise))
    return Campaign(tuple(f"S{k + 1}" for k in range(count)), diameters, tuple(curves))


def test_few_readings_are_compared():
    campaign = hard_spheres(8, toe=4e-3)
    base = base_fit(check_tests(campaign), Model(), threshold_MPa=0.0, progress=lambda _: None)
    assert base.coarse
    assert np.all(np.asarray(base.tests.mask).sum(1) <= 2 * DECISIONS.readings)


def test_time_explains_nothing_of_loading_alone():
    mask = np.ones((3, 4), bool)
    unloading = np.tile([0.0, 0.0, 1.0, 1.0], (3, 1))
    at = {"clock": np.arange(12.0).reshape(3, 4), "load": unloading, "unloading": unloading}
    assert "clock" in informative(at, mask)
    assert set(informative(at, mask & (unloading == 0))) == {"load", "unloading"}


def test_a_soft_contact_of_hard_spheres_is_named_and_closes_the_gap():
    found = discover(hard_spheres(12, toe=4e-3), **GIVEN)
    assert found.candidate_set == (("toe_asperity",),)
    assert found.effects[0].amplitude == pytest.approx(4e-3, rel=0.15)
    assert found.to_json()["gap"]["closed_fraction"] > 0.8


def test_hard_spheres_without_a_soft_contact_get_none():
    found = discover(hard_spheres(8, toe=0.0), **GIVEN, confirm=False)
    assert "toe_asperity" not in {name for names in found.candidate_set or () for name in names}
