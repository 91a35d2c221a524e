"""What else one could do: an oracle, stepwise AIC, and a smooth discrepancy; solvers as `adapter` calls them.

`python -m benchmarks.blind.run --name NAME --subset 100 --solver benchmarks.blind.baselines:oracle --label oracle`, and
likewise `aic` and `discrepancy`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from .settings import SETTINGS

_B, _ZERO_SD_UM = SETTINGS.baselines, SETTINGS.refitting.zero_sd_um


def answer(verdict: str, effects: Sequence[tuple[str, str, float]] = (), **more: Any) -> dict[str, Any]:
    """A `discovery.json` with what a baseline can say; effects are (mechanism, formula, probability)."""
    named = [{"mechanism": m, "variant": v, "probability": p, "parameters": {}} for m, v, p in effects]
    sets = [[m] for m, *_ in effects]
    return {"schema": 1, "verdict": verdict, "summary": "", "effects": named, "candidate_set": sets, **more}


def oracle(folder: Path, *, seed: int = 0) -> dict[str, Any]:
    """A score test with the generator's own formulas, the true ones among them, at the true noise and spreads."""
    from .oracle import solve

    return solve(Path(folder), seed)


@dataclass(frozen=True)
class Fitted:
    """A base fit, linear around it: of each particle residual (um), own columns scaled by their spreads, diameter.

    formulas: variants that these tests can show. tests, fit, rows: what signatures are computed from.
    """

    residual: list[np.ndarray]
    own: list[np.ndarray]
    common: list[np.ndarray]
    coordinates: list[np.ndarray]
    diameter: np.ndarray
    signatures: dict[tuple[str, str], tuple[list[np.ndarray], int]]


def fitted(folder: Path, with_formulas: bool) -> Fitted:
    """The library's base fit of a campaign and the derivatives of its curves, by the library's own forward model."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    import mcc_jax as mcc
    from mcc_jax.calibrate.forward import Forms, Point, linearise
    from mcc_jax.campaign.record import available_data

    campaign = mcc.read_campaign(folder)
    fit = mcc.fit(campaign, threshold_MPa=0.0)
    count, unloading = len(fit.tests), fit.model.unloading

    def filled(tree: Any) -> Any:
        arrays, rest = eqx.partition(tree, eqx.is_array)
        more = _B.padded - count
        grown = jax.tree.map(
            lambda x: jnp.pad(x, [(0, more), *[(0, 0)] * (x.ndim - 1)], mode="edge") if x.ndim else x, arrays
        )
        return eqx.combine(grown, rest)

    tests, latent, zero = filled((fit.tests, fit.point.latent, fit.point.zero))

    def columns(variants: tuple[Any, ...]) -> np.ndarray:
        forms = Forms(unloading, variants)
        start = jnp.array([0.0] * len(variants) + [n.middle for v in variants for n in v.nuisances])
        point = Point(latent, zero, jnp.broadcast_to(start, (len(latent), len(start))))
        return np.asarray(linearise(point, tests, forms).columns)[:count]

    rows = [np.flatnonzero(mask) for mask in np.asarray(fit.tests.mask)]
    base = columns(())
    tau = np.maximum(np.asarray(fit.population.tau), 1e-6)
    flatness = np.asarray(fit.tests.flatness)
    force, path = np.asarray(fit.tests.force), np.asarray(fit.tests.path)
    own, common, coordinates = [], [], []
    for i, at in enumerate(rows):
        J = base[i, at]
        own.append(np.column_stack([J[:, :3] * tau, np.full(len(at), _ZERO_SD_UM)]))
        shape = J[:, :3].sum(1) * flatness[i] / (1.0 + float(fit.population.a) * flatness[i])
        common.append(np.column_stack([J, shape]))
        coordinates.append(np.column_stack([force[i, at] / force[i, at].max(), path[i, at] / path[i, at].max()]))
    signatures, there = {}, available_data(campaign)
    for mechanism in mcc.LIBRARY.values() if with_formulas else ():
        for variant in mechanism:
            if mechanism.name != "pop_in" and set(variant.needs) <= there:
                found = columns((variant,))[:, :, 4]
                signatures[mechanism.name, variant.name] = ([found[i, at] for i, at in enumerate(rows)], variant.sign)
    residual = [np.asarray(fit.residual)[i, at] for i, at in enumerate(rows)]
    return Fitted(residual, own, common, coordinates, np.asarray(fit.tests.effective_diameter), signatures)


def eliminated(base: Fitted, sd: float, more: Sequence[list[np.ndarray]] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Residual and further columns with what particles and population can take up removed, over the white noise."""
    ys, Gs, Xs = [], [], []
    for i, residual in enumerate(base.residual):
        size = base.own[i].shape[1]
        M = np.vstack([base.own[i] / sd, np.eye(size)])
        Q = np.linalg.qr(M)[0]

        def free(columns: np.ndarray, Q: np.ndarray = Q, size: int = size) -> np.ndarray:
            columns = np.vstack([columns / sd, np.zeros((size, columns.shape[1]))])
            return columns - Q @ (Q.T @ columns)

        ys.append(free(residual[:, None]))
        Gs.append(free(base.common[i]))
        Xs.append(free(np.column_stack([column[i] for column in more])) if more else np.zeros((len(M), 0)))
    G, y, X = np.vstack(Gs), np.vstack(ys)[:, 0], np.vstack(Xs)
    G = G / np.maximum(np.linalg.norm(G, axis=0), 1e-12)
    U, s, _ = np.linalg.svd(G, full_matrices=False)
    U = U[:, s > 1e-8 * s[0]]
    return y - U @ (U.T @ y), X - U @ (U.T @ X)


