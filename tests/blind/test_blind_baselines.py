"""The baselines: an oracle on made campaigns, AIC and the discrepancy on a small linear problem."""

import numpy as np
import pytest

from benchmarks.blind import adapter, baselines, plan, seal
from benchmarks.blind.plan import Case
from mcc_jax.effects import LIBRARY

pytestmark = pytest.mark.extended

CLEAR = Case(1, "single", "first", (("thermal_drift", "exact", 20.0),), "P1", 10, "clean")
BENDS_WITH_ITS_AMPLITUDE = Case(2, "single", "first", (("adhesion", "dugdale", 10.0),), "P1", 10, "clean")
ON_NO_LIST = Case(3, "unlisted", "second", (("unlisted", "SerratedFlow", 100.0),), "P0", 5, "clean")


def made(case, place):
    """The folder of a sealed campaign."""
    seal.seal("day-5", place / "work", place / "sealed", [case])
    return place / "work/day-5/campaigns" / plan.keys(5, 460)[case.number]


@pytest.mark.parametrize(
    ("case", "verdict", "names"),
    [
        (Case(0, "null", "second", (), "P1", 10, "smooth"), "NO_GAP", []),
        (CLEAR, "NAMED", ["thermal_drift"]),
        (BENDS_WITH_ITS_AMPLITUDE, "NAMED", ["adhesion"]),
        (ON_NO_LIST, "UNLISTED", []),
    ],
)
def test_the_oracle_knows(case, verdict, names, tmp_path):
    found = baselines.oracle(made(case, tmp_path))
    assert adapter.problem(found) is None
    assert (found["verdict"], [e["mechanism"] for e in found["effects"]]) == (verdict, names)
    if case.kind == "null":
        assert found["p_anything_missing"] > 0.05
    if names:
        assert found["ranking"][0]["mechanism"] == names[0]


def made_up(hidden, seed=0):
    """A base fit of eight particles with two candidate formulas, one of them hidden."""
    rng = np.random.default_rng(seed)
    at = np.linspace(0.0, 1.0, 100)
    shapes = {("creep", "a"): (np.sin(5 * at), 1), ("damage", "b"): (np.cos(9 * at), 1), ("adhesion", "c"): (at**6, 1)}
    residual = [0.1 * rng.standard_normal(100) + (hidden * np.sin(5 * at)) for _ in range(8)]
    return baselines.Fitted(
        residual=residual,
        own=[np.column_stack([at, np.full(100, 10.0)]) for _ in range(8)],
        common=[np.column_stack([at, at**2]) for _ in range(8)],
        coordinates=[np.column_stack([at, at]) for _ in range(8)],
        diameter=np.full(8, 100.0),
        signatures={name: ([shape] * 8, sign) for name, (shape, sign) in shapes.items()},
    )


def test_aic_names_what_lowers_it(monkeypatch):
    monkeypatch.setattr(baselines, "fitted", lambda folder, with_formulas: made_up(0.5))
    found = baselines.aic("here")
    assert found["verdict"] == "NAMED"
    assert found["effects"][0]["mechanism"] == "creep"
    assert found["ranking"][0]["probability"] > 0.99
    # An amplitude of the forbidden sign is never named.
    monkeypatch.setattr(baselines, "fitted", lambda folder, with_formulas: made_up(-0.5))
    assert "creep" not in [e["mechanism"] for e in baselines.aic("here")["effects"]]


def test_the_discrepancy_says_whether_something_is_missing(monkeypatch):
    monkeypatch.setattr(baselines, "fitted", lambda folder, with_formulas: made_up(0.5))
    found = baselines.discrepancy("here")
    assert (found["verdict"], found["effects"]) == ("UNLISTED", [])
    assert 0.5 < found["gap"]["closed_fraction"] < 1.0
    monkeypatch.setattr(baselines, "fitted", lambda folder, with_formulas: made_up(0.0))
    assert baselines.discrepancy("here")["verdict"] == "NO_GAP"


def test_marginal_likelihood_against_the_dense_one():
    """At a fixed variance it is that of N(0, variance + X diag(prior^2) X'), up to a constant."""
    rng = np.random.default_rng(1)
    X, y, prior = rng.standard_normal((30, 3)), rng.standard_normal(30), np.array([0.5, 1.0, 2.0])
    value, (weights, variance) = baselines._with(X.T @ X, X.T @ y, float(y @ y), 30, prior)
    dense = variance * np.eye(30) + X * prior**2 @ X.T
    expected = -0.5 * (np.linalg.slogdet(dense)[1] + y @ np.linalg.solve(dense, y)) + 15.0
    assert value == pytest.approx(expected, rel=1e-10)
    assert weights == pytest.approx(prior**2 * (X.T @ np.linalg.solve(dense, y)), rel=1e-8)


@pytest.mark.parametrize("solver", [baselines.aic, baselines.discrepancy])
def test_baselines_on_a_made_campaign(tmp_path, solver, monkeypatch):
    few = ("thermal_drift", "frame_compliance", "damage")
    monkeypatch.setattr("mcc_jax.LIBRARY", {name: LIBRARY[name] for name in few})
    found = solver(made(CLEAR, tmp_path))
    assert adapter.problem(found) is None
    assert found["verdict"] in ("NAMED", "UNLISTED")
