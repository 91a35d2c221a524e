"""The plan of the bench: counts, balance, and cells that rotate with the seed."""

from collections import Counter
from itertools import pairwise, product

import pytest

from benchmarks.blind import plan
from benchmarks.blind.settings import BETWEEN_PARTICLES, MECHANISMS, SETTINGS

D = SETTINGS.drawing


def of(cases, kind):
    return [case for case in cases if case.kind == kind]


def test_counts_and_subset():
    cases = plan.plan(5)
    assert Counter(case.kind for case in cases) == {"single": 160, "pair": 40, "null": 200, "unlisted": 30, "fault": 30}
    assert Counter(case.kind for case in cases if case.subset) == D.subset
    assert sum(D.subset.values()) == 100
    assert [case.number for case in cases] == list(range(460))
    assert sorted(plan.keys(5, 460)) == [f"c{k:03d}" for k in range(460)]
    assert plan.from_record(cases[0].record()) == cases[0]


def test_singles_are_a_latin_square():
    cases = of(plan.plan(5), "single")
    cells = Counter((case.effects[0][0], case.effects[0][2]) for case in cases)
    assert set(cells.values()) == {1}
    assert len(cells) == len(MECHANISMS) * len(D.single_levels)
    assert set(Counter((case.effects[0][0], case.generator) for case in cases).values()) == {4}
    by_level = Counter((case.effects[0][2], case.generator) for case in cases)
    assert min(by_level.values()) >= 4
    for cell in product(MECHANISMS, ("first", "second")):
        formulas = Counter(case.effects[0][1] for case in cases if (case.effects[0][0], case.generator) == cell)
        assert max(formulas.values()) - min(formulas.values()) <= 1
        assert len(formulas) >= 2
    assert set(Counter(case.effects[0][0] for case in cases if case.subset).values()) == {2}
    levels = Counter(case.effects[0][2] for case in cases if case.subset)
    assert max(levels.values()) - min(levels.values()) <= 1


def test_pairs_nulls_unlisted_and_faults_are_balanced():
    cases = plan.plan(5)
    pairs = of(cases, "pair")
    assert set(Counter(name for case in pairs for name, *_ in case.effects).values()) == {D.matchings}
    couples = [frozenset(name for name, *_ in case.effects) for case in pairs]
    assert len(set(couples)) == len(couples)
    assert not set(couples) & set(D.no_pair)
    assert all(level >= 20 for case in pairs for *_, level in case.effects)
    assert Counter(case.noise for case in of(cases, "null")) == D.nulls
    assert Counter(case.generator for case in of(cases, "null")) == {"first": 100, "second": 100}
    assert Counter(case.generator for case in of(cases, "unlisted")) == {"first": 15, "second": 15}
    assert set(Counter(case.fault for case in of(cases, "fault")).values()) == {D.faults}
    between = [case for case in of(cases, "single") if case.effects[0][0] in BETWEEN_PARTICLES]
    assert all(case.particles >= D.enough_particles for case in between)
    assert {case.particles for case in cases} == set(D.particles)


def test_cells_rotate_with_the_seed_and_with_nothing_else():
    def cells(seed):
        singles = of(plan.plan(seed), "single")
        return {(case.generator, case.effects, case.protocol, case.particles, case.noise) for case in singles}

    assert plan.plan(1) == plan.plan(1)
    for one, other in pairwise(map(cells, (1, 2, 3))):
        assert len(one & other) < 20
    assert plan.keys(1, 460) != plan.keys(2, 460)
    assert plan.digest(1) != plan.digest(2)


@pytest.mark.parametrize("seed", range(3))
def test_every_formula_of_both_generators_is_used(seed):
    cases = plan.plan(seed)
    for name, generator in plan.generators().items():
        used = {case.effects[0][:2] for case in of(cases, "single") if case.generator == name}
        assert used == {(m, f) for m in MECHANISMS for f in generator.formulas(m)}
        assert {f for case in of(cases, "unlisted") if case.generator == name for _, f, _ in case.effects} <= set(
            generator.unlisted()
        )
