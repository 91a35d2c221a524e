"""The law of unloading: adhesion, a modulus that changes with strain, the shape of the branch, yielding backwards."""

from __future__ import annotations

import numpy as np

from ..law import CONTACT_AREA, unloading_ratio
from .effect import Array, Campaign, Effect, State, power


class _Adhesion(Effect):
    mechanism = "adhesion"


class AdhesionContact(_Adhesion):
    text = "sigma_u -> sigma_u - th*phi^1.5*(1-phi^{k})"
    start, unit, largest = 0.3, "MPa", 4.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"k": int(rng.integers(16, 41))}

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        phi = np.sqrt(np.clip(1 - recovered * recovered, 0, 1))
        return ratio - theta / s.peak * phi**1.5 * (1 - phi**self.drawn.k)


class AdhesionJKR(_Adhesion):
    text = (
        "sigma_u -> sigma_u - sqrt(8 pi th Ebar (a_P phi)^3)/(pi R_e^2)*(1-exp(-s/{k})), th=work of adhesion "
        "(JKR punch, pull-off ~ a^1.5)"
    )
    start, unit = 1e-3, "MPa um (=J/m^2)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"k": float(rng.uniform(0.08, 0.25))}

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        Re = c.particles.Re[c.owner]
        phi = np.sqrt(np.clip(1 - recovered * recovered, 0, 1))
        contact = 2 * Re * np.sqrt(CONTACT_AREA * s.eps_P)
        pull = np.sqrt(8 * np.pi * theta * c.particles.mean_modulus * (contact * phi) ** 3) / (np.pi * Re**2)
        return ratio - pull / s.peak * (-np.expm1(-recovered / self.drawn.k))


class AdhesionDugdale(_Adhesion):
    text = (
        "sigma_u -> sigma_u - th*(a_P phi/R_e)^2*(1-exp(-s/{k})) "
        "(Dugdale/DMT: constant bond stress on the remaining contact)"
    )
    start, unit, largest = 0.1, "MPa", 4.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"k": float(rng.uniform(0.1, 0.3))}

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        bonded = theta * 4 * CONTACT_AREA * s.eps_P * (1 - recovered * recovered)
        return ratio - bonded / s.peak * (-np.expm1(-recovered / self.drawn.k))


class _Damage(Effect):
    mechanism = "damage"
    start, unit = 1.0, "-"
    protocols = ("P1", "P0")
    low_turn = True


class DamageExponential(_Damage):
    text = "Ebar -> Ebar*exp(-th*(eps_P-0.1)+)"
    largest = 4.0

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        return np.exp(-theta * np.maximum(s.eps_P - 0.1, 0))


class DamageSaturating(_Damage):
    text = "Ebar -> Ebar*(1-{Dc}*(1-exp(-th*(eps_P-{e0})+^{k}))) (saturating, Lemaitre threshold)"
    largest = 20.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"Dc": 0.85, "e0": float(rng.uniform(0.1, 0.2)), "k": float(rng.uniform(1.3, 2.0))}

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        beyond = np.maximum(s.eps_P - self.drawn.e0, 0) ** self.drawn.k
        return 1 - self.drawn.Dc * (-np.expm1(-theta * beyond))


class DamageFatigue(_Damage):
    text = "Ebar -> Ebar*(1-th)^(n-1), n = number of unloadings so far (fatigue of the bonds)"
    start, unit, largest = 0.05, "per cycle", 0.4
    protocols, reloads, low_turn = ("P1",), 1, False

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        return (1 - min(theta, 0.95)) ** np.maximum(c.path.unloadings - 1, 0)


class _Densification(Effect):
    mechanism = "densification_stiffening"
    start, unit = 0.5, "-"
    protocols = ("P1", "P1", "P0")
    low_turn = True


