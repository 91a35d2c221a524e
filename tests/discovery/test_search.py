"""A search over few mechanisms: posterior, sets, places, held-out gap, verify."""

from dataclasses import replace

import numpy as np
import pytest
from campaigns import N, base_of, cached, with_curves

from mcc_jax.campaign import available_data
from mcc_jax.discovery import answer, screen, verify
from mcc_jax.discovery.answer import effects_of, instead_of, population_under, sets_of
from mcc_jax.discovery.evidence import LinearModel, likely_start, optimise
from mcc_jax.discovery.hypothesis import Hypothesis, sudden_steps
from mcc_jax.discovery.result import Effect
from mcc_jax.discovery.search import Search
from mcc_jax.discovery.settings import DECISIONS, STRONG, UNLISTED, VERY_STRONG
from mcc_jax.effects import LIBRARY, Need, find_variant

pytestmark = pytest.mark.extended

FEW = {name: LIBRARY[name] for name in ("frame_compliance", "damage")}


def search_in(campaign, library):
    return Search(base_of(campaign), library, library, lambda _: None)


def search_of(campaign):
    library, _ = screen.untestable(FEW, available_data(campaign))
    return search_in(campaign, library).run()


@pytest.fixture(scope="module")
def named():
    return search_of(cached("frame_compliance=0.004"))


@pytest.fixture
def with_pair(named, monkeypatch):
    """The same search with another hypothesis of the same evidence alone and with a misfit, added to what was found."""
    kept = dict(named.found)

    def add(names, value, **more):
        one = Hypothesis(names, alone=value, with_misfit=value, **more)
        monkeypatch.setattr(named, "found", {**kept, names: one})
        return named

    return add


def test_a_hidden_effect_leads_and_its_probability_says_so(named):
    found = named.posterior()
    assert next(iter(found)) == ("frame_compliance",)
    assert found[("frame_compliance",)] > 0.9
    assert sum(found.values()) == pytest.approx(1)
    assert named.found[("frame_compliance",)].at.theta[0] == pytest.approx(0.004, rel=0.1)


def test_particles_in_which_more_is_missing_are_not_taken_for_noisier_ones():
    search = search_in(cached("frame_compliance=0.06"), FEW)
    assert np.ptp(search.base.scale) > 1
    settled = search._settled()
    np.testing.assert_array_equal(settled.base.scale, 1.0)
    assert settled.found["frame_compliance",].at.theta[0] == pytest.approx(0.06, rel=0.05)


@pytest.mark.parametrize(("hidden", "leads"), [("", ()), ("pop_in=1.0,location_MPa=4", ("pop_in",))], ids=str)
def test_outliers_of_the_noise_fade_and_are_of_either_sign_while_steps_stay(hidden, leads):
    campaign = cached(*filter(None, [hidden]))

    rng = np.random.default_rng(2)
    outliers = [(rng.integers(10, 40), 1.0 - k % 2 * 2.0) for k in range(N)]

    def with_outlier(curve):
        place, size = outliers.pop()
        after = np.arange(len(curve.time_s)) - place
        fading = np.where(after >= 0, np.exp(-np.maximum(after, 0) / 10), 0.0)
        return curve.time_s, curve.force_mN, curve.displacement_um + size * fading

    search = search_in(with_curves(campaign, with_outlier), {name: LIBRARY[name] for name in ("pop_in", "damage")})
    found = search.run()
    assert next(iter(found.posterior())) == leads
    assert (found.outliers > STRONG) is True
    # Where noise is correlated over more than a test, nothing tells an outlier of it from a step of the particle.
    (sudden, *_), null = LIBRARY["pop_in"].variants, search.null
    assert sudden_steps(search.base, null, sudden, of_noise=True) is not None
    hyper = null.optimum.hyper + np.log(1e3) * (np.arange(len(null.optimum.hyper)) == 3)
    lasting = replace(null, optimum=replace(null.optimum, hyper=hyper))
    assert sudden_steps(search.base, lasting, sudden, of_noise=True) is None


def test_p_values_of_nothing_are_uniform(monkeypatch):
    """Scores drawn from the null law itself in place of the observed ones."""
    nothing, plain = search_of(cached(seed=1)), verify._Statistic
    rng = np.random.default_rng(0)

    class Drawn(plain):
        def __init__(self, search):
            super().__init__(search)
            values, vectors = np.linalg.eigh(self.gram)
            root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
            normal = rng.standard_normal(self.score.shape)
            self.score = np.einsum("ncd,nd->nc", root, normal)

    monkeypatch.setattr(verify, "_Statistic", Drawn)
    p = np.array([verify.p_anything(nothing, seed) for seed in range(30)])
    assert 0.3 < p.mean() < 0.7
    assert np.sum(p < 0.1) <= 8


def test_two_names_must_lead_by_the_margin(named, with_pair):
    best = max(h.log_evidence for h in named.found.values())
    pair = ("damage", "frame_compliance")
    for lead, there in ((0.5 * DECISIONS.margin, False), (3 * DECISIONS.margin, True)):
        assert (pair in with_pair(pair, best + lead).posterior()) is there


