"""The baselines: an oracle on made campaigns, AIC and the discrepancy on a small linear problem."""

import numpy as np
import pytest

from benchmarks.blind import adapter, baselines, plan, seal
from benchmarks.blind.plan import Case

pytestmark = pytest.mark.extended

NAME = "day-5"


def single(number, level, mechanism="thermal_drift", formula="exact"):
    return Case(number, "single", "first", ((mechanism, formula, level),), "P1", 10, "clean")


CASES = {
    "nothing": Case(0, "null", "second", (), "P1", 10, "smooth"),
    "clear": single(1, 20.0),
    "bends with its amplitude": single(2, 10.0, "adhesion", "dugdale"),
    "on no list": Case(3, "unlisted", "second", (("unlisted", "SerratedFlow", 100.0),), "P0", 5, "clean"),
}


def made(name, place):
    """The folder of a sealed campaign."""
    seal.seal(NAME, place / "work", place / "sealed", [CASES[name]])
    return place / "work" / NAME / "campaigns" / plan.keys(5, 460)[CASES[name].number]


@pytest.mark.parametrize(
    ("name", "verdict", "names"),
    [
        ("nothing", "NO_GAP", []),
        ("clear", "NAMED", ["thermal_drift"]),
        ("bends with its amplitude", "NAMED", ["adhesion"]),
        ("on no list", "UNLISTED", []),
    ],
)
def test_the_oracle_knows(name, verdict, names, tmp_path):
    found = baselines.oracle(made(name, tmp_path))
    assert adapter.problem(found) is None
    assert (found["verdict"], [e["mechanism"] for e in found["effects"]]) == (verdict, names)
    if name == "nothing":
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


def test_the_library_of_another_checkout_comes_first(monkeypatch, tmp_path):
    import sys

    monkeypatch.setattr(sys, "path", list(sys.path))
    assert adapter.find(f"checkout:{tmp_path}") is adapter.in_process
    assert sys.path[0] == str(tmp_path)


@pytest.mark.parametrize("solver", [baselines.aic, baselines.discrepancy])
def test_baselines_on_a_made_campaign(tmp_path, solver):
    found = solver(made("clear", tmp_path))
    assert adapter.problem(found) is None
    assert found["verdict"] in ("NAMED", "UNLISTED")
