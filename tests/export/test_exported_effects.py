"""Effects in every export: C against the library, tables, card, JAX artefacts with memory, and what is refused."""

import itertools
import json
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import PAIR, PLATES, WALL, build_driver, head, run_driver
from test_c_header import history, random_laws, random_paths, scales
from test_recipes import run_recipe
from test_tables import assert_rebuilt

from mcc_jax import InputError, Particle, Unloading, drive, paper_law
from mcc_jax.dem import half_contact, pair_force, wall_force
from mcc_jax.effects import LIBRARY, AbstractEffect, AbstractModulusAtPeak
from mcc_jax.export import (
    c_header,
    card,
    curve_tables,
    golden_table,
    jax_artefact,
    lammps_recipe,
    write_export,
    yade_recipe,
)
from mcc_jax.law import StrainScaling

pytestmark = pytest.mark.extended

PARTICLE = Particle(213.54, 196.07, 186.33)
NAMED = {
    "damage": ("damage:exponential",),
    "late damage and size": ("damage:threshold", "size_effect:flow_and_modulus", "size_effect:strain_gradient"),
    "linear and stress": ("damage:linear", "densification_stiffening:heckel", "densification_stiffening:stress"),
    "shape": ("shape_second_order:in_plane_aspect", "shape_second_order", "densification_stiffening:relative_density"),
}
OPEN = [v for m in LIBRARY.values() for v in m if not v.build(v.typical).closed]


class Softer(AbstractModulusAtPeak):
    """A user's own: E / (1 + kappa eps_P sigma_P)."""

    def factor(self, strain, stress):
        return 1 / (1 + self.amplitude * jnp.maximum(strain, 0.0) ** 2 * jnp.sqrt(stress))


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(0, 0, 0, 0, 0, None))
def along(law, diameters, others, path, peak, kind):
    """The library's forces [N] and tangents [N/m] along a path [m]; a platen test is two halves against walls."""
    side, other = (half_contact(law, Particle(*d)) for d in (diameters, others))

    def force(x, peak):
        if kind == PAIR:
            return pair_force(side, other, peak, x)
        share = 0.5 if kind == PLATES else 1.0
        return wall_force(side, share * peak, share * x)

    return jax.vmap(jax.value_and_grad(force))(path, peak)


@pytest.mark.parametrize("names", [*NAMED.values(), Softer(0.4)], ids=[*NAMED, "own"])
@pytest.mark.parametrize("unloading", [Unloading.PRINTED, Unloading.PUNCH_EXACT])
def test_c_equals_the_library_over_random_paths(tmp_path, unloading, names):
    """Random coefficients, moduli and shapes under one header, platens, wall and unlike pairs, to twice the tests."""
    rng, count, steps = np.random.default_rng(5), 300, 24
    names = (names,) if isinstance(names, AbstractEffect) else names
    scaling = StrainScaling.CONTACT
    program = build_driver(tmp_path, c_header(paper_law(unloading, scaling).with_effects(*names)))
    laws, diameters = random_laws(rng, count, unloading, scaling, monotone=True)
    others = diameters * rng.uniform(0.3, 1.0, (count, 1))
    reach, recovered = (np.asarray(v) for v in scales(laws, jnp.asarray(diameters)))
    damaged = eqx.filter_vmap(lambda law: law.with_effects(*names))(laws)
    for kind, scale in ((PLATES, 2.0), (WALL, 1.0), (PAIR, 0.8)):
        paths = 1e-6 * scale * random_paths(rng, reach, 2 * recovered, steps)
        peaks = np.maximum(history(paths), paths)
        force, tangent = (np.asarray(v) for v in along(damaged, diameters, others, paths, peaks, kind))
        got = run_driver(program, head(kind, steps, laws, diameters, laws, others), paths)
        largest, stiffest = force.max(axis=1, keepdims=True), tangent.max(axis=1, keepdims=True)
        np.testing.assert_array_less(np.abs(got[0] - force) / largest, 1e-12)
        np.testing.assert_array_less(np.abs(got[1] - tangent) / stiffest, 1e-9)
    plain = run_driver(build_driver(tmp_path, c_header(paper_law(unloading, scaling))),
                       head(PAIR, steps, laws, diameters, laws, others), paths)  # fmt: skip
    assert (np.abs(plain[0] - got[0]).max(axis=1) / largest[:, 0] > 1e-3).mean() > 0.5  # they do something


