"""The curve and the formula of a gap that no listed mechanism explains, on tests that are made up without the law."""

import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax.calibrate.data import select
from mcc_jax.calibrate.forward import Linear, Point
from mcc_jax.calibrate.noise import Along, Correlation
from mcc_jax.calibrate.priors import NakagamiPrior
from mcc_jax.campaign import Campaign, Curve, check_tests
from mcc_jax.discovery.base import Base, State
from mcc_jax.discovery.closure import closure
from mcc_jax.discovery.design import Design
from mcc_jax.discovery.evidence import Optimum
from mcc_jax.discovery.fit import Fitted
from mcc_jax.discovery.hypothesis import Discrepancy, Hypothesis
from mcc_jax.discovery.misfit import general, scaled
from mcc_jax.discovery.screen import Candidate, Candidates, Screen
from mcc_jax.discovery.search import Search
from mcc_jax.discovery.settings import UNLISTED
from mcc_jax.effects import find_variant

NOISE_UM = 0.05


def made_up():
    """Six particles that are loaded and unloaded, each to a force of its own."""
    share = np.append(np.linspace(0.01, 1, 40), np.linspace(0.98, 0.05, 20))
    strain = 0.1 * (share + np.maximum.accumulate(share)) / 2
    diameters, peaks = np.linspace(100, 200, 6), (90, 60, 150, 80, 120, 70)
    curves = (Curve(np.arange(60.0), p * share, d * strain) for p, d in zip(peaks, diameters, strict=True))
    campaign = Campaign(tuple("abcdef"), diameters[:, None] * np.ones(3), tuple(curves))
    return select(check_tests(campaign), threshold_MPa=0.0).tests


def search_with(added):
    """A search that found what no mechanism explains: a displacement over diameter that is `added` to the tests."""
    tests = made_up()
    mask, force, path = (np.asarray(x) for x in (tests.mask, tests.force, tests.displacement))
    size, time = np.asarray(tests.effective_diameter)[:, None], np.asarray(tests.record.time)
    top, nothing = np.where(mask, force, 0.0).max(1, keepdims=True), np.zeros(mask.shape)
    down = np.where(np.asarray(tests.loading), 0.0, 1.0)
    natural = {"load": force / top, "force": force, "travel": path / size, "drive": path, "clock": time, "since": time}
    natural |= {"peak_force": top + nothing, "unloading": down, "reloading": nothing}
    natural |= {
        "strain": np.maximum.accumulate(path, 1) / size,
        "peak": np.sqrt(np.maximum.accumulate(force, 1)) / size,
    }
    at, zero = scaled(natural, mask), jnp.zeros(mask.shape)
    linear = Linear(zero, jnp.zeros((*mask.shape, 0)), zero, zero, zero)
    parts = general(at, tests, linear)
    truth = np.where(mask, size * added(natural["load"]), 0.0)
    ones = np.where(mask, 1.0, 0.0)[..., None]
    own = ones * np.append(np.zeros(4), 5.0)  # of the law's own numbers only the displacement offset
    design = Design(
        tests, linear, own, np.concatenate([0 * own, *parts], -1), np.zeros((*mask.shape, 0)),
        truth + NOISE_UM * np.where(mask, np.random.default_rng(0).standard_normal(mask.shape), 0.0),
        np.ones(6), np.array([0] * 5 + [k for k, part in enumerate(parts, 1) for _ in range(part.shape[-1])]),
        np.zeros((2, 4)), np.zeros(0), np.zeros(0), np.zeros((len(parts), 3)), (NakagamiPrior(1.0),) * 4,
        Correlation.MATERN_32, Along.LOAD,
    )  # fmt: skip
    hyper = np.concatenate([np.log([NOISE_UM, 1e-3, 1e-3, 0.2]), np.ones(4), np.full(len(parts), np.log(NOISE_UM))])
    state = State(Point(jnp.zeros((6, 4)), jnp.zeros(6), jnp.zeros((6, 0))), jnp.zeros(5))
    search, base = Search.__new__(Search), Base.__new__(Base)
    vars(base).update(tests=tests)
    creep = Candidates((Candidate(find_variant("creep:logarithmic"), {}),), truth[..., None])
    vars(search).update(
        base=base, natural=natural, at=at, discrepancy=Discrepancy(parts, np.log(NOISE_UM)),
        screen=Screen(creep, *(np.zeros(0),) * 3),
        found={UNLISTED: Hypothesis(UNLISTED, at=Fitted((), state, design, Optimum(hyper, 0.0, 0.0)))},
    )  # fmt: skip
    return search, truth


def test_an_unlisted_effect_gets_a_curve_and_a_formula():
    search, truth = search_with(lambda load: 0.004 * load**2)
    found = closure(search, seed=0)
    assert found.formula == "added displacement / D_e = +0.004 u^2; u = F / F_peak"
    assert (found.coordinate, found.selection_frequency) == ("load", 1.0)
    assert found.span["load"] == pytest.approx((0.01, 1.0), abs=0.05)
    # It is known up to a constant, which the displacement offset takes up; held out by the weights of the others.
    mask = np.asarray(search.base.tests.mask)
    for curve in (found.correction_um, found.held_out_um):
        assert np.median([np.std((curve - truth)[i, mask[i]]) for i in range(6)]) < NOISE_UM
    assert np.std(found.added - 0.004 * found.x**2) < 4e-4
    assert np.all(found.sd < 1e-3)
    assert found.resembles[0] == ("creep", pytest.approx(1.0, abs=0.02))
