"""Compiling exported C and C++ and running it over paths."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1")
LANGUAGES = {"c": ("cc", "-std=c99"), "c++": ("c++", "-std=c++11")}
HERE = Path(__file__).parent
PLATES, WALL, PAIR = 0.0, 1.0, 2.0


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


def build_driver(folder, header, language="c"):
    """Compile `drive_header.c` with the text of a header; the program."""
    (folder / "mcc_law.h").write_text(header)
    program = folder / "drive_header"
    compile_with(language, ["-I", folder, "-o", program, HERE / "drive_header.c"])
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


def head(kind, steps, law_i, diameters_i, law_j=None, diameters_j=None, x_max=0.0):
    """Records of the driver but for their paths; diameters in um, shape (paths, 3)."""
    law_j, diameters_j = (law_i, diameters_i) if law_j is None else (law_j, diameters_j)
    count = len(diameters_i)
    front = np.tile([kind, float(steps)], (count, 1))
    i, j = (np.broadcast_to(law_numbers(law), (count, 8)) for law in (law_i, law_j))
    return np.hstack([front, i, 1e-6 * diameters_i, j, 1e-6 * diameters_j, np.full((count, 1), x_max)])
