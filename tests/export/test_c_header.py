import math
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from bisecting import pair_force
from compiling import LANGUAGES, PAIR, PLATES, WALL, build_driver, compile_with, head, run_driver
from helpers import FORMS

from mcc_jax import InputError, MccLaw, Particle, Plastic, Unloading, paper_law
from mcc_jax.export import Origin, c_header
from mcc_jax.law import History, StrainScaling

MODULUS_MPA = {Unloading.PRINTED: 16000.0, Unloading.PUNCH: 500.0, Unloading.PUNCH_EXACT: 500.0}
PARTICLE = Particle(213.54, 196.07, 186.33)
PATHS, STEPS = 100_000, 24


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_driver(tmp_path_factory.mktemp("header"), c_header(paper_law()))


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
def scales(law, diameters):
    """Displacement at a scaled strain of 0.67, and what is recovered from there [um]."""
    particle = Particle(*diameters)
    strain = 0.67 / law.shape_factor(particle)
    return particle.displacement(strain), particle.displacement(law.recoverable_strain(particle, strain))


@eqx.filter_jit
@eqx.filter_vmap
def along(law, diameters, path, past):
    """The library's forces [mN] and tangents [mN/um] along a path [um] with its history."""
    particle = Particle(*diameters)

    def force(x, before):
        return law.step(particle, History(before), x)[1]

    return jax.vmap(jax.value_and_grad(force))(path, past)


def random_paths(rng, reach, recovered, steps=STEPS):
    """Loading, unloading and reloading at random, some points exactly at the peak so far, some before first touch."""
    count = len(reach)
    peaks = np.maximum.accumulate(reach[:, None] * rng.uniform(0, 1, (count, steps)) ** 2, axis=1)
    depth = np.where(rng.uniform(size=(count, steps)) < 0.4, 0.0, rng.uniform(0, 1.2, (count, steps)))
    paths = peaks - depth * recovered[:, None]
    return np.where(rng.uniform(size=paths.shape) < 0.02, -0.01 * reach[:, None], paths)


def history(paths):
    past = np.maximum.accumulate(np.maximum(paths, 0.0), axis=1)
    return np.hstack([np.zeros((len(paths), 1)), past[:, :-1]])


@pytest.mark.parametrize("kind", [PLATES, WALL, PAIR], ids=["plates", "wall", "equal pair"])
def test_equals_the_library_over_random_paths(program, kind):
    """A wall is half a platen test, and two equal half contacts are a whole one: the library's curve in all three."""
    rng = np.random.default_rng(int(kind))
    share = 0.5 if kind == WALL else 1.0
    for unloading, scaling in FORMS:
        count = math.ceil(PATHS / len(FORMS))
        laws, diameters = random_laws(rng, count, unloading, scaling, monotone=kind == PAIR)
        reach, recovered = (np.asarray(v) for v in scales(laws, jnp.asarray(diameters)))
        paths = random_paths(rng, reach, recovered)
        force, tangent = (np.asarray(v) for v in along(laws, diameters, paths, history(paths)))
        got = run_driver(program, head(kind, STEPS, laws, diameters), 1e-6 * share * paths)
        largest, stiffest = force.max(axis=1, keepdims=True), tangent.max(axis=1, keepdims=True)
        assert (largest > 0).all()
        np.testing.assert_array_less(np.abs(1e3 * got[0] - force) / largest, 1e-12)
        # A tangent has a square root at full release, which magnifies the rounding of displacements.
        np.testing.assert_array_less(np.abs(1e-3 * share * got[1] - tangent) / stiffest, 1e-10)
        np.testing.assert_allclose(1e6 / share * got[2], np.maximum.accumulate(np.maximum(paths, 0), 1), rtol=1e-15)


@eqx.filter_jit
@eqx.filter_vmap
def recovered_from(law, diameters, peaks):
    """Displacement recovered on full release from peaks [um]."""
    particle = Particle(*diameters)
    return particle.displacement(law.recoverable_strain(particle, particle.strain(peaks)))