@pytest.mark.parametrize("recipe", [lammps_recipe, yade_recipe])
def test_recipes_give_the_headers_forces(tmp_path, recipe):
    law = paper_law().with_effects("damage", "size_effect")
    host = "lammps" if recipe is lammps_recipe else "yade"
    text, header = recipe(law, PARTICLE), c_header(law)
    force, want, *_ = run_recipe(tmp_path, text, header, host).T
    np.testing.assert_array_equal(force, want)
    plain = run_recipe(tmp_path, recipe(paper_law(), PARTICLE), c_header(paper_law()), host).T[0]
    assert np.abs(force - plain).max() > 0.01 * plain.max()
    assert "Effect damage:exponential: E exp(-kappa eps_P); damage_rate = 0.447214." in text


@pytest.mark.parametrize("names", NAMED.values(), ids=NAMED)
def test_the_law_rebuilt_from_the_tables_alone(names):
    law, particle = paper_law(Unloading.PUNCH, StrainScaling.CONTACT), Particle(213.54, 196.07, 150.0)
    law = type(law)(law.plastic, law.a, 500.0, law.unloading, law.strain_scaling).with_effects(*names)
    assert_rebuilt(law, particle, curve_tables(law, particle))
    with pytest.raises(InputError, match="particle must be"):
        curve_tables(law)


def test_golden_table_of_closed_effects_is_the_law_driven(tmp_path):
    law = paper_law().with_effects("damage", "size_effect:flow")
    table = golden_table(law, PARTICLE)
    path = table[table["path"] == 3]
    x = path["displacement_um"].to_numpy()
    force = drive(law, PARTICLE, x, time=np.arange(len(x))).force
    np.testing.assert_allclose(path["force_mN"], force, rtol=0, atol=1e-12 * float(force.max()))


def test_card_names_effects_with_equation_and_numbers():
    law = paper_law().with_effects("damage:threshold", "creep:logarithmic", Softer(0.4))
    written = json.loads(json.dumps(card(law, PARTICLE)))
    damage, creep, own = written["effects"]
    assert damage == {
        "name": "damage:threshold",
        "equation": "E exp(-kappa (eps_P - eps_0)) above eps_0",
        "unit": "-",
        "numbers": {"damage_rate": pytest.approx(0.2**0.5), "threshold_strain": 0.3},
    }
    assert creep["numbers"] == {"creep_compliance_per_MPa": pytest.approx(2e-4), "tau_s": 10.0}
    assert own == {
        "name": "Softer",
        "equation": "A user's own: E / (1 + kappa eps_P sigma_P).",
        "numbers": {"amplitude": 0.4},
    }
    plain = card(paper_law())
    assert "effects" not in plain
    assert written["sha256"] != plain["sha256"]
    assert (
        written["sha256"]
        != card(paper_law().with_effects("damage:threshold", "creep:logarithmic", Softer(0.3)))["sha256"]
    )


# ---- JAX, with memory ------------------------------------------------------------------------------------------------

CONSUMER = """
import json, sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
folder = Path(sys.argv[1])
files = json.loads((folder / "mcc_jax_export.json").read_text())["artefacts"]["files"]
given = np.load(folder / "given.npz")

def run(which, first, *more):
    name = f"mcc_{which}_float64.jax_export"
    call = jax.export.deserialize(bytearray((folder / name).read_bytes())).call
    memory = [jnp.broadcast_to(jnp.asarray(m["start"], m["dtype"]), (2, *m["shape"])) for m in files[name]["memory"]]
    count = len(files[name]["results"]) - 1
    def step(memory, now):
        *results, = call(jnp.repeat(now[0], 2), jnp.repeat(now[1], 2), *more, *memory)
        return results[count:], results[0]
    memory, answer = jax.lax.scan(step, memory, (jnp.asarray(first), jnp.asarray(given["time"])))
    slope = jax.grad(lambda x: call(x, jnp.ones(2), *more, *memory)[0].sum())(jnp.full(2, first[-1]))
    after = {f"m{k}": np.asarray(m[1]) for k, m in enumerate(memory)}
    return dict(answer=np.asarray(answer[:, 1]), slope=np.asarray(slope[1]), **after)

np.savez(folder / "step.npz", **run("step", given["displacement"]))
np.savez(folder / "step_load.npz", **run("step_load", given["force"]))
np.savez(folder / "step_each.npz", **run("step_each", given["displacement"], given["diameters"], given["coefficients"]))
assert not [name for name in sys.modules if name.startswith(("mcc_jax", "equinox"))]
"""


