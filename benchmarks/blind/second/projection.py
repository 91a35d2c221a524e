"""How far a set of curves lies from anything the base law can give, in units of the true noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .law import Shift, coefficients, simulate
from .particles import LOG_C_SD


@dataclass(frozen=True)
class Mode:
    """What the base law may take up.

    zero: a displacement zero of each test. spread: prior standard deviations of ln C1, ln C3, ln C5 about means that
    are free; None leaves the three free for each particle.
    """

    zero: bool = False
    spread: np.ndarray | None = None


MODES = {
    "free": Mode(),
    "free_zero": Mode(zero=True),
    "pop": Mode(spread=np.array([LOG_C_SD[0], 0.01, LOG_C_SD[2]])),
    "pop_exact": Mode(spread=np.array([LOG_C_SD[0], 1e-6, LOG_C_SD[2]])),
}

_STEP = 1e-4
_ROUNDS, _HALVINGS = 8, 6


class _Tangents(NamedTuple):
    """Change of the displacement with ln C1, ln C3, ln C5, with a (None where not asked), with ln modulus."""

    log_C: list[np.ndarray]
    a: np.ndarray | None
    log_modulus: np.ndarray


@dataclass(frozen=True)
class _Point:
    """A base law: ln C beside the true one as mean plus spread times deviation, zero of each test in um."""

    shift: Shift
    zero: np.ndarray
    deviation: np.ndarray
    mean: np.ndarray


class Projection:
    """Gauss-Newton from the truth onto the base law.

    Where C is free for each particle, a does nothing that C could not do, and is left out.
    """

    def __init__(self, campaign):
        self.campaign = campaign
        self.base = simulate(campaign)
        self._at_truth = None

    def project(self, change, mode="free"):
        """What is left, whitened, of a small change of the displacement: one linear step from the truth."""
        zeros = np.zeros((3, len(self.campaign.particles)))
        if self._at_truth is None:
            self._at_truth = self._tangents(Shift(zeros), with_a=True)
        return self._solve(change, self._at_truth, MODES[mode], zeros)[0]

    def distance(self, curves, mode="free", effects=()):
        """Lambda: the distance to the nearest base law."""
        return self.fit(curves, mode, effects)[1]

    def fit(self, curves, mode="free", effects=()):
        """Whitened residuals beside the nearest base law, linear in the last step, and the distance.

        effects: what made the curves; where these only rescale coefficients, the search starts at the rescaled ones.
        """
        mode = MODES[mode]
        spread = mode.spread
        point, residual, objective = self._start(curves, mode, effects)
        left = None
        for _ in range(_ROUNDS):
            tangents = self._tangents(point.shift, with_a=spread is not None)
            left, local, shared = self._solve(residual, tangents, mode, point.deviation)
            predicted = float(left @ left)
            if objective - predicted < 0.004 * predicted + 1e-3:
                break
            unit = 1 if spread is None else spread[:, None]
            share = min(1.0, 0.5 / max(1e-9, np.abs(shared).max(), np.abs(local[:3] * unit).max()))
            for _ in range(_HALVINGS):
                tried = _moved(point, share, local, shared, mode)
                tried_residual, tried_objective = self._objective(curves, tried, mode)
                if tried_objective < objective:
                    break
                share *= 0.4
            else:
                break
            point, residual, objective = tried, tried_residual, tried_objective
        return left, np.sqrt(objective)

    def _start(self, curves, mode, effects):
        count = len(self.campaign.particles)
        zeros = np.zeros((3, count))
        point = _Point(Shift(zeros), np.zeros(count), zeros, np.zeros(3))
        residual, objective = self._objective(curves, point, mode)
        log_C, log_modulus = self._rescaled(effects)
        if not np.any(log_C) and not log_modulus:
            return point, residual, objective
        for kept in ([True, True, True], [True, False, True]):
            tried = _Point(Shift(log_C.copy(), 0.0, log_modulus), np.zeros(count), zeros, np.zeros(3))
            if mode.spread is not None:
                mean = log_C.mean(1)
                deviation = ((log_C - mean[:, None]) / mode.spread[:, None]) * np.array(kept)[:, None]
                shift = Shift(mean[:, None] + mode.spread[:, None] * deviation, 0.0, log_modulus)
                tried = _Point(shift, np.zeros(count), deviation, mean)
            tried_residual, tried_objective = self._objective(curves, tried, mode)
            if tried_objective < objective:
                point, residual, objective = tried, tried_residual, tried_objective
        return point, residual, objective

    def _rescaled(self, effects):
        """Ln C and mean ln modulus that an effect on coefficients amounts to."""
        p = self.campaign.particles
        values = coefficients(self.campaign, effects)
        shape = np.log(values.eta / (1 + p.a * (1 - p.q)))
        log_C = np.stack([np.log(getattr(values, name) / p.C[:, k]) for k, name in enumerate(("C1", "C3", "C5"))])
        return log_C + shape, float(np.mean(np.log(values.modulus / p.modulus)))

    def _objective(self, curves, point, mode):
        """Residuals in um and their squared length, whitened, with the prior's."""
        path, whitening = self.campaign.path, self.campaign.noise.whitening
        residual = curves - simulate(self.campaign, shift=point.shift) - point.zero[path.owner]
        squared = sum(float(np.sum((w @ residual[s]) ** 2)) for w, s in zip(whitening, path.slices, strict=True))
        return residual, squared + (float(np.sum(point.deviation**2)) if mode.spread is not None else 0.0)

    def _tangents(self, at, with_a):
        def slope(up, down):
            return (simulate(self.campaign, shift=up) - simulate(self.campaign, shift=down)) / (2 * _STEP)

        log_C = []
        for k in range(3):
            up, down = at.log_C.copy(), at.log_C.copy()
            up[k] += _STEP
            down[k] -= _STEP
            log_C.append(slope(at._replace(log_C=up), at._replace(log_C=down)))
        log_modulus = slope(
            at._replace(log_modulus=at.log_modulus + _STEP), at._replace(log_modulus=at.log_modulus - _STEP)
        )
        a = slope(at._replace(a=at.a + _STEP), at._replace(a=at.a - _STEP)) if with_a else None
        return _Tangents(log_C, a, log_modulus)

    def _solve(self, residual, tangents, mode, deviation):
        """Least squares: what is left (whitened, with the prior's rows), the steps of each particle, the shared step.

        Each particle's own columns are taken out first, so that only the shared ones make one system.
        """
        path, spread = self.campaign.path, mode.spread
        own = 3 + mode.zero
        shared = [tangents.log_modulus] if spread is None else [*tangents.log_C, tangents.a, tangents.log_modulus]
        bases, triangles, targets, columns = [], [], [], []
        for i, samples in enumerate(path.slices):
            whiten = self.campaign.noise.whitening[i]
            ones = [np.ones(samples.stop - samples.start)] if mode.zero else []
            M = whiten @ np.stack([t[samples] for t in tangents.log_C] + ones, 1)
            y = whiten @ residual[samples]
            G = whiten @ np.stack([g[samples] for g in shared], 1)
            if spread is not None:
                M[:, :3] *= spread
                M = np.vstack([M, np.eye(3, own)])
                y = np.concatenate([y, -deviation[:, i]])
                G = np.vstack([G, np.zeros((3, len(shared)))])
            norm = np.linalg.norm(M, axis=0)
            Q, R = np.linalg.qr(M / norm)
            bases.append(Q)
            triangles.append(R * norm)
            targets.append((y, y - Q @ (Q.T @ y)))
            columns.append((G, G - Q @ (Q.T @ G)))
        G = np.vstack([free for _, free in columns])
        y = np.concatenate([free for _, free in targets])
        norm = np.maximum(np.linalg.norm(np.vstack([whole for whole, _ in columns]), axis=0), 1e-12)
        step = np.linalg.lstsq(G / norm, y, rcond=1e-6)[0] / norm
        local = [
            np.linalg.lstsq(R, Q.T @ (y_i - G_i @ step), rcond=1e-9)[0]
            for Q, R, (y_i, _), (G_i, _) in zip(bases, triangles, targets, columns, strict=True)
        ]
        return y - G @ step, np.stack(local, 1), step


def _moved(point, share, local, shared, mode):
    """The point a share of the step further."""
    shift, deviation, mean = point.shift, point.deviation, point.mean
    if mode.spread is None:
        shift = Shift(shift.log_C + share * local[:3], shift.a, shift.log_modulus + share * shared[0])
    else:
        deviation = deviation + share * local[:3]
        mean = mean + share * shared[:3]
        log_C = mean[:, None] + mode.spread[:, None] * deviation
        shift = Shift(log_C, shift.a + share * shared[3], shift.log_modulus + share * shared[4])
    zero = point.zero + share * local[3] if mode.zero else point.zero
    return _Point(shift, zero, deviation, mean)
