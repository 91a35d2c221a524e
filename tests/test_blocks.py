"""Many contacts in blocks are the same contacts as without them."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import InputError, in_blocks
from mcc_jax.geometry import Particle
from mcc_jax.law import History, MccLaw, Plastic


def contacts(count):
    rng = np.random.default_rng(3)
    draw = lambda low, high: jnp.asarray(rng.uniform(low, high, count))  # noqa: E731
    law = eqx.filter_vmap(lambda C1, a, E: MccLaw(Plastic(C1, 3.0, 2.66), a, E))(draw(5, 9), draw(1, 2), draw(1e4, 2e4))
    particle = eqx.filter_vmap(Particle)(draw(100, 200), draw(100, 200), draw(60, 100))
    return law, particle, eqx.filter_vmap(History)(draw(0, 40)), draw(-5, 60)


def step(law, particle, state, displacement):
    return law.step(particle, state, displacement)


def force(law, particle, state, displacement):
    return law.step(particle, state, displacement)[1]


def assert_same(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), one, other)


@pytest.mark.parametrize("count", [1, 7, 64, 101, 120])  # fewer than a block, even blocks, a rest, smaller even blocks
def test_values_are_those_of_vmap(count):
    arguments = contacts(count)
    assert_same(jax.jit(in_blocks(step, block=32))(*arguments), jax.vmap(step)(*arguments))


@pytest.mark.extended
def test_gradients_inside_outside_and_forward():
    arguments = contacts(101)
    each = jax.vmap(jax.grad(force))(*arguments)
    assert_same(jax.jit(in_blocks(jax.grad(force), block=16))(*arguments), each)
    whole = jax.jit(jax.grad(lambda law, *rest: jnp.sum(in_blocks(force, block=16)(law, *rest))))(*arguments)
    assert_same(whole, each)
    tangent = jax.tree.map(jnp.ones_like, arguments)
    assert_same(*(jax.jvp(f, arguments, tangent)[1] for f in (in_blocks(force, block=16), jax.vmap(force))))


def test_a_gradient_needs_little_memory():
    """Without blocks every value in between is an array over all contacts."""
    arguments = contacts(64 * 2048)

    def temporary(function):
        return jax.jit(function).lower(*arguments).compile().memory_analysis().temp_size_in_bytes

    rest = jax.grad(force, (1, 2, 3))
    assert temporary(in_blocks(rest)) < 0.1 * temporary(jax.vmap(rest))


@pytest.mark.parametrize("other", [jnp.ones(4), jnp.asarray(1.0)])
def test_what_is_not_one_batch_is_refused(other):
    with pytest.raises(InputError, match="lengths"):
        in_blocks(lambda x, y: x + y)(jnp.ones(3), other)
    with pytest.raises(InputError, match=">= 1"):
        in_blocks(lambda x: x, block=0)


@pytest.mark.extended
def test_over_devices_the_same():
    program = (
        "import jax, jax.numpy as jnp, numpy as np, pytest; jax.config.update('jax_num_cpu_devices', 4)\n"
        "from mcc_jax import in_blocks, InputError\n"
        "x = jnp.linspace(0, 3, 404)\n"
        "f = lambda v: jnp.sin(v) / (1 + v)\n"
        "each = in_blocks(f, block=10, devices=tuple(jax.devices()))\n"
        "found = jax.jit(each)(x)\n"
        "assert len(found.sharding.device_set) == 4\n"
        "np.testing.assert_allclose(found, f(x), rtol=1e-6)\n"
        "with pytest.raises(InputError, match='403 contacts'): each(x[:-1])\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
