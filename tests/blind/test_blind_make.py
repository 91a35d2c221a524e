"""Campaigns of both generators: their law, their independence, strengths, noise and faults."""

import ast
import itertools
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.blind import make, noise, plan, world
from benchmarks.blind.plan import Case
from benchmarks.blind.settings import MECHANISMS, SETTINGS
from benchmarks.blind.strength import Projection, amplitude_for, signature
from mcc_jax import MccLaw, Particle, Plastic, drive
from mcc_jax.campaign import read_campaign

pytestmark = pytest.mark.extended

BENCH = Path(__file__).parents[2] / "benchmarks/blind"
GENERATORS = {"first": "generator", "second": "second"}


def null(generator, protocol="P1", particles=5, **more):
    return Case(**{"number": 3, "kind": "null", "effects": (), "noise": "clean", **more},
                generator=generator, protocol=protocol, particles=particles)  # fmt: skip


def single(generator, mechanism, formula, level, **more):
    return null(generator, **{"kind": "single", "effects": ((mechanism, formula, level),), **more})


def imports(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or node.names[0].name)


@pytest.mark.parametrize("name", GENERATORS.values())
def test_generators_share_no_code_with_each_other_or_the_library(name):
    allowed = {"..world", "..settings", "..plan"}
    for file in (BENCH / name).rglob("*.py"):
        depth = len(file.relative_to(BENCH / name).parts)
        for module in imports(file):
            assert module.split(".")[0] not in ("mcc_jax", "benchmarks", "jax"), file.name
            if module.startswith("." * (depth + 1)):
                assert file.name == "interface.py", file
                assert module in allowed


@pytest.mark.parametrize(
    ("generator", "mechanism", "formula"),
    [
        ("first", "damage", "exact"),
        ("first", "creep", "power"),
        ("second", "densification_stiffening", "DensificationSpriggs"),
        ("second", "creep", "CreepLogarithmic"),
    ],
)
def test_the_modulus_at_peaks_is_that_of_unloading_from_there(generator, mechanism, formula):
    """What a particle gives back on unloading from its peak goes with one over the root of the modulus there."""
    _, drawn, _ = make.drawn(single(generator, mechanism, formula, 20.0, particles=5), 5, 0)
    alone = drawn.truth["effective_modulus_MPa"]
    (hidden,) = drawn.hidden
    sized = [(hidden, 0.2 * hidden.start)]
    assert drawn.modulus_at_peaks([(hidden, 0.0)]) == pytest.approx(alone, rel=1e-12)
    found = drawn.modulus_at_peaks(sized) / alone
    if mechanism == "creep":
        assert found == 1.0
        return
    given_back = []
    for curve in (drawn.curves((), None), drawn.curves(sized, None)):
        tops = [s.start + int(np.argmax(drawn.force[s])) for s in drawn.slices]
        lows = [t + int(np.argmin(drawn.force[t : s.stop])) for t, s in zip(tops, drawn.slices, strict=True)]
        given_back.append(np.mean(np.log(curve[tops] - curve[lows])))
    assert np.log(found) == pytest.approx(2 * (given_back[0] - given_back[1]), rel=1e-6)


@pytest.mark.parametrize(("generator", "protocol"), list(itertools.product(GENERATORS, plan.PROTOCOLS)))
def test_generators_agree_with_the_law_without_effects(generator, protocol):
    """Against the library's own law, which neither knows."""
    _, drawn, _ = make.drawn(null(generator, protocol), 5, 0)
    C = np.exp(np.array([1.9027, 1.1015, 0.9784])[:, None] + drawn.deviation[:3])
    modulus = drawn.truth["effective_modulus_MPa"] * np.exp(drawn.deviation[3])
    for i, s in enumerate(drawn.slices):
        law = MccLaw(Plastic(*map(jnp.asarray, C[:, i])), drawn.truth["a"], jnp.asarray(modulus[i]))
        sizes = [jnp.asarray(drawn.columns[f"D{k}_um"][i]) for k in (1, 2, 3)]
        there = drive(law, Particle(*sizes), jnp.asarray(drawn.force[s]), control="load")
        assert np.asarray(there.displacement) == pytest.approx(drawn.base[s], rel=2e-4, abs=2e-3)