def aic(folder: Path, *, seed: int = 0) -> dict[str, Any]:
    """Forward selection over the library's formulas by Akaike's criterion, white noise, first order, no correction."""
    base = fitted(Path(folder), with_formulas=True)
    names = list(base.signatures)
    signs = np.array([base.signatures[name][1] for name in names])
    count = sum(map(len, base.residual))
    sd = float(np.sqrt(np.mean(np.concatenate(base.residual) ** 2)))
    y, X = eliminated(base, sd, [base.signatures[name][0] for name in names])
    usual = np.linalg.norm(X, axis=0)
    effects: list[tuple[str, str, float]] = []
    ranking: list[dict[str, Any]] = []
    taken: set[str] = set()
    for _ in range(_B.names):
        norm = np.linalg.norm(X, axis=0)
        score = np.where(norm > 1e-6 * np.maximum(usual, 1e-300), y @ X / np.maximum(norm, 1e-300), 0.0)
        score = np.where((signs != 0) & (np.sign(score) != signs), 0.0, score)
        score = np.where([m in taken for m, _ in names], 0.0, score)
        rss = float(y @ y)
        gain = count * (np.log(rss) - np.log(np.maximum(rss - score**2, 1e-12))) - 2.0  # in AIC
        of = {m: max(gain[k] for k, (name, _) in enumerate(names) if name == m) for m, _ in names}
        weights = np.exp(0.5 * (np.array([0.0, *of.values()]) - max(0.0, *of.values())))
        weights = dict(zip(of, weights[1:] / weights.sum(), strict=True))
        ranking = ranking or [{"mechanism": m, "probability": float(p)} for m, p in weights.items()]
        best = int(np.argmax(gain))
        if gain[best] <= 0:
            break
        mechanism, formula = names[best]
        effects.append((mechanism, formula, float(weights[mechanism])))
        taken.add(mechanism)
        unit = X[:, best] / norm[best]
        y, X = y - unit * (unit @ y), X - np.outer(unit, unit @ X)
    return answer("NAMED" if effects else "NO_GAP", effects, ranking=ranking)


