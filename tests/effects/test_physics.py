"""What each mechanism must do: signs, limits, closed forms."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import paper_particle, sphere
from tested import BASE, FORCE, LAW, PARTICLE, RECORD, TIME, VARIANTS, added, base, lanes, respond

from mcc_jax.effects import LIBRARY, clean_record
from mcc_jax.formulas import recovery
from mcc_jax.law import MccLaw, Plastic, signatures


def family(*names):
    return pytest.mark.parametrize("variant", [v for v in VARIANTS if v.mechanism in names], ids=lambda v: v.label)


def shift(variant):
    """What the effect adds at its typical amplitude [um]."""
    values, _ = lanes(variant)
    return values[4] - values[0]


def at(time):
    return int(np.flatnonzero(np.asarray(TIME) == time)[0])


POINTS = FORCE.size
"""Every record has as many points as that of `lanes`: operations are compiled for a shape."""


def filled(values):
    """Repeat the last point, which changes nothing, up to the common number of points."""
    return jnp.asarray(np.pad(values, (0, POINTS - len(values)), mode="edge"))


def ramp_and_hold(force=200.0, seconds=2000.0, ramp=1e-3):
    """Almost a step of load, held."""
    time = np.concatenate([[0.0, ramp], ramp + np.geomspace(1e-2, seconds, POINTS - 2)])
    return clean_record(jnp.minimum(jnp.asarray(time) / ramp, 1.0) * force, jnp.asarray(time))


ADDING = ("frame_compliance", "creep", "toe_asperity", "misalignment", "platen_sink_in", "pop_in", "ratcheting")
TAKING = ("platen_friction", "reverse_plasticity", "reload_hysteresis")


@family(*ADDING, *TAKING)
def test_adds_displacement_or_takes_it_away(variant):
    change = shift(variant)
    if variant.mechanism in ADDING:
        assert change.min() >= -1e-12
        assert change.max() > 1e-3
        assert abs(change[0]) < 1e-12
    else:
        assert change.max() <= 1e-9
        assert change.min() < -1e-2


@family("frame_compliance")
def test_a_frame_knows_only_force(variant):
    moved = shift(variant)
    for force in (160.0, 100.0, 200.0, 0.0):
        same = np.asarray(FORCE) == force
        np.testing.assert_allclose(moved[same], moved[same][0], atol=1e-12)
    order = np.argsort(np.asarray(FORCE), kind="stable")
    assert (np.diff(moved[order]) >= -1e-12).all()


@pytest.mark.extended
def test_drift_knows_only_time():
    variants = LIBRARY["thermal_drift"].variants
    other = signatures(LAW, PARTICLE, clean_record(0.3 * FORCE, TIME), [v.build(0.0) for v in variants])
    for variant, slope in zip(variants, other, strict=True):
        np.testing.assert_allclose(shift(variant), variant.typical * np.asarray(slope), atol=1e-11)


@family("creep")
def test_creep_makes_a_nose(variant):
    """Displacement goes on growing in a hold; in the hold at no load it comes back, or stays."""
    crept = shift(variant)
    assert crept[at(280.0)] > crept[at(240.0)] + 1e-4
    assert crept[at(390.0)] <= crept[at(380.0)] + 1e-12


def test_creep_functions_are_those_of_their_names():
    record, amplitude = ramp_and_hold(), 1e-4
    scale = amplitude * PARTICLE.effective_diameter * PARTICLE.stress(jnp.asarray(200.0))
    time = np.asarray(record.time)[2:]
    late = time > 0.3

    def creep(name, **nuisance):
        return (added(LIBRARY["creep"][name], amplitude, record, **nuisance) / scale)[2:]

    np.testing.assert_allclose(creep("kelvin_voigt", tau_s=20.0), -np.expm1(-time / 20), atol=1e-4)
    np.testing.assert_allclose(creep("logarithmic", tau_s=10.0), np.log1p(time / 10), atol=2e-3, rtol=2e-3)
    for n in (0.2, 0.4):
        np.testing.assert_allclose(creep("power_law", exponent=n)[late], (time[late] / 100) ** n, rtol=0.01)
    np.testing.assert_allclose(creep("viscous_flow"), time / 100, atol=1e-5)
    np.testing.assert_allclose(creep("viscoplastic", tau_s=10.0), np.log1p(time / 10), atol=1e-3)
    np.testing.assert_allclose(creep("viscoplastic_root", tau_s=10.0), np.cbrt(1 + time / 10) - 1, atol=1e-3)
    np.testing.assert_allclose(creep("hold_logarithmic", tau_s=10.0), np.log1p((time - 1e-3) / 10), atol=1e-9)
    np.testing.assert_allclose(creep("hold_kelvin", tau_s=20.0), -np.expm1(-(time - 1e-3) / 20), atol=1e-9)
    spread = creep("distributed", tau_s=20.0)
    assert (np.diff(spread) > 0).all()
    assert 0.45 < np.interp(14.0, time, spread) < 0.55
    assert spread[-1] > 0.97


def test_creep_of_a_slow_ramp_is_the_closed_form():
    """Ramp of stress with Kelvin-Voigt and logarithmic creep functions, whatever the sampling."""
    end, amplitude = 100.0, 1e-4
    exact = {"kelvin_voigt": end - 20 * -np.expm1(-end / 20), "logarithmic": (end + 20) * np.log1p(end / 20) - end}
    for points in (3, 40):
        time = filled(np.linspace(0.0, end, points))
        record = clean_record(2.0 * time, time)
        scale = amplitude * PARTICLE.effective_diameter * PARTICLE.stress(jnp.asarray(2.0))
        for name, value in exact.items():
            crept = added(LIBRARY["creep"][name], amplitude, record, tau_s=20.0)[-1]
            np.testing.assert_allclose(crept / scale, value, rtol=2e-3)


def test_creep_under_a_round_contact_is_that_of_lee_and_radok():
    """After a step of load d^(3/2) = d_0^(3/2) (1 + c (1 - exp(-t / tau)))."""
    record = ramp_and_hold()
    crept = added(LIBRARY["creep"]["growing_contact"], 0.1, record, tau_s=40.0)[1:]
    first, time = float(base(record)[1]), np.asarray(record.time)[1:]
    np.testing.assert_allclose((1 + crept / first) ** 1.5, 1 - 0.1 * np.expm1(-time / 40.0), rtol=1e-4)


def test_creep_of_a_hold_needs_a_hold_and_begins_again_with_each():
    """Nothing on ramps; two holds of ten seconds make twice what one makes, not what one of twenty makes."""
    time = filled(np.linspace(0.0, 60.0, 61))
    ramps = jnp.interp(time, jnp.asarray([0.0, 30.0, 60.0]), jnp.asarray([0.0, 200.0, 0.0]))
    turns, forces = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0], [0.0, 200.0, 200.0, 100.0, 200.0, 200.0, 0.0]
    holds = jnp.interp(time, jnp.asarray(turns), jnp.asarray(forces))
    scale = 1e-4 * PARTICLE.effective_diameter * PARTICLE.stress(jnp.asarray(200.0))
    for name, once in (("hold_logarithmic", np.log1p(1.0)), ("hold_kelvin", -np.expm1(-1.0))):
        none, twice = (
            added(LIBRARY["creep"][name], 1e-4, clean_record(force, time), tau_s=10.0) / float(scale)
            for force in (ramps, holds)
        )
        np.testing.assert_allclose(none, 0, atol=1e-12)
        np.testing.assert_allclose(twice[[10, 20, 40, 50, 60]], once * np.array([0, 1, 1, 2, 2]), atol=1e-9)


@pytest.mark.extended
def test_faster_loading_is_harder():
    """At one force the displacement falls with the rate, or is that of the reference rate."""
    time = jnp.linspace(0.0, 1.0, 60)
    variants = LIBRARY["rate_dependence"].variants
    effects = [v.build(0.0) for v in variants]

    @jax.vmap
    def change(seconds):
        return signatures(LAW, PARTICLE, clean_record(200.0 * time, seconds * time), effects)[:, -1]

    slow, fast = jax.jit(change)(jnp.asarray([1000.0, 30.0]))
    assert jnp.all(fast < slow - 3), [v.name for v in variants]


def test_activated_flow_is_viscous_when_slow_and_logarithmic_when_fast():
    effect = LIBRARY["rate_dependence"]["flow_eyring"].build(0.01, rate_share=1.0)
    rate = jnp.asarray([1e-3, 1e-2, 1e2, 1e3])
    np.testing.assert_allclose(effect.factor(rate[:2]), 1 + 0.01 * rate[:2], rtol=1e-6)
    np.testing.assert_allclose(effect.factor(rate[2:]), 1 + 0.01 * np.log(2 * rate[2:]), rtol=1e-6)


def test_a_constant_pull_depends_on_what_the_load_has_lost():
    """u' = u + k (1 - u') phi^2 / (phi^2 + 0.3^2), solved again by repetition; the pull does not fade half way."""
    variant, stress = LIBRARY["adhesion"]["constant_nominal"], 0.5
    force = 200.0 * np.concatenate([np.linspace(0.01, 1.0, 50), np.linspace(0.95, 0.05, 40)])
    record = clean_record(filled(force), filled(np.linspace(0.0, 200.0, len(force))))
    pulled = added(variant, stress, record)[50 : len(force)]
    k = stress / float(PARTICLE.stress(jnp.asarray(200.0)))
    u = carried = force[50:] / 200.0
    for _ in range(100):
        contact = 1 - np.asarray(recovery(carried)) ** 2
        pull = (1 - carried) * contact / (contact + 0.09)
        carried = u + k * pull
    delta = float(LAW.recoverable_displacement(PARTICLE, base(record)[49], jnp.asarray(200.0), jnp.asarray(1.0)))
    np.testing.assert_allclose(pulled, delta * np.asarray(recovery(u) - recovery(carried)), rtol=1e-6)
    assert (np.diff(pull[:35]) > 0).all()


def test_a_flat_contact_pulls_off_at_kendalls_force():
    """The strength of the pull over the peak force is sqrt(8 pi a^3 E* w) / F_P, with K_c = sqrt(2 E* w)."""
    modulus, work = 5000.0, 0.01  # MPa, N/m
    record = clean_record(filled(np.array([0.0, 200.0, 100.0])), filled(np.array([0.0, 100.0, 150.0])))
    toughness = np.sqrt(2 * modulus * work)
    pulled = added(LIBRARY["adhesion"]["kendall"], toughness, record)[2]
    peak = float(base(record)[1])
    radius = np.sqrt(1.43 * float(PARTICLE.effective_diameter) * peak / 2)
    pull_off = 1e-3 * np.sqrt(8 * np.pi * radius**3 * modulus * work)  # mN
    equal = added(LIBRARY["adhesion"]["jkr_nominal"], 1e3 * pull_off / float(PARTICLE.effective_area), record)[2]
    assert pulled == pytest.approx(equal, rel=1e-3)  # the root of a small radius is rounded
    assert 1 < pull_off < 100


@pytest.mark.extended
@family("adhesion")
def test_adhesion_holds_the_particle_back(variant):
    """It acts on the elastic branch only, adds displacement there, most close to release."""
    pulled, force = shift(variant), np.asarray(FORCE)
    virgin = force >= np.maximum.accumulate(force)
    assert np.abs(pulled[virgin]).max() < 1e-12
    assert pulled.min() >= -1e-12
    assert pulled[at(380.0)] > 0
    branch = slice(at(280.0), at(380.0) + 1)
    assert pulled[branch].argmax() > 0.6 * (branch.stop - branch.start)


@pytest.mark.parametrize("name", ["damage", "densification_stiffening"])
def test_damage_softens_and_densification_stiffens_unloading(name):
    """Recovery from the highest peak grows or falls, and loading stays as it was."""
    sign = 1 if name == "damage" else -1
    force = np.asarray(FORCE)
    virgin = force >= np.maximum.accumulate(force)
    for variant in LIBRARY[name]:
        if variant.name.startswith("locking"):  # loading itself stiffens: below
            continue
        values, _ = lanes(variant)
        np.testing.assert_allclose(values[4][virgin], values[0][virgin], rtol=1e-12)
        recovered = values[:, at(280.0)] - values[:, at(380.0)]
        assert sign * (recovered[4] - recovered[0]) > 1e-3, variant.name


def test_the_hysteresis_loop_dissipates():
    """Work put in by a full reload minus that given back by the unloading before it, and the loop closes."""
    time = jnp.asarray(np.linspace(0.0, 6.0, POINTS))
    part = (POINTS - 1) // 6
    force = jnp.interp(time, jnp.arange(7.0), jnp.asarray([0.0, 200.0, 20.0, 200.0, 20.0, 200.0, 0.0]))
    record = clean_record(force, time)
    for variant in LIBRARY["reload_hysteresis"]:
        displacement = np.asarray(respond(variant, variant.typical, record=record))
        loop = slice(part, 3 * part + 1)
        work = np.trapezoid(np.asarray(force)[loop], displacement[loop])
        assert work > 0.1, variant.name
        np.testing.assert_allclose(displacement[3 * part], displacement[part], rtol=1e-12)
        again = displacement[3 * part : 5 * part + 1]
        np.testing.assert_allclose(displacement[loop], again, rtol=1e-9)


def test_an_inner_loop_closes_and_is_forgotten():
    """The lag of plays is h Delta half way from full release, and what was reloaded and released leaves no trace."""
    variant = LIBRARY["reload_hysteresis"]["return_point"]
    outer = np.array([0.0, 200.0, 0.0, 100.0, 200.0])
    inner = np.array([0.0, 200.0, 0.0, 100.0, 60.0, 100.0, 200.0])
    lags = [
        added(variant, 0.2, clean_record(filled(force), filled(10.0 * np.arange(len(force)))))
        for force in (outer, inner)
    ]
    strain = LAW.plastic.strain(PARTICLE.stress(jnp.asarray(200.0))) / LAW.shape_factor(PARTICLE)
    peak = PARTICLE.displacement(strain)
    delta = float(LAW.recoverable_displacement(PARTICLE, peak, jnp.asarray(200.0), jnp.asarray(1.0)))
    assert lags[0][3] == pytest.approx(-0.2 * delta, rel=1e-9)
    np.testing.assert_allclose(lags[1][[3, 5, 6]], lags[0][[3, 3, 4]], atol=1e-12)
    assert lags[1][4] > lags[1][3]  # the inner loop has a width of its own
    assert abs(lags[0][4]) < 1e-12


def test_ratcheting_counts_reloads():
    time = filled(np.linspace(0.0, 7.0, 106))
    force = jnp.interp(time, jnp.arange(8.0), jnp.asarray([0.0, 200.0, 0.0, 200.0, 0.0, 200.0, 0.0, 200.0]))
    record = clean_record(force, time)
    for variant in LIBRARY["ratcheting"]:
        grown = added(variant, variant.typical, record)
        steps = np.diff(grown[[15, 45, 75, 105]])
        assert (np.diff(grown) >= -1e-10).all()
        assert (steps > 1e-3).all()
        if variant.name in ("linear", "elastic_share", "peak_share", "late"):
            np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
        elif variant.name == "power":
            np.testing.assert_allclose(steps, steps[0] * np.array([1, 3, 5]), rtol=1e-9)
        else:
            assert (np.diff(steps) < 0).all()


@family("unloading_shape")
def test_another_shape_keeps_both_ends(variant):
    bent, force = shift(variant), np.asarray(FORCE)
    ends = (force >= np.maximum.accumulate(force)) | (force <= 0)
    assert np.abs(bent[ends]).max() < 1e-9
    assert np.abs(bent).max() > 1e-3


def test_the_whole_of_a_power_law_unloads_by_it():
    """F / F_P = ((d - d_0) / (d_P - d_0))^m; with m = 3/2 the arcsine is nearly that already."""
    variant = LIBRARY["unloading_shape"]["power_law"]
    force = 200.0 * np.concatenate([np.linspace(0.01, 1.0, 50), np.linspace(0.99, 0.0, POINTS - 50)])
    record = clean_record(jnp.asarray(force), jnp.asarray(np.linspace(0.0, 200.0, len(force))))
    left = {}
    for m in (1.2, 1.5, 2.0):
        response = np.asarray(LAW.with_effects(variant.build(1.0, exponent=m)).respond(PARTICLE, record))[49:]
        recovering = (response - response[-1]) / (response[0] - response[-1])
        np.testing.assert_allclose(recovering[:-1] ** m, force[49:-1] / force.max(), rtol=1e-9)
        left[m] = np.abs(response - np.asarray(base(record))[49:]).max() / (response[0] - response[-1])
    assert left[1.5] < 0.05 < min(left[1.2], left[2.0])


def test_sizes_and_shapes_that_are_the_reference_feel_nothing_and_small_particles_are_stronger():
    for name, particle in (("size_effect", sphere(200.0)), ("shape_second_order", sphere(150.0))):
        for variant in LIBRARY[name]:
            other = respond(variant, variant.typical, particle=particle)
            np.testing.assert_allclose(other, base(RECORD, particle), rtol=1e-12)
    small, record = sphere(100.0), clean_record(0.2 * FORCE, TIME)
    for variant in LIBRARY["size_effect"]:
        assert respond(variant, 0.3, particle=small, record=record).max() < base(record, small).max()


def test_shape_is_the_shape_factor():
    """1 + b q^2 on eta_p: the response of a law whose a gives the same shape factor."""
    variant, b = LIBRARY["shape_second_order"]["flatness_squared"], 0.4
    q = float(PARTICLE.flatness)
    eta = (1 + 1.43 * q) * (1 + b * q * q)
    law = replace(LAW, a=jnp.asarray((eta - 1) / q))
    np.testing.assert_allclose(respond(variant, b), law.path_load(PARTICLE, law.init(PARTICLE), FORCE)[1], rtol=1e-9)


def test_a_length_of_the_material_is_that_of_nix_and_gao():
    """Strength^2 is linear in 1 / D_e, with the ratio of slope to intercept the length."""
    effect = LIBRARY["size_effect"]["strain_gradient"].build(50.0)
    small, large = (float(effect.modify(LAW, sphere(d), RECORD).plastic.C1) for d in (50.0, 1e6))
    assert (small / large) ** 2 == pytest.approx((1 + 50 / 50) / (1 + 50 / 1e6), rel=1e-9)


def test_a_pop_in_is_a_step_that_stays():
    variant = LIBRARY["pop_in"]["sharp"]
    jump = added(variant, 0.7, location_MPa=2.0)
    stress = np.maximum.accumulate(np.asarray(PARTICLE.stress(FORCE)))
    np.testing.assert_allclose(jump[stress < 1.97], 0, atol=1e-12)
    np.testing.assert_allclose(jump[stress > 2.03], 0.7, atol=1e-12)


def test_an_elastic_onset_is_hertz_up_to_yield_and_the_law_beyond():
    """F ~ d^(3/2) below the stress of yield; there the slope is that of a linear law, and stays."""
    law = MccLaw(Plastic(6.0, 0.0, 1e-9), 0.0, 16_000.0)
    yields, effect = 4.0, LIBRARY["toe_asperity"]["hertz"]
    toe = 0.5 * yields / 6.0  # strain
    stress = np.linspace(0.0, 12.0, POINTS)
    record = clean_record(PARTICLE.force(jnp.asarray(stress)), jnp.linspace(0.0, 100.0, POINTS))
    strain = np.asarray(PARTICLE.strain(respond(effect, toe, law=law, record=record, stress_scale_MPa=yields)))
    elastic = stress <= yields
    np.testing.assert_allclose(strain[elastic], 1.5 * yields / 6.0 * (stress[elastic] / yields) ** (2 / 3), atol=1e-4)
    np.testing.assert_allclose(strain[~elastic], stress[~elastic] / 6.0 + toe, rtol=1e-6)


def test_asperities_stay_flat():
    for variant in LIBRARY["toe_asperity"]:
        flat = added(variant, 0.01)
        last = 0.0 if variant.name.startswith("elastic") else flat.max()
        assert flat[at(380.0)] == pytest.approx(last, rel=1e-9, abs=1e-9)


@pytest.mark.extended
def test_friction_and_hardening_meet_the_stress_they_say():
    """The solved strain fulfils the equation: stress of the law times the factor is the stress applied."""
    force = jnp.linspace(0.0, 300.0, POINTS)
    record = clean_record(force, force / 2)

    def times(factor):
        return lambda e, a: LAW.loading_stress(PARTICLE, e) * factor(e, a)

    def every_term(e, a):
        return LAW.loading_stress(PARTICLE, 0.2 * (e / 0.2) ** (1 + a / 2))

    grown = lambda e: np.expm1(15 * e) - 15 * e  # noqa: E731
    for mechanism, name, stress in (
        ("platen_friction", "strain", times(lambda e, a: 1 + a * e)),
        ("densification_stiffening", "locking", times(lambda e, a: 1 + a * (e / 0.5) ** 8)),
        ("densification_stiffening", "locking_exponential", times(lambda e, a: 1 + a * grown(e) / grown(0.5))),
        ("finite_hardening_exponent", "all_terms", times(lambda e, a: (e / 0.2) ** (a / 2))),
        ("finite_hardening_exponent", "every_term", every_term),
        ("finite_hardening_exponent", "every_term_and_unloading", every_term),
    ):
        variant = LIBRARY[mechanism][name]
        strain = PARTICLE.strain(respond(variant, variant.typical, record=record))[1:]
        np.testing.assert_allclose(stress(strain, variant.typical), PARTICLE.stress(force)[1:], rtol=1e-9)


@pytest.mark.extended
def test_dry_air_hardens_and_an_unknown_humidity_does_nothing():
    effects = [LIBRARY["humidity"][name].build(0.0) for name in ("C1", "flow", "flow_and_modulus", "flow_linear")]

    @jax.vmap
    def change(humidity):
        record = eqx.tree_at(lambda r: r.relative_humidity, RECORD, humidity)
        return signatures(LAW, PARTICLE, record, effects)

    dry, reference, wet = jax.jit(change)(jnp.asarray([20.0, 45.0, 70.0]))
    assert jnp.all(dry[:, at(280.0)] < -10)
    assert jnp.all(wet[:, at(280.0)] > 10)
    np.testing.assert_array_equal(reference, 0)
    assert clean_record(FORCE, TIME).relative_humidity == 45


def test_strength_follows_the_glass_transition_and_a_sigmoid():
    """Water of an isotherm lowers T_g by Gordon and Taylor; a sigmoid is half way at its middle."""

    def strength(name, amplitude, humidity, **further):
        record = eqx.tree_at(lambda r: r.relative_humidity, RECORD, jnp.asarray(humidity))
        law = LIBRARY["humidity"][name].build(amplitude, **further).modify(LAW, PARTICLE, record)
        return float(law.plastic.C1 / LAW.plastic.C1)

    water = {rh: 0.036 * 12 * 0.75 * rh / ((1 - 0.75 * rh) * (1 - 0.75 * rh + 9 * rh)) for rh in (0.45, 0.8)}
    assert water[0.45] == pytest.approx(0.047, abs=1e-3)
    k = 1.55 * 493 / 136
    glass = {rh: (493 + k * w * 136) / (1 + k * w) for rh, w in water.items()}
    assert strength("flow_glass_transition", 0.01, 80.0) == pytest.approx(np.exp(0.01 * (glass[0.8] - glass[0.45])))
    assert strength("flow_sigmoid", 0.5, 45.0, middle_percent=60.0) == pytest.approx(1.0)
    dry, half, wet = (strength("flow_sigmoid", 0.5, rh, middle_percent=60.0) for rh in (0.0, 60.0, 100.0))
    assert half == pytest.approx((dry + wet) / 2, abs=2e-3)


def test_water_softens_yield_and_modulus_at_two_rates():
    both = LIBRARY["humidity"]["C1_and_modulus"].build(0.01, modulus_share=0.5)
    wet = eqx.tree_at(lambda r: r.relative_humidity, RECORD, jnp.asarray(65.0))
    law = both.modify(LAW, PARTICLE, wet)
    np.testing.assert_allclose(law.plastic.C1, LAW.plastic.C1 * np.exp(-0.2), rtol=1e-12)
    np.testing.assert_allclose(law.effective_modulus, LAW.effective_modulus * np.exp(-0.1), rtol=1e-12)
    np.testing.assert_array_equal((law.plastic.C3, law.plastic.C5), (LAW.plastic.C3, LAW.plastic.C5))
    alone = LIBRARY["humidity"]["C1"].build(0.01).modify(LAW, PARTICLE, wet)
    none = LIBRARY["humidity"]["C1_and_modulus"].build(0.01, modulus_share=0.0).modify(LAW, PARTICLE, wet)
    assert eqx.tree_equal(none, alone, rtol=1e-12)


def test_a_stiff_platen_does_not_give_way():
    """The sink-in of a flat punch: F / (2 a E*), with the contact radius of the law."""
    variant = LIBRARY["platen_sink_in"]["flat"]
    top = at(240.0)
    strain = float(BASE[top] / PARTICLE.effective_diameter)
    radius = 2 * float(PARTICLE.effective_radius) * np.sqrt(1.43 * strain / 2)  # each platen takes half
    assert added(variant, 0.1)[top] == pytest.approx(0.1 * 300.0 / (2 * radius), rel=2e-3)


@pytest.mark.extended
def test_particles_whose_law_is_not_monotone_stay_finite():
    law = MccLaw(Plastic(4.0, 3.0, 2.4), 1.43, 16e3)
    particle = paper_particle(6)
    record = clean_record(0.5 * FORCE, TIME)
    for names in (("platen_friction", "rate_dependence"), ("size_effect", "damage", "creep")):
        effects = tuple(LIBRARY[n].variants[0].build(LIBRARY[n].variants[0].typical) for n in names)
        displacement = law.with_effects(*effects).respond(particle, record)
        assert jnp.all(jnp.isfinite(displacement))
        assert 0.5 < float(displacement.max() / law.path_load(particle, law.init(particle), 0.5 * FORCE)[1].max()) < 1.5
