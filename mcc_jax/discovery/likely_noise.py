"""Kinds of noise, which are part of every hypothesis: which one the tests prefer, and what another would do."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from ..calibrate.data import ranges_um
from ..calibrate.judgement import LARGE_MISFIT
from ..calibrate.model import Model
from ..calibrate.noise import Along, Correlation, particle_scales
from .base import Base
from .columns import Design, with_noise
from .design import design_of
from .evidence import LinearModel, Optimum, optimise, residual_of, whitened
from .settings import STRONG


def with_other_noise(design: Design, hyper: np.ndarray, model: Model) -> Optimum:
    """The mode of the hyperparameters under the noise of a model, from the mode under another.

    Its log density is -inf where the correlated noise is more than a misfit may be: a smooth curve of every test's own
    describes any test, and leaves nothing for a law to explain.
    """
    other, start = with_noise(design, model), hyper.copy()
    start[3] = other.noise[0, 3]  # the length's unit may be another
    found = optimise(other, start, curvature=False)
    share = np.median(np.exp(found.hyper[2]) * design.scale / ranges_um(design.tests))
    return found if share < LARGE_MISFIT else replace(found, log_evidence=-np.inf, log_joint=-np.inf)


def with_likely_noise(base: Base) -> tuple[Base, Optimum]:
    """The base law at its mode, under the kind of noise that the tests prefer: the model's own unless clearly not.

    A search under noise that the tests are not of fits formulas to what the noise leaves.
    """
    design = design_of(base, base.state)
    own = optimise(design, base.hyperparameters, curvature=False)
    others = [(*with_own_scales(design, own.hyper, model), model) for model in noise_models(base)]
    best, scale, model = max(others, key=lambda one: one[0].log_joint)
    if best.log_joint > own.log_joint + STRONG:
        return replace(base, model=model, scale=scale), best
    return base, own


def with_own_scales(design: Design, hyper: np.ndarray, model: Model) -> tuple[Optimum, np.ndarray]:
    """As `with_other_noise`, with the particles' own factors that belong to this kind of noise, and these factors.

    Under noise of another kind what wanders for long makes some particles look noisier than others.
    """
    alike = with_noise(replace(design, scale=np.ones(len(design.scale))), model)
    found = with_other_noise(alike, hyper, model)
    white, _ = whitened(found.hyper, alike, residual_of(LinearModel(found.hyper, alike).solve(), alike))
    mask = np.asarray(design.tests.mask)
    scale = particle_scales(alike.scale, np.sum(np.where(mask, white, 0.0) ** 2, 1), mask.sum(1) - 4)
    if np.any(scale != 1.0):
        found = with_other_noise(replace(design, scale=scale), found.hyper, model)
    return found, scale


def noise_models(base: Base) -> tuple[Model, ...]:
    """The model with other kinds of noise: rough or smooth, along the load or in time.

    The prior of its length keeps its share of a test.
    """
    tests, model = base.tests, base.model
    mask, prior = np.asarray(tests.mask), model.chosen_priors

    def length(along: Along) -> float:
        x = tests.path if along is Along.LOAD else tests.record.time
        return max(float(np.median(np.where(mask, x, -np.inf).max(1) - np.where(mask, x, np.inf).min(1))), 1e-9)

    models = []
    rough, smooth = Correlation.EXPONENTIAL, Correlation.MATERN_32
    for correlation, along in product((rough, smooth), (Along.LOAD, Along.TIME)):
        if (correlation, along) != (model.correlation, model.along):
            median = prior.noise_length.median * length(along) / length(model.along)
            priors = replace(prior, noise_length=replace(prior.noise_length, median=median))
            models.append(replace(model, correlation=correlation, along=along, priors=priors))
    return tuple(models)
