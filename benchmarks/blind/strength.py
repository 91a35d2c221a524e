"""How strongly a hidden effect shows: what no refit of the base law can take up, in units of the true noise.

lambda squared is the least penalised misfit of the base law to the noiseless curves with the effect. Free in that fit:
a, ln modulus and the means of ln C1, ln C3, ln C5; of each particle ln C1, ln C3, ln C5, its modulus and its strain's
factor where these scatter, all about the population at their true spreads, and its zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .noise import Noise, whitening
from .settings import SETTINGS
from .world import Hidden, Shift, World

Tangents = tuple[np.ndarray, np.ndarray]

_R = SETTINGS.refitting


@dataclass(frozen=True)
class Point:
    """A base law beside the true one: own deviations (n, columns) in standard deviations, shared numbers (5)."""

    own: np.ndarray
    shared: np.ndarray


@dataclass(frozen=True)
class Refit:
    """The base law fitted to noiseless curves.

    white: what is left, whitened, with the rows of the prior; strength: lambda; left_um: what is left at each reading.
    """

    white: np.ndarray
    strength: float
    left_um: np.ndarray
    point: Point


class Projection:
    """The base law's freedom in one campaign at the true noise and the true spreads."""

    def __init__(self, world: World, noise: Noise, nuisance: str = "") -> None:
        self.world = world
        self.whiteners = whitening(noise, world)
        scatter = {name: sd if name == nuisance else 0.0 for name, sd in SETTINGS.testers.scatter.items()}
        sd = [*np.maximum(world.spread, _R.least_spread), scatter["shape"], scatter["modulus"], _R.zero_sd_um]
        self._used = np.flatnonzero(sd)
        self._sd = np.asarray(sd)[self._used]
        self._start = Point(np.zeros((world.count, len(self._used))), np.zeros(5))

    @cached_property
    def _at_truth(self) -> Tangents:
        return self._tangents(self._start)

    def project(self, change: np.ndarray) -> np.ndarray:
        """What is left, whitened, of a small change of the displacement: one linear step from the truth."""
        return self._solve(change, self._at_truth, self._start)[0]

    @property
    def deviation(self) -> np.ndarray:
        """What the particles' true deviations from the population add to the data of a score test, um.

        Curves are taken about the particles' true numbers; a test that knows the population only sees these, too.
        """
        C1, C3, C5, modulus = self.world.deviation
        columns = self._at_truth[0]
        full = np.zeros((len(columns), 6))
        full[:, self._used] = columns
        own = np.stack([C1, C3, C5, 0.0 * C1, modulus, 0.0 * C1], axis=1)[self.world.owner]
        return np.sum(full * own, axis=1)

    def unexplained(self, change: np.ndarray) -> np.ndarray:
        """What of a small change of the displacement the base law cannot take up, um."""
        tangents = self._at_truth
        _, own, shared = self._solve(change, tangents, self._start)
        return self._left(change, tangents, own, shared)

    def whiten(self, change: np.ndarray) -> np.ndarray:
        """Whitened curves as one vector."""
        return np.concatenate([w @ change[s] for w, s in zip(self.whiteners, self.world.slices, strict=True)])

    def refit(self, curves: np.ndarray, start: Point | None = None) -> Refit:
        """The nearest base law by Gauss-Newton with steps halved; linear in the last step."""
        point = self._start
        if not np.all(np.isfinite(curves)):  # beyond where the formula means anything
            return Refit(np.zeros_like(curves), np.inf, np.zeros_like(curves), point)
        residual, objective = self._objective(curves, point)
        if start is not None:
            tried = self._objective(curves, start)
            if tried[1] < objective:
                point, (residual, objective) = start, tried
        for _ in range(_R.rounds):
            tangents = self._tangents(point)
            white, own, shared = self._solve(residual, tangents, point)
            predicted = float(white @ white)
            if objective - predicted < _R.settled * predicted + 1e-3:
                break
            size = max(np.abs(shared).max(), np.abs(own[:, :-1] * self._sd[:-1]).max(), 1e-9)
            share = min(1.0, 0.5 / size)
            for _ in range(_R.halvings):
                tried_point = Point(point.own + share * own, point.shared + share * shared)
                tried = self._objective(curves, tried_point)
                if tried[1] < objective:
                    break
                share *= 0.4
            else:
                break
            point, (residual, objective) = tried_point, tried
        return Refit(white, float(np.sqrt(predicted)), self._left(residual, tangents, own, shared), point)

    def _left(self, residual: np.ndarray, tangents: Tangents, own: np.ndarray, shared: np.ndarray) -> np.ndarray:
        columns, common = tangents
        return residual - np.sum(columns * self._sd * own[self.world.owner], axis=1) - common @ shared

    def _shift(self, point: Point) -> Shift:
        """Own columns: ln C1, ln C3, ln C5, all three, modulus, zero. Shared: a, modulus, ln C1, ln C3, ln C5."""
        full = np.zeros((self.world.count, 6))
        full[:, self._used] = point.own * self._sd
        log_C = full[:, :3].T + full[:, 3] + point.shared[2:, None]
        return Shift(log_C, full[:, 4] + point.shared[1], float(point.shared[0]))

    def _objective(self, curves: np.ndarray, point: Point) -> tuple[np.ndarray, float]:
        zero = (point.own[:, -1] * self._sd[-1])[self.world.owner]
        residual = curves - self.world.curves((), self._shift(point)) - zero
        if not np.all(np.isfinite(residual)):
            return residual, np.inf
        white = self.whiten(residual)
        return residual, float(white @ white + np.sum(point.own**2))

    def _tangents(self, point: Point) -> Tangents:
        """Derivatives of the displacement: own columns before scaling by their spreads, shared columns."""
        at = self._shift(point)

        def slope(log_C: np.ndarray | None = None, log_modulus: float = 0.0, a: float = 0.0) -> np.ndarray:
            step = np.zeros(3) if log_C is None else log_C

            def moved(sign: float) -> np.ndarray:
                h = sign * _R.step
                shift = Shift(at.log_C + h * step[:, None], at.log_modulus + h * log_modulus, at.a + h * a)
                return self.world.curves((), shift)

            return (moved(1.0) - moved(-1.0)) / (2.0 * _R.step)

        log_C = [slope(row) for row in np.eye(3)]
        modulus = slope(log_modulus=1.0)
        own = np.stack([*log_C, sum(log_C), modulus, np.ones_like(modulus)], axis=1)
        return own[:, self._used], np.stack([slope(a=1.0), modulus, *log_C], axis=1)

    def _solve(self, residual: np.ndarray, tangents: Tangents, at: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Least squares with each particle's own columns taken out first: what is left, own steps, shared steps."""
        columns, common = tangents
        size = len(self._used)
        parts, free, targets = [], [], []
        for i, (w, s) in enumerate(zip(self.whiteners, self.world.slices, strict=True)):
            M = np.vstack([w @ (columns[s] * self._sd), np.eye(size)])
            G = np.vstack([w @ common[s], np.zeros((size, common.shape[1]))])
            y = np.concatenate([w @ residual[s], -at.own[i]])
            Q, R = np.linalg.qr(M)
            parts.append((Q, R, y, G))
            free.append(G - Q @ (Q.T @ G))
            targets.append(y - Q @ (Q.T @ y))
        G, y = np.vstack(free), np.concatenate(targets)
        norm = np.maximum(np.linalg.norm(G, axis=0), 1e-12)
        shared = np.linalg.lstsq(G / norm, y, rcond=1e-8)[0] / norm
        own = np.stack([np.linalg.solve(R, Q.T @ (y_i - G_i @ shared)) for Q, R, y_i, G_i in parts])
        return y - G @ shared, own, shared


def signature(projection: Projection, hidden: Hidden) -> np.ndarray:
    """Projected, whitened change by an effect where it is weak, scaled to length one; nil where it cannot be seen."""
    world, amplitude = projection.world, 1e-2 * min(hidden.start, hidden.largest)
    small = projection.project(world.curves([(hidden, amplitude)], None) - world.base)
    size = np.linalg.norm(small)
    if size > _R.weak:  # formulas bend with their amplitude
        small = projection.project(world.curves([(hidden, amplitude * _R.weak / size)], None) - world.base)
        size = np.linalg.norm(small)
    return small / size if size > 1e-4 else np.zeros_like(small)


def amplitude_for(projection: Projection, hidden: Hidden, target: float) -> tuple[float, Refit]:
    """Amplitude at which lambda reaches `target`, never above the formula's bound, and the base law refitted there."""
    world = projection.world
    small = 1e-2 * min(hidden.start, hidden.largest)
    slope = np.linalg.norm(projection.project(world.curves([(hidden, small)], None) - world.base)) / small
    theta = min(hidden.largest, 0.95 * target / max(slope, 1e-12))
    below, above, best, point = (0.0, 0.0), None, None, None
    for _ in range(_R.search):
        found = projection.refit(world.curves([(hidden, theta)], None), point)
        point = found.point
        miss = abs(np.log(max(found.strength, 1e-9) / target))
        if best is None or miss < best[0]:
            best = (miss, theta, found)
        if abs(found.strength / target - 1.0) < _R.close or (theta >= hidden.largest and found.strength < target):
            break
        if found.strength < target:
            below = (theta, found.strength)
        else:
            above = (theta, found.strength)
        if above is None:
            theta = min(hidden.largest, theta * float(np.clip(target / max(found.strength, 1e-6), 1.02, 3.0)))
        else:
            width = above[0] - below[0]
            theta = below[0] + width * (target - below[1]) / (above[1] - below[1])
            theta = float(np.clip(theta, below[0] + 0.05 * width, above[0] - 0.02 * width))
    return best[1:]


def cosine(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two projected, whitened curves; nil where one is."""
    size = np.linalg.norm(one) * np.linalg.norm(other)
    return float(one @ other / size) if size > 0 else 0.0


def resemblances(projection: Projection, white: np.ndarray, but: str = "") -> list[tuple[str, str, float]]:
    """Listed formulas of other mechanisms by how like they are to a projected curve: mechanism, formula, correlation.

    To first order; the best formula of each mechanism, a correlation of the impossible sign counts as none.
    """
    best: dict[str, tuple[str, float]] = {}
    for hidden in projection.world.listed():
        if hidden.mechanism == but:
            continue
        rho = cosine(white, signature(projection, hidden))
        rho = abs(rho) if hidden.signed else max(rho, 0.0)
        if rho > best.get(hidden.mechanism, ("", -1.0))[1]:
            best[hidden.mechanism] = (hidden.formula, rho)
    return sorted(((m, f, rho) for m, (f, rho) in best.items()), key=lambda row: -row[2])