@pytest.mark.parametrize(("lead", "told"), [(0.0, False), (0.5, True), (3.0, False)])
def test_two_names_short_of_the_margin_in_place_of_one_make_a_set(named, lead, told, with_pair):
    """Below their prior odds they are not reported; beyond the margin they are the answer themselves."""
    pair, leader = ("creep", "damage"), ("frame_compliance",)
    level = max(named.log_posteriors().values()) + DECISIONS.pair + lead * DECISIONS.margin
    with_pair(pair, level - (0 if lead else 2 * DECISIONS.pair))  # one pair of two mechanisms has no further odds
    winner = next(iter(named.log_posteriors()))
    assert winner == (pair if lead > 1 else leader)
    pairs = instead_of(named, winner)
    assert pairs == ((pair,) if told else ())
    if winner == leader:
        (effect,) = effects = effects_of(named, leader, 0.0)
        (names,) = sets_of(named, leader, effects, pairs)
        assert names == ((*leader, *pair) if told else leader)
        assert (effect.probability > 0.9) is not told


@pytest.mark.parametrize("present", [(), (Need.TWO_RATES,)])
def test_at_one_rate_rate_and_size_are_in_one_set_whatever_the_evidence(named, present, monkeypatch):
    names = "rate_dependence", "size_effect"
    monkeypatch.setattr(answer, "available_data", lambda _: frozenset(present))
    monkeypatch.setattr(named, "found", {(n,): Hypothesis((n,), 100.0 * k, 100.0 * k) for k, n in enumerate(names)})
    monkeypatch.setattr(named, "library", LIBRARY)
    effect = Effect(find_variant("size_effect"), {}, 0.3, 0.01, 1.0, 0.0)
    assert sets_of(named, names[1:], [effect], ()) == (names[1:] if present else names[::-1],)


def test_another_form_is_searched_where_it_begins_near(named):
    best, leader = max(h.alone for h in named.found.values()), ("frame_compliance",)
    assert named.comes_near(leader, best)
    assert not named.comes_near(leader, best + 2 * VERY_STRONG)
    assert named.comes_near(UNLISTED, best + 2 * VERY_STRONG)  # not known before it is searched


def test_a_second_name_has_an_amplitude_that_one_would_believe(named, with_pair):
    best, pair = max(h.log_evidence for h in named.found.values()), ("damage", "frame_compliance")
    one = named.found[("frame_compliance",)].at
    first = max(pair, key=lambda n: named.found[(n,)].log_evidence)
    variants = tuple(LIBRARY[n].variants[0] for n in pair)
    for beyond in pair:
        theta = np.array([(1.5 if n == beyond else 0.5) * v.plausible[1] for n, v in zip(pair, variants, strict=True)])
        formulas = replace(one, variants=variants, state=one.state.with_numbers(theta))
        assert (pair in with_pair(pair, best + 100, at=formulas).posterior()) is (beyond == first)


def test_names_that_a_leader_imitates_are_reached_by_replacing_it(named, monkeypatch):
    """Frame compliance leads alone; its best pair is with creep, but creep with damage is better still."""
    value = named.found["frame_compliance",].log_evidence
    found = {(m,): Hypothesis((m,), value - lack, at=named.null) for m, lack in (("creep", 50), ("damage", 90))}
    found |= {names: named.found[names] for names in ((), ("frame_compliance",), UNLISTED)}
    by_name = {
        "frame_compliance": {("creep", "frame_compliance"): value + 20},
        "creep": {("creep", "damage"): value + 40, ("creep", "frame_compliance"): value + 20},
        "damage": {("creep", "damage"): value + 40},
    }
    asked = []

    def pairs_with(leader):
        asked.append(leader.names[0])
        for names, pair in by_name[leader.names[0]].items():
            named.found.setdefault(names, Hypothesis(names, pair, pair, at=named.null))

    monkeypatch.setattr(named, "found", found)
    monkeypatch.setattr(named, "pairs_with", pairs_with)
    monkeypatch.setattr(named, "other_formulas", lambda pair: None)
    pairs_with(found["frame_compliance",])
    named.replace_names({("frame_compliance",)})
    assert named.better_pairs()[0].names == ("creep", "damage")
    assert asked == ["frame_compliance", "creep", "damage"]


def test_a_pair_with_a_discrepancy_counts_for_the_pair(named, monkeypatch):
    pair, smooth = ("damage", "frame_compliance"), named.found[UNLISTED].log_evidence
    logs = []
    for both in (-np.inf, smooth + 200):
        one = Hypothesis(pair, smooth + 50, smooth + 50, with_discrepancy=both)
        monkeypatch.setattr(named, "found", {**named.found, pair: one})
        logs.append(named._log_joints())
    assert logs[1][pair] > logs[0][pair] + 50
    assert all(logs[1][n] == logs[0][n] for n in logs[0] if n != pair)


