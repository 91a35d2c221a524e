"""Every column of the independently computed table of the paper's 20 particles, and what is said about them."""

import json
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import A, close, exact_elastic_shape_factor, paper_law

from mcc_jax.campaign.paper import PAPER_DIAMETERS_UM
from mcc_jax.geometry import Particle, elastic_shape_factor, plastic_shape_factor
from mcc_jax.law import StrainScaling, Unloading

LAW = paper_law()
CUT_OFF = 0.2  # MPa, where the paper's curves begin


@pytest.fixture(scope="module")
def expected():
    table = json.loads((Path(__file__).parents[1] / "data" / "twenty_particles.json").read_text(encoding="utf-8"))
    return {name: np.array(values, float) for name, values in table.items() if name != "about"}


def columns_of(particle):
    """All columns of one particle, from the library."""
    eta = plastic_shape_factor(particle, A)
    at = lambda stress: LAW.plastic.strain(jnp.array(stress)) / eta  # noqa: E731
    out = {
        "D1_um": particle.D1,
        "D2_um": particle.D2,
        "D3_um": particle.D3,
        "D_e_um": particle.effective_diameter,
        "R_e_um": particle.effective_radius,
        "D_avg_um": particle.mean_diameter,
        "avg_over_De": particle.mean_diameter / particle.effective_diameter,
        "D3sq_over_D1D2": 1 - particle.flatness,
        "eta_p": eta,
        # As the paper prints it, with D1/D2 whichever is larger.
        "eta_e_printed": 1 / (1 - ((particle.D1 / particle.D2) ** 0.1368 - 1) ** 1.531),
        "eta_e_sym": elastic_shape_factor(particle),
        "eps_0p2MPa": at(CUT_OFF),
        "F_0p2MPa_mN": particle.force(jnp.array(CUT_OFF)),
    }
    for stress in (7, 16):
        force = particle.force(jnp.array(float(stress)))
        state, displacement = LAW.step_load(particle, LAW.init(particle), force)
        strain = particle.strain(displacement)
        delta = LAW.recoverable_strain(particle, strain)
        master = paper_law(Unloading.PRINTED, StrainScaling.MASTER)
        punch = paper_law(Unloading.PUNCH).recoverable_strain(particle, strain)
        time = force / 2.0  # [mN/s], the rate of the tests
        released = LAW.energy(particle, state, jnp.array(0.0))
        values = {
            "eps_{}": strain,
            "eta_eps_{}": eta * strain,
            "gamma_{}_um": displacement,
            "gamma_over_D3_{}": displacement / particle.D3,
            "Fmax_{}_mN": LAW.step(particle, state, displacement)[1],
            "deps_printed_raw_{}": delta,
            "dgamma_printed_raw_{}_um": particle.displacement(delta),
            "eps_residual_printed_raw_{}": particle.strain(LAW.residual_displacement(particle, state)),
            "deps_printed_eta1_{}": LAW.recoverable_strain(Particle(100.0, 100.0, 100.0), eta * strain),
            "deps_printed_master_{}": master.recoverable_strain(particle, strain),
            "deps_squared_raw_{}": punch,
            "dgamma_squared_raw_{}_um": particle.displacement(punch),
            "t_load_{}_s": time,
            "t_cycle_{}_s": 2 * time,
            "E_diss_printed_raw_{}_nJ": released.dissipated,
        }
        out |= {name.format(f"{stress}MPa"): value for name, value in values.items()}
    return out


@pytest.fixture(scope="module")
def computed():
    particles = eqx.filter_vmap(Particle)(*jnp.asarray(PAPER_DIAMETERS_UM.T))
    exact = [exact_elastic_shape_factor(max(D1 / D2, D2 / D1)) for D1, D2, _ in PAPER_DIAMETERS_UM]
    columns = {"eta_e_exact": exact, **eqx.filter_jit(eqx.filter_vmap(columns_of))(particles)}
    return {name: np.asarray(column) for name, column in columns.items()}


def test_the_table_has_45_columns_and_all_are_computed(expected, computed):
    assert len(expected) == 45
    assert set(expected) == {"particle", *computed}
    np.testing.assert_array_equal(expected["particle"], np.arange(1, 21))


def test_every_column_is_that_of_the_table(expected, computed):
    for name, column in computed.items():
        nan = np.isnan(expected[name])
        assert nan.sum() == (12 if name == "eta_e_printed" else 0), name
        np.testing.assert_array_equal(np.isnan(column), nan, name)
        close(column[~nan], expected[name][~nan], rel=1e-8)
