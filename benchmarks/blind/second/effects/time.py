"""Time: drift, creep, rate."""

from __future__ import annotations

import numpy as np

from .effect import Array, Campaign, Effect, State, log_uniform

RATE_UNIT = 1e-3
"""Strain rate in 1/s at which rate formulas leave the law as it is."""


class _Drift(Effect):
    mechanism = "thermal_drift"
    start, unit = 1e-3, "um/s"


class DriftCommon(_Drift):
    text = "gamma += {sg}th*t (one rate in all tests)"
    signed = True

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return self.sign * theta * c.path.time


class DriftPerTest(_Drift):
    text = "gamma += th*z_i*t, z_i~N(0,1) per test"

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return theta * c.particles.normal[c.owner, 0] * c.path.time


class DriftSettling(_Drift):
    text = "gamma += {sg}th*(0.6+0.4|z_i|)*tau*(1-exp(-t/tau)), tau={tau} s (chamber settles)"
    signed = True

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"tau": log_uniform(rng, 90, 250)}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        tau = self.drawn.tau
        share = 0.6 + 0.4 * np.abs(c.particles.normal[c.owner, 0])
        return self.sign * theta * share * tau * (-np.expm1(-c.path.time / tau))


class _Creep(Effect):
    """Hereditary: D_e times the integral of a kernel over the changes of stress."""

    mechanism = "creep"
    start, unit = 1e-4, "1/MPa"
    protocols = ("P1", "P0", "P2")

    def kernel(self, since: Array) -> Array:
        """Strain per MPa and amplitude, `since` seconds after a step of stress."""
        raise NotImplementedError

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        if self not in c.memory:
            c.memory[self] = self._per_amplitude(c)
        return theta * c.memory[self]

    def _per_amplitude(self, c: Campaign) -> Array:
        strain = np.empty(len(c.path))
        for samples in c.path.slices:
            time, stress = c.path.time[samples], c.path.stress[samples]
            steps = np.concatenate([[stress[0]], np.diff(stress)])
            stepped_at = np.concatenate([[time[0] / 2], 0.5 * (time[1:] + time[:-1])])
            since = time[:, None] - stepped_at[None]
            strain[samples] = np.where(since > 0, self.kernel(np.maximum(since, 0)), 0) @ steps
        return strain * c.particles.De[c.owner]


class CreepKelvinVoigt(_Creep):
    text = "tau de/dt + e = th*sigma, gamma += D_e*e, tau={tau} s (Kelvin-Voigt)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"tau": log_uniform(rng, 5, 25)}

    def kernel(self, since: Array) -> Array:
        return -np.expm1(-since / self.drawn.tau)


class CreepLogarithmic(_Creep):
    text = "gamma += D_e*th*int ln(1+(t-s)/tau) dsigma(s), tau={tau} s (logarithmic, hereditary)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"tau": log_uniform(rng, 1.5, 8)}

    def kernel(self, since: Array) -> Array:
        return np.log1p(since / self.drawn.tau)


class CreepFractional(_Creep):
    text = "gamma += D_e*th*int ((t-s)/10s)^p dsigma(s), p={p} (fractional / springpot)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"p": float(rng.uniform(0.22, 0.36))}

    def kernel(self, since: Array) -> Array:
        return (since / 10) ** self.drawn.p


class _Rate(Effect):
    """Strain rate on the unchanged loading curve."""

    mechanism = "rate_dependence"
    start, unit = 0.01, "-"
    protocols = ("P2",)


class RateFirstTerm(_Rate):
    text = "C1 -> C1*(1+th*ln(edot/1e-3)), edot = local strain rate of first loading"

    def loading(self, theta: float, terms: State) -> None:
        logarithm = np.log(terms.stress_rate / terms.slope / RATE_UNIT)
        terms.first = terms.first * np.maximum(0.1, 1 + theta * logarithm)


class RatePower(_Rate):
    text = "sigma_load -> sigma_load*(edot/1e-3)^th (strain-rate sensitivity on the whole master law)"

    def loading(self, theta: float, terms: State) -> None:
        logarithm = np.log(terms.stress_rate / terms.slope / RATE_UNIT)
        terms.factor = terms.factor * np.exp(np.clip(theta * logarithm, -2, 2))


class RateCowperSymonds(_Rate):
    text = "sigma_load -> sigma_load*(1+th*(edot/1e-3)^(1/{p})) (Cowper-Symonds)"
    start = 0.02

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"p": float(rng.uniform(3, 5))}

    def loading(self, theta: float, terms: State) -> None:
        ratio = terms.stress_rate / terms.slope / RATE_UNIT
        terms.factor = terms.factor * (1 + theta * ratio ** (1 / self.drawn.p))


FORMULAS = (
    *(DriftCommon, DriftPerTest, DriftSettling),
    *(CreepKelvinVoigt, CreepLogarithmic, CreepFractional),
    *(RateFirstTerm, RatePower, RateCowperSymonds),
)