def test_a_name_with_a_discrepancy_counts_for_what_explains_more(named, monkeypatch):
    smooth = named.found[UNLISTED].log_evidence
    others = {n: replace(h, with_discrepancy=-np.inf) for n, h in named.found.items()}
    monkeypatch.setattr(named, "found", others)
    assert named.log_posteriors()[UNLISTED] == pytest.approx(smooth - DECISIONS.unlisted)  # prior odds of its own
    for own, larger in ((smooth - 50, UNLISTED), (smooth + 50, ("damage",))):
        damage, logs = Hypothesis(("damage",), alone=own, with_misfit=own), []
        for both in (-np.inf, smooth + 200):
            monkeypatch.setattr(named, "found", {**others, ("damage",): replace(damage, with_discrepancy=both)})
            logs.append(named.log_posteriors())
        assert logs[1][larger] > logs[0][larger] + 50
        assert [n for n in logs[0] if logs[0][n] != logs[1][n]] == [larger]


def kinked(whole, um):
    """The same tests with an unloading that bends at 60 % of the load: no mechanism of the library does."""

    def bent(c):
        share = c.force_mN / np.maximum(np.maximum.accumulate(c.force_mN), 1e-9)
        return c.time_s, c.force_mN, c.displacement_um - um * np.maximum(0.6 - share, 0.0) * (c.force_mN > 0.05)

    return with_curves(whole, bent)


def test_the_misfit_of_a_formula_is_a_share_of_the_effect_that_is_left():
    """Its prior follows the amplitude: a formula that explains little lends its name to little."""
    search = search_in(kinked(cached(seed=1), 1.0), {"toe_asperity": LIBRARY["toe_asperity"]})
    search.fit_singles(["toe_asperity"], 1)
    one = search.found[("toe_asperity",)]
    search.fit_misfit(one)
    hyper, design = one.misfit
    alone = one.at.theta[0] / one.at.variants[0].plausible[0]
    share = LinearModel(hyper, design).solve().amplitude[0] / alone
    assert 0.4 < share < 0.8  # 0.37 with a misfit of the whole amplitude
    assert np.exp(design.misfits[0, [0, 2]]) == pytest.approx(share * np.array([0.1, 0.3]), rel=0.15)
    assert one.sizes[0] <= DECISIONS.misfit_most + 1e-6


def test_formulas_of_the_modulus_agree_at_the_peaks():
    """The modulus of each is that of the law at a strain of its own; at the peaks all describe the same tests."""
    whole = cached("densification_stiffening:exponential=1.0", seed=1)
    library = {"densification_stiffening": LIBRARY["densification_stiffening"]}
    search = search_in(whole, library)
    search.fit_singles(["densification_stiffening"], 4)
    each = [population_under(search.base, r, r.optimum.hyper, r.design) for r in search.fits.values() if r.theta[0]]
    extrapolated, at_peaks = (np.array([mean[j] for mean, _, _ in each]) for j in (1, 5))
    assert np.ptp(extrapolated) > 0.1
    assert np.ptp(at_peaks) < 0.03
    strain = [float(np.max(c.displacement_um)) for c in whole.curves] / np.asarray(search.base.tests.effective_diameter)
    errors = np.array([sd[5] for _, sd, _ in each])
    assert np.all(np.abs(at_peaks - np.log(16e3) - np.mean(strain)) < 3 * errors)
    wider = np.array([sd[1] for _, sd, _ in each])
    assert np.all(errors < wider)
    assert np.all(np.abs(extrapolated - np.log(16e3)) < 3 * wider)


def test_pairs_to_first_order_are_of_two_mechanisms(named, monkeypatch):
    a, b, value = named.screen.pairs
    mechanisms = named.screen.candidates.mechanisms
    assert np.all(mechanisms[a] != mechanisms[b])
    # A second amplitude that explains nothing costs a little of the evidence that the first has alone.
    alone, best = named.screen.singles().max(), int(np.argmax(value))
    assert alone - 8 < value[best] < alone + 8
    monkeypatch.setattr("mcc_jax.discovery.search.DECISIONS", replace(DECISIONS, margin=-100.0))
    assert named.leading_pairs() == {("damage", "frame_compliance"): (a[best], b[best])}


def test_a_discrepancy_begins_where_noise_leaves_it_most(named):
    """Fitted without it, correlated noise has swallowed a gap; what cannot come near another name is left."""
    r, of = named.null, named.discrepancy
    start = np.append(r.optimum.hyper, [np.log(DECISIONS.general) + of.log_white - 1.0] * len(of.parts))
    design = of.added_to(named.base, r).design
    swallowed = np.where(np.arange(len(start)) == 2, start + 2.0, start)
    likely, _ = likely_start(design, swallowed)
    one, best = (optimise(design, begun, without=r.optimum) for begun in (swallowed, likely))
    assert best.log_joint > one.log_joint - 0.02 * len(start)  # as near as a mode is met (`FLAT`)
    far = best.log_joint + VERY_STRONG + 10.0
    assert of.added_to(named.base, r, far) is None
    leader = replace(named.found[("frame_compliance",)], with_discrepancy=-np.inf)
    named.fit_discrepancy(leader, leader.alone + 2 * VERY_STRONG)
    assert leader.with_discrepancy == -np.inf
    named.fit_discrepancy(leader, -np.inf)
    assert np.isfinite(leader.with_discrepancy)
