"""Every public object says in at most 20 lines what a person wants to know of it."""

import dataclasses
import enum
import importlib
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcc_jax as mcc
from mcc_jax import dem, discovery, effects, export
from mcc_jax._format import described, in_words

PARTS = ("law", "campaign", "effects", "simulate", "calibrate", "discovery", "dem", "export", "plots", "report")
MOST_LINES, WIDEST = 20, 240
ABSTRACT = ("AbstractContactLaw", "AbstractEffect", "AbstractModulusAtPeak", "Calibration")
# What a person does not want to see: whole arrays, types in place of values, addresses.
GREY = re.compile(r"\barray\(|\b(?:weak_)?[fiu](?:32|64)\[|\bbool\[|object at 0x|<[A-Za-z_.]+>|mappingproxy|nan\b")


def classes():
    """Every public class."""
    found = set()
    for module in (mcc, *(importlib.import_module(f"mcc_jax.{part}") for part in PARTS)):
        things = (getattr(module, name) for name in dir(module) if name[0] != "_")
        found |= {one for one in things if inspect.isclass(one) and str(one.__module__).startswith("mcc_jax")}
    return found


def check(thing):
    text = repr(thing)
    assert 1 <= len(text.splitlines()) <= MOST_LINES, text
    assert max(map(len, text.splitlines())) <= WIDEST, text
    assert not GREY.search(text), text


def test_every_public_class_has_a_repr_of_its_own():
    """Not the one that prints arrays in full, nor the one that prints types in place of values."""
    scalars = {"float", "int", "str", "bool", "float | None", "int | None", "tuple[float, float]", "Kind"}
    for thing in classes():
        if thing.__name__ in ABSTRACT or issubclass(thing, enum.Enum | Exception) or thing is mcc.simulate.RESULTS:
            continue
        own = str(getattr(thing.__repr__, "__module__", "")).startswith("mcc_jax")
        plain = {f.type for f in dataclasses.fields(thing)} if dataclasses.is_dataclass(thing) else {None}
        assert (own and "dataclass" not in thing.__repr__.__qualname__) or plain <= scalars, thing


@pytest.fixture(scope="module")
def some():
    """Objects of each kind that cost little to make."""
    law, particle = mcc.paper_law(), mcc.Particle(213.54, 196.07, 186.33)
    path = jnp.concatenate([jnp.linspace(0, 100, 50), jnp.linspace(100, 95, 50)])
    response = mcc.drive(law, particle, path)
    tests = mcc.paper_campaign(0, programme=mcc.Programme.cycles(points=60))
    side = dem.half_contact(law, particle)
    return {
        "law": law,
        "law with effects": law.with_effects("creep:logarithmic", "frame_compliance"),
        "batch": jax.vmap(mcc.Particle)(*jnp.full((3, 5), 100.0)),
        "response": response,
        "energy": law.energy(particle, response.state, path[-1]),
        "library": mcc.LIBRARY,
        **{f"mechanism {name}": mechanism for name, mechanism in mcc.LIBRARY.items()},
        **{v.label: v for mechanism in mcc.LIBRARY.values() for v in mechanism},
        "hidden": mcc.HiddenEffect(effects.find_variant("pop_in")),
        "programme": mcc.Programme.cycles(levels=(0.3, 0.6, 1.0), unload_to=0.3, hold_s=20.0),
        "instrument": mcc.Instrument(displacement_noise_um=0.02),
        "campaign": tests,
        "curve": tests.curves[0],
        "adjustment": mcc.adjust(tests),
        "tests": mcc.calibrate.select_tests(tests),
        "record": effects.clean_record(jnp.linspace(0, 10, 20), jnp.linspace(0, 10, 20)),
        "model": mcc.Model().with_effects("creep", "frame_compliance"),
        "priors": mcc.Priors(),
        "decisions": discovery.DECISIONS,
        "packing": dem.spheres(law, np.array([100.0, 120.0]), density=1540.0),
        "walls": dem.die(1e-3, 2e-3)[-1],
        "motion": dem.Motion.of(time_step=1e-8, drag=0.0),
        "pair": dem.pair_energy(side, side, jnp.asarray(2e-5), jnp.asarray(2e-5)),
        "artefact": export.jax_artefact(law, particle),
    }


def test_what_is_made_in_a_moment_takes_a_few_lines(some):
    for thing in some.values():
        check(thing)


@pytest.mark.extended
def test_calibrations_and_what_they_return_take_a_few_lines(paper_posterior):
    posterior = paper_posterior
    curves = mcc.predict_new_particle(posterior, (200.0, 190.0, 160.0), force_mN=posterior.campaign.curves[0].force_mN)
    squares = mcc.least_squares(posterior.campaign)
    paper = mcc.calibrate_paper(posterior.campaign)
    parts = [posterior.fit, squares.identifiability, paper.shape, paper.plastic, paper.elastic, paper.adjustment]
    parts += [mcc.calibrate.sample_laws(posterior, count=3), *posterior.curves[:1]]
    for thing in (posterior, squares, paper, curves, *parts):
        check(thing)


def test_a_law_shows_values_with_units(some):
    text = str(some["law with effects"])
    assert "effective modulus  16000 MPa" in text
    assert "creep:logarithmic: creep_compliance_per_MPa 0.0002 1/MPa, tau_s 10" in text
    assert "frame_compliance:linear: compliance_um_per_mN 0.001414 um/mN" in text
    assert "7685 nJ" in repr(some["energy"])
    assert "0 to 268.3 mN" in repr(some["response"])
    assert "successful" in repr(some["response"])


def test_what_jax_traces_is_printed_too():
    printed = []
    jax.jit(lambda law: printed.append(repr(law)) or law.a)(mcc.paper_law())
    jax.jit(lambda energy: printed.append(repr(energy)) or energy.work)(mcc.law.Energy(*jnp.ones(3)))
    assert all(len(text.splitlines()) <= MOST_LINES for text in printed)


IN_WORDS = [
    (None, "None"), (True, "True"), (3, "3 um"), (0.00001, "1 × 10⁻⁵ um"), ("", "none"),
    ("a" * 200, "a" * 67 + "..."), (b"abc", "3 bytes"), (np.array([]), "no values"),
    (np.array([1.0, 2.0]), "[1, 2] um"), (np.full((2, 5), np.nan), "2 × 5 values, none finite"),
    (np.arange(6.0), "6 values, 0 to 5 um"), (np.array([True, False, True]), "2 of 3 true"),
    (np.array(["a", "b"]), "2 of <U1"), ((), "none"), ((None, None), "None, None"),
    (tuple(np.zeros(100)), "100 of float64"), ({"a": 1}, "a 1"), (mcc.Unloading.PUNCH, "punch"), (len, "len"),
]  # fmt: skip


@pytest.mark.parametrize(("value", "text"), IN_WORDS)
def test_values_in_words(value, text):
    assert in_words(value, "um") == text


def test_a_small_object_is_one_line_and_a_large_one_a_table():
    @dataclasses.dataclass(frozen=True)
    class Some:
        first: float
        second: str
        third: str = ""
        __repr__ = described(first="mN")

    assert repr(Some(1.5, "b")) == "Some(first=1.5 mN, second=b, third=none)"
    large = ["Some", "  first   1.5 mN", f"  second  {'b' * 67}...", f"  third   {'c' * 40}"]
    assert repr(Some(1.5, "b" * 90, "c" * 40)).splitlines() == large