@pytest.mark.parametrize(
    "names",
    [
        ("creep:logarithmic", "frame_compliance"),
        ("creep:logarithmic", "frame_compliance", "thermal_drift", "damage:cyclic", "size_effect"),
    ],
    ids=["two", "five"],
)
def test_a_fresh_process_with_jax_alone_follows_memory_and_time(names, tmp_path):
    """Creep, frame, a drift, cyclic damage: as `mcc_jax.drive` to 1e-12, memory included."""
    law = paper_law().with_effects(*names)
    turns = [0.0, 40.0, 37.0, 60.0, 58.0, 58.5]
    x = np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(turns)])
    time = np.cumsum(np.random.default_rng(0).uniform(0.1, 5.0, len(x)))
    by_displacement = drive(law, PARTICLE, x, time=time)
    force = np.array(by_displacement.force)
    by_load = drive(law, PARTICLE, force, time=time, control="load")
    files = write_export("jax", law, PARTICLE, tmp_path)
    assert "mcc_force_float64.jax_export" not in files
    sizes, own = ([PARTICLE.D1, PARTICLE.D2, PARTICLE.D3], [law.plastic.C1, law.plastic.C3, law.plastic.C5])
    np.savez(tmp_path / "given.npz", displacement=x, force=force, time=time,
             diameters=np.tile(sizes, (2, 1)), coefficients=np.tile(own, (2, 1)))  # fmt: skip
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", CONSUMER, tmp_path], capture_output=True, text=True, timeout=240,
                          env=environment, cwd=tmp_path)  # fmt: skip
    assert done.returncode == 0, done.stderr
    for which, want, state in (
        ("step", force, by_displacement.state),
        ("step_each", force, by_displacement.state),
        ("step_load", by_load.displacement, by_load.state),
    ):
        written = np.load(tmp_path / f"{which}.npz")
        np.testing.assert_allclose(written["answer"], want, rtol=0, atol=1e-12 * np.abs(want).max())
        leaves = jax.tree.leaves(state)
        assert len(leaves) == sum(name.startswith("m") for name in written.files)
        for k, leaf in enumerate(leaves):
            np.testing.assert_allclose(written[f"m{k}"], leaf, rtol=1e-12, atol=1e-12)
        assert np.isfinite(written["slope"])
    table = np.genfromtxt(tmp_path / "mcc_jax_export_golden.csv", delimiter=",", names=True)
    path = table[table["path"] == 1]
    again = drive(law, PARTICLE, path["displacement_um"], time=path["time_s"])
    np.testing.assert_allclose(path["force_mN"], again.force, rtol=0, atol=1e-12 * float(again.force.max()))


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", OPEN, ids=lambda v: f"{v.mechanism}:{v.name}")
def test_formats_of_other_engines_refuse_by_name(tmp_path, variant):
    law = paper_law().with_effects(variant)
    for form in ("c", "lammps", "yade", "csv"):
        with pytest.raises(
            InputError, match=f"{variant.mechanism}:{variant.name} is not known in closed form"
        ) as caught:
            write_export(form, law, PARTICLE, tmp_path)
        assert "JAX artefact" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_what_would_gain_energy_goes_to_no_particle_code():
    law = paper_law().with_effects(LIBRARY["damage"]["stress"].build(4.0))
    with pytest.raises(InputError, match="give back more energy"):
        c_header(law)
    assert "time_s" in golden_table(law, PARTICLE)  # the library itself drives it


class Bessel(AbstractModulusAtPeak):
    """Uses a function that no C compiler has."""

    def factor(self, strain, stress):
        return 1 + self.amplitude * jax.scipy.special.i0e(strain)


class Loop(AbstractModulusAtPeak):
    """Goes on until it is done."""

    def factor(self, strain, stress):
        return jax.lax.fori_loop(0, 3, lambda _, x: x / (1 + self.amplitude * strain), jnp.ones_like(strain))


@pytest.mark.parametrize(("effect", "operation"), [(Bessel(0.1), "bessel_i0e"), (Loop(0.1), "scan")])
def test_an_operation_that_c_does_not_know(effect, operation):
    with pytest.raises(InputError, match=f"{operation}, which has no counterpart in C"):
        c_header(paper_law().with_effects(effect))


def test_force_without_memory_is_not_offered():
    with pytest.raises(InputError, match="Choices: step_load, step, step_each"):
        jax_artefact(paper_law().with_effects("creep"), PARTICLE, "force")
