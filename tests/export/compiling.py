"""Compiling exported C and C++, running it over paths, and comparing it with the library."""

import shutil
import subprocess
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcc_jax import MccLaw, Particle, Plastic, Unloading
from mcc_jax.dem import half_contact, pair_force, wall_force

STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1")
LANGUAGES = {"c": ("cc", "-std=c99"), "c++": ("c++", "-std=c++11")}
HERE = Path(__file__).parent
PLATES, WALL, PAIR = 0.0, 1.0, 2.0
MODULUS_MPA = {Unloading.PRINTED: 16000.0, Unloading.PUNCH: 500.0, Unloading.PUNCH_EXACT: 500.0}
PARTICLE = Particle(213.54, 196.07, 186.33)


def compile_with(language, arguments):
    """Run a compiler with every warning an error; the test is skipped only if the machine has none."""
    name, standard = LANGUAGES[language]
    compiler = shutil.which(name)
    if compiler is None:
        pytest.skip(f"no compiler {name}")
    done = subprocess.run(
        [compiler, "-x", language, standard, *STRICT, *map(str, arguments), "-lm"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def compile_and_run(folder, header, main):
    """What a C program prints that includes a header."""
    (folder / "mcc_law.h").write_text(header)
    (folder / "main.c").write_text(main)
    compile_with("c", ["-I", folder, "-o", folder / "main", folder / "main.c"])
    return subprocess.run([folder / "main"], capture_output=True, text=True, check=True).stdout


def build_driver(folder, header):
    """Compile `drive_header.c` with the text of a header; the program."""
    folder.mkdir(exist_ok=True)
    (folder / "mcc_law.h").write_text(header)
    program = folder / "drive_header"
    compile_with("c", ["-I", folder, "-o", program, HERE / "drive_header.c"])
    return program


def run_driver(program, heads, paths):
    """Force, tangent and history of shape (paths, steps) for heads (paths, 25) and paths (paths, steps) in SI units."""
    done = subprocess.run([program], input=np.hstack([heads, paths]).tobytes(), capture_output=True, check=True)
    return np.moveaxis(np.frombuffer(done.stdout).reshape(*paths.shape, 3), -1, 0)


def law_numbers(law):
    """What the driver wants to know of one law or a batch of them, shape (..., 8)."""
    n = 1.0 if law.unloading.value == "printed" else 2.0
    own = [law.plastic.C1, law.plastic.C3, law.plastic.C5, law.a, 1e6 * law.effective_modulus]
    same = [law.unloading.constant, n, float(law.strain_scaling.power)]
    return np.stack(np.broadcast_arrays(*map(np.asarray, [*own, *same])), axis=-1)


def head(kind, steps, law, diameters, others=None, x_max=0.0):
    """Records of the driver but for their paths; diameters in um, shape (paths, 3), and those of the other particle."""
    count = len(diameters)
    numbers = np.broadcast_to(law_numbers(law), (count, 8))
    others = diameters if others is None else others
    parts = [np.tile([kind, float(steps)], (count, 1)), numbers, 1e-6 * diameters, numbers, 1e-6 * others]
    return np.hstack([*parts, np.full((count, 1), x_max)])


def random_laws(rng, count, unloading, scaling, monotone=False):
    """Laws and diameters [um] far around the paper's; unless excluded, some are not monotone."""
    C1, C5 = rng.uniform(3, 15, count), rng.uniform(1.8, 3.5, count)
    C3 = rng.uniform(0, 1 if monotone else 1.05, count) * (20 / 9 * C1 * C5**5) ** (1 / 6)
    plastic = eqx.filter_vmap(Plastic)(*map(jnp.asarray, (C1, C3, C5)))
    modulus = jnp.asarray(MODULUS_MPA[unloading] * rng.uniform(0.25, 4, count))
    shape = jnp.asarray(rng.uniform(-0.8, 1.4, count))
    laws = eqx.filter_vmap(lambda p, a, E: MccLaw(p, a, E, unloading, scaling))(plastic, shape, modulus)
    return laws, rng.uniform(100, 300, (count, 1)) * rng.uniform(0.88, 1.12, (count, 3))


@eqx.filter_jit
@eqx.filter_vmap
def recovered_from(law, diameters, strain):
    """Displacements at scaled strains, and what is recovered from there [um]."""
    particle = Particle(*diameters)
    strain = strain / law.shape_factor(particle)
    return particle.displacement(strain), particle.displacement(law.recoverable_strain(particle, strain))


def random_paths(rng, laws, diameters, steps=24):
    """Displacements [um]: loading, unloading and reloading at random, some exactly at the peak, some before contact."""
    count = len(diameters)
    ends = recovered_from(laws, jnp.asarray(diameters), jnp.full(count, 0.67))
    reach, recovered = (np.asarray(v)[:, None] for v in ends)
    peaks = np.maximum.accumulate(reach * rng.uniform(0, 1, (count, steps)) ** 2, axis=1)
    depth = np.where(rng.uniform(size=(count, steps)) < 0.4, 0.0, rng.uniform(0, 1.2, (count, steps)))
    return np.where(rng.uniform(size=peaks.shape) < 0.02, -0.01 * reach, peaks - depth * recovered)


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(eqx.if_array(0), 0, 0, 0, 0, None))  # a switch of an effect is a plain number
def along(law, diameters, others, path, peak, kind):
    """The library's forces [N] and tangents [N/m] along a path [m]; a platen test is two halves against walls."""
    side, other = (half_contact(law, Particle(*d)) for d in (diameters, others))
    share = 0.5 if kind == PLATES else 1.0

    def force(x, peak):
        return pair_force(side, other, peak, x) if kind == PAIR else wall_force(side, share * peak, share * x)

    return jax.vmap(jax.value_and_grad(force))(path, peak)


def assert_same(program, kind, laws, diameters, paths, *, others=None, effects=(), tolerance=1e-10, turns=1):
    """The C program equals the library along paths [m], relative to the largest of each path or of its turns."""
    others = diameters if others is None else others
    peaks = np.maximum.accumulate(np.maximum(paths, 0.0), axis=1)
    damaged = eqx.filter_vmap(lambda law: law.with_effects(*effects))(laws)
    want = along(damaged, diameters, others, paths, peaks, kind)
    *got, history = run_driver(program, head(kind, paths.shape[1], laws, diameters, others), paths)
    for mine, theirs, allowed in zip(got, want, (1e-12, tolerance), strict=True):
        largest = np.asarray(theirs).reshape(len(paths), turns, -1).max(axis=2)
        assert (largest > 0).all()
        error = np.abs(mine - theirs) / np.repeat(largest, paths.shape[1] // turns, axis=1)
        np.testing.assert_array_less(error, allowed)
    np.testing.assert_array_equal(history, peaks)
    return got