@pytest.mark.parametrize("generator", GENERATORS)
def test_every_formula_is_nil_at_zero_and_shows(generator):
    known = world.generators()[generator]
    forms = [(m, f) for m in MECHANISMS for f in known.formulas(m)] + [("unlisted", f) for f in known.unlisted()]
    for mechanism, formula in forms:
        protocol = known.protocols(mechanism, formula)[0]
        drawn = known.draw(np.random.default_rng(2), single(generator, mechanism, formula, 1.0, protocol=protocol))
        hidden = drawn.hidden[0]
        # The second's sliding disc keeps a friction of 1e-4 where its formula would divide by zero.
        assert drawn.curves([(hidden, 0.0)], None) == pytest.approx(drawn.base, abs=3e-3), formula
        assert np.abs(drawn.curves([(hidden, min(hidden.start, hidden.largest))], None) - drawn.base).max() > 1e-3
        assert (hidden.mechanism, hidden.formula) == (mechanism, formula)


@pytest.mark.parametrize(("generator", "formula"), [("first", "exact"), ("second", "FrameLinear")])
def test_strength_is_the_whitened_length_of_what_is_left(generator, formula):
    _, drawn, drawn_noise = make.drawn(single(generator, "frame_compliance", formula, 20.0), 5, 0)
    projection = Projection(drawn, drawn_noise)
    theta, found = amplitude_for(projection, drawn.hidden[0], 20.0)
    assert found.strength == pytest.approx(20.0, rel=SETTINGS.refitting.close)
    change = drawn.curves([(drawn.hidden[0], theta)], None) - drawn.base
    assert np.linalg.norm(projection.project(change)) == pytest.approx(20.0, rel=0.1)
    assert np.linalg.norm(signature(projection, drawn.hidden[0])) == pytest.approx(1.0)
    # A change that the base law can make is nothing.
    shift = world.Shift(np.full((3, drawn.count), 1e-4), np.full(drawn.count, 2e-4), 1e-4)
    own = drawn.curves((), shift) - drawn.base
    assert np.linalg.norm(projection.project(own)) < 0.02 * np.linalg.norm(projection.whiten(own))


@pytest.mark.parametrize("kind", ["clean", "rough", "smooth", "heavy", "scale"])
def test_noise_has_its_covariance(kind):
    """What is left of pure noise has as much chi2 as there are readings, and a few per mille less for the fit."""
    rng, drawn, drawn_noise = make.drawn(null("first", "P0", 10, noise=kind), 5, 0)
    projection = Projection(drawn, drawn_noise)
    on_displacement, on_force = noise.sample(rng, drawn_noise, drawn)
    left = projection.project(on_displacement - noise.slopes(drawn) * on_force)
    tolerance = (24 if kind == "heavy" else 6) * np.sqrt(2 * len(left))
    assert left @ left == pytest.approx(len(left), abs=tolerance)


@pytest.mark.parametrize("fault", ["force_zero", "clipping", "breakage"])
def test_faults(fault):
    case = null("second", "P0", 10, kind="fault", fault=fault)
    made, clean = make.make(case, 5), make.make(null("second", "P0", 10), 5)
    told, there, before = made.answer["fault"], made.readings, clean.readings
    assert told["kind"] == fault
    if fault == "force_zero":
        assert there.force - before.force == pytest.approx(told["offset_mN"])
    elif fault == "clipping":
        assert there.displacement.max() == told["limit_um"] < before.displacement.max()
    else:
        pairs = [(there.force[there.owner == i], before.force[before.owner == i]) for i in range(10)]
        assert {str(i + 1) for i, pair in enumerate(pairs) if not np.array_equal(*pair)} == set(told["particles"])


def test_a_made_case_is_written_and_read_by_the_library(tmp_path):
    case = single("first", "thermal_drift", "exact", 20.0)
    made = make.make(case, 5)
    make.write(made, tmp_path / "one")
    make.write(make.make(case, 5), tmp_path / "two")
    assert make.digest_of(tmp_path / "one") == make.digest_of(tmp_path / "two")
    campaign = read_campaign(tmp_path / "one")
    assert len(campaign.curves) == 5
    effect = made.answer["effects"][0]
    assert effect["lambda"] == pytest.approx(20.0, rel=0.02)
    assert effect["alike"][0]["mechanism"] != "thermal_drift"
    assert made.left_um.shape == made.effect_um.shape == made.readings.force.shape
    assert 0 < np.linalg.norm(made.left_um) < np.linalg.norm(made.effect_um)


def test_segments_of_a_path():
    force = np.array([1.0, 2.0, 3.0, 2.0, 1.0, 2.0, 3.0, 4.0, 4.0, 2.0])
    kinds = [world.LOADING] * 3 + [world.UNLOADING] * 2 + [world.RELOADING] * 2 + [world.LOADING, world.HOLD]
    assert world.segments(force).tolist() == [*kinds, world.UNLOADING]