def discrepancy(folder: Path, *, seed: int = 0) -> dict[str, Any]:
    """A smooth Gaussian process for what the law lacks, common to all particles, after Kennedy and O'Hagan (2001).

    Its coordinates are the share of the largest load and the share of the load path. It names nothing: UNLISTED where
    its marginal likelihood, less two nats for its two hyperparameters, is above that of white noise alone, and it
    closes some of the gap of particles left out.
    """
    base = fitted(Path(folder), with_formulas=False)
    sd = float(np.sqrt(np.mean(np.concatenate(base.residual) ** 2)))
    waves = list(product(range(_B.waves), repeat=2))
    basis = [[_cosine(c, wave) * d for c, d in zip(base.coordinates, base.diameter, strict=True)] for wave in waves]
    y, X = eliminated(base, sd, basis)
    gram, moment, square = X.T @ X, X.T @ y, float(y @ y)
    best, weights = _without(square, len(y)), None
    plain = best
    for length, size in product(_B.lengths, _B.sizes):
        spectrum = np.array([np.exp(-0.5 * (np.pi * length) ** 2 * (a * a + b * b)) for a, b in waves])
        prior = np.sqrt(size**2 * spectrum / spectrum.sum())
        value, found = _with(gram, moment, square, len(y), prior)
        if value > best:
            best, weights = value, (found, prior)
    gap = {"heldout": "leave-one-particle-out", "steps": [], "closed_fraction": None}
    if weights is not None:
        gap["closed_fraction"] = _closed(base, X, y, weights[1] ** 2 / weights[0][1])
    missing = best - plain > _B.hyperparameters and gap["closed_fraction"] > 0
    return answer("UNLISTED" if missing else "NO_GAP", gap=gap, log_bayes_factor=best - plain)


def _cosine(coordinates: np.ndarray, wave: tuple[int, int]) -> np.ndarray:
    return np.cos(np.pi * wave[0] * coordinates[:, 0]) * np.cos(np.pi * wave[1] * coordinates[:, 1])


def _without(square: float, number: int) -> float:
    """Log marginal likelihood at the best variance of white noise alone."""
    return -0.5 * number * np.log(square / number)


def _with(
    gram: np.ndarray, moment: np.ndarray, square: float, number: int, prior: np.ndarray
) -> tuple[float, tuple[np.ndarray, float]]:
    """The same with weights of normal prior, at the best of a few variances; the weights and that variance."""
    best = (-np.inf, (moment, 1.0))
    for variance in square / number * np.geomspace(0.01, 1.0, 13):
        A = np.eye(len(prior)) + prior[:, None] * gram * prior / variance
        L = np.linalg.cholesky(A)
        half = np.linalg.solve(L, prior * moment) / variance
        value = -0.5 * (number * np.log(variance) + square / variance - half @ half) - np.log(np.diag(L)).sum()
        value += 0.5 * number
        if value > best[0]:
            best = (value, (prior * np.linalg.solve(L.T, half), float(variance)))
    return best


def _closed(base: Fitted, X: np.ndarray, y: np.ndarray, ridge: np.ndarray) -> float:
    """Share of the mean square of particles left out that the discrepancy of the others takes away."""
    sizes = [len(r) + own.shape[1] for r, own in zip(base.residual, base.own, strict=True)]
    left, before = 0.0, 0.0
    penalty = np.diag(1.0 / np.maximum(ridge, 1e-300))
    gram, moment = X.T @ X, X.T @ y
    for at in _blocks(sizes):
        weights = np.linalg.solve(gram - X[at].T @ X[at] + penalty, moment - X[at].T @ y[at])
        left += float(np.sum((y[at] - X[at] @ weights) ** 2))
        before += float(np.sum(y[at] ** 2))
    return 1.0 - left / before


def _blocks(sizes: Sequence[int]) -> Iterator[slice]:
    start = 0
    for size in sizes:
        yield slice(start, start + size)
        start += size
