"""From what users give, which is of `mcc_jax.calibrate`, to what this package works with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from ... import arguments
from ..._errors import InputError
from ...calibrate import Model as PublicModel
from ...calibrate.priors import Priors
from .model import Model
from .noise import NoisePrior


def checked_settings(
    progress: Callable[[str], None] | None, model: PublicModel | None, threshold_MPa: Any
) -> tuple[Callable[[str], None], PublicModel, float]:
    """What discovery and power share, with the defaults filled in.

    Raises:
        InputError: for one of the wrong kind or out of its range.
    """
    tell = arguments.teller(progress)
    if model is not None:
        arguments.instance(model, PublicModel, "model", "Make one with mcc_jax.Model().")
    threshold = arguments.number(threshold_MPa, "threshold_MPa, a stress,", least=0)
    return tell, model or PublicModel(), threshold


def legacy_model(model: PublicModel) -> Model:
    """The model that a user gave, as this package has it.

    Raises:
        InputError: for a model with effects, which the search adds by itself.
    """
    if model.effects:
        raise InputError(
            f"discovery knows no effects beforehand, and the model has {', '.join(model.variants)}",
            remedy="Give the model without effects; mcc_jax.compare compares models that have some.",
        )
    return Model(
        unloading=model.unloading,
        strain_scaling=model.strain_scaling,
        modulus_scatter=model.modulus_scatter,
        shape_scatter=model.shape_scatter,
        priors=model.priors,
    )


def noise_prior(priors: Priors) -> NoisePrior:
    """The four priors of the noise together."""
    four = (priors.noise_displacement_um, priors.noise_force_mN, priors.noise_correlated_um, priors.noise_length)
    return NoisePrior(jnp.asarray([p.median for p in four]), jnp.asarray([p.log_sd for p in four]))
