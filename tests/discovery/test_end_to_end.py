"""From curves to an answer: a hidden effect is named, nothing hidden is nothing found, the rest is declared."""

import dataclasses
import json

import numpy as np
import pytest
from campaigns import QUICK, SINGLE, cached, campaign, found_in, with_curves

from mcc_jax import InputError
from mcc_jax.campaign import available_data
from mcc_jax.discovery import discover
from mcc_jax.discovery.screen import untestable
from mcc_jax.effects import EQUIVALENCES, LIBRARY

COMPLIANCE = 0.004
FEW = {name: LIBRARY[name] for name in ("frame_compliance", "damage")}


@pytest.fixture(scope="module", params=["few", "all"])
def named(request):
    """What is found among few mechanisms, without the posterior, and among all."""
    frame = f"frame_compliance={COMPLIANCE}"
    if request.param == "all":
        return found_in(frame)
    return discover(cached(frame), library=FEW, experiments=False, posterior=False)


def content(found):
    """What `discovery.json` would contain, through text and back: no NaN, no infinity."""
    return json.loads(json.dumps(found.to_json(), allow_nan=False))


def test_a_hidden_effect_is_named_and_its_amplitude_found(named):
    told = content(named)
    assert told["verdict"] in ("NAMED", "SET")
    (names,), (first,) = told["candidate_set"], told["effects"]
    assert "frame_compliance" in names
    assert {one["mechanism"]: one["probability"] for one in told["ranking"]}["frame_compliance"] > 0.3
    assert first["p_family_wise"] < 0.05
    if first["mechanism"] == "frame_compliance":
        estimate = first["parameters"]["compliance_um_per_mN"]
        assert abs(estimate["value"] - COMPLIANCE) < 3 * estimate["sd"] + 0.05 * COMPLIANCE
    declared = told["equivalent_by_construction"]
    assert [tuple(one["names"]) for one in declared] == [e.names for e in EQUIVALENCES]
    assert all(one["why"] and one["told_apart_by"] for one in declared)


def test_adding_it_closes_the_gap_and_brings_the_modulus_back(named):
    told = content(named)
    assert told["gap"]["closed_fraction"] > 0.9
    first, last = told["gap"]["steps"]
    assert (first["added"], last["added"]) == (None, told["effects"][0]["mechanism"])
    assert last["chi2_per_dof"] < first["chi2_per_dof"]
    assert last["systematic_um"] < first["systematic_um"]
    assert last["elpd"] > 2 * last["elpd_se"]
    before, after = (told[f"parameters_{w}"]["effective_modulus_MPa"]["value"] for w in ("before", "after"))
    assert abs(np.log(after / 16_000)) < 0.5 * abs(np.log(before / 16_000))


def test_the_answer_says_where(named):
    told = content(named)
    shares = [place["share"] for place in told["where"]]
    assert shares == sorted(shares, reverse=True)
    assert 0 < sum(shares) <= 1 + 1e-9
    for place in told["where"]:
        assert set(place["particles"]) <= set(named.base.campaign.particles)
        low, high = place["load_fraction"]
        assert 0 <= low < high <= 1
    assert "disagree" in told["summary"]
    assert "held-out" in told["summary"]


def test_what_was_added_is_an_ordinary_part_of_the_law(named):
    effect = named.effects[0]
    built = effect.build()
    assert float(built.amplitude) == pytest.approx(effect.amplitude)
    assert [v.mechanism for v in named.model.effects] == [effect.mechanism]
    assert named.outcome == named.verdict
    assert [type(e) for e in named.law().effects] == [type(built)]
    with pytest.raises(InputError, match="takes its posterior"):
        dataclasses.replace(named, posterior=None).law(named.base.campaign.particles[2])


@pytest.mark.extended
def test_a_particle_has_its_own_law_with_what_was_added():
    found = found_in(f"frame_compliance={COMPLIANCE}")
    name = found.base.campaign.particles[2]
    own, typical = found.law(name), found.law()
    assert [type(e) for e in own.effects] == [type(e) for e in typical.effects] == [type(found.effects[0].build())]
    assert float(own.plastic.C1) == float(found.posterior.law(name).plastic.C1) != float(typical.plastic.C1)
    with pytest.raises(InputError, match="no particle 'none'"):
        found.law("none")


@pytest.mark.extended
def test_nothing_hidden_nothing_found():
    told = content(found_in(seed=1))
    assert told["verdict"] == "NO_GAP"
    assert told["effects"] == told["candidate_set"] == told["where"] == told["leads"] == []
    assert told["p_anything_missing"] > 0.05
    assert told["closure"] is None
    assert "agree" in told["summary"]


@pytest.mark.extended
def test_an_excluded_name_is_not_named():
    whole = cached(f"frame_compliance={COMPLIANCE}")
    told = content(discover(whole, library=FEW, exclude=("frame_compliance",), **QUICK))
    assert told["verdict"] != "NO_GAP"
    reported = [*told["effects"], *told["ranking"]]
    names = {name for names in told["candidate_set"] for name in names} | {one["mechanism"] for one in reported}
    assert "frame_compliance" not in names
    with pytest.raises(InputError, match="no mechanism 'wobble'"):
        discover(whole, exclude=("wobble",))
    with pytest.raises(InputError, match="no mechanism is left"):
        discover(whole, library=FEW, exclude=tuple(FEW))


@pytest.mark.extended
def test_one_loading_and_unloading_cannot_show_what_needs_more():
    single, lacking = campaign(seed=1, programme=SINGLE), {"reload_hysteresis", "ratcheting", "humidity"}
    assert {one["mechanism"] for one in untestable(LIBRARY, available_data(single))[1]} == lacking
    told = content(discover(single, library=FEW | {name: LIBRARY[name] for name in lacking}, **QUICK))
    needs = {one["mechanism"]: one["needs"] for one in told["untestable"]}
    assert set(needs) == lacking
    assert needs["reload_hysteresis"] == needs["ratcheting"] == "a reload segment"
    assert "relative_humidity_percent" in needs["humidity"]
    assert not set(needs) & {one["mechanism"] for one in told["ranking"]}
    assert all(name.replace("_", " ") in told["summary"] for name in needs)


@pytest.mark.extended
@pytest.mark.parametrize(
    ("mechanism", "change"),
    [
        ("frame_compliance", lambda c: -0.004 * c.force_mN),
        ("creep", lambda c: -0.02 * np.log1p(c.time_s / 10) * c.force_mN / 100),
    ],
)
def test_no_effect_is_ever_named_with_an_impossible_sign(mechanism, change):
    wrong = with_curves(cached(seed=1), lambda c: (c.time_s, c.force_mN, c.displacement_um + change(c)))
    found = discover(wrong, library={n: LIBRARY[n] for n in (mechanism, "adhesion", "unloading_shape")}, **QUICK)
    for effect in found.effects:
        assert effect.variant.sign == 0 or effect.variant.sign * effect.amplitude > 0
    assert mechanism not in {effect.mechanism for effect in found.effects}
