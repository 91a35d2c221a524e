"""What is said about each mechanism: names, units, signs, ranges; and how a user adds one."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tested import BASE, LAW, NAMES, PARTICLE, RECORD, VARIANTS, respond

from mcc_jax.effects import LIBRARY, AbstractEffect, Mechanism, Nuisance, find_variant

CONTRACT = [
    "frame_compliance", "thermal_drift", "creep", "rate_dependence", "adhesion", "damage", "densification_stiffening",
    "reload_hysteresis", "ratcheting", "finite_hardening_exponent", "unloading_shape", "size_effect",
    "shape_second_order", "pop_in", "toe_asperity", "platen_friction", "misalignment", "platen_sink_in",
    "reverse_plasticity", "humidity",
]  # fmt: skip
UNITS = {"um/mN": "_um_per_mN", "um/s": "_um_per_s", "1/MPa": "_per_MPa", "1/GPa": "_per_GPa", "MPa": "_MPa"}
UNITS |= {"um": "_um", "rad": "_rad", "1/%": "_per_percent_humidity", "1/K": "_per_kelvin"}
UNITS |= {"MPa um^0.5": "_MPa_sqrt_um"}
NUISANCE_UNITS = ("_s", "_MPa", "_mN", "_um", "_rad", "_percent", "_strain", "_share", "exponent", "cycles_to_rest")


def test_every_mechanism_of_the_contract_is_a_family():
    assert list(LIBRARY) == CONTRACT
    for name, mechanism in LIBRARY.items():
        assert mechanism.name == name
        assert len(mechanism.variants) >= 3
        assert mechanism[mechanism.variants[-1].name] is mechanism.variants[-1]
        assert not mechanism.opposite or LIBRARY[mechanism.opposite].opposite == name


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
def test_every_variant_says_what_it_is(variant):
    assert variant.typical * (variant.sign or 1) > 0
    assert variant.parameter.endswith(UNITS.get(variant.unit, ""))
    assert variant.unit in UNITS or (variant.unit == "-" and re.fullmatch(r"[a-z_]+", variant.parameter))
    assert all((variant.equation, variant.source, variant.explanation))
    assert all(nuisance.name.endswith(NUISANCE_UNITS) for nuisance in variant.nuisances)
    grid = variant.grid()
    assert len(grid) == np.prod([len(n.grid) for n in variant.nuisances], initial=1, dtype=int)
    for point in grid:
        effect = variant.build(0.5, **point)
        assert {name: float(getattr(effect, name)) for name in ("amplitude", *point)} == {"amplitude": 0.5, **point}
    with pytest.raises(ValueError, match=variant.parameter):
        variant.build(0.5, nonsense=1.0)


@pytest.mark.extended
def test_a_nuisance_has_no_meaning_at_the_null_and_some_beyond():
    for name in ("frame_compliance:stiffening", "creep:kelvin_voigt", "pop_in:sharp"):
        variant = find_variant(name)
        first, last = variant.grid()[0], variant.grid()[-1]
        np.testing.assert_allclose(respond(variant, 0.0, **first), respond(variant, 0.0, **last), rtol=1e-12)
        difference = respond(variant, variant.typical, **first) - respond(variant, variant.typical, **last)
        assert jnp.max(jnp.abs(difference)) > 1e-4, name


def test_what_differs_from_test_to_test_is_marked():
    assert {v.mechanism for v in VARIANTS if v.random_per_test} == {"thermal_drift"}
    assert all(v.sign == 0 for v in VARIANTS if v.random_per_test)
    assert {v.mechanism for v in VARIANTS if any(n.random_per_test for n in v.nuisances)} == {"thermal_drift", "pop_in"}


def test_names_lead_to_variants():
    assert find_variant("creep") is LIBRARY["creep"].variants[0]
    assert find_variant("creep:power_law").name == "power_law"
    with pytest.raises(ValueError, match="Known: frame_compliance, thermal_drift"):
        find_variant("wobble")
    with pytest.raises(ValueError, match="creep has no variant 'x'; it has: kelvin_voigt"):
        find_variant("creep:x")
    with pytest.raises(TypeError):
        LIBRARY["creep"] = None  # type: ignore[index]


def test_descriptions_without_sense_are_refused():
    variant = LIBRARY["creep"].variants[0]
    for change in ({"plausible": (2.0, 1.0)}, {"sign": 2}, {"nuisances": (Nuisance("x", (5.0,), (0.0, 1.0), ""),)}):
        with pytest.raises(ValueError, match="creep:kelvin_voigt"):
            dataclasses.replace(variant, **change)
    with pytest.raises(ValueError, match="two variants of one name"):
        Mechanism("creep", "Twice.", (variant, variant))
    with pytest.raises(ValueError, match="is not one of"):
        Mechanism("other", "Another.", (variant,))


class Careless(AbstractEffect):
    """A user's formula that is zero at amplitude 0 only but for rounding."""

    def inside(self, context):
        share = context.load_share
        return context.recoverable * (jnp.exp((1 + self.amplitude) * jnp.log(share + 0.1)) - (share + 0.1))


def test_the_null_is_exact_whatever_the_formula():
    run = lambda a: LAW.with_effects(Careless(a)).respond(PARTICLE, RECORD)  # noqa: E731
    value, slope = jax.jvp(run, (jnp.zeros(()),), (jnp.ones(()),))
    np.testing.assert_allclose(value, BASE, rtol=1e-12)
    np.testing.assert_allclose(slope, (run(1e-6) - run(-1e-6)) / 2e-6, atol=1e-6 * jnp.abs(slope).max())
