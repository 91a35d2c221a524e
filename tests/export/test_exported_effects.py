"""Effects in exports: C against the library, recipes, tables, card, and what is refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import PAIR, PARTICLE, PLATES, WALL, assert_same, build_driver, random_laws, random_paths
from helpers import Softer
from test_recipes import run_recipe
from test_tables import assert_rebuilt

from mcc_jax import InputError, Particle, Unloading, drive, paper_law
from mcc_jax.effects import LIBRARY, AbstractModulusAtPeak
from mcc_jax.export import c_header, card, curve_tables, golden_table, lammps_recipe, write_export, yade_recipe
from mcc_jax.law import StrainScaling

pytestmark = pytest.mark.extended

NAMED = {
    "damage": ("damage:exponential",),
    "late damage and size": ("damage:threshold", "size_effect:flow_and_modulus", "size_effect:strain_gradient"),
    "linear and stress": ("damage:linear", "densification_stiffening:heckel", "densification_stiffening:stress"),
    "shape": ("shape_second_order:in_plane_aspect", "shape_second_order", "densification_stiffening:relative_density"),
}
OPEN = [v for m in LIBRARY.values() for v in m if not v.build(v.typical).closed]


@pytest.mark.parametrize("names", [*NAMED.values(), (Softer(0.4),)], ids=[*NAMED, "own"])
@pytest.mark.parametrize("unloading", [Unloading.PRINTED, Unloading.PUNCH_EXACT])
def test_c_equals_the_library_over_random_paths(tmp_path, unloading, names):
    """Random coefficients, moduli and shapes under one header, platens, wall and unlike pairs, to twice the tests."""
    rng, scaling = np.random.default_rng(5), StrainScaling.CONTACT
    laws, diameters = random_laws(rng, 300, unloading, scaling, monotone=True)
    others = diameters * rng.uniform(0.3, 1.0, (len(diameters), 1))
    program, plain = (
        build_driver(folder, c_header(paper_law(unloading, scaling).with_effects(*effects), PARTICLE))
        for folder, effects in ((tmp_path, names), (tmp_path / "plain", ()))
    )
    for kind, scale in ((PLATES, 2.0), (WALL, 1.0), (PAIR, 0.8)):
        paths = 1e-6 * scale * random_paths(rng, laws, diameters)
        given = {"others": others, "tolerance": 1e-9}
        force, _ = assert_same(program, kind, laws, diameters, paths, effects=names, **given)
    without, _ = assert_same(plain, PAIR, laws, diameters, paths, **given)
    assert (np.abs(without - force).max(axis=1) / force.max(axis=1) > 1e-3).mean() > 0.5  # they do something


@pytest.mark.parametrize("recipe", [lammps_recipe, yade_recipe])
def test_recipes_give_the_headers_forces(tmp_path, recipe):
    law = paper_law().with_effects("damage", "size_effect")
    host = "lammps" if recipe is lammps_recipe else "yade"
    text, header = recipe(law, PARTICLE), c_header(law, PARTICLE)
    force, want, *_ = run_recipe(tmp_path, text, header, host).T
    np.testing.assert_array_equal(force, want)
    plain = run_recipe(tmp_path, recipe(paper_law(), PARTICLE), c_header(paper_law(), PARTICLE), host).T[0]
    assert np.abs(force - plain).max() > 0.01 * plain.max()
    assert "Effect damage:exponential: E exp(-kappa eps_P); damage_rate = 0.447214." in text


@pytest.mark.parametrize("names", NAMED.values(), ids=NAMED)
def test_the_law_rebuilt_from_the_tables_alone(names):
    law, particle = paper_law(Unloading.PUNCH, StrainScaling.CONTACT), Particle(213.54, 196.07, 150.0)
    law = type(law)(law.plastic, law.a, 500.0, law.unloading, law.strain_scaling).with_effects(*names)
    assert_rebuilt(law, particle, curve_tables(law, particle))


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
    other = card(paper_law().with_effects("damage:threshold", "creep:logarithmic", Softer(0.3)), PARTICLE)
    plain = card(paper_law(), PARTICLE)
    assert "effects" not in plain
    assert len({written["sha256"], plain["sha256"], other["sha256"]}) == 3


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
        c_header(law, PARTICLE)
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
        c_header(paper_law().with_effects(effect), PARTICLE)
