"""Pathological campaigns: all by the paper's method, which is quick, and some by least squares."""

from __future__ import annotations

import pytest
from pathological import COMMAND, campaign_of, run_one
from pathological_kinds import KINDS

from mcc_jax.calibrate.data import select

pytestmark = pytest.mark.extended

BY_NAME = {kind.name: kind for kind in KINDS}
FITTED = (
    "displacement from a far origin below zero",
    "ceramic pebbles of 1 mm and 100 N",
    "force in steps of a tenth of the peak",
    "displacement times 1e9",
    "three particles of four unloading only",
)
REFUSED = (
    "unloading only",
    "unloading and a reload to the same force",
    "approach only",
    "hold only",
    "two points each",
    "loads below the threshold only",
    "constant force",
    "constant displacement",
    "force of the other sign",
    "not a number in displacement",
    "no particle",
    "one name twice",
    "force and displacement of unlike lengths",
)


@pytest.mark.parametrize("name", FITTED)
def test_ends_in_a_result(name):
    found = run_one(BY_NAME[name], 1, "least-squares")
    assert (found.how, found.fault) in [("converged", ""), ("not converged", "")], found


@pytest.mark.parametrize("name", [kind.name for kind in KINDS if " cycles" in kind.name])
def test_hundreds_of_cycles_are_selected(name):
    campaign = campaign_of(BY_NAME[name], 0)
    chosen = select(campaign)
    assert len(chosen.kept) == len(campaign)
    assert max(map(len, chosen.rows)) < 700
    for rows, curve in zip(chosen.rows, campaign.curves, strict=True):
        assert curve.force_mN[rows].max() == curve.force_mN.max()
    assert (chosen.tests.loading & chosen.tests.mask).sum(axis=1).min() >= 12


@pytest.mark.parametrize(
    ("name", "method"), [*((name, "least-squares") for name in REFUSED), *((REFUSED[i], COMMAND) for i in (0, 3))]
)
def test_ends_in_one_line_with_a_remedy(name, method):
    found = run_one(BY_NAME[name], 1, method)
    assert (found.how, found.fault) == ("refused", ""), found


@pytest.mark.parametrize("name", BY_NAME)
def test_every_kind_ends_as_it_should_by_the_paper_s_method(name):
    found = run_one(BY_NAME[name], 1, "paper")
    assert not found.fault, found


def test_a_seed_gives_the_same_campaign_again():
    one, two = (campaign_of(BY_NAME["plain"], 3) for _ in range(2))
    assert one.particles == two.particles
    assert all((a.force_mN == b.force_mN).all() for a, b in zip(one.curves, two.curves, strict=True))
    assert len(BY_NAME) == len(KINDS) >= 40
