"""The loading-unloading law under load control, printed form, and the steps at which an effect may change it.

Loading: C1 x - (C3 x)^3 + (C5 x)^5 in MPa, x = eta_p eps, eta_p = 1 + a (1 - q), eps = gamma / D_e. Below the largest
stress sigma_P at strain eps_P: sigma / sigma_P = f(s), s being the recovered strain over delta,
delta^2 = sigma_P / (4.12 Ebar eps_P).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from .campaign import Campaign
    from .effects.effect import Effect

Curve = Callable[[np.ndarray], np.ndarray]
Sized = Sequence[tuple["Effect", float]]

CONTACT_AREA = 1.43  # Storakers' largest c^2 of the contact radius; not the shape parameter
PUNCH = 4.12

_ANGLE = np.linspace(0, np.pi / 2, 40001)
# For small angles the closed form loses its digits to cancellation.
_RATIO = np.where(
    _ANGLE < 0.01,
    (2 / np.pi) * (2 * _ANGLE**3 / 3 - 2 * _ANGLE**5 / 15),
    (2 / np.pi) * (_ANGLE - np.sin(_ANGLE) * np.cos(_ANGLE)),
)
_ROOT = np.cbrt(_RATIO)


class Shift(NamedTuple):
    """A base law beside the true one: added to ln C (of all or of each particle), to a, to ln modulus."""

    log_C: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0)
    a: float = 0.0
    log_modulus: np.ndarray | float = 0.0


NO_SHIFT = Shift()


def unloading_ratio(s: np.ndarray) -> np.ndarray:
    """f(s) = (2/pi) [acos s - s sqrt(1 - s^2)], the stress over sigma_P."""
    s = np.clip(s, 0, 1)
    height = np.sqrt((1 - s) * (1 + s))
    angle = np.arctan2(height, s)
    return (2 / np.pi) * np.where(angle < 0.01, 2 * angle**3 / 3, angle - s * height)


def recovered_fraction(ratio: np.ndarray) -> np.ndarray:
    """Inverse of `unloading_ratio`, from a table in which the cube root is nearly straight."""
    return np.cos(np.interp(np.cbrt(np.clip(ratio, 0, 1)), _ROOT, _ANGLE))


def bisect(function: Curve, low: np.ndarray, high: np.ndarray, target: np.ndarray, rounds: int = 34) -> np.ndarray:
    """Where an increasing function of arrays reaches `target`."""
    for _ in range(rounds):
        middle = 0.5 * (low + high)
        short = function(middle) < target
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return 0.5 * (low + high)


def coefficients(campaign: Campaign, effects: Sized = (), shift: Shift = NO_SHIFT) -> SimpleNamespace:
    """C1, C3, C5, modulus in MPa and eta_p of each particle."""
    p = campaign.particles
    values = SimpleNamespace(
        C1=p.C[:, 0] * np.exp(shift.log_C[0]),
        C3=p.C[:, 1] * np.exp(shift.log_C[1]),
        C5=p.C[:, 2] * np.exp(shift.log_C[2]),
        modulus=p.modulus * np.exp(shift.log_modulus),
        eta=1 + (p.a + shift.a) * (1 - p.q),
    )
    for effect, theta in effects:
        effect.coefficients(theta, campaign, values)
    return values


def loading(campaign: Campaign, effects: Sized, values: SimpleNamespace, owner: np.ndarray) -> Curve:
    """The loading curve as a function of strain, for samples that belong to the particles `owner`."""
    p = campaign.particles
    C1, C3, C5, eta = (getattr(values, name)[owner] for name in ("C1", "C3", "C5", "eta"))
    De, D = p.De[owner], p.D[owner]
    stress_rate = (campaign.path.rate / p.area)[owner]

    def stress(eps: np.ndarray) -> np.ndarray:
        x = eta * eps
        terms = SimpleNamespace(
            x=x,
            eps=eps,
            C1=C1,
            C3=C3,
            C5=C5,
            first=C1 * x,
            third=-((C3 * x) ** 3),
            fifth=(C5 * x) ** 5,
            factor=np.ones_like(x),
            extra=0.0,
            stress_rate=stress_rate,
            slope=eta * np.maximum(C1 - 3 * C3**3 * x**2 + 5 * C5**5 * x**4, 0.02 * C1),
            De=De,
            D=D,
        )
        for effect, theta in effects:
            effect.loading(theta, terms)
        return (terms.first + terms.third + terms.fifth) * terms.factor + terms.extra

    return stress


def simulate(campaign: Campaign, effects: Sized = (), shift: Shift = NO_SHIFT) -> np.ndarray:
    """Displacement in um at every sample, without noise. effects: pairs (effect, amplitude)."""
    return response(campaign, effects, shift).displacement


def response(campaign: Campaign, effects: Sized = (), shift: Shift = NO_SHIFT) -> SimpleNamespace:
    """What acts at every sample: `displacement` in um, `modulus` in MPa, and what they are made of."""
    p, path, owner = campaign.particles, campaign.path, campaign.owner
    values = coefficients(campaign, effects, shift)
    eta, modulus, De = values.eta[owner], values.modulus[owner], p.De[owner]
    peak, stress = path.peak, path.stress
    for effect, theta in effects:
        peak, stress = effect.stress(theta, campaign, peak, stress)
    curve = loading(campaign, effects, values, owner)
    eps_P = bisect(curve, np.zeros(len(path)), np.full(len(path), 1.3) / np.minimum(eta, 3), peak)
    s = SimpleNamespace(eps_P=eps_P, peak=peak, De=De, Re=De / 2, D3=p.D[owner, 2])
    for effect, theta in effects:
        modulus = modulus * effect.modulus(theta, campaign, s)
    s.delta = np.sqrt(peak / (PUNCH * modulus * eps_P))
    s.u = np.clip(stress / peak, 0, 1)
    s.recovered = _recovered(campaign, effects, s)
    s.phi = np.sqrt(np.clip(1 - s.recovered * s.recovered, 0, 1))
    s.eps = eps_P - s.delta * s.recovered
    s.gamma, s.gamma_P = s.eps * De, eps_P * De
    # Contact radius: a^2 = 2 c^2 R gamma, with the peak's and with the current displacement.
    s.contact_P = 2 * s.Re * np.sqrt(CONTACT_AREA * eps_P)
    s.contact = 2 * s.Re * np.sqrt(CONTACT_AREA * np.maximum(s.eps, 1e-9))
    gamma = s.gamma.copy()
    for effect, theta in effects:
        gamma = gamma + effect.displacement(theta, campaign, s)
    s.displacement, s.modulus = gamma, modulus
    return s


def _recovered(campaign: Campaign, effects: Sized, s: SimpleNamespace) -> np.ndarray:
    """The recovered fraction at the load fraction u: from the table, or by bisection where an effect changes f."""
    changing = [(effect, theta) for effect, theta in effects if effect.changes("unloading")]
    if not changing:
        return np.where(s.u >= 1, 0.0, recovered_fraction(s.u))

    def falling(fraction: np.ndarray) -> np.ndarray:
        ratio = unloading_ratio(fraction)
        for effect, theta in changing:
            ratio = effect.unloading(theta, campaign, s, fraction, ratio)
        return -ratio

    found = bisect(falling, np.zeros(len(s.u)), np.ones(len(s.u)), -s.u)
    return np.where(s.u < 1 - 1e-12, found, 0.0)
