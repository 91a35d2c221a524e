"""What users give reaches the engine under discovery field by field."""

import dataclasses

import numpy as np
import pytest

from mcc_jax import InputError, LogNormalPrior, Model, NormalPrior, Priors
from mcc_jax.discover.legacy.model import Model as LegacyModel
from mcc_jax.discover.legacy.settings import checked_settings, legacy_model, noise_prior


def test_a_model_is_taken_over_field_by_field():
    priors = dataclasses.replace(Priors.default(), a=NormalPrior(0.5, 0.1), zero_um=NormalPrior(0.0, 2.0))
    given = Model("punch", "contact", True, True, priors)
    taken = legacy_model(given)
    for f in dataclasses.fields(LegacyModel):
        assert getattr(taken, f.name) == getattr(given, f.name), f.name
    with pytest.raises(InputError, match="knows no effects"):
        legacy_model(given.with_effects("creep"))
    assert (taken.scatter.modulus, taken.scatter.shape) == (True, True)
    assert float(taken.zero_sd) == 2.0


def test_without_a_model_the_public_default_is_kept():
    tell, model, threshold = checked_settings(None, None, 0)
    tell("nothing happens")
    assert model == Model()
    assert threshold == 0.0


def test_the_noise_has_its_four_priors_in_their_order():
    priors = dataclasses.replace(Priors.default(), noise_force_mN=LogNormalPrior(0.07, 0.9))
    prior = noise_prior(priors)
    np.testing.assert_array_equal(prior.median, [0.02, 0.07, 0.01, 0.2])
    np.testing.assert_array_equal(prior.log_sd, [1.5, 0.9, 1.5, 1.0])
