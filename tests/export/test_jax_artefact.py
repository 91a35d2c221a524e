"""JAX artefacts where mcc_jax cannot be imported, with and without the memory of effects."""

import itertools
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import PARTICLE

from mcc_jax import InputError, Unloading, drive, paper_law
from mcc_jax.export import golden_table, jax_artefact, write_export
from mcc_jax.law import StrainScaling

pytestmark = pytest.mark.extended

FORMS = [(Unloading.PRINTED, StrainScaling.RAW), (Unloading.PUNCH, StrainScaling.MASTER)]
SIZES = [float(v) for v in (PARTICLE.D1, PARTICLE.D2, PARTICLE.D3)]


def coefficients(law):
    return [float(v) for v in (law.plastic.C1, law.plastic.C3, law.plastic.C5)]


def run_alone(folder, code, *arguments):
    """What a script prints that has JAX, NumPy and the exported files, and nothing else."""
    start = """
import json, sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
folder = Path(sys.argv[1])

def load(which, dtype):
    return jax.export.deserialize(bytearray((folder / f"mcc_{which}_{dtype}.jax_export").read_bytes()))
"""
    end = '\nassert not [name for name in sys.modules if name.startswith(("mcc_jax", "equinox"))]\n'
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run([sys.executable, "-c", start + code + end, folder, *map(json.dumps, arguments)],
                          capture_output=True, text=True, timeout=240, env=environment, cwd=folder)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


GOLDEN = """
table = np.genfromtxt(folder / "mcc_jax_export_golden.csv", delimiter=",", names=True)
found = {}
reloading = table["displacement_um"] < table["displacement_max_um"]

def arguments(dtype):
    x = jnp.asarray(table["displacement_um"], dtype)
    past = jnp.asarray(np.where(reloading, table["displacement_max_um"], 0.0), dtype)
    rows = [jnp.broadcast_to(jnp.asarray(json.loads(text), dtype), (len(x), 3)) for text in sys.argv[2:]]
    return x, past, *rows

def misses(results):
    names = "force_mN", "tangent_mN_per_um", "displacement_max_um"
    return [float(np.abs(v - table[name]).max() / table[name].max()) for v, name in zip(results, names)]

for dtype in ("float64", "float32"):
    x, past, sizes, own = arguments(dtype)
    step = load("step", dtype)
    results = step.call(x, past)
    assert {v.dtype for v in results} == {jnp.dtype(dtype)}
    found[dtype] = {"step": misses(results), "platforms": list(step.platforms)}
    found[dtype]["force"] = misses([load("force", dtype).call(x, past)])
    found[dtype]["step_each"] = misses(load("step_each", dtype).call(x, past, sizes, own))
x, past, sizes, own = arguments("float64")
force, tangent, _ = load("step", "float64").call(x, past)
found["one of many"] = float(load("step", "float64").call(x[10:11], past[10:11])[0][0] - force[10])
only, each = load("force", "float64"), load("step_each", "float64")
slope = jax.grad(lambda x: only.call(x, past).sum())(x)
found["gradient"] = float(jnp.abs(slope - tangent).max() / table["tangent_mN_per_um"].max())
found["sensitivity"] = jax.grad(lambda own: each.call(x, past, sizes, own)[0].sum())(own).sum(0).tolist()
print(json.dumps(found))
"""


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_fresh_process_with_jax_alone_gets_the_golden_table(tmp_path, form):
    law = paper_law(*form)
    if form[0] is Unloading.PUNCH:
        law = type(law)(law.plastic, law.a, 500.0, *form)
    names = write_export("jax", law, PARTICLE, tmp_path)
    assert {name for name in names if name.endswith(".jax_export")} == {
        f"mcc_{which}_{dtype}.jax_export"
        for which in ("force", "step", "step_each")
        for dtype in ("float64", "float32")
    }
    found = json.loads(run_alone(tmp_path, GOLDEN, SIZES, coefficients(law)))
    double, single = found["float64"], found["float32"]
    assert double["platforms"] == ["cpu", "cuda", "rocm", "tpu"]
    for function in ("force", "step", "step_each"):
        assert double[function][0] < 1e-13
        # In single precision a displacement of 100 um has 1e-5 um, of a recoverable one of a few um.
        assert single[function][0] < 3e-5
    for function in ("step", "step_each"):
        assert double[function][1] < 1e-11  # the tangent has a square root at full release
        assert double[function][2] < 1e-15
        assert single[function][2] < 1e-7
    assert found["one of many"] == 0.0
    assert found["gradient"] < 1e-11
    np.testing.assert_allclose(found["sensitivity"], sensitivity(law), rtol=1e-10)


