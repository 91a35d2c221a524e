"""The C header against the library over random paths, at the limits of numbers, and as a text that compiles."""

import math
import subprocess

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import (
    LANGUAGES,
    PAIR,
    PARTICLE,
    PLATES,
    WALL,
    assert_same,
    build_driver,
    compile_and_run,
    compile_with,
    head,
    law_numbers,
    random_laws,
    random_paths,
    recovered_from,
    run_driver,
)
from helpers import FORMS

from mcc_jax import MccLaw, Plastic, paper_law
from mcc_jax.export import Origin, c_header

PATHS = {PLATES: 100_000, WALL: 100_000, PAIR: 3000}
KINDS = pytest.mark.parametrize("kind", PATHS, ids=["plates", "wall", "pair"])


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_driver(tmp_path_factory.mktemp("header"), c_header(paper_law(), PARTICLE))


@KINDS
def test_equals_the_library_over_random_paths(program, kind):
    """Whatever the form; of pairs the other particle is down to dust, and up to what is a wall."""
    rng = np.random.default_rng(int(kind))
    for form in FORMS:
        laws, diameters = random_laws(rng, math.ceil(PATHS[kind] / len(FORMS)), *form, monotone=kind == PAIR)
        ratio = 10 ** rng.uniform(-5, 5, (len(diameters), 1))
        paths = 1e-6 * random_paths(rng, laws, diameters) * (np.minimum(ratio, 1.0) if kind == PAIR else 1.0)
        assert_same(program, kind, laws, diameters, paths, others=ratio * diameters)


@pytest.mark.extended
@pytest.mark.parametrize("kind", [PLATES, PAIR], ids=["plates", "equal pair"])
def test_equals_the_library_where_the_recovery_is_limited(program, kind):
    """Peaks from 1e-9 to twice the tested range, moduli down to that of a rubber: formula, peak and slope as limits."""
    rng, count, turns = np.random.default_rng(7), 60, 6
    for form in FORMS:
        laws, diameters = random_laws(rng, count, *form, monotone=True)
        soft = laws.effective_modulus * 10 ** jnp.asarray(rng.uniform(-3, 0, count))
        laws = eqx.tree_at(lambda law: law.effective_modulus, laws, soft)
        strain = np.sort(0.67 * 10 ** rng.uniform(-9, 0.3, (count, turns)), axis=1)
        peaks, recovered = map(np.asarray, recovered_from(laws, jnp.asarray(diameters), jnp.asarray(strain)))
        assert (recovered <= peaks * (1 + 1e-15)).all()
        assert ((recovered == peaks).mean() > 0.1) & ((recovered < peaks).mean() > 0.1)
        paths = peaks[..., None] - recovered[..., None] * np.array([0.0, 1e-3, 0.3, 0.7, 0.95, 1.1])
        assert_same(program, kind, laws, diameters, 1e-6 * paths.reshape(count, -1), turns=turns)


def test_finite_whatever_the_displacement(program):
    """First touch, the peak, full release, denormal and enormous numbers, shapes and coefficients at their limits."""
    values = [0.0, 5e-324, 1e-300, 1e-155, 1e-20, 1e-6, 4e-5, 1e-3, 1.0, 1e10, 1e50]
    values = np.array([*values, *(-v for v in values)])
    laws = [
        MccLaw(plastic, a, 16000.0, *form)
        for form in FORMS
        for plastic in (Plastic(6.7, 3.0, 2.66), Plastic(4.0, 0.0, 2.4), Plastic(1.0, 4.0, 2.0))
        for a in (1.43, -300.0, 0.0)
    ]
    first, second = (v.ravel() for v in np.meshgrid(values, values))
    paths = np.stack([first, second, first, np.nextafter(first, -1), 0.999 * first, 0.9 * first, first], axis=1)
    sizes = np.tile([200.0, 180.0, 150.0], (len(paths), 1))
    for law in laws:
        for kind in PATHS:
            force, tangent, peak = run_driver(program, head(kind, paths.shape[1], law, sizes, 0.3 * sizes), paths)
            assert np.isfinite(force).all()
            assert np.isfinite(tangent).all()
            assert (force >= 0).all()
            np.testing.assert_array_equal(peak, np.maximum.accumulate(np.maximum(paths, 0), axis=1))
            if float(law.a) == -300.0:  # the shape factor is negative: nothing is carried
                assert not force.any()


