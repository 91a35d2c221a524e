"""Lists of contacts: history follows the pair through new lists, other orders, more room, the disk."""

import sys
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packed import PRESSING, SKIN, dense, forces_of, motion, packing

from mcc_jax import InputError
from mcc_jax._archive import encode
from mcc_jax.dem import advance, carry_history, close_pairs, list_edges, load_state, rebuild_list, save_state

PARTICLES = 30


def with_history(edges, seed=0):
    """The list with numbers to remember in every used place."""
    rng, used = np.random.default_rng(seed), np.asarray(edges.active)
    overlap_max, slip = rng.uniform(1e-7, 1e-5, edges.capacity), rng.normal(0, 1e-7, (edges.capacity, 3))
    return replace(edges, overlap_max=jnp.asarray(overlap_max * used), slip=jnp.asarray(slip * used[:, None]))


def remembered(edges):
    """What each pair remembers, by pair."""
    return {
        (int(i), int(j)): (float(d), tuple(map(float, s)))
        for i, j, d, s, used in zip(edges.i, edges.j, edges.overlap_max, edges.slip, edges.active, strict=True)
        if used
    }


pairs_strategy = st.lists(
    st.tuples(st.integers(0, PARTICLES - 1), st.integers(0, PARTICLES - 1)).filter(lambda p: p[0] != p[1]), max_size=40
)


@pytest.mark.extended
@settings(max_examples=25, deadline=None)
@given(old=pairs_strategy, new=pairs_strategy, seed=st.integers(0, 3))
def test_history_follows_the_pair(old, new, seed):
    """T5: bitwise through a new list in any order, with repetitions, turned round; what was absent is virgin."""
    first = with_history(list_edges(np.array(old, int).reshape(-1, 2), PARTICLES, 48), seed)
    second = carry_history(first, list_edges(np.array(new, int).reshape(-1, 2), PARTICLES, 64))
    before, after = remembered(first), remembered(second)
    assert set(after) == {(min(p), max(p)) for p in new}
    for pair, value in after.items():
        assert value == before.get(pair, (0.0, (0.0, 0.0, 0.0)))
    assert np.all(np.diff(second.key) >= 0)
    assert not second.overlap_max[~np.asarray(second.active)].any()


def test_overflow_is_reported():
    with pytest.raises(InputError, match="3 pairs do not fit into a list of 2 edges"):
        list_edges(np.array([[0, 1], [1, 2], [3, 2]]), 4, 2)
    with pytest.raises(InputError, match="pairs do not fit into a list of 10 edges"):
        rebuild_list(packing(), dense(), SKIN, capacity=10)


def test_bad_pairs_are_named():
    for pair in ([0, 0], [0, 4], [-1, 2]):
        with pytest.raises(InputError, match="pair 1 joins"):
            list_edges(np.array([[0, 1], pair]), 4, 8)


def test_keys_hold_many_particles():
    """N^2 of a million particles does not fit 32 bits."""
    edges = list_edges(np.array([[999_998, 999_999], [0, 999_999]]), 1_000_000, 2)
    assert edges.key.tolist() == [999_999, 999_998 * 1_000_000 + 999_999]
    assert (edges.i.tolist(), edges.j.tolist()) == ([0, 999_998], [999_999, 999_999])


@pytest.mark.parametrize("search", ["scipy", "vesin"])
def test_neighbours_equal_all_pairs(search, monkeypatch):
    if search == "vesin":
        pytest.importorskip("vesin")
    else:
        monkeypatch.setitem(sys.modules, "vesin", None)
    rng = np.random.default_rng(2)
    position, radius = rng.uniform(0, 1e-3, (200, 3)), rng.uniform(2e-5, 8e-5, 200)
    gap = np.linalg.norm(position[:, None] - position[None], axis=2) - radius[:, None] - radius[None]
    expected = {(i, j) for i, j in zip(*np.nonzero(gap < 1e-5), strict=True) if i < j}
    found = close_pairs(position, radius, 1e-5)
    assert {(min(p), max(p)) for p in found.tolist()} == expected
    assert len(found) == len(expected)


def test_neighbours_of_few_and_of_nowhere():
    assert close_pairs(np.zeros((1, 3)), np.ones(1), 0.1).shape == (0, 2)
    with pytest.raises(InputError, match="particle 1 is not finite"):
        close_pairs(np.array([[0.0, 0, 0], [np.nan, 0, 0]]), np.ones(2), 0.1)


def unloading():
    """A packing pressed and then let go a little, so that most contacts are on their elastic branch."""
    state, _ = advance(packing(), motion(), dense(), PRESSING, 1, 60, SKIN)
    return advance(packing(), motion(), state, -PRESSING, 1, 30, SKIN)[0]


@pytest.mark.extended
def test_a_new_list_in_the_middle_of_unloading_changes_nothing():
    """T5: rebuilt, permuted and with more room; history bitwise, forces of edges and sums over particles."""
    state = unloading()
    pairs = close_pairs(np.asarray(state.position), np.asarray(packing().radius), SKIN)
    shuffled = np.random.default_rng(0).permutation(pairs)[:, ::-1]
    other = carry_history(state.edges, list_edges(shuffled, len(state.position), 2 * state.edges.capacity))
    kept = {p: v for p, v in remembered(state.edges).items() if p in remembered(other)}
    assert kept
    assert {p: remembered(other)[p] for p in kept} == kept
    forces, edges, _ = forces_of(packing(), motion(), state)
    again, edges_again, _ = forces_of(packing(), motion(), state, other)
    size = np.max(np.abs(forces.force))
    assert np.max(np.abs(again.force - forces.force)) <= 1e-13 * size
    np.testing.assert_allclose(again.on_wall, forces.on_wall, atol=1e-13 * np.max(np.abs(forces.on_wall)))
    both = set(remembered(edges)) & set(remembered(edges_again))
    assert all(remembered(edges)[p][0] == remembered(edges_again)[p][0] for p in both)


@pytest.mark.extended
def test_resumed_run_is_bitwise_the_same(tmp_path):
    state = dense()
    half, _ = advance(packing(), motion(), state, PRESSING, 2, 40, SKIN)
    save_state(tmp_path / "half.mcc", packing(), half)
    whole, rows = advance(packing(), motion(), half, PRESSING, 2, 40, SKIN)
    again_packing, again = load_state(tmp_path / "half.mcc")
    assert eqx.tree_equal((again_packing, again), (packing(), half))
    resumed, rows_again = advance(again_packing, motion(), again, PRESSING, 2, 40, SKIN)
    assert eqx.tree_equal(resumed, whole)
    assert np.array_equal(rows.on_wall, rows_again.on_wall)
    assert list(tmp_path.iterdir()) == [tmp_path / "half.mcc"]


@pytest.mark.parametrize("content", [None, b"", b"not a state", encode("another result")])
def test_missing_and_damaged_states_are_refused(tmp_path, content):
    file = tmp_path / "state.mcc"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=r"state\.mcc"):
        load_state(file)