@pytest.mark.extended
@pytest.mark.parametrize("kind", [PLATES, PAIR], ids=["plates", "equal pair"])
def test_equals_the_library_where_the_recovery_is_limited(program, kind):
    """Peaks from 1e-9 to twice the tested range, moduli down to that of a rubber: formula, peak and slope as limits."""
    rng = np.random.default_rng(7)
    for unloading, scaling in FORMS:
        count, turns = 60, 6
        laws, diameters = random_laws(rng, count, unloading, scaling, monotone=True)
        soft = laws.effective_modulus * 10 ** jnp.asarray(rng.uniform(-3, 0, count))
        laws = eqx.tree_at(lambda law: law.effective_modulus, laws, soft)
        reach, _ = (np.asarray(v) for v in scales(laws, jnp.asarray(diameters)))
        peaks = np.sort(reach[:, None] * 10 ** rng.uniform(-9, 0.3, (count, turns)), axis=1)
        recovered = np.asarray(recovered_from(laws, diameters, jnp.asarray(peaks)))
        assert (recovered <= peaks * (1 + 1e-15)).all()
        assert ((recovered == peaks).mean() > 0.1) & ((recovered < peaks).mean() > 0.1)
        paths = peaks[..., None] - recovered[..., None] * np.array([0.0, 1e-3, 0.3, 0.7, 0.95, 1.1])
        paths = paths.reshape(count, -1)
        force, tangent = (np.asarray(v) for v in along(laws, diameters, paths, history(paths)))
        got = run_driver(program, head(kind, paths.shape[1], laws, diameters), 1e-6 * paths)
        at_peak = np.repeat(force.reshape(count, turns, -1)[..., 0], 6, axis=1)
        stiffest = np.repeat(tangent.reshape(count, turns, -1).max(axis=2), 6, axis=1)
        np.testing.assert_array_less(np.abs(1e3 * got[0] - force) / at_peak, 1e-12)
        np.testing.assert_array_less(np.abs(1e-3 * got[1] - tangent) / stiffest, 1e-10)


def test_pair_of_unlike_particles_equals_bisection(program):
    rng = np.random.default_rng(3)
    count, steps = 8, 20
    for unloading, scaling in FORMS[::2]:
        one, sizes = random_laws(rng, count, unloading, scaling, monotone=True)
        two, others = random_laws(rng, count, unloading, scaling, monotone=True)
        others *= np.geomspace(1e-5, 1e5, count)[:, None]  # down to dust, and up to what is a wall
        reach = np.minimum(*(np.asarray(scales(law, jnp.asarray(d))[0]) for law, d in ((one, sizes), (two, others))))
        laws = [[jax.tree.map(lambda v, k=k: v[k], law) for k in range(count)] for law in (one, two)]
        sides = [(a, Particle(*d), b, Particle(*e)) for a, d, b, e in zip(laws[0], sizes, laws[1], others, strict=True)]
        width = np.array([pair_force(*side, x, x)[2] for side, x in zip(sides, reach, strict=True)])
        paths = random_paths(rng, reach, width, steps)
        past = np.maximum.accumulate(np.maximum(paths, 0.0), axis=1)
        want = np.array([pair_force(*side, x, peak)[:2] for side, x, peak in zip(sides, paths, past, strict=True)])
        want = want.transpose(0, 2, 1)
        got = run_driver(program, head(PAIR, steps, one, sizes, two, others), 1e-6 * paths)
        swapped = run_driver(program, head(PAIR, steps, two, others, one, sizes), 1e-6 * paths)
        for k, unit in ((0, 1e3), (1, 1e-3)):
            largest = want[..., k].max(axis=1, keepdims=True)
            np.testing.assert_array_less(np.abs(unit * got[k] - want[..., k]) / largest, (1e-12, 1e-9)[k])
            np.testing.assert_array_less(np.abs(got[k] - swapped[k]) * unit / largest, (1e-12, 1e-9)[k])


