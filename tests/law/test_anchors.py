"""Numeric anchors of the law, and tests that its specification asks for, by number; the others are in other files."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ALL_FORMS,
    EBAR,
    K1,
    A,
    check,
    close,
    force_along,
    paper_law,
    paper_particle,
    particle_of_shape,
    sphere,
)

from mcc_jax.geometry import Particle, plastic_shape_factor
from mcc_jax.law import History, StrainScaling, Unloading

CASES = {
    # stress, eps_P, delta, eps_f, loading tangent, onset tangent, w_load, w_rec, w_diss, F_P, E_diss
    ("sphere", 10): ("0.606348302816", "0.0158172259104", "0.590531076906", "74.4496015188", "804.970196385",
                     "1.56281630546", "0.0671303917237", "1.49568591374", "78.5398163397", "1174.70896967"),
    (1, 7): ("0.448764815105", "0.0153826451248", "0.433382169980", "64.2358355979", "579.398194577",
             "0.931712572438", "0.0457001815097", "0.886012390928", "277.589559618", "7895.00640556"),
    (1, 16): ("0.538652047060", "0.0212274210671", "0.517424625993", "144.074524958", "959.694192307",
              "1.91186723165", "0.144147156989", "1.76772007466", "634.490421983", "15751.65478"),
    (12, 10): ("0.428831502862", "0.0188082357440", "0.410023267118", "105.268361174", "676.958520758",
               "1.10528035101", "0.0798246317200", "1.02545571929", "275.525225175", "5291.92913593"),
    (16, 16): ("0.429751702184", "0.0237652610522", "0.405986441132", "180.583433186", "857.210559187",
               "1.52534126926", "0.161380640867", "1.36396062839", "1637.96824424", "50412.1402955"),
}  # fmt: skip
PUNCH_DELTA = {
    ("sphere", 10): "3.95368495622e-4",
    (1, 7): "3.21700535462e-4",
    (1, 16): "6.71164486821e-4",
    (12, 10): "4.70131988602e-4",
    (16, 16): "7.51405419802e-4",
}


def particle_of(name):
    return sphere(100.0) if name == "sphere" else paper_particle(name)


@pytest.mark.parametrize("case", CASES)
def test_anchor_cases(case):
    name, stress = case
    strain_text, delta, residual, tangent, onset, w_load, w_rec, w_diss, F, E_diss = CASES[case]
    p, law = particle_of(name), paper_law()
    peak_strain = law.plastic.strain(jnp.array(float(stress))) / law.shape_factor(p)
    peak = p.displacement(peak_strain)
    state = History(peak)
    check(peak_strain, strain_text)
    check(law.recoverable_strain(p, peak_strain), delta)
    check(law.residual_displacement(p, state) / p.effective_diameter, residual)
    check(jax.grad(lambda e: law.loading_stress(p, e))(peak_strain), tangent)
    per_strain = p.effective_diameter / p.force(jnp.array(1.0))
    below = jnp.nextafter(peak, 0.0)
    check(jax.grad(lambda d: law.step(p, state, d)[1])(peak) * per_strain, tangent)
    check(jax.grad(lambda d: law.step(p, state, d)[1])(below) * per_strain, onset, rel=1e-12)
    check(law.step(p, state, peak)[1], F)
    check(law.step_load(p, law.init(p), p.force(jnp.array(float(stress))))[1] / p.effective_diameter, strain_text)
    volume = p.force(jnp.array(1.0)) * p.effective_diameter  # nJ per MPa
    close(volume, 2 * np.pi * p.effective_radius**3 * 1e-3, rel=1e-14)
    check(law.contact(p).work(peak) / volume, w_load)
    at_peak, released = law.energy(p, state, peak), law.energy(p, state, peak - 0.1 * p.effective_diameter)
    check(at_peak.recoverable / volume, w_rec)
    check(released.dissipated / volume, w_diss)
    check(released.dissipated, E_diss)
    assert released.recoverable == 0
    close(released.work, released.dissipated)
    close(at_peak.work, law.contact(p).work(peak), rel=1e-15)
    check(paper_law(Unloading.PUNCH).recoverable_strain(p, peak_strain), PUNCH_DELTA[case])


# The table of JAX pitfalls: eta_p = 1.2442, eps_P = 0.45, printed form.
PITFALL = (paper_law(), particle_of_shape(1.2442))


def stress_at(strain, strain_max=0.45):
    """Stress along the branch as a function of strain, through `step`, so with its rule for ties."""
    law, p = PITFALL
    return p.stress(law.step(p, History(p.displacement(jnp.asarray(strain_max))), p.displacement(strain))[1])


DELTA = 0.015448848218415247


@pytest.mark.extended
@pytest.mark.parametrize(
    ("below", "value", "slope", "curvature"),
    [
        (0.0, "7.079815256080347", None, None),
        (1e-9, "7.079814672586946", "583.4933857862367", "2.4448e-3"),
        (DELTA / 2, "2.7682234749243193", "505.32009503107525", "21806.160471722833"),
        (2 * DELTA, "0", "0", "0"),
    ],
)
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_values_and_derivatives_on_the_branch(below, value, slope, curvature, mode):
    strain = jnp.array(0.45 - below)
    check(stress_at(strain), value, rel=1e-13)
    if slope is not None:
        check(mode(stress_at)(strain), slope, rel=2e-13)
        # 1e-9 below the onset, d2 is proportional to a difference of two strains: eps / 1e-9 of it is rounding.
        check(mode(jax.jacfwd(stress_at))(strain), curvature, rel=1e-6 if below == 1e-9 else 1e-12)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_at_the_onset(mode):
    """Exactly at the peak: the loading tangent. The branch itself starts with the slope 583.49 and no curvature."""
    law, p = PITFALL
    check(mode(stress_at)(jnp.array(0.45)), "65.02504900496756", rel=1e-13)
    check(
        4 / np.pi * stress_at(jnp.array(0.45)) / law.recoverable_strain(p, jnp.array(0.45)),
        "583.4933857862379",
        rel=1e-14,
    )
    check(law.recoverable_strain(p, jnp.array(0.45)), "0.015448848218415247")
    branch = lambda e: law.unloading_stress(p, e, jnp.array(0.45))  # noqa: E731
    check(branch(jnp.array(0.45)), "7.079815256080347")
    check(mode(branch)(jnp.array(0.45)), "583.4933857862379", rel=1e-13)
    assert mode(mode(branch))(jnp.array(0.45)) == 0
    check(mode(stress_at)(jnp.array(0.45 - 1e-12)), "583.4933857862379", rel=1e-9)
    assert jnp.isfinite(mode(mode(stress_at))(jnp.array(0.45 - 1e-12)))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("form", Unloading)
def test_derivatives_at_zero(mode, form):
    """The virgin tangent eta K1 = 8.72109548, whole and not in halves."""
    law, p = paper_law(form), PITFALL[1]
    virgin = lambda e: p.stress(law.step(p, law.init(p), p.displacement(e))[1])  # noqa: E731
    assert virgin(jnp.array(0.0)) == 0
    check(mode(virgin)(jnp.array(0.0)), "8.72109548", rel=1e-14)
    np.testing.assert_array_equal(mode(virgin)(jnp.array(-0.1)), 0)


@pytest.mark.parametrize(
    ("strain", "printed"), [(1e-4, "-6.014885e-8"), (1e-3, "-6.0148362e-6"), (1e-2, "-6.0099545e-4")]
)
def test_01_tabor_limit(strain, printed):
    """Small strain is the linear law of ideal plasticity: sigma -> eta K1 eps."""
    law, p = paper_law(), paper_particle(1)
    eta = plastic_shape_factor(p, A)
    # At 1e-4 the departure is 6e-8, of which double precision leaves nine digits at best.
    check(
        law.loading_stress(p, jnp.array(strain)) / (eta * K1 * strain) - 1,
        printed,
        rel=2e-16 / 6e-8 * (1e-4 / strain) ** 2,
    )


def test_02_rigid_limit():
    """A hundredfold modulus recovers a tenth (printed) or a hundredth (punch)."""
    p = sphere(100.0)
    for form, factor in ((Unloading.PRINTED, 10), (Unloading.PUNCH, 100)):
        soft, stiff = paper_law(form), paper_law(form, modulus=100 * EBAR)
        peak = soft.plastic.strain(jnp.array(10.0))
        close(soft.recoverable_strain(p, peak) / stiff.recoverable_strain(p, peak), factor, rel=1e-14)


@ALL_FORMS
def test_03_continuity_at_both_ends_of_the_branch(unloading, scaling):
    law, p = paper_law(unloading, scaling), paper_particle(6)
    peak = p.displacement(jnp.array(0.35))
    state, end = History(peak), law.residual_displacement(p, History(peak))
    force = eqx.filter_jit(lambda d: law.step(p, state, d)[1])
    slope = eqx.filter_jit(jax.grad(lambda d: law.step(p, state, d)[1]))
    top = float(force(peak))
    close(top, p.force(law.loading_stress(p, jnp.array(0.35))), rel=1e-14)
    close(force(jnp.nextafter(peak, 0.0)), top, rel=1e-12)
    # One rounding of the displacement, relative to the recovered displacement, is the accuracy of s.
    rounding = 2**-52 * peak / (peak - end)
    assert 0 <= force(end) <= 2 * top * (2 * rounding) ** 1.5
    assert 0 <= slope(end) <= top / (peak - end) * 4 * np.sqrt(2 * rounding)
    below = end - 2 * rounding * (peak - end)
    assert force(below) == 0
    assert slope(below) == 0
    for d in (below - 1.0, jnp.array(0.0), jnp.array(-10.0)):
        assert force(d) == 0


@pytest.mark.extended
def test_05_scale():
    """D -> 2D: the same stress-strain curve; displacement x2, force x4, energy x8."""
    law = paper_law()
    small = Particle(213.54, 196.07, 186.33)
    large = Particle(2 * 213.54, 2 * 196.07, 2 * 186.33)
    strain = jnp.concatenate([jnp.linspace(0, 0.5, 21), jnp.linspace(0.5, 0.48, 21)])
    one, other = (force_along(law, p, p.displacement(strain)) for p in (small, large))
    close(other, 4 * one, rel=1e-12)
    close(large.stress(other), small.stress(one), rel=1e-12)
    force = small.force(jnp.array(10.0))
    d_small, d_large = (law.step_load(p, law.init(p), k * force)[1] for p, k in ((small, 1), (large, 4)))
    close(d_large, 2 * d_small, rel=1e-14)
    lost = [law.energy(p, History(d), jnp.array(0.0)).dissipated for p, d in ((small, d_small), (large, d_large))]
    close(lost[1], 8 * lost[0], rel=1e-13)


def test_06_exchange_of_D1_and_D2():
    law = paper_law()
    path = jnp.concatenate([jnp.linspace(0, 60.0, 31), jnp.linspace(60, 50.0, 31)])
    p = paper_particle(20)
    q = Particle(p.D2, p.D1, p.D3)
    np.testing.assert_array_equal(force_along(law, p, path), force_along(law, q, path))


@pytest.mark.extended
@ALL_FORMS
def test_08_reload_retraces_and_rejoins(unloading, scaling):
    law, p = paper_law(unloading, scaling, modulus=3000.0), paper_particle(9)
    top, deep, further = (p.displacement(jnp.array(e)) for e in (0.40, 0.37, 0.45))
    up, down = jnp.linspace(0, top, 40), jnp.linspace(top, deep, 40)
    beyond = jnp.linspace(top, further, 40)
    path = jnp.concatenate([up, down, down[::-1], beyond])
    force = force_along(law, p, path)
    close(force[80:120], force[40:80][::-1], scale=2e-14 * float(force.max()))
    np.testing.assert_array_equal(force[120:], force_along(law, p, jnp.concatenate([up, beyond]))[40:])


@pytest.mark.extended
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@ALL_FORMS
def test_09_sum_rule_at_the_onset(unloading, scaling, mode):
    """Along eps = eps_P the branch is the loading curve: d sigma/d eps + d sigma/d eps_P = loading tangent."""
    law, p = paper_law(unloading, scaling), PITFALL[1]
    strain = jnp.array(0.45)
    by_strain, by_peak = mode(lambda e, P: law.unloading_stress(p, e, P), argnums=(0, 1))(strain, strain)
    tangent = jax.grad(lambda e: law.loading_stress(p, e))(strain)
    close(by_strain + by_peak, tangent, scale=1e-12 * abs(float(by_strain)))
    check(tangent, "65.02504900496756", rel=1e-13)
    if (unloading, scaling) == (Unloading.PRINTED, StrainScaling.RAW):
        check(by_strain, "583.4934")
        check(by_peak, "-518.4683")


@ALL_FORMS
def test_14_monotone_and_bounded_on_unloading(unloading, scaling):
    law, p = paper_law(unloading, scaling), paper_particle(18)
    for strain_max in (0.005, 0.05, 0.4, 0.6):
        delta = law.recoverable_strain(p, jnp.array(strain_max))
        strain = jnp.linspace(strain_max - 1.1 * delta, strain_max, 2001)
        peak = law.loading_stress(p, jnp.array(strain_max))
        stress = law.unloading_stress(p, strain, jnp.array(strain_max))
        assert jnp.all(jnp.diff(stress) >= -1e-15 * peak)
        assert jnp.all(stress >= 0)
        assert jnp.all(stress <= peak)
        assert stress[0] == 0
        assert stress[-1] == peak