@KINDS
def test_a_history_below_zero_is_that_of_a_virgin_particle_and_nan_shows(program, kind):
    paths, sizes = np.array([[-2e-6, -5e-7, 0.0, 1e-5, 9.9e-6, np.nan]]), np.full((1, 3), 200.0)
    virgin, odd = (run_driver(program, head(kind, 6, paper_law(), sizes, x_max=x), paths) for x in (0.0, -1e-6))
    np.testing.assert_array_equal(virgin, odd)
    assert not virgin[0, 0, :3].any()
    assert (virgin[0, 0, 3:5] > 0).all()
    assert math.isnan(virgin[0, 0, 5])


@pytest.mark.extended
@pytest.mark.parametrize("language", LANGUAGES)
def test_compiles_without_a_warning_and_holds_the_values(tmp_path, language):
    """Every form, twice included, and the initialiser gives back the law to the last bit."""
    for number, form in enumerate(FORMS):
        law = paper_law(*form)
        values = zip(("C1", "C3", "C5", "a", "effective_modulus", "k", "n", "p"), law_numbers(law), strict=True)
        tests = " || ".join(f'l.{name} != strtod("{float(value).hex()}", NULL)' for name, value in values)
        (tmp_path / f"law_{number}.h").write_text(c_header(law, PARTICLE))
        source, program = tmp_path / f"main_{number}.c", tmp_path / f"main_{number}"
        source.write_text(
            f'#include <stdlib.h>\n#include "law_{number}.h"\n#include "law_{number}.h"\n'
            f"int main(void)\n{{\n    mcc_law l = MCC_LAW_CALIBRATED;\n    return {tests};\n}}\n"
        )
        compile_with(language, ["-I", tmp_path, "-o", program, source])
        subprocess.run([program], check=True)


NORMALS = """
#include <stdio.h>
#include "mcc_law.h"
static void show(mcc_contact c) { printf("%.17g %.17g %.17g %.17g %.17g\\n", c.k1, c.k3, c.k5, c.c, c.x_valid); }
int main(void)
{
    const mcc_law law = MCC_LAW_CALIBRATED;
    show(mcc_half_contact(&law, 2e-4, 1.8e-4, 1.5e-4));
    show(mcc_half_contact_along(&law, 2e-4, 1.8e-4, 1.5e-4, 0.0, 0.0, 1.0));
    show(mcc_half_contact(&law, 1.8e-4, 1.5e-4, 2e-4));
    show(mcc_half_contact_along(&law, 2e-4, 1.8e-4, 1.5e-4, -1.0, 0.0, 0.0));
    show(mcc_half_contact(&law, 2e-4, 2e-4, 2e-4));
    show(mcc_half_contact_along(&law, 2e-4, 2e-4, 2e-4, 0.48, 0.6, 0.64));
    return 0;
}
"""


def test_along_any_normal_is_the_plate_along_D3_and_the_sphere_everywhere(tmp_path):
    out = compile_and_run(tmp_path, c_header(paper_law(), PARTICLE), NORMALS)
    rows = np.array([[float(v) for v in line.split()] for line in out.splitlines()])
    np.testing.assert_allclose(rows[1::2], rows[::2], rtol=1e-13)
    assert len({row[0] for row in rows}) > 2


def test_any_name_is_harmless_in_the_comment(tmp_path):
    name = '*/ int x = 1/0; /* "\\\n??/ \N{SNOWMAN} #error'
    origin = Origin(particle=name, geometry=name)
    header = c_header(paper_law(), PARTICLE, origin=origin)
    assert not compile_and_run(tmp_path, header, '#include "mcc_law.h"\nint main(void) { return 0; }\n')
