import operator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import MccLaw, Particle, Plastic, drive, paper_law
from mcc_jax.simulate import RESULTS, paper_population, simulate_batch

PARTICLE = Particle(213.54, 196.07, 186.33)
NAN = float("nan")
BAD = [("C1", 0.0), ("C5", -2.0), ("C3", -1.0), ("C1", NAN), ("C3", NAN), ("C5", NAN), ("E", -1.0)]


def test_displacement_and_load_control_trace_the_same_curve():
    law = paper_law()
    path = jnp.concatenate([jnp.linspace(0, 100, 40), jnp.linspace(100, 97, 20), jnp.linspace(97, 115, 30)])
    by_displacement = drive(law, PARTICLE, path)
    by_load = drive(law, PARTICLE, by_displacement.force, control="load")
    np.testing.assert_allclose(by_load.displacement, path, rtol=1e-12)
    assert by_displacement.result == RESULTS.successful
    assert bool(by_displacement.monotone)


def test_a_path_can_be_continued_from_its_state():
    law = paper_law()
    path = jnp.concatenate([jnp.linspace(0, 80, 30), jnp.linspace(80, 77, 20), jnp.linspace(77, 100, 30)])
    whole = drive(law, PARTICLE, path)
    first = drive(law, PARTICLE, path[:45])
    second = drive(law, PARTICLE, path[45:], state=first.state)
    np.testing.assert_array_equal(jnp.concatenate([first.force, second.force]), whole.force)


@pytest.mark.parametrize("control", ["displacement", "load"])
def test_numbers_that_are_not_finite_are_explained(control):
    path = jnp.array([0.0, 20.0, jnp.nan, 30.0])
    assert drive(paper_law(), PARTICLE, path, control=control, throw=False).result == RESULTS.nonfinite_response
    with pytest.raises(eqx.EquinoxRuntimeError, match=r"entry of the path.*law's own parameters.*throw=False"):
        drive(paper_law(), PARTICLE, path, control=control)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        *(({name: bad}, "C1, C5 and the effective modulus must be positive") for name, bad in BAD),
        ({"a": -3.0}, "carries no stress"),
    ],
)
def test_a_parameter_out_of_range_is_explained(changed, why):
    numbers = {"C1": 7.0, "C3": 3.0, "C5": 2.6, "a": 1.43, "E": 16e3} | changed
    C1, C3, C5, a, E = (jnp.asarray(value) for value in numbers.values())
    with pytest.raises(eqx.EquinoxRuntimeError, match=why):
        drive(MccLaw(Plastic(C1, C3, C5), a, E), Particle(200.0, 200.0, 80.0), jnp.linspace(0, 5, 5))


def test_a_law_that_is_not_monotone_is_flagged_and_snaps_through():
    law = MccLaw(Plastic(4.0, 3.0, 2.4), 0.0, 16e3)
    sphere = Particle(100.0, 100.0, 100.0)
    peak_force = float(sphere.force(jnp.asarray(0.664820461376)))
    response = drive(law, sphere, jnp.linspace(0, 1.5 * peak_force, 400), control="load")
    assert not bool(response.monotone)
    strain = np.asarray(response.displacement) / 100
    assert np.all(np.diff(strain) >= 0)
    jump = np.argmax(np.diff(strain))
    # From the peak (0.29047) over the trough (0.34508) to where the rising branch regains the load: nothing in between.
    assert strain[jump] < 0.290470885402 < 0.345075622969 < strain[jump + 1]


def test_batch_is_the_loop():
    plastic = paper_population().sample(jax.random.key(3), 4)
    laws = eqx.filter_vmap(lambda p: MccLaw(p, 1.43, 16e3))(plastic)
    sizes = jnp.array([[200.0, 180, 150], [100, 120, 90], [150, 150, 150], [90, 80, 60]])
    particles = eqx.filter_vmap(Particle)(*sizes.T)
    paths = jnp.stack(
        [jnp.concatenate([jnp.linspace(0, s, 30), jnp.linspace(s, 0.9 * s, 20)]) for s in (60.0, 40, 70, 25)]
    )
    together = simulate_batch(laws, particles, paths)
    for i in range(4):
        law, particle = jax.tree.map(operator.itemgetter(i), (laws, particles))
        one = drive(law, particle, paths[i])
        np.testing.assert_allclose(together.force[i], one.force, rtol=1e-13, atol=1e-12)


def test_new_numbers_do_not_recompile():
    traces = []

    @jax.jit
    def force(law, particle, path):
        traces.append(1)
        return drive(law, particle, path, throw=False).force

    for modulus in (8e3, 16e3, 32e3):
        force(MccLaw(paper_population().mean_law, 1.43, modulus), PARTICLE, jnp.linspace(0, modulus / 400, 7))
    assert len(traces) == 1
