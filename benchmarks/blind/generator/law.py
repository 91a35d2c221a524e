"""The paper's loading-unloading law under load control, all particles of a campaign at once.

Strain is gamma / D_e and stress F / (pi D_e^2 / 4) with D_e = D1 D2 / D3; the shape factor is 1 + a (1 - D3 / D_e).
Loading: C1 x - (C3 x)^3 + (C5 x)^5 in MPa, x = shape factor times strain. Under load control the strain is the *first*
one at which the running maximum of that curve reaches the stress, so a curve that is not monotone snaps through.
Unloading and reloading below the largest stress S at strain e: sigma / S = (2/pi) [acos s - s sqrt(1 - s^2)], s being
the recovered strain over sqrt(S / (4.12 E e)) (the printed form with the raw strain).

An effect changes one or several of the steps below; without effects the hooks are not even called. Arrays are
(particles, samples); what belongs to a particle is (particles, 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import norm

if TYPE_CHECKING:
    from .designs import Path

Number = np.ndarray | float

SHAPE_PARAMETER = 1.43
CONTACT_AREA = 1.43  # the paper's c^2 for perfect plasticity; equal to the shape parameter by coincidence
PUNCH = 4.12
EFFECTIVE_MODULUS_MPA = 16_000.0
LOG_C = {"C1": (1.9027, 0.2985), "C3": (1.1015, 4.8914e-9), "C5": (0.9784, 0.0797)}
MN_PER_MPA_UM2 = 1e-3

_X = np.linspace(0.0, 1.4, 1401)
_CHORD_STEPS = 6


@dataclass(frozen=True)
class Particles:
    """Sizes in um and the material of each particle, arrays of one length."""

    D1: np.ndarray
    D2: np.ndarray
    D3: np.ndarray
    C1: np.ndarray
    C3: np.ndarray
    C5: np.ndarray
    modulus: np.ndarray
    columns: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def De(self) -> np.ndarray:
        return self.D1 * self.D2 / self.D3

    @property
    def q(self) -> np.ndarray:
        return self.D3**2 / (self.D1 * self.D2)

    def with_(self, **changes: np.ndarray) -> Particles:
        return replace(self, **changes)


def shape_factor(q: np.ndarray, a: float = SHAPE_PARAMETER) -> np.ndarray:
    """1 + a (1 - D3 / D_e); note D3 / D_e = D3^2 / (D1 D2) = q."""
    return 1.0 + a * (1.0 - q)


def master_stress(x: np.ndarray, C1: Number, C3: Number, C5: Number) -> np.ndarray:
    """The loading polynomial in MPa."""
    return x * (C1 - x * x * (C3**3 - x * x * C5**5))


def is_monotone(C1: Number, C3: Number, C5: Number, margin: float = 1.0) -> np.ndarray | bool:
    """Whether the loading polynomial never falls; `margin` below one asks for more than that."""
    return margin * 20.0 * C1 * C5**5 >= 9.0 * C3**6


def monotone_means(margin: float) -> np.ndarray:
    """Means of ln C1, ln C3, ln C5 over draws that are monotone with a margin: a normal distribution cut by a plane."""
    means, sds = np.array(list(LOG_C.values())).T
    along = np.array([1.0, -6.0, 5.0])
    spread = np.sqrt(np.sum((along * sds) ** 2))
    z = (np.log(9.0 / (20.0 * margin)) - along @ means) / spread
    return means + along * sds**2 / spread * norm.pdf(z) / norm.sf(z)


def unloading_ratio(s: np.ndarray) -> np.ndarray:
    """sigma / sigma_P at the recovered fraction s."""
    s = np.clip(s, 0.0, 1.0)
    return 2.0 / np.pi * (np.arccos(s) - s * np.sqrt((1.0 - s) * (1.0 + s)))


def recovered_fraction(ratio: np.ndarray) -> np.ndarray:
    """Inverse of `unloading_ratio`: with T = 2 acos s it is Kepler's equation T - sin T = pi ratio."""
    ratio = np.clip(ratio, 0.0, 1.0)
    z = np.cbrt(6.0 * ratio)
    angle = z * np.cbrt(np.pi)
    angle = np.minimum(angle + angle**3 / 60.0, np.pi)
    for _ in range(5):
        slope = 2.0 * np.sin(0.5 * angle) ** 2
        gap = np.where(angle < 0.05, angle**3 / 6.0 * (1.0 - angle**2 / 20.0), angle - np.sin(angle)) - np.pi * ratio
        angle = np.clip(angle - np.where(slope > 0, gap / np.where(slope > 0, slope, 1.0), 0.0), 0.0, np.pi)
    return np.cos(0.5 * angle)


def full_recovery(stress: np.ndarray, strain: np.ndarray, modulus: np.ndarray) -> np.ndarray:
    """Strain recovered between `stress` and zero."""
    return np.sqrt(stress / (PUNCH * modulus * np.maximum(strain, 1e-12)))