def sensitivity(law):
    """Derivatives of the golden table's sum of forces with respect to C1, C3, C5, by the library."""
    table = golden_table(law, PARTICLE)
    x, most = (jnp.asarray(table[name].to_numpy()) for name in ("displacement_um", "displacement_max_um"))
    past = jnp.where(x < most, most, 0.0)

    def total(law):
        history = type(law.init(PARTICLE))
        return jax.vmap(lambda x, past: law.step(PARTICLE, history(past), x)[1])(x, past).sum()

    return coefficients(jax.grad(total)(law))


MEMORY = """
files = json.loads((folder / "mcc_jax_export.json").read_text())["artefacts"]["files"]
given = np.load(folder / "given.npz")

def run(which, first, *more):
    call, signature = load(which, "float64").call, files[f"mcc_{which}_float64.jax_export"]
    memory = [jnp.broadcast_to(jnp.asarray(m["start"], m["dtype"]), (2, *m["shape"])) for m in signature["memory"]]
    count = len(signature["results"]) - 1
    def step(memory, now):
        *results, = call(jnp.repeat(now[0], 2), jnp.repeat(now[1], 2), *more, *memory)
        return results[count:], results[0]
    memory, answer = jax.lax.scan(step, memory, (jnp.asarray(first), jnp.asarray(given["time"])))
    slope = jax.grad(lambda x: call(x, jnp.ones(2), *more, *memory)[0].sum())(jnp.full(2, first[-1]))
    after = {f"m{k}": np.asarray(m[1]) for k, m in enumerate(memory)}
    np.savez(folder / f"{which}.npz", answer=np.asarray(answer[:, 1]), slope=np.asarray(slope[1]), **after)

run("step", given["displacement"])
run("step_load", given["force"])
run("step_each", given["displacement"], *(np.tile(json.loads(text), (2, 1)) for text in sys.argv[2:]))
"""


@pytest.mark.parametrize("more", [(), ("thermal_drift", "damage:cyclic", "size_effect")], ids=["two", "five"])
def test_a_fresh_process_with_jax_alone_follows_memory_and_time(more, tmp_path):
    """Creep, frame, a drift, cyclic damage: as `mcc_jax.drive` to 1e-12, memory included."""
    law = paper_law().with_effects("creep:logarithmic", "frame_compliance", *more)
    turns = [0.0, 40.0, 37.0, 60.0, 58.0, 58.5]
    x = np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(turns)])
    time = np.cumsum(np.random.default_rng(0).uniform(0.1, 5.0, len(x)))
    by_displacement = drive(law, PARTICLE, x, time=time)
    force = np.array(by_displacement.force)
    by_load = drive(law, PARTICLE, force, time=time, control="load")
    assert "mcc_force_float64.jax_export" not in write_export("jax", law, PARTICLE, tmp_path)
    np.savez(tmp_path / "given.npz", displacement=x, force=force, time=time)
    run_alone(tmp_path, MEMORY, SIZES, coefficients(law))
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


def test_what_an_artefact_cannot_be_is_refused():
    with jax.enable_x64(False), pytest.raises(InputError, match="single precision"):
        jax_artefact(paper_law(), PARTICLE)
    with pytest.raises(InputError, match="Choices: step_load, step, step_each"):
        jax_artefact(paper_law().with_effects("creep"), PARTICLE, "force")
