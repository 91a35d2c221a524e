"""The oracle: it opens the answers for everything but the name, and so says how much a campaign can tell at most."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from . import make
from .baselines import answer
from .noise import slopes
from .plan import from_record
from .settings import SETTINGS
from .strength import Projection, signature
from .world import Hidden

_B = SETTINGS.baselines


def readings(folder: Path) -> np.ndarray:
    """Time, force, displacement of every reading."""
    return np.loadtxt(folder / "curves.csv", delimiter=",", skiprows=1, usecols=(1, 2, 3))


def solve(folder: Path, seed: int = 0) -> dict[str, Any]:
    """Score test of every formula of the campaign's own generator, the hidden ones with their true numbers included."""
    told = json.loads((folder.parents[1] / "answers" / f"{folder.name}.json").read_text())
    case = from_record(told["case"])
    if case.fault:  # it knows the fault, and has nothing to name
        return answer("NO_GAP")
    _, world, noise = make.drawn(case, told["master"], told["attempt"])
    projection = Projection(world, noise, case.noise)
    _, force, displacement = readings(folder).T
    change = displacement - world.base - slopes(world) * (force - world.force)
    y = projection.project(change + projection.deviation)
    known = [h for h in (*world.listed(), *world.hidden) if h.mechanism != "unlisted"]
    G = np.stack([signature(projection, h) for h in known])
    signed = np.array([h.signed for h in known])
    rng = np.random.default_rng(seed)
    null = np.abs(_admissible(_normal(rng, G @ G.T), signed)).max(axis=1)
    first, drop, left, tangent = _best(projection, known, G, signed, y)
    p = float((1 + np.sum(null >= np.sqrt(max(2 * max(drop.values()), 0.0)))) / (_B.draws + 1))
    ranking = _ranking(drop)
    more = {"ranking": ranking, "p_anything_missing": p}
    if p >= _B.level:
        return answer("UNLISTED" if _too_much(y) else "NO_GAP", **more)
    names = [(first.mechanism, first.formula, ranking[0]["probability"])]
    others = [k for k, h in enumerate(known) if h.mechanism != first.mechanism]
    H = G[others] - np.outer(G[others] @ tangent, tangent)
    H = H / np.maximum(np.linalg.norm(H, axis=1, keepdims=True), 1e-9)
    second, gain, after, _ = _best(projection, [known[k] for k in others], H, signed[others], left)
    if max(gain.values()) > _B.second:
        names.append((second.mechanism, second.formula, 1.0))
        left = after
    if _too_much(left):
        return answer("UNLISTED", **more)
    return answer("NAMED", names, **more)


def _too_much(left: np.ndarray) -> bool:
    return bool(chi2.sf(float(left @ left), len(left)) < _B.unlisted)


def _normal(rng: np.random.Generator, covariance: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance)
    return rng.standard_normal((_B.draws, len(values))) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T


def _admissible(score: np.ndarray, signed: np.ndarray) -> np.ndarray:
    return np.where(signed, score, np.maximum(score, 0.0))


def _ranking(drop: dict[str, float]) -> list[dict[str, Any]]:
    weights = np.exp(np.array(list(drop.values())) - max(drop.values()))
    order = np.argsort(-weights)
    return [{"mechanism": list(drop)[k], "probability": float(weights[k] / weights.sum())} for k in order]


def _best(
    projection: Projection, known: list[Hidden], G: np.ndarray, signed: np.ndarray, y: np.ndarray
) -> tuple[Hidden, dict[str, float], np.ndarray, np.ndarray]:
    """The best formula, half the drop of chi2 by mechanism, what is left, and the direction that was taken."""
    score = _admissible(G @ y, signed)
    half = 0.5 * score**2
    lefts = [y - s * g for s, g in zip(score, G, strict=True)]
    raw = np.abs(G @ y)  # a strong effect may have the forbidden sign to first order
    if raw.max() > _B.strong:
        true = [k for k, h in enumerate(known) if h in projection.world.hidden]
        for k in {*np.argsort(-raw)[: _B.followed].tolist(), *true}:
            refined = _followed(projection, known[k], y, float(raw[k]))
            value = 0.5 * float(y @ y - refined @ refined)
            if value > half[k]:
                half[k], lefts[k] = value, refined
    drop: dict[str, float] = {}
    for h, value in zip(known, half, strict=True):
        drop[h.mechanism] = max(drop.get(h.mechanism, 0.0), float(value))
    best = int(np.argmax(half))
    taken = y - lefts[best]
    return known[best], drop, lefts[best], taken / max(np.linalg.norm(taken), 1e-12)


def _followed(projection: Projection, hidden: Hidden, y: np.ndarray, score: float) -> np.ndarray:
    """What an effect of the best finite amplitude leaves."""
    world = projection.world

    def left(log_amplitude: float) -> np.ndarray:
        curves = world.curves([(hidden, float(np.exp(log_amplitude)))], None)
        found = y - projection.project(curves - world.base)
        return found if np.all(np.isfinite(found)) else np.full_like(y, 1e9)

    small = 1e-3 * min(hidden.start, hidden.largest)
    size = np.linalg.norm(projection.project(world.curves([(hidden, small)], None) - world.base))
    guess = np.log(max(abs(score), 1.0) * small / max(size, 1e-12))
    top = min(guess + _B.reach, np.log(hidden.largest))
    grid = np.linspace(min(guess, top) - _B.reach, top, _B.scanned)
    step = grid[1] - grid[0]
    least = min(grid, key=lambda x: float(np.sum(left(x) ** 2)))  # the misfit may have several minima
    found = minimize_scalar(
        lambda x: float(np.sum(left(x) ** 2)), bounds=(least - step, min(least + step, top)), method="bounded",
        options={"maxiter": 12},
    )  # fmt: skip
    return left(float(found.x))
