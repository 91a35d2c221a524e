"""Effects on no list."""

from __future__ import annotations

from functools import partial

import numpy as np

from ..path import UNLOAD
from .effect import Array, Campaign, Formula, State

_none = partial(Formula, "unlisted")


def _ringing(th: float, c: Campaign, s: State, n: State) -> Array:
    since = c.path.since_turn
    return np.where(c.path.turns > 0, th * np.exp(-since / n.tau) * np.sin(2 * np.pi * since / n.P), 0)


def _lock_up(th: float, terms: State, n: State) -> None:
    terms.extra = terms.extra + th * 1000 * terms.x**9


def _elbow(th: float, c: Campaign, s: State, n: State) -> Array:
    def transformed(u: Array | float) -> Array | float:
        return 1 / (1 + np.exp((u - n.uc) / 0.035))

    return -th * s.delta * s.De * (transformed(s.u) - transformed(1.0))


def _serrated(th: float, terms: State, n: State) -> None:
    terms.factor = terms.factor * (1 + th * np.sin(2 * np.pi * terms.eps / n.P))


def _backlash(th: float, c: Campaign, s: State, n: State) -> Array:
    return -th * (c.path.branch == UNLOAD) * (-np.expm1(-c.path.since_turn / 3.0))


def _cell(th: float, c: Campaign, n: State) -> tuple[Array, Array]:
    force = c.path.force
    felt = force * (1 + th * np.sin(2 * np.pi * force / n.P)) / c.particles.area[c.owner]
    return np.concatenate([np.maximum.accumulate(felt[samples]) for samples in c.path.slices]), felt


# fmt: off
FORMULAS = (
    _none(
        "EncoderError", "gamma += th*sin(2 pi gamma/{P} um) (periodic interpolation error of the displacement encoder)",
        {"displacement": lambda th, c, s, n: th * np.sin(2 * np.pi * s.gamma / n.P)}, {"P": ("even", 9, 16)},
        start=0.05, unit="um", protocols=("P0",),
    ),
    _none(
        "Ringing",
        "gamma += th*exp(-t_r/{tau}s)*sin(2 pi t_r/{P}s) after every reversal of the drive, t_r=time since reversal "
        "(ringing of the control loop)", {"displacement": _ringing}, {"tau": ("even", 25, 45), "P": ("even", 18, 30)},
        start=0.1, unit="um", protocols=("P1",),
    ),
    _none(
        "LockUp", "sigma_load += th*(eta_p eps)^9 * 1000 MPa (a ninth-power lock-up term in the master law)",
        {"loading": _lock_up}, start=0.02, protocols=("P0",),
    ),
    _none(
        "LayerYields",
        "gamma += th*D_e*exp(-((sigma_max-{s0})/{w})^2) on the way in and kept from sigma_P on unloading "
        "(temporary yielding of a layer around one stress)",
        {"displacement": lambda th, c, s, n: th * s.De * np.exp(-(((c.path.peak - n.s0) / n.w) ** 2))},
        {"s0": ("even", 3.5, 5), "w": ("even", 0.7, 1.1)}, start=1e-3,
    ),
    _none(
        "Elbow", "unloading and reloading: gamma -= th*delta*D_e/(1+exp((u-{uc})/0.035)) "
        "(elbow: reversible transformation at a fixed load fraction)", {"displacement": _elbow},
        {"uc": ("even", 0.5, 0.65)}, start=0.05,
    ),
    _none(
        "SerratedFlow",
        "sigma_load *= 1+th*sin(2 pi eps/{P}) (serrated flow: fibril layers buckle periodically in strain)",
        {"loading": _serrated}, {"P": ("even", 0.05, 0.075)}, start=0.01,
    ),
    _none(
        "Backlash", "gamma -= th*(1-exp(-t_r/3s)) while the force falls, 0 otherwise, t_r=time since reversal "
        "(backlash of the lead screw: a fixed lost motion at each reversal)", {"displacement": _backlash}, start=0.1,
        unit="um", protocols=("P1",), reloads=1,
    ),
    _none(
        "LoadCellError", "true force = F*(1+th*sin(2 pi F/{P} mN)) (load-cell linearity error with a common period)",
        {"stress": _cell}, {"P": ("even", 90, 160)}, start=0.005,
    ),
)
# fmt: on
