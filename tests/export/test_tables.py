import jax.numpy as jnp
import numpy as np
import pytest
from compiling import PARTICLE
from helpers import FORMS
from hypothesis import given, settings
from hypothesis import strategies as st

from mcc_jax import InputError, MccLaw, Particle, Plastic, drive, paper_law
from mcc_jax.export import curve_tables, golden_pair_table, golden_table, write_export

TOLERANCE = 1e-5
numbers = st.tuples(
    st.floats(2, 20), st.floats(0, 0.99), st.floats(1.5, 4), st.floats(100, 1e5), st.sampled_from(FORMS)
)


@pytest.mark.extended
@settings(max_examples=20)
@given(numbers)
def test_linear_interpolation_is_within_the_stated_error(drawn):
    C1, share, C5, modulus, form = drawn
    law = MccLaw(Plastic(C1, share * (20 / 9 * C1 * C5**5) ** (1 / 6), C5), 1.43, modulus, *form)
    tables = curve_tables(law, PARTICLE)
    assert tables.error <= TOLERANCE
    x = np.random.default_rng(0).uniform(0, 0.67, 4000)
    at = tables.loading.set_index("scaled_strain")
    sphere = Particle(200.0, 200.0, 200.0)  # eta_p = 1
    for column, curve in (
        ("stress_MPa", law.plastic.stress),
        ("tangent_MPa", law.plastic.tangent),
        ("recovered_strain_at_eta_1", lambda x: law.recoverable_strain(sphere, x)),
    ):
        miss = np.abs(np.interp(x, at.index, at[column]) - np.asarray(curve(jnp.asarray(x))))
        assert miss.max() <= TOLERANCE * at[column].abs().max()


def interpolated(table, law, eta, peak):
    """Stress, and scaled strain recovered, from scaled peak strains, as `master_curve.json` says."""
    stress, tangent, formula = (
        np.interp(peak, table["scaled_strain"], table[name])
        for name in ("stress_MPa", "tangent_MPa", "recovered_strain_formula_at_eta_1")
    )
    delta = eta * eta ** ((1 - law.strain_scaling.power) / 2) * formula
    return stress, np.minimum(delta, np.minimum(peak, 3 * np.pi / 8 * stress / tangent))


@pytest.mark.parametrize(("form", "modulus"), [(FORMS[0], 16e3), (FORMS[3], 1e4), (FORMS[6], 100.0), (FORMS[8], 3.0)])
@pytest.mark.parametrize("D3", [150.0, 230.0])
def test_recovered_strain_of_any_shape(form, modulus, D3):
    """From the formula's column and its limit: flat and upright particles, any peak."""
    law, particle = MccLaw(paper_law().plastic, 1.43, modulus, *form), Particle(213.54, 196.07, D3)
    eta = float(law.shape_factor(particle))
    peak = 0.67 / eta * np.random.default_rng(1).uniform(0, 1, 4000) ** 4
    delta = interpolated(curve_tables(law, PARTICLE).loading, law, eta, eta * peak)[1] / eta
    want = np.asarray(law.recoverable_strain(particle, jnp.asarray(peak)))
    assert np.abs(delta - want).max() <= 3e-5 * want.max()


def test_the_unloading_curve_is_the_arcsine_law():
    table = curve_tables(paper_law(), PARTICLE).unloading
    s = np.random.default_rng(1).uniform(0, 1, 5000)
    want = 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
    assert np.abs(np.interp(s, table["recovered_share"], table["stress_share"]) - want).max() <= TOLERANCE


def assert_rebuilt(law, particle, tables):
    """An engine that interpolates gets the golden table's forces."""
    golden = golden_table(law, particle)
    eta, diameter = float(law.shape_factor(particle)), float(particle.effective_diameter)
    x, peak = eta * golden["displacement_um"] / diameter, eta * golden["displacement_max_um"] / diameter
    peak_stress, delta = interpolated(tables.loading, law, eta, peak)
    unloading = tables.unloading
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(x < peak, (peak - x) / delta, 0.0)
    stress = peak_stress * np.interp(share, unloading["recovered_share"], unloading["stress_share"])
    force = stress * float(particle.effective_area) * 1e-3
    assert np.abs(force - golden["force_mN"]).max() <= 2e-4 * golden["force_mN"].max()


@pytest.mark.parametrize("form", [FORMS[0], FORMS[4], FORMS[8]], ids=str)
def test_the_law_rebuilt_from_the_tables_alone(form):
    law = paper_law(*form)
    assert_rebuilt(law, Particle(213.54, 196.07, 150.0), curve_tables(law, PARTICLE))


def test_a_curve_with_a_corner_is_refused():
    with pytest.raises(InputError, match="corner"):
        curve_tables(MccLaw(Plastic(1.0, 4.0, 2.0), 1.43, 16000.0), PARTICLE)


def test_golden_table_is_the_law_driven_along_its_paths():
    """Half contacts at both platens: the tangent is half of that of a wall at half the displacement."""
    law, particle = paper_law(), PARTICLE
    table, walls = golden_table(law, particle, seed=3), golden_pair_table(law, particle, seed=3)
    for _, path in table.groupby("path"):
        force = drive(law, particle, jnp.asarray(path["displacement_um"].to_numpy())).force
        np.testing.assert_allclose(path["force_mN"], force, rtol=0, atol=1e-12 * float(force.max()))
        assert path["displacement_max_um"].is_monotonic_increasing
    wall = walls[walls["partner"] == "wall"]
    np.testing.assert_allclose(2 * table["tangent_mN_per_um"], wall["tangent_mN_per_um"], rtol=1e-14)
    first = table[table["path"] == 0]
    assert (first["displacement_um"] < 0).any()
    assert ((first["force_mN"] == 0) & (first["displacement_um"] > 0)).any()  # released
    reach = float(0.67 * particle.effective_diameter / law.shape_factor(particle))
    assert first["displacement_um"].max() == pytest.approx(reach, rel=1e-12)


def test_seed_and_units():
    ours, again, si, other = (golden_table(paper_law(), PARTICLE, **k) for k in ({}, {}, {"units": "SI"}, {"seed": 1}))
    assert ours.equals(again)
    assert not ours.equals(other)
    for one, two, factor in (
        ("displacement_um", "displacement_m", 1e-6),
        ("force_mN", "force_N", 1e-3),
        ("tangent_mN_per_um", "tangent_N_per_m", 1e3),
    ):
        np.testing.assert_allclose(ours[one] * factor, si[two], rtol=1e-15)


def test_every_digit_survives_the_file(tmp_path):
    write_export("json", paper_law(), PARTICLE, tmp_path)
    table = golden_table(paper_law(), PARTICLE)
    file = tmp_path / "parameters_golden.csv"
    assert file.read_text().startswith(",".join(table.columns) + "\n")
    np.testing.assert_array_equal(np.loadtxt(file, delimiter=",", skiprows=1), table.to_numpy(float))
