"""Many campaigns in a queue: the results of one by one, in order, errors in place, compilations shared."""

import numpy as np
import pytest
from joint_cases import COEFFICIENTS, DIAMETERS, NOISE, Programme, simulated

from mcc_jax import InputError, calibrate_bayes, calibrate_least_squares, calibrate_many
from mcc_jax.calibrate.joint._data import enlarged, select_tests
from mcc_jax.calibrate.joint._individual import _fit
from mcc_jax.calibrate.joint._many import _groups
from mcc_jax.calibrate.joint._sampling import sample_population

SETTINGS = {"chains": 2, "warmup": 150, "draws": 100, "seed": 3}
SHORT, LONG = Programme.cycles(points=50), Programme.cycles(points=70)


@pytest.fixture(scope="module")
def campaigns():
    """Four of different lengths and sizes, one of which nothing can be made of."""
    return [
        simulated(instrument=NOISE, programme=SHORT),
        simulated(COEFFICIENTS[:3], DIAMETERS[:3], instrument=NOISE, programme=LONG, seed=1),
        simulated(instrument=NOISE, programme=SHORT, peak_MPa=0.1),
        simulated(instrument=NOISE, programme=SHORT, seed=2),
    ]


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def queued(campaigns, told):
    before = sample_population._cached._cache_size(), _fit._cached._cache_size()
    found = calibrate_many(campaigns, progress=lambda i, step: told.append((i, step)), **SETTINGS)
    after = sample_population._cached._cache_size(), _fit._cached._cache_size()
    return found, np.subtract(after, before)


def test_results_come_in_order_and_errors_in_place(queued, campaigns):
    found, _ = queued
    assert isinstance(found[2], InputError)
    assert "no particle can be used" in str(found[2])
    for i in (0, 1, 3):
        assert found[i].campaign is campaigns[i]
        assert found[i].C.shape == (2, 100, len(campaigns[i]), 3)
        assert found[i].fit.latent.shape == (len(campaigns[i]), 4)


def test_progress_names_the_campaign(queued, told):
    for i, last in enumerate(["done", "done", "failed", "done"]):
        assert [step for row, step in told if row == i][-1] == last
    assert (0, "sampling the population") in told


def test_campaigns_of_similar_size_share_their_compilations(queued):
    _, compiled = queued
    # The particles are fitted from three starts each time: one shape.
    assert compiled[0] == 1
    assert compiled[1] == 1


@pytest.mark.parametrize("i", [0, 1, 3])
def test_the_numbers_are_those_of_one_by_one(queued, campaigns, i):
    one, many = calibrate_bayes(campaigns[i], **SETTINGS), queued[0][i]
    for name, draws in one.named_population().items():
        np.testing.assert_allclose(many.named_population()[name], draws, rtol=1e-7, atol=1e-9, err_msg=name)
    for name in ("C", "modulus_MPa", "zero_um", "shape_factor", "log_likelihood", "pareto_k"):
        np.testing.assert_allclose(getattr(many, name), getattr(one, name), rtol=1e-6, atol=1e-7, err_msg=name)
    assert many.warnings() == one.warnings()


def test_least_squares_with_two_workers(campaigns):
    found = calibrate_many(campaigns, method="least-squares", workers=2)
    assert isinstance(found[2], InputError)
    for i in (0, 1, 3):
        one = calibrate_least_squares(campaigns[i])
        for many, alone in zip(found[i].solution.value, one.solution.value, strict=True):
            np.testing.assert_allclose(many, alone, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(float(found[i].solution.loss), float(one.solution.loss), rtol=1e-9)


def test_what_is_filled_up_counts_for_nothing(campaigns):
    tests = select_tests(campaigns[1]).tests
    count, points = tests.force.shape
    more = enlarged(tests, count + 2, points + 5)
    assert more.force.shape == (count + 2, points + 5)
    np.testing.assert_array_equal(more.weight, [1.0] * count + [0.0] * 2)
    assert not np.asarray(more.mask)[:, points:].any()
    np.testing.assert_array_equal(more.step[:, points:], 0.0)
    np.testing.assert_array_equal(more.force[:count, :points], tests.force)
    assert enlarged(tests, 0, points) is tests
    np.testing.assert_array_equal(enlarged(tests, count).weight, np.ones(count))


def test_groups_have_similar_sizes():
    sizes = {0: (20, 192), 1: (5, 192), 2: (14, 256), 3: (20, 640), 4: (4, 128)}
    assert _groups(sizes, particles=True) == [((0, 640), [3]), ((20, 256), [0, 2]), ((5, 192), [1, 4])]
    assert _groups({0: (5, 128), 1: (4, 128), 2: (5, 192)}, particles=False) == [((0, 192), [2, 0]), ((0, 128), [1])]


def test_wrong_arguments_are_told(campaigns):
    with pytest.raises(ValueError, match="method"):
        calibrate_many(campaigns, method="guess")
    with pytest.raises(ValueError, match="worker"):
        calibrate_many(campaigns, workers=0)
    with pytest.raises(TypeError, match="speed"):
        calibrate_many(campaigns, speed=3)
    assert calibrate_many([]) == []