@pytest.mark.extended
@pytest.mark.parametrize("unloading", Unloading)
def test_reference_of_a_pair_equals_thirty_digits(unloading):
    """The bisection itself, from the formulas of the paper, in arithmetic that does not round."""
    mpmath.mp.dps = 30
    one = MccLaw(Plastic(6.7, 3.0, 2.66), 1.43, MODULUS_MPA[unloading], unloading, StrainScaling.CONTACT)
    two = MccLaw(Plastic(9.0, 2.5, 2.4), 0.5, 0.7 * MODULUS_MPA[unloading], unloading, StrainScaling.CONTACT)
    small = Particle(90.0, 120.0, 100.0)
    n = 1 if unloading is Unloading.PRINTED else 2

    def half(law, particle):
        D1, D2, D3 = (mpmath.mpf(float(d)) for d in (particle.D1, particle.D2, particle.D3))
        radius = D1 * D2 / D3 / 2
        eta = 1 + mpmath.mpf(float(law.a)) * (1 - D3**2 / (D1 * D2))
        C1, C3, C5, E = (
            mpmath.mpf(float(v)) for v in (law.plastic.C1, law.plastic.C3, law.plastic.C5, law.effective_modulus)
        )

        def stress(d):
            x = eta * d / radius
            return C1 * x - (C3 * x) ** 3 + (C5 * x) ** 5

        def recovered(d):
            return radius * mpmath.sqrt((stress(d) / E) ** n / (law.unloading.constant * eta * d / radius))

        return lambda d: mpmath.pi * radius**2 * stress(d) / 1000, recovered

    (force_i, recovered_i), (force_j, recovered_j) = half(one, PARTICLE), half(two, small)
    peak = mpmath.mpf(60)
    d = mpmath.findroot(lambda d: force_i(d) - force_j(peak - d), (20, 40))
    width = recovered_i(d) + recovered_j(peak - d)
    got = np.array(pair_force(one, PARTICLE, two, small, 60.0, 60.0))
    np.testing.assert_allclose(got,
        (float(force_i(d)), float(mpmath.diff(lambda D: force_i(mpmath.findroot(
            lambda d: force_i(d) - force_j(D - d), (20, 40))), peak)), float(width)), rtol=1e-13,
    )  # fmt: skip
    for q in ("0.001", "0.3", "0.99"):
        q = mpmath.mpf(q)
        want = force_i(d) * 2 / mpmath.pi * (mpmath.acos(q) - q * mpmath.sqrt(1 - q * q))
        got = pair_force(one, PARTICLE, two, small, float(peak - q * width), 60.0)[0]
        assert got == pytest.approx(float(want), abs=1e-13 * float(force_i(d)))


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
    for law in laws:
        for kind in (PLATES, WALL, PAIR):
            sizes = np.tile([200.0, 180.0, 150.0], (len(paths), 1))
            force, tangent, peak = run_driver(program, head(kind, paths.shape[1], law, sizes, law, 0.3 * sizes), paths)
            assert np.isfinite(force).all()
            assert np.isfinite(tangent).all()
            assert (force >= 0).all()
            np.testing.assert_array_equal(peak, np.maximum.accumulate(np.maximum(paths, 0), axis=1))
            if float(law.a) == -300.0:  # the shape factor is negative: nothing is carried
                assert not force.any()


@pytest.mark.parametrize("kind", [PLATES, WALL, PAIR])
def test_a_history_below_zero_is_that_of_a_virgin_particle(program, kind):
    paths, sizes = np.array([[-2e-6, -5e-7, 0.0, 1e-5, 9.9e-6]]), np.full((1, 3), 200.0)
    virgin, odd = (run_driver(program, head(kind, 5, paper_law(), sizes, x_max=x), paths) for x in (0.0, -1e-6))
    np.testing.assert_array_equal(virgin, odd)
    assert not virgin[0, 0, :3].any()


