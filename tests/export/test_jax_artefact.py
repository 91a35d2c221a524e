import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import InputError, Particle, Unloading, paper_law
from mcc_jax.export import golden_table, jax_artefact, write_export
from mcc_jax.law import StrainScaling

pytestmark = pytest.mark.extended

PARTICLE = Particle(213.54, 196.07, 186.33)

# Runs where mcc_jax cannot be imported: JAX, NumPy and the files are all there is.
CONSUMER = """
import json, sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
folder = Path(sys.argv[1])
table = np.genfromtxt(folder / "mcc_jax_export_golden.csv", delimiter=",", names=True)
found = {}
largest, stiffest = table["force_mN"].max(), table["tangent_mN_per_um"].max()
reloading = table["displacement_um"] < table["displacement_max_um"]

def load(which, dtype):
    return jax.export.deserialize(bytearray((folder / f"mcc_{which}_{dtype}.jax_export").read_bytes()))

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
found["gradient"] = float(jnp.abs(slope - tangent).max() / stiffest)
found["sensitivity"] = jax.grad(lambda own: each.call(x, past, sizes, own)[0].sum())(own).sum(0).tolist()
assert not [name for name in sys.modules if name.startswith(("mcc_jax", "equinox"))]
print(json.dumps(found))
"""


FORMS = [(Unloading.PRINTED, StrainScaling.RAW), (Unloading.PUNCH, StrainScaling.MASTER)]


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
    coefficients = [float(v) for v in (law.plastic.C1, law.plastic.C3, law.plastic.C5)]
    diameters = [float(v) for v in (PARTICLE.D1, PARTICLE.D2, PARTICLE.D3)]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", CONSUMER, tmp_path, json.dumps(diameters), json.dumps(coefficients)],
        capture_output=True, text=True, timeout=120, env=environment, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
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

    plastic = jax.grad(total)(law).plastic
    return [float(v) for v in (plastic.C1, plastic.C3, plastic.C5)]


def test_platforms_are_those_asked_for():
    artefact = jax_artefact(paper_law(), PARTICLE, "force", platforms=("cpu",))
    assert artefact.signature["platforms"] == ["cpu"]
    assert jax.export.deserialize(bytearray(artefact.content)).platforms == ("cpu",)


def test_double_precision_out_of_single_is_refused():
    with jax.enable_x64(False), pytest.raises(InputError, match="single precision"):
        jax_artefact(paper_law(), PARTICLE)
