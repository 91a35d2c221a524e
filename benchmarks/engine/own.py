"""Effects that differ from test to test: a drift of each test's own, and sudden steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.special import logsumexp

from mcc_jax.calibrate.compiling import compiled
from mcc_jax.calibrate.data import Tests
from mcc_jax.calibrate.forward import Linear
from mcc_jax.calibrate.noise import whitening
from mcc_jax.calibrate.priors import NakagamiPrior

from .design import Base, State, design_of
from .evidence import Design, Optimum, optimise, scales_of, solve
from .screen import single_integrals

SHARES = (0.03, 0.1, 0.3, 1.0)
MOST_STEPS = 4


@dataclass(frozen=True)
class Own:
    """A hypothesis of numbers that each test has of its own.

    Attributes:
        log_evidence: its log marginal likelihood.
        optimum: hyperparameters.
        name: what it is.
    """

    log_evidence: float
    optimum: Optimum
    name: str
    steps: tuple[Any, ...] = ()


def drift(base: Base, state: State, free: np.ndarray, columns: Array, candidates: Any) -> tuple[float, Own | None]:
    """Log evidence of an amplitude that scatters around a common one, over all formulas of the mechanism.

    Args:
        columns: signatures of all candidates in units of their smallest plausible amplitudes.
        candidates: the formulas.
    """
    values: dict[str, list[float]] = {}
    best = None
    for k, c in enumerate(candidates):
        if not c.variant.random_per_test:
            continue
        ratio = c.variant.plausible[1] / c.variant.plausible[0]
        prior = NakagamiPrior(ratio, shape=0.25)
        own = columns[..., k : k + 1]
        design = design_of(
            base, state, (), own_columns=own, own_spreads=(prior,), amplitude_columns=own, largest=(ratio,), sign=(0,)
        )
        start = np.append(free, 1.0)
        o = optimise(design, start, curvature=False)
        values.setdefault(c.variant.name, []).append(o.log_joint)
        if best is None or o.log_joint > best[0].log_joint:
            best = o, c, design
    if best is None:
        return -np.inf, None
    o, c, design = best
    curved = optimise(design, o.free)
    each = [logsumexp(v) - np.log(len(v)) for v in values.values()]
    total = float(logsumexp(each) - np.log(len(each))) + curved.log_evidence - o.log_joint
    return total, Own(total, curved, f"{c.mechanism}:{c.variant.name}")


@compiled
def step_scores(free: Array, design: Design, epsilon: Array) -> tuple[Array, Array]:
    """Score and information of a step of 1 um at every point, each particle's own numbers integrated out."""
    noise, own, _common = scales_of(free, design)
    kinds = design.kinds
    points = design.data.shape[-1]
    residual = design.data - jnp.einsum("npc,c->np", design.common, epsilon)

    def one(scale: Array, tests: Tests, linear: Linear, columns: Array, residual: Array) -> tuple[Array, Array]:
        filtered = whitening(noise, scale, tests, linear, kinds.correlation, kinds.along)
        after = jnp.tril(jnp.ones((points, points)))
        steps = jnp.where(tests.mask[:, None], after, 0.0)
        white = filtered(jnp.concatenate([columns * own[None], steps, residual[:, None]], -1))
        o = columns.shape[-1]
        inner = white[:, :o].T @ white[:, :o] + jnp.eye(o)
        border = white[:, :o].T @ white[:, o:]
        root = jnp.linalg.cholesky(inner)
        half = jax.scipy.linalg.solve_triangular(root, border, lower=True)
        score = white[:, o:-1].T @ white[:, -1] - half[:, :-1].T @ half[:, -1]
        information = jnp.sum(white[:, o:-1] ** 2, 0) - jnp.sum(half[:, :-1] ** 2, 0)
        return score, information

    return jax.vmap(one)(design.scale, design.tests, design.linear, design.own, residual)


def pop_in(base: Base, state: State, free: np.ndarray, null: float, unit: tuple[float, float]) -> Own:
    """Log evidence of sudden steps in some tests, found one after the other.

    Args:
        null: log evidence without any.
        unit: smallest and largest plausible step [um].
    """
    tests = base.tests
    N, P = np.asarray(tests.mask).shape
    loading = np.asarray(tests.loading & tests.mask)
    ratio = unit[1] / unit[0]
    prior = NakagamiPrior(ratio / 3, shape=0.5)
    columns = np.zeros((N, P, 0))
    found: list[tuple[int, int]] = []
    at, _extra, best = free, (), Own(-np.inf, None, "pop_in:sharp")
    for turn in range(MOST_STEPS):
        own = jnp.asarray(columns) if turn else None
        design = design_of(base, state, (), own_columns=own, own_spreads=(prior,) * turn)
        if turn:
            o = optimise(design, np.concatenate([free, np.full(turn, 1.0)]), curvature=False)
            places = sum(np.log(max(loading[i].sum(), 1)) for i, _ in found)
            k = len({i for i, _ in found})
            share = max((k + 0.5) / (N + 1), 0.03)
            odds = k * np.log(share) + (N - k) * np.log1p(-min(share, 0.999)) + (len(found) - k) * np.log(0.5)
            value = o.log_joint - places + odds - np.log(len(SHARES))
            if value <= best.log_evidence + 0.5:
                break
            best = Own(float(value), o, "pop_in:sharp", tuple(found))
            at = o.free
        s = solve(jnp.asarray(at), design)
        score, information = map(np.asarray, step_scores(jnp.asarray(at), design, s.common))
        new = np.zeros((N, P, 1))
        added = False
        for i in range(N):
            rows = np.flatnonzero(loading[i])[1:]
            if not len(rows):
                continue
            each, _ = single_integrals(
                unit[0] * score[i, rows],
                unit[0] ** 2 * information[i, rows],
                np.ones(len(rows)),
                np.full(len(rows), ratio),
            )
            if logsumexp(each) - np.log(len(rows)) > np.log(3.0):
                j = rows[int(np.argmax(each))]
                new[i, j:, 0] = unit[0]
                found.append((i, int(j)))
                added = True
        if not added:
            break
        columns = np.concatenate([columns, np.where(np.asarray(tests.mask)[..., None], new, 0.0)], -1)
    return best
