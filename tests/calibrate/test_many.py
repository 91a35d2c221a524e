"""Many campaigns in a queue: the results of one by one, in order, errors in place, compilations shared."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from joint_cases import COEFFICIENTS, DIAMETERS, NOISE, Programme, simulated

from mcc_jax import InputError, calibrate_many, least_squares, sample
from mcc_jax.calibrate import running
from mcc_jax.calibrate.data import LENGTHS, padded_length

SETTINGS = {"chains": 2, "warmup": 150, "draws": 100, "seed": 3}
SHORT, LONG = Programme.cycles(points=70), Programme.cycles(points=110)


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
def queued(campaigns):
    """What was found and reported, and our functions that were compiled for the first campaign and for all others."""
    modules = [module for name, module in sys.modules.items() if name.startswith("mcc_jax")]
    ours = {name for module in modules for name, value in vars(module).items() if callable(value)}
    told, first, further = [], [], []

    def listen(event, _, fun_name="", **__):
        name = fun_name.removeprefix("jit(").removesuffix(")")
        if "backend_compile" in event and name in ours:
            (further if (0, "done") in told else first).append(name)

    jax.clear_caches()  # of other tests
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        found = calibrate_many(campaigns, progress=lambda i, step: told.append((i, step)), **SETTINGS)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    return found, told, first, further


@pytest.mark.extended
def test_campaigns_of_similar_size_share_their_compilations(queued):
    *_, first, further = queued
    assert len(first) > 5
    assert further == []


@pytest.mark.extended
def test_the_numbers_are_those_of_one_by_one_in_order_and_errors_are_in_place(queued, campaigns):
    found, told, *_ = queued
    assert isinstance(found[2], InputError)
    assert "no particle can be used" in str(found[2])
    assert {(0, "done"), (1, "done"), (2, "failed"), (3, "done")} <= set(told)
    for i in (0, 1, 3):
        one, many = sample(campaigns[i], **SETTINGS), found[i]
        for name, draws in one.named_population().items():
            np.testing.assert_array_equal(many.named_population()[name], draws, err_msg=name)
        for name in ("C", "modulus_MPa", "zero_um", "shape_factor", "log_likelihood", "pareto_k"):
            np.testing.assert_array_equal(getattr(many, name), getattr(one, name), err_msg=name)
        assert many.warnings() == one.warnings()


@pytest.mark.extended
def test_least_squares_in_a_queue_are_those_of_one_by_one(campaigns):
    (many,), one = calibrate_many(campaigns[:1], method="least-squares"), least_squares(campaigns[0])
    for found, wanted in zip(many.solution.value, one.solution.value, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_records_are_padded_to_few_lengths():
    assert [padded_length(n) for n in (1, 64, 65, 301, 448, 449)] == [64, 64, 128, 320, 448, 896]
    assert all(padded_length(n) == n for n in LENGTHS)


def test_wrong_arguments_are_told(campaigns):
    with pytest.raises(ValueError, match="method"):
        calibrate_many(campaigns, method="guess")
    with pytest.raises(TypeError, match="speed"):
        calibrate_many(campaigns, speed=3)
    assert calibrate_many([]) == []


@pytest.mark.skipif(not running.MAPS.exists(), reason="only Linux limits memory maps, and shows them")
@pytest.mark.parametrize(("limit", "times"), [("10\n", 2), (f"{10**9}\n", 1), ("", 1), ("many", 1), (None, 1)])
def test_compiled_functions_are_forgotten_near_a_known_limit_only(monkeypatch, tmp_path, limit, times):
    traced = []

    @jax.jit
    def function(x):
        traced.append(1)
        return x + 1

    function(jnp.zeros(3))
    file = tmp_path / "max_map_count"
    if limit is None:  # no maps are shown
        monkeypatch.setattr(running, "MAPS", file)
    else:
        file.write_text(limit)
        monkeypatch.setattr(running, "MAX_MAPS", file)
    running.make_room()
    assert function(jnp.ones(3)).tolist() == [2, 2, 2]
    assert len(traced) == times