class DensificationSpriggs(_Densification):
    text = "Ebar -> Ebar*exp(-th*(p-{p0})), p={p0}-{k}*eps_P (Spriggs)"
    largest = 7.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"p0": float(rng.uniform(0.3, 0.5)), "k": float(rng.uniform(0.4, 0.8))}

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        return np.exp(theta * self.drawn.k * s.eps_P)


class DensificationGibsonAshby(_Densification):
    text = "Ebar -> Ebar*(1-{b}*eps_P)^(-th) (Gibson-Ashby power of relative density, rho=rho0/(1-b eps))"
    largest = 6.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"b": float(rng.uniform(0.6, 1.0))}

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        return (1 - self.drawn.b * np.minimum(s.eps_P, 0.95)) ** (-theta)


class DensificationOnset(_Densification):
    text = "Ebar -> Ebar*(1+th*((eps_P-{e0})+)^2) (pores close above an onset strain)"
    start, largest = 2.0, 25.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"e0": float(rng.uniform(0.12, 0.25))}

    def modulus(self, theta: float, c: Campaign, s: State) -> Array | float:
        return 1 + theta * np.maximum(s.eps_P - self.drawn.e0, 0) ** 2


class _Shape(Effect):
    mechanism = "unloading_shape"
    start, unit, largest = 0.05, "-", 1.0


class ShapeExponent(_Shape):
    text = "phi^2 = 1-((eps_P-eps)/delta)^(2{sg}th)"
    largest = 0.9
    signed = True

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        bent = power(recovered, 1 + self.sign * min(theta, 1.2) / 2)
        return ratio + unloading_ratio(bent) - unloading_ratio(recovered)


class ShapeHertz(_Shape):
    text = "sigma = sigma_P*[(1-th) f(s) + th (1-s^2)^1.5] (part of the pressure is Hertzian)"

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        return ratio + theta * ((1 - recovered * recovered) ** 1.5 - unloading_ratio(recovered))


class ShapeOliverPharr(_Shape):
    text = "sigma = sigma_P*[(1-th) f(s) + th (1-s)^{m}] (Oliver-Pharr power law part)"

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"m": float(rng.uniform(1.8, 2.6))}

    def unloading(self, theta: float, c: Campaign, s: State, recovered: Array, ratio: Array) -> Array:
        return ratio + theta * ((1 - recovered) ** self.drawn.m - unloading_ratio(recovered))


class _Reverse(Effect):
    mechanism = "reverse_plasticity"
    unit = "-"


class ReverseFourthPower(_Reverse):
    text = "gamma -= th*D_e*(1-F/F_P)^4"
    start, largest = 2e-3, 0.03

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return -theta * s.De * (1 - s.u) ** 4


class ReverseOnset(_Reverse):
    text = "gamma -= th*delta*D_e*((u_c-u)+/u_c)^2, u_c={uc} (reverse yielding below a load fraction)"
    start, largest = 0.1, 1.0

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"uc": float(rng.uniform(0.25, 0.45))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return -theta * s.delta * s.De * (np.maximum(self.drawn.uc - s.u, 0) / self.drawn.uc) ** 2


class ReverseResidualStress(_Reverse):
    text = "gamma -= th*D_e*eps_P*(1-u)^{k} (residual stress pushes back, grows with plastic strain)"
    start, largest = 5e-3, 0.06

    def draw(self, rng: np.random.Generator) -> dict[str, float | int]:
        return {"k": float(rng.uniform(3, 5))}

    def displacement(self, theta: float, c: Campaign, s: State) -> Array | float:
        return -theta * s.De * s.eps_P * (1 - s.u) ** self.drawn.k


FORMULAS = (
    *(AdhesionContact, AdhesionJKR, AdhesionDugdale),
    *(DamageExponential, DamageSaturating, DamageFatigue),
    *(DensificationSpriggs, DensificationGibsonAshby, DensificationOnset),
    *(ShapeExponent, ShapeHertz, ShapeOliverPharr),
    *(ReverseFourthPower, ReverseOnset, ReverseResidualStress),
)
