"""Neighbour lists and force models of other codes give the contacts of this one."""

import abc
import dataclasses
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import InputError, paper_law
from mcc_jax.dem import close_pairs, list_edges, pair_force, spheres
from mcc_jax.dem.adapters import edges_from_jaxmd, jaxdem_force_model

pytestmark = pytest.mark.extended

COUNT = 30


def listed(format_name, index, overflow=False):
    """What the adapter reads of jax-md's list; a test below takes the list of jax-md itself."""
    return types.SimpleNamespace(
        idx=jnp.asarray(index),
        reference_position=jnp.zeros((COUNT, 3)),
        did_buffer_overflow=jnp.asarray(overflow),
        format=f"NeighborListFormat.{format_name}",
    )


def test_lists_of_jaxmd_become_edges():
    index = np.array([[8, 3, COUNT, 3, 5], [2, 9, COUNT, 9, COUNT - 1]])
    edges = edges_from_jaxmd(listed("Sparse", index))
    pairs = {(int(i), int(j)) for i, j in zip(edges.i[edges.active], edges.j[edges.active], strict=True)}
    assert pairs == {(2, 8), (3, 9), (5, COUNT - 1)}
    assert edges.capacity == 5
    assert edges.particles == COUNT
    assert edges_from_jaxmd(listed("OrderedSparse", index), capacity=9).capacity == 9


def test_lists_of_jaxmd_that_miss_pairs_are_refused():
    with pytest.raises(InputError, match="overflowed"):
        edges_from_jaxmd(listed("OrderedSparse", [[1], [2]], overflow=True))
    with pytest.raises(InputError, match=r"format NeighborListFormat\.Dense"):
        edges_from_jaxmd(listed("Dense", np.zeros((COUNT, 2), int)))


@pytest.mark.filterwarnings("ignore")  # jax-md's own
def test_jaxmd_finds_the_same_pairs():
    position, scale = np.random.default_rng(0).uniform(0, 4e-4, (COUNT, 3)), 1e-4
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # even to import it
        partition = pytest.importorskip("jax_md.partition")
        from jax_md import space

        find = partition.neighbor_list(
            space.free()[0], 1.0, 1.0, 0.2, disable_cell_list=True, format=partition.NeighborListFormat.OrderedSparse
        )
        neighbours = find.allocate(jnp.asarray(position / scale))
    edges = edges_from_jaxmd(neighbours)
    near = close_pairs(position, np.full(COUNT, 0.5 * scale), 0.2 * scale)
    expected = list_edges(near, COUNT, edges.capacity)
    assert len(near) > 20
    np.testing.assert_array_equal(edges.key, expected.key)


@pytest.fixture
def stand_in(monkeypatch):
    """JaxDEM's interface as its source shows it: what a force model inherits, and no more."""

    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(slots=True)
    class ForceModel(abc.ABC):
        laws: tuple = dataclasses.field(default=(), metadata={"static": True})

        @staticmethod
        @abc.abstractmethod
        def force(i, j, pos, state, system): ...

        @staticmethod
        @abc.abstractmethod
        def energy(i, j, pos, state, system): ...

    module = types.ModuleType("jaxdem")
    module.ForceModel = ForceModel
    monkeypatch.setitem(sys.modules, "jaxdem", module)


def test_the_force_model_is_the_pair_law_over_load_unload_reload(stand_in):
    """Called as JaxDEM's NeighborList does: one particle and its padded neighbours, history slot by slot."""
    packing = spheres(paper_law(), jnp.asarray([90.0, 110.0, 100.0]))
    model = jaxdem_force_model(packing.sides)
    assert model.requires_history
    assert len(jax.tree.leaves(model)) == len(jax.tree.leaves(packing.sides))
    system = types.SimpleNamespace(force_model=model, domain=types.SimpleNamespace(displacement=lambda a, b, _: a - b))
    neighbours = jnp.asarray([[1, 2, 0], [0, 0, 0], [0, 0, 0]])  # unused slots name particle 0, as in JaxDEM
    used = np.array([[True, True, False], [True, False, False], [True, False, False]])

    @jax.jit
    def forces(position, history):
        state = types.SimpleNamespace(rad=packing.radius, torque=jnp.zeros((3, 3)))

        def one(i, j, past):
            return model.force_and_history(i, j, position, state, system, past)

        return jax.vmap(one)(jnp.arange(3), neighbours, history)

    def overlaps(depth):
        # 1 and 2 touch 0 from two sides, the second half as deep.
        reach = packing.radius[0] + packing.radius[1:]
        x = jnp.asarray([[0.0, 0, 0], [1.0, 0, 0], [0, -1.0, 0]])
        return x.at[1].multiply(reach[0] - depth).at[2].multiply(reach[1] - 0.5 * depth)

    history = model.init_history((3, 3))
    peak, expected = np.zeros(2), []
    for depth in (2e-6, 6e-6, 5.9e-6, 5.5e-6, 8e-6, 7.9e-6, -1e-6):
        force, torque, history = forces(overlaps(depth), history)
        assert not torque.any()
        for k, own in enumerate((depth, 0.5 * depth)):
            i, j = (jax.tree.map(lambda x, n=n: x[n], packing.sides) for n in (0, k + 1))
            expected = pair_force(i, j, jnp.asarray(peak[k]), jnp.asarray(own))
            peak[k] = max(peak[k], own)
            size = np.linalg.norm(force[0, k])
            np.testing.assert_allclose(size, expected, rtol=1e-9, atol=1e-15)
            np.testing.assert_array_equal(force[0, k], -force[k + 1, 0])
    np.testing.assert_allclose(np.asarray(history)[used], np.repeat(peak, 2)[[0, 2, 1, 3]], rtol=1e-9)
    assert force[0, 0, 0] == 0


def test_the_force_model_refuses_to_forget(stand_in):
    model = jaxdem_force_model(spheres(paper_law(), jnp.asarray([90.0, 110.0])).sides)
    with pytest.raises(InputError, match="carries no history"):
        model.force(0, 1, jnp.zeros((2, 3)), None, None)


def test_without_jaxdem_one_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxdem", None)
    with pytest.raises(InputError, match="JaxDEM is not installed"):
        jaxdem_force_model(spheres(paper_law(), jnp.asarray([90.0])).sides)