def test_what_is_not_a_number_shows(program):
    sizes = np.full((1, 3), 200.0)
    for kind in (PLATES, WALL, PAIR):
        force, *_ = run_driver(program, head(kind, 2, paper_law(), sizes), np.array([[1e-5, np.nan]]))
        assert math.isfinite(force[0, 0])
        assert math.isnan(force[0, 1])


@pytest.mark.extended
@pytest.mark.parametrize("language", LANGUAGES)
def test_compiles_without_a_warning_and_holds_the_values(tmp_path, language):
    """Every form, twice included, and the initialiser gives back the law to the last bit."""
    law = paper_law()
    forms = [paper_law(*form) for form in FORMS]
    for number, form in enumerate(forms):
        (tmp_path / f"law_{number}.h").write_text(c_header(form, PARTICLE).replace("MCC_LAW_H", f"LAW_{number}_H"))
    values = (law.plastic.C1, law.plastic.C3, law.plastic.C5, law.a, 1e6 * law.effective_modulus)
    for number, form in enumerate(forms):
        n = 1 if form.unloading is Unloading.PRINTED else 2
        tests = [
            *(f"l.{name} != {v.hex()}" for name, v in zip(("C1", "C3", "C5", "a", "effective_modulus"),
              map(float, values), strict=True)),
            f"l.k != {form.unloading.constant.hex()}", f"l.n != {n}", f"l.p != {form.strain_scaling.power}",
        ]  # fmt: skip
        tests = [t.split(" != ")[0] + f' != strtod("{t.split(" != ")[1]}", NULL)' for t in tests]
        source = tmp_path / f"main_{number}.c"
        source.write_text(
            f'#include <stdlib.h>\n#include "law_{number}.h"\n#include "law_{number}.h"\n'
            f"int main(void)\n{{\n    mcc_law l = MCC_LAW_CALIBRATED;\n    return {' || '.join(tests)};\n}}\n"
        )
        compile_with(language, ["-I", tmp_path, "-o", tmp_path / f"main_{number}", source])
        subprocess.run([tmp_path / f"main_{number}"], check=True)


def test_along_any_normal_is_the_plate_along_D3_and_the_sphere_everywhere(tmp_path):
    (tmp_path / "mcc_law.h").write_text(c_header(paper_law()))
    (tmp_path / "normals.c").write_text(
        """
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
    )
    compile_with("c", ["-I", tmp_path, "-o", tmp_path / "normals", tmp_path / "normals.c"])
    out = subprocess.run([tmp_path / "normals"], capture_output=True, text=True, check=True).stdout
    rows = np.array([[float(v) for v in line.split()] for line in out.splitlines()])
    np.testing.assert_allclose(rows[1::2], rows[::2], rtol=1e-13)
    assert len({row[0] for row in rows}) > 2


def test_any_name_is_harmless_in_the_comment(tmp_path):
    name = '*/ int x = 1/0; /* "\\\n??/ \N{SNOWMAN} #error'
    origin = Origin(particle=name, geometry=name)
    (tmp_path / "mcc_law.h").write_text(c_header(paper_law(), PARTICLE, origin=origin))
    (tmp_path / "main.c").write_text('#include "mcc_law.h"\nint main(void) { return 0; }\n')
    compile_with("c", ["-I", tmp_path, "-o", tmp_path / "main", tmp_path / "main.c"])


def test_a_law_out_of_range_is_refused():
    law = eqx.tree_at(lambda law: law.effective_modulus, paper_law(), jnp.asarray(-1.0))
    with pytest.raises(InputError, match="must be positive"):
        c_header(law, PARTICLE)
    with pytest.raises(InputError, match="shape factor"):
        c_header(eqx.tree_at(lambda law: law.a, paper_law(), jnp.asarray(-20.0)), Particle(200.0, 190.0, 100.0))
