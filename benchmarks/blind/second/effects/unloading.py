"""Unloading and time: adhesion, modulus, shape, yielding backwards, reloads, creep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

import numpy as np

from ..law import CONTACT_AREA, unloading_ratio
from ..path import RELOAD
from .effect import Array, Campaign, Formula, State
from .loading import power

_adhesion = partial(Formula, "adhesion")
_damage = partial(Formula, "damage", protocols=("P1", "P0"), low_turn=True)
_dense = partial(Formula, "densification_stiffening", start=0.5, protocols=("P1", "P1", "P0"), low_turn=True)
_shape = partial(Formula, "unloading_shape", start=0.05, largest=1.0)
_reverse = partial(Formula, "reverse_plasticity")
_lag = partial(Formula, "reload_hysteresis", start=0.03, protocols=("P1", "P2"), reloads=1)
_ratchet = partial(Formula, "ratcheting", start=0.05, protocols=("P1", "P2"), reloads=3)
_creep = partial(Formula, "creep", start=1e-4, unit="1/MPa", protocols=("P1", "P0", "P2"))


def _contact(th: float, c: Campaign, s: State, recovered: Array, n: State) -> Array:
    phi = np.sqrt(np.clip(1 - recovered * recovered, 0, 1))
    return -th / s.peak * phi**1.5 * (1 - phi**n.k)


def _jkr(th: float, c: Campaign, s: State, recovered: Array, n: State) -> Array:
    Re, phi = c.particles.Re[c.owner], np.sqrt(np.clip(1 - recovered * recovered, 0, 1))
    contact = 2 * Re * np.sqrt(CONTACT_AREA * s.eps_P)
    pull = np.sqrt(8 * np.pi * th * c.particles.mean_modulus * (contact * phi) ** 3) / (np.pi * Re**2)
    return -pull / s.peak * (-np.expm1(-recovered / n.k))


def _dugdale(th: float, c: Campaign, s: State, recovered: Array, n: State) -> Array:
    bonded = th * 4 * CONTACT_AREA * s.eps_P * (1 - recovered * recovered)
    return -bonded / s.peak * (-np.expm1(-recovered / n.k))


def _saturating(th: float, c: Campaign, s: State, n: State) -> Array:
    return 1 - 0.85 * (-np.expm1(-th * np.maximum(s.eps_P - n.e0, 0) ** n.k))


def _bent(th: float, c: Campaign, s: State, recovered: Array, n: State) -> Array:
    return unloading_ratio(power(recovered, 1 + n.sign * min(th, 1.2) / 2)) - unloading_ratio(recovered)


def _onset(th: float, c: Campaign, s: State, n: State) -> Array:
    return -th * s.delta * s.De * (np.maximum(n.uc - s.u, 0) / n.uc) ** 2


def lagging(
    lag: Callable[[Array, State], Array], depth: Callable[[Campaign], Array | float] = lambda c: 1.0
) -> dict[str, Callable]:
    """The displacement lags on reloading, so that a loop dissipates: lag along the reload, 0 at both ends."""

    def displacement(th: float, c: Campaign, s: State, n: State) -> Array:
        lagged = -th * s.delta * s.De * lag(c.path.reload_share, n) * depth(c)
        return np.where(c.path.branch == RELOAD, lagged, 0.0)

    return {"displacement": displacement}


def adding(step: Callable[[Campaign, State, int, int, State], float], exponent: float) -> dict[str, Callable]:
    """Every reload adds strain that stays: `step` of the reload of a number, beginning at a sample."""

    def displacement(th: float, c: Campaign, s: State, n: State) -> Array:
        out, numbers = np.zeros(len(c.path)), Counter()
        for i, begin, end, stop in c.path.reloads:
            numbers[i] += 1
            added = th * step(c, s, numbers[i], begin, n) * c.particles.De[i]
            out[begin:end] += added * np.clip(c.path.reload_share[begin:end], 0, 1) ** exponent
            out[end:stop] += added
        return out

    return {"displacement": displacement}


def hereditary(kernel: Callable[[Array, State], Array]) -> dict[str, Callable]:
    """D_e times the integral of a kernel over the changes of stress: strain per MPa, so many seconds after a step."""

    def displacement(th: float, c: Campaign, s: State, n: State) -> Array:
        if id(n) not in c.memory:
            c.memory[id(n)] = (n, _per_amplitude(c, lambda since: kernel(since, n)))  # n is kept, so is its id
        return th * c.memory[id(n)][1]

    return {"displacement": displacement}


def _per_amplitude(c: Campaign, kernel: Callable[[Array], Array]) -> Array:
    strain = np.empty(len(c.path))
    for samples in c.path.slices:
        time, stress = c.path.time[samples], c.path.stress[samples]
        steps = np.concatenate([[stress[0]], np.diff(stress)])
        stepped_at = np.concatenate([[time[0] / 2], 0.5 * (time[1:] + time[:-1])])
        since = time[:, None] - stepped_at[None]
        strain[samples] = np.where(since > 0, kernel(np.maximum(since, 0)), 0) @ steps
    return strain * c.particles.De[c.owner]


# fmt: off
FORMULAS = (
    _adhesion(
        "AdhesionContact", "sigma_u -> sigma_u - th*phi^1.5*(1-phi^{k})", {"unloading": _contact},
        {"k": ("whole", 16, 41)}, start=0.3, unit="MPa", largest=4.0,
    ),
    _adhesion(
        "AdhesionJKR",
        "sigma_u -> sigma_u - sqrt(8 pi th Ebar (a_P phi)^3)/(pi R_e^2)*(1-exp(-s/{k})), th=work of adhesion "
        "(JKR punch, pull-off ~ a^1.5)", {"unloading": _jkr}, {"k": ("even", 0.08, 0.25)}, start=1e-3,
        unit="MPa um (=J/m^2)",
    ),
    _adhesion(
        "AdhesionDugdale", "sigma_u -> sigma_u - th*(a_P phi/R_e)^2*(1-exp(-s/{k})) "
        "(Dugdale/DMT: constant bond stress on the remaining contact)", {"unloading": _dugdale},
        {"k": ("even", 0.1, 0.3)}, start=0.1, unit="MPa", largest=4.0,
    ),
    _damage(
        "DamageExponential", "Ebar -> Ebar*exp(-th*(eps_P-0.1)+)",
        {"modulus": lambda th, c, s, n: np.exp(-th * np.maximum(s.eps_P - 0.1, 0))}, largest=4.0,
    ),
    _damage(
        "DamageSaturating", "Ebar -> Ebar*(1-0.85*(1-exp(-th*(eps_P-{e0})+^{k}))) (saturating, Lemaitre threshold)",
        {"modulus": _saturating}, {"e0": ("even", 0.1, 0.2), "k": ("even", 1.3, 2.0)}, largest=20.0,
    ),
    _damage(
        "DamageFatigue", "Ebar -> Ebar*(1-th)^(n-1), n = number of unloadings so far (fatigue of the bonds)",
        {"modulus": lambda th, c, s, n: (1 - min(th, 0.95)) ** np.maximum(c.path.unloadings - 1, 0)}, start=0.05,
        unit="per cycle", largest=0.4, protocols=("P1",), reloads=1, low_turn=False,
    ),
    _dense(
        "DensificationSpriggs", "Ebar -> Ebar*exp(-th*(p-{p0})), p={p0}-{k}*eps_P (Spriggs)",
        {"modulus": lambda th, c, s, n: np.exp(th * n.k * s.eps_P)},
        {"p0": ("even", 0.3, 0.5), "k": ("even", 0.4, 0.8)}, largest=7.0,
    ),
    _dense(
        "DensificationGibsonAshby",
        "Ebar -> Ebar*(1-{b}*eps_P)^(-th) (Gibson-Ashby power of relative density, rho=rho0/(1-b eps))",
        {"modulus": lambda th, c, s, n: (1 - n.b * np.minimum(s.eps_P, 0.95)) ** (-th)}, {"b": ("even", 0.6, 1.0)},
        largest=6.0,
    ),
    _dense(
        "DensificationOnset", "Ebar -> Ebar*(1+th*((eps_P-{e0})+)^2) (pores close above an onset strain)",
        {"modulus": lambda th, c, s, n: 1 + th * np.maximum(s.eps_P - n.e0, 0) ** 2}, {"e0": ("even", 0.12, 0.25)},
        start=2.0, largest=25.0,
    ),
    _shape("ShapeExponent", "phi^2 = 1-((eps_P-eps)/delta)^(2{sg}th)", {"unloading": _bent}, largest=0.9, signed=True),
    _shape(
        "ShapeHertz", "sigma = sigma_P*[(1-th) f(s) + th (1-s^2)^1.5] (part of the pressure is Hertzian)",
        {"unloading": lambda th, c, s, r, n: th * ((1 - r * r) ** 1.5 - unloading_ratio(r))},
    ),
    _shape(
        "ShapeOliverPharr", "sigma = sigma_P*[(1-th) f(s) + th (1-s)^{m}] (Oliver-Pharr power law part)",
        {"unloading": lambda th, c, s, r, n: th * ((1 - r) ** n.m - unloading_ratio(r))}, {"m": ("even", 1.8, 2.6)},
    ),
    _reverse(
        "ReverseFourthPower", "gamma -= th*D_e*(1-F/F_P)^4",
        {"displacement": lambda th, c, s, n: -th * s.De * (1 - s.u) ** 4}, start=2e-3, largest=0.03,
    ),
    _reverse(
        "ReverseOnset", "gamma -= th*delta*D_e*((u_c-u)+/u_c)^2, u_c={uc} (reverse yielding below a load fraction)",
        {"displacement": _onset}, {"uc": ("even", 0.25, 0.45)}, start=0.1, largest=1.0,
    ),
    _reverse(
        "ReverseResidualStress",
        "gamma -= th*D_e*eps_P*(1-u)^{k} (residual stress pushes back, grows with plastic strain)",
        {"displacement": lambda th, c, s, n: -th * s.De * s.eps_P * (1 - s.u) ** n.k}, {"k": ("even", 3, 5)},
        start=5e-3, largest=0.06,
    ),
    _lag(
        "LagParabola", "reload: gamma -= th*delta*D_e*4v(1-v), v=(F-F_turn)/(F_P-F_turn)",
        lagging(lambda v, n: 4 * v * (1 - v)),
    ),
    _lag(
        "LagSticking", "reload: gamma -= th*delta*D_e*(1-exp(-v/{k}))*(1-v^{m}) (sticking contact slips early)",
        lagging(lambda v, n: -np.expm1(-v / n.k) * (1 - v**n.m)), {"k": ("even", 0.08, 0.2), "m": ("whole", 2, 5)},
    ),
    _lag(
        "LagMasing", "reload: gamma -= th*delta*D_e*(1-F_turn/F_P)*6.75*v^2*(1-v) (Masing-like, late closure)",
        lagging(lambda v, n: 6.75 * v * v * (1 - v), lambda c: 1 - c.path.turn_stress / c.path.peak),
    ),
    _ratchet(
        "RatchetDepth",
        "every reload adds eps += th*delta_k*(1-sigma_turn/sigma_P), kept for good, grown as v^2 along the reload",
        adding(lambda c, s, k, at, n: s.delta[at] * (1 - c.path.turn_stress[at] / s.peak[at]), 2.0),
    ),
    _ratchet(
        "RatchetShakedown", "k-th reload adds eps += th*delta_k*k^(-{q}) grown as v^4 (shakedown)",
        adding(lambda c, s, k, at, n: s.delta[at] * k ** (-n.q), 4.0), {"q": ("even", 0.4, 0.9)},
    ),
    _ratchet(
        "RatchetChaboche",
        "k-th reload adds eps += th*eps_P*exp(-{q}(k-1)), grown as v^3 (Chaboche-type, in plastic strain)",
        adding(lambda c, s, k, at, n: s.eps_P[at] * np.exp(-n.q * (k - 1)), 3.0), {"q": ("even", 0.2, 0.5)}, start=1e-3,
    ),
    _creep(
        "CreepKelvinVoigt", "tau de/dt + e = th*sigma, gamma += D_e*e, tau={tau} s (Kelvin-Voigt)",
        hereditary(lambda since, n: -np.expm1(-since / n.tau)), {"tau": ("log", 5, 25)},
    ),
    _creep(
        "CreepLogarithmic", "gamma += D_e*th*int ln(1+(t-s)/tau) dsigma(s), tau={tau} s (logarithmic, hereditary)",
        hereditary(lambda since, n: np.log1p(since / n.tau)), {"tau": ("log", 1.5, 8)},
    ),
    _creep(
        "CreepFractional", "gamma += D_e*th*int ((t-s)/10s)^p dsigma(s), p={p} (fractional / springpot)",
        hereditary(lambda since, n: (since / 10) ** n.p), {"p": ("even", 0.22, 0.36)},
    ),
)
# fmt: on