def first_strain(stress: np.ndarray, curve: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """The first x at which the running maximum of `curve` (a function of x) reaches `stress`; (particles, samples)."""
    values = curve(np.broadcast_to(_X, (stress.shape[0], _X.size)))
    envelope = np.maximum.accumulate(values, axis=1)
    right = np.stack([np.searchsorted(row, s) for row, s in zip(envelope, stress, strict=True)])
    right = np.clip(right, 1, _X.size - 1)
    x0, x1 = _X[right - 1], _X[right]
    y0 = np.take_along_axis(values, right - 1, axis=1)
    y1 = np.take_along_axis(values, right, axis=1)
    for _ in range(_CHORD_STEPS):
        rise = np.where(y1 > y0, y1 - y0, 1.0)
        x = np.clip(x0 + (x1 - x0) * np.clip((stress - y0) / rise, 0.0, 1.0), x0, x1)
        y = curve(x)
        below = y < stress
        x0, y0 = np.where(below, x, x0), np.where(below, y, y0)
        x1, y1 = np.where(below, x1, x), np.where(below, y1, y)
    rise = np.where(y1 > y0, y1 - y0, 1.0)
    return x0 + (x1 - x0) * np.clip((stress - y0) / rise, 0.0, 1.0)


def simulate(
    particles: Particles,
    path: Path,
    effects: Sequence[tuple[dict[str, Callable], float]] = (),
    a: float = SHAPE_PARAMETER,
) -> np.ndarray:
    """Displacement in um along `path` (see `designs`), without noise and from its own zero.

    `effects` are pairs (hooks, amplitude); hooks is a dictionary of functions, each called as f(amplitude, value,
    state), and "flow" as f(amplitude, stress, x, state).
    """
    return response(particles, path, effects, a).displacement


def response(
    particles: Particles, path: Path, effects: Sequence[tuple[dict[str, Callable], float]], a: float
) -> SimpleNamespace:
    """What acts along `path`: `displacement` in um, `modulus` in MPa, and what they are made of; see `simulate`."""
    p, state = _state(particles, path, a)

    def apply(name: str, value: np.ndarray) -> np.ndarray:
        for hooks, amplitude in effects:
            if name in hooks:
                value = hooks[name](amplitude, value, state)
        return value

    state.eta = apply("shape", shape_factor(p.q, a))
    state.C1 = apply("C1", particles.C1[:, None])
    state.C3 = apply("C3", particles.C3[:, None])
    state.C5 = apply("C5", particles.C5[:, None])

    def loading(x: np.ndarray) -> np.ndarray:
        stress = master_stress(x, state.C1, state.C3, state.C5)
        for hooks, amplitude in effects:
            if "flow" in hooks:
                stress = hooks["flow"](amplitude, stress, x, state)
        return stress

    state.x = first_strain(state.sigma_P, loading)
    if any("overstress" in hooks for hooks, _ in effects):
        # Part of the stress depends on the rate: the rest is what the loading curve carries.
        state.strain_rate = _strain_rate(state, path)
        for _ in range(12):
            extra = apply("overstress", np.zeros_like(state.x))
            reduced = np.maximum.accumulate(np.maximum(state.sigma_P - extra, 1e-9), axis=1)
            state.x = first_strain(reduced, loading)
    state.eps_P = state.x / state.eta
    state.modulus = apply("modulus", np.broadcast_to(particles.modulus[:, None], state.x.shape))
    state.delta = full_recovery(state.sigma_P, state.eps_P, state.modulus)
    state.s = apply("recovered_fraction", recovered_fraction(state.u))
    state.recovery = apply("recovery", state.delta * state.s)
    state.eps = state.eps_P - state.recovery
    state.eps = apply("strain", state.eps)
    state.gamma = p.De * state.eps
    state.displacement = apply("observable", state.gamma)
    return state


def _state(particles: Particles, path: Path, a: float) -> tuple[SimpleNamespace, SimpleNamespace]:
    """What the hooks may look at from the start: geometry, path, stresses."""
    p = SimpleNamespace(
        De=particles.De[:, None],
        Re=0.5 * particles.De[:, None],
        q=particles.q[:, None],
        D1=particles.D1[:, None],
        D2=particles.D2[:, None],
        D3=particles.D3[:, None],
        columns={name: np.asarray(value)[:, None] for name, value in particles.columns.items()},
    )
    sigma = path.force / (np.pi * p.Re**2 * MN_PER_MPA_UM2)
    sigma_P = np.maximum.accumulate(sigma, axis=1)
    state = SimpleNamespace(
        particle=p,
        path=path,
        F=path.force,
        t=path.time,
        a=a,
        sigma=sigma,
        sigma_P=sigma_P,
        u=sigma / sigma_P,
        peak=sigma.max(axis=1, keepdims=True),
    )
    return p, state


def _strain_rate(state: SimpleNamespace, path: Path) -> np.ndarray:
    """Strain rate on the loading curve when its largest stress was first reached, 1/s."""
    slope = state.C1 - 3.0 * state.C3**3 * state.x**2 + 5.0 * state.C5**5 * state.x**4
    stress_rate = path.rate / (np.pi * state.particle.Re**2 * MN_PER_MPA_UM2)
    rate = stress_rate / (state.eta * np.maximum(slope, 0.5))
    new = np.ones_like(state.sigma, dtype=bool)
    new[:, 1:] = state.sigma_P[:, 1:] > state.sigma_P[:, :-1]
    first = np.maximum.accumulate(np.where(new, np.arange(state.sigma.shape[1]), 0), axis=1)
    return np.take_along_axis(np.broadcast_to(rate, state.sigma.shape), first, axis=1)
