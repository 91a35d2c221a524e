"""How strongly a hidden effect shows: its part that no refit of the base law can take up, in units of the noise.

Each particle's curve has covariance V = K + Z Omega Z', K the noise and Z the derivatives with respect to its own ln
C1, ln C3, ln C5, zero offset (and ln modulus where particles differ in it). After whitening, what the global parameters
(a, ln modulus, means of ln C) can explain is projected out; the length of what is left of an effect is lambda = |theta|
/ SE. Effects inside the law are finite, and the base law follows them along a curved path; for these the base law is
refitted (Gauss-Newton on the penalised misfit, whose minimum in the linear case is lambda squared).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from . import noise as noise_
from .law import LOG_C, SHAPE_PARAMETER, coefficients, simulate

_STEP = 1e-4
_ZERO_SD_UM = 10.0
_RANDOM = ("C1", "C3", "C5", "modulus")
_GLOBAL = ("a", "modulus", "C1", "C3", "C5")
_ADDITIVE = {"observable", "strain"}
_COEFFICIENTS = {"C1", "modulus"}


class Projection:
    """Base tangent space and noise of one design; `project` whitens and projects a change of the curves."""

    def __init__(self, particles, path, noise, scale):
        self.particles, self.path = particles, path
        self.base = simulate(particles, path)
        # Slope of the curve in force, for the noise of the force; a hold has none.
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.gradient(self.base, axis=1) / np.gradient(path.force, axis=1)
        slope = np.clip(np.where(np.isfinite(slope), np.abs(slope), 0.0), 0.0, 5.0)
        self._noise = noise_.covariance(noise, noise_.path_length(particles, path), scale, slope)
        sd = {name: LOG_C[name][1] for name in LOG_C} | {"modulus": noise.modulus_spread}
        self._sd = np.array([sd[name] for name in _RANDOM] + [_ZERO_SD_UM])
        self._cholesky, self._q, _, self._Z = self._factors(particles, SHAPE_PARAMETER)

    def _factors(self, particles, a):
        """Cholesky factors of V, orthonormal whitened global columns, their triangular factor, and Z."""
        columns = _tangents(particles, self.path, a)
        Z = np.stack([*(columns[name] for name in _RANDOM), np.ones_like(self.base)], axis=2)
        scaled = Z * self._sd
        cholesky = np.linalg.cholesky(self._noise + scaled @ scaled.transpose(0, 2, 1))
        q, r = np.linalg.qr(_whiten(cholesky, np.stack([columns[name] for name in _GLOBAL], axis=2)))
        return cholesky, q, r, Z

    def whiten(self, change):
        """Whitened curves as one vector."""
        return _whiten(self._cholesky, change[:, :, None])[:, 0]

    def project(self, change):
        """Whitened, projected change of the displacements (particles, samples), as one vector."""
        white = self.whiten(change)
        return white - self._q @ (self._q.T @ white)

    def unexplained(self, change):
        """What of a change of the displacements the base law, refitted, cannot take up; um, (particles, samples)."""
        left = self.project(change).reshape(self.base.shape)
        own = self._own(self._cholesky, left, self._Z)
        return np.einsum("nst,nt->ns", self._cholesky, left) - np.einsum("ntk,nk->nt", self._Z, own)

    def _own(self, cholesky, left, Z):
        """Deviations of the particles, (particles, 5), that whitened, projected curves ask for."""
        back = np.stack(
            [
                solve_triangular(L, v, lower=True, trans="T", check_finite=False)
                for L, v in zip(cholesky, left, strict=True)
            ]
        )
        return self._sd**2 * np.einsum("ntk,nt->nk", Z, back)

    def change(self, effects):
        """Change of the displacements that `effects` make, um."""
        return simulate(self.particles, self.path, effects) - self.base

    def signature(self, effect):
        """Projected derivative of the displacements by the amplitude at zero."""
        step = 1e-3 * effect.unit
        return self.project(self.change(effect(step))) / step

    def strength(self, effects):
        """lambda of finite effects."""
        if all(set(hooks) <= _COEFFICIENTS and "C1" in hooks for hooks, _ in effects):
            return float(np.linalg.norm(self.project(self._log_change(effects))))
        target = simulate(self.particles, self.path, effects)
        if all(set(hooks) <= _ADDITIVE for hooks, _ in effects):
            return float(np.linalg.norm(self.project(target - self.base)))
        return self.refit(target)

    def _log_change(self, effects):
        """Effect that only rescales C1 and the modulus of whole particles, in the logarithms, where it is linear."""
        before = {"C1": self.particles.C1, "modulus": self.particles.modulus}
        after = coefficients(self.particles, self.path, effects)
        shifts = {name: np.log(after[name] / before[name]) for name in before}
        return sum(self._Z[:, :, _RANDOM.index(name)] * shifts[name][:, None] for name in shifts)

    def residual(self, change, displacement_noise, force_noise, deviations):
        """What a fit of the base law at the true covariance leaves: whitened, projected data.

        deviations (particles, 5): the particles' true ln C1, ln C3, ln C5, ln modulus and zero, less their means.
        """
        slope = np.gradient(self.base, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = slope / np.gradient(self.path.force, axis=1)
        slope = np.where(np.isfinite(slope), np.clip(slope, -5.0, 5.0), 0.0)
        errors = displacement_noise - slope * force_noise + np.einsum("ntk,nk->nt", self._Z, deviations)
        return self.project(change + errors)

    def refit(self, target, rounds=4):
        """Square root of the least penalised misfit of the base law to the noiseless curves `target`."""
        count, names = len(self.base), list(LOG_C)
        shift, common = np.zeros((count, 5)), np.zeros(5)
        best, move = np.inf, 1.0
        for _ in range(rounds):
            logs = shift[:, :4] + common[[2, 3, 4, 1]]
            p = self.particles
            moved = p.with_(
                **{name: getattr(p, name) * np.exp(logs[:, j]) for j, name in enumerate((*names, "modulus"))},
                zero=p.zero + shift[:, 4],
            )
            a = SHAPE_PARAMETER + common[0]
            residual = target - simulate(moved, self.path, a=a)
            cholesky, q, r, Z = self._factors(moved, a)
            linear = residual + np.einsum("ntk,nk->nt", Z, shift)
            white = _whiten(cholesky, linear[:, :, None])[:, 0] + q @ (r @ common)
            fitted = q.T @ white
            left = (white - q @ fitted).reshape(self.base.shape)
            value = float(np.linalg.norm(left))
            if not np.isfinite(value):
                break
            if abs(value - best) < 5e-3 * value:
                best = value
                break
            best = value
            new_common = np.linalg.solve(r, fitted)
            new_shift = self._own(cholesky, left, Z)
            size = max(np.abs(new_common - common).max(), np.abs(new_shift[:, :4] - shift[:, :4]).max())
            move = min(1.0, 0.5 / max(size, 1e-12))
            common = common + move * (new_common - common)
            shift = shift + move * (new_shift - shift)
        return best


def _whiten(cholesky, curves):
    return np.concatenate(
        [solve_triangular(L, c, lower=True, check_finite=False) for L, c in zip(cholesky, curves, strict=True)],
    )


def _tangents(particles, path, a):
    """Derivatives of the displacement by ln C1, ln C3, ln C5, ln modulus and a, by central differences."""

    def moved(name, step):
        if name == "a":
            return simulate(particles, path, a=a + step)
        return simulate(particles.with_(**{name: getattr(particles, name) * np.exp(step)}), path, a=a)

    return {
        name: (moved(name, _STEP) - moved(name, -_STEP)) / (2.0 * _STEP) for name in ("C1", "C3", "C5", "modulus", "a")
    }


def amplitude_for(projection, effect, target, tolerance=0.02, largest=None, strength=None):
    """Amplitude at which `effect(amplitude)` reaches lambda = `target`.

    Returns (amplitude, lambda); the latter stays short of the target where the effect saturates or leaves its domain at
    `largest` first. Zero where the effect cannot be seen at all. `strength` replaces lambda by another function of
    effects.
    """
    measure = strength or projection.strength
    largest = np.inf if largest is None else largest
    step = min(1e-3 * effect.unit, largest)
    slope = measure(effect(step)) / step
    if slope * effect.unit < 1e-6:
        return 0.0, 0.0
    low, high = 0.0, np.inf
    trial = min(target / slope, largest)
    best = (step, slope * step)
    for _ in range(12):
        reached = measure(effect(trial))
        if np.isfinite(reached) and abs(reached - target) < abs(best[1] - target):
            best = (trial, reached)
        if abs(best[1] / target - 1.0) < tolerance or (trial >= largest and reached < target):
            break
        if np.isfinite(reached) and reached < target:
            low = trial
        else:
            high = trial
        guess = trial * np.clip(target / reached, 0.3, 3.0) if np.isfinite(reached) and reached > 0 else 0.0
        if not low < guess < high:
            guess = 0.5 * (low + high) if np.isfinite(high) else 2.0 * low
        trial = min(guess, largest)
        if low >= largest:
            break
    return float(best[0]), float(best[1])
