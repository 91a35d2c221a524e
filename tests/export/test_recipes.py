import re
import subprocess

import numpy as np
import pytest
from compiling import HERE, PARTICLE, compile_with

from mcc_jax import Unloading, paper_law
from mcc_jax.export import Origin, c_header, lammps_recipe, yade_recipe
from mcc_jax.law import StrainScaling

FORMS = [(Unloading.PRINTED, StrainScaling.RAW), (Unloading.PUNCH_EXACT, StrainScaling.MASTER)]


def code_blocks(recipe):
    """The C++ of a recipe by the file name in the heading above it."""
    return dict(re.findall(r"^## `([^`]+)`\n\n```cpp\n(.*?)^```$", recipe, flags=re.MULTILINE | re.DOTALL))


def run_recipe(folder, recipe, header, host):
    """Compile a recipe's code with the stand-ins of its host, and run their main program; the numbers it prints."""
    (folder / "mcc_law.h").write_text(header)
    sources = []
    for name, code in code_blocks(recipe).items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(code)
        sources += [file] if file.suffix == ".cpp" else []
    stand_ins = HERE / "stand_ins" / host
    program = folder / "program"
    compile_with("c++", ["-I", folder, "-I", stand_ins, "-o", program, *sources, stand_ins / "main.cpp"])
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    return np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_the_normal_model_for_lammps_gives_the_headers_forces(tmp_path, form):
    law = paper_law(*form)
    numbers = run_recipe(tmp_path, lammps_recipe(law, PARTICLE), c_header(law, PARTICLE), "lammps")
    force, want, history, x_max, without_update = numbers.T
    assert len(force) == 14
    assert (want > 0).sum() >= 6
    np.testing.assert_array_equal(force, want)
    np.testing.assert_array_equal(history, x_max)
    np.testing.assert_array_equal(without_update, want)


@pytest.mark.extended
@pytest.mark.parametrize("form", FORMS, ids=str)
def test_the_functors_for_yade_give_the_headers_forces(tmp_path, form):
    law = paper_law(*form)
    numbers = run_recipe(tmp_path, yade_recipe(law, PARTICLE), c_header(law, PARTICLE), "yade")
    force, want, shear, friction = numbers.T
    assert len(force) == 21
    np.testing.assert_array_equal(force, want)
    np.testing.assert_allclose(shear, friction, rtol=1e-14)
    np.testing.assert_array_equal(force[7:14], force[14:])  # which body comes first does not matter


def test_style_macros_of_lammps_see_the_model():
    """With GranSubMod_CLASS defined the header only registers the style, whatever else it holds."""
    block = code_blocks(lammps_recipe(paper_law(), PARTICLE))["gran_sub_mod_mcc.h"]
    assert re.search(r"^#ifdef GranSubMod_CLASS\n.*\nGranSubModStyle\(mcc,GranSubModNormalMCC,NORMAL\);", block)


@pytest.mark.parametrize("recipe", [lammps_recipe, yade_recipe])
def test_recipes_carry_values_provenance_and_what_was_not_tested(recipe):
    law = paper_law()
    text = recipe(law, PARTICLE, origin=Origin(particle="```7*", warnings=("watch out",)))
    for value in (float(law.plastic.C1), float(law.plastic.C5), 1e6 * float(law.effective_modulus)):
        assert repr(value) in text
    assert "Not tested:" in text
    assert text.count("```") % 2 == 0
    assert "```7" not in text.replace("```cpp", "")


def test_python_of_the_yade_recipe_is_python():
    (block,) = re.findall(r"```python\n(.*?)```", yade_recipe(paper_law(), PARTICLE), flags=re.DOTALL)
    compile(block, "yade.md", "exec")
