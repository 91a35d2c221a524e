"""The hidden effects: for each listed mechanism an exact form and variants of the same physics, and forms on no list.

A hook is f(amplitude, value, state) and changes one step of `law.simulate`: "shape", "C1", "C3", "C5", "flow" (with x),
"overstress", "modulus", "recovered_fraction", "recovery", "strain", "observable". Every effect is nil at amplitude
zero. Conventions: displacement in um, force in mN, stress in MPa; u = F / F_P, sigma_P and eps_P the largest stress and
its strain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .law import CONTACT_AREA, MN_PER_MPA_UM2, recovered_fraction, unloading_ratio

RELOAD, HUMIDITY, FINITE_PUNCH = "a reload segment", "humidity column", "contact larger than the punch"


@dataclass(frozen=True)
class Form:
    """One formula.

    mechanism: listed name, or the formula's own for an unlisted one. form: "exact" or the variant's name. unit: size of
    a usual amplitude. plausible: amplitudes the literature knows. signs: the physically possible ones. needs: what a
    campaign must have. draw: random circumstances (rng, count) -> dictionary. build: hooks for these circumstances.
    """

    mechanism: str
    form: str
    equation: str
    unit: float
    build: Callable
    plausible: tuple[float, float] = (0.0, np.inf)
    signs: tuple[int, ...] = (1,)
    needs: tuple[str, ...] = ()
    draw: Callable = lambda rng, count: {}
    largest: float | None = None
    parameter: str = ""


@dataclass(frozen=True)
class Effect:
    """A form in given circumstances; `effect(amplitude)` is what `law.simulate` takes."""

    form: Form
    circumstances: dict = field(default_factory=dict)
    sign: int = 1

    @property
    def unit(self):
        return self.form.unit

    def __call__(self, amplitude):
        return ((self.form.build(**self.circumstances), self.sign * amplitude),)


def contact_radius(eps, Re):
    """Radius of the contact in um, each plate taking half of the approach: sqrt(2 c2 R h), h = D_e eps / 2."""
    return Re * np.sqrt(2.0 * CONTACT_AREA * np.maximum(eps, 0.0))


# --- the machine -----------------------------------------------------------------------------------------------------
def _frame():
    return {"observable": lambda k, g, s: g + k * s.F}


def _frame_stiffening():
    return {"observable": lambda k, g, s: g + k * 300.0 * (s.F / 300.0) ** 0.8}


def _frame_seated():
    return {"observable": lambda k, g, s: g + k * 350.0 * np.log1p(s.F / 350.0)}


def _drift():
    return {"observable": lambda k, g, s: g + k * s.t}


def _drift_decaying(tau):
    return {"observable": lambda k, g, s: g + k * tau * (1.0 - np.exp(-s.t / tau))}


def _drift_per_test(share):
    return {"observable": lambda k, g, s: g + k * share[:, None] * s.t}


def _sink_in():
    # gamma += F / (2 a_c E*), amplitude 1 / E* in 1/MPa.
    def observable(k, g, s):
        radius = contact_radius(np.maximum(s.eps_P, 1e-4), s.particle.Re)
        return g + k * s.F / MN_PER_MPA_UM2 / (2.0 * radius)

    return {"observable": observable}


def _sink_in_hertz():
    # Dent of a smooth cap instead of a flat punch: the contact grows with the load itself.
    def observable(k, g, s):
        pressure = 3.0 * s.C1 / 7.0
        radius = np.sqrt(np.maximum(s.F, 0.0) / MN_PER_MPA_UM2 / (np.pi * pressure)) + 0.1 * s.particle.Re
        return g + k * s.F / MN_PER_MPA_UM2 / (2.0 * radius)

    return {"observable": observable}


def _tilt():
    return {"observable": lambda k, g, s: g + k * contact_radius(s.eps, s.particle.Re)}


def _tilt_wedge():
    # The high edge touches first: the gap under it closes over a tenth of strain.
    return {
        "observable": lambda k, g, s: g + k * s.particle.De * np.sqrt(1.0 - np.exp(-np.maximum(s.eps_P, 0.0) / 0.12))
    }


# --- time ------------------------------------------------------------------------------------------------------------
def _memory(state, kernel):
    """Integral of kernel(t - t') d sigma(t') over the record, sampled as ramps between the points."""
    t = state.t
    middle = 0.5 * (t[:, 1:] + t[:, :-1])
    steps = np.diff(state.sigma, axis=1)
    lag = t[:, :, None] - middle[:, None, :]
    return np.einsum("nij,nj->ni", np.where(lag > 0, kernel(np.maximum(lag, 0.0)), 0.0), steps)


def _creep(tau):
    return {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: 1.0 - np.exp(-lag / tau))}


def _creep_logarithmic(tau):
    return {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: np.log1p(lag / tau))}


def _creep_power(power):
    return {"strain": lambda k, e, s: e + k * _memory(s, lambda lag: (lag / 60.0) ** power)}


_RATE_0 = 1e-3


def _rate():
    return {"overstress": lambda k, v, s: v + k * s.C1 * s.x * np.log(np.maximum(s.strain_rate, 1e-7) / _RATE_0)}


def _rate_power():
    # The whole flow stress as a power of the rate.
    def overstress(k, v, s):
        return v + s.sigma_P * (1.0 - (np.maximum(s.strain_rate, 1e-7) / _RATE_0) ** -k)

    return {"overstress": overstress}


def _rate_cowper():
    # Overstress as the square root of the rate, nil at rest.
    return {"overstress": lambda k, v, s: v + k * s.C1 * s.x * np.sqrt(s.strain_rate / _RATE_0)}


# --- unloading -------------------------------------------------------------------------------------------------------
_S = np.linspace(0.0, 1.0, 401)


def _invert_unloading(stress, state):
    """First s at which the decreasing curve `stress(s)` (a function of (n, t, k) arrays) falls to the stress."""
    out = np.empty_like(state.sigma)
    for i in range(len(out)):
        s = np.broadcast_to(_S, (out.shape[1], _S.size))
        left = np.minimum.accumulate(stress(s, state.sigma_P[i][:, None]) - state.sigma[i][:, None], axis=1)
        j = np.argmax(left <= 1e-12, axis=1)
        j = np.where(left[:, -1] > 1e-12, _S.size - 1, j)
        rows = np.arange(len(j))
        high, low = left[rows, np.maximum(j - 1, 0)], left[rows, j]
        part = np.where(high > low, high / np.where(high > low, high - low, 1.0), 1.0)
        out[i] = np.where(j > 0, _S[np.maximum(j - 1, 0)] + (_S[1] - _S[0]) * np.clip(part, 0.0, 1.0), 0.0)
    return out


def _bond(strength):
    """Recovered fraction when a tension `strength(s)` per unit amplitude opposes the separation of the contact.

    The change is computed on one grid for both curves, so that nothing is left at amplitude zero.
    """

    def recovered(k, value, s):
        def held(f, sigma_P):
            return sigma_P * unloading_ratio(f) - k * strength(f)

        free = _invert_unloading(lambda f, sigma_P: sigma_P * unloading_ratio(f), s)
        return np.clip(value + _invert_unloading(held, s) - free, 0.0, 1.0)

    return {"recovered_fraction": recovered}


def _adhesion():
    def strength(f):
        phi = np.sqrt((1.0 - f) * (1.0 + f))
        return phi**1.5 * (1.0 - np.exp(-(1.0 - phi) / 0.1))

    return _bond(strength)


def _adhesion_dugdale():
    # A constant stress over the part of the contact that still holds, taking over as the first tenth is unloaded.
    def strength(f):
        return (1.0 - f**2) * -np.expm1(-((f / 0.35) ** 2))

    return _bond(strength)


def _damage():
    return {"modulus": lambda k, E, s: E * np.exp(-k * (s.eps_P - 0.3))}


def _damage_lemaitre():
    # Damage grows with the square of the strain from a threshold.
    return {"modulus": lambda k, E, s: E / (1.0 + k * np.maximum(s.eps_P - 0.15, 0.0) ** 2 / 0.25)}


def _damage_work():
    return {"modulus": lambda k, E, s: E * np.exp(-k * _work(s) / 1.5)}


def _work(s):
    x = s.x
    return (s.C1 * x**2 / 2.0 - s.C3**3 * x**4 / 4.0 + s.C5**5 * x**6 / 6.0) / s.eta


def _porosity(eps_P):
    return 0.42 * np.exp(-2.2 * eps_P)


def _densification():
    return {"modulus": lambda k, E, s: E * np.exp(-k * _porosity(s.eps_P))}


def _densification_power():
    # Open-cell form: the modulus as a power of the relative density.
    return {"modulus": lambda k, E, s: E * ((1.0 - _porosity(s.eps_P)) / (1.0 - _porosity(0.35))) ** k}


def _densification_linear():
    return {"modulus": lambda k, E, s: E * np.maximum(1.0 + k * (s.eps_P - 0.35), 0.05)}


def _unloading_shape():
    return {"recovered_fraction": lambda k, f, s: f ** (1.0 + k)}


def _unloading_shape_power():
    # Partly a power law in the recovered displacement, as in the reduction of indentation records.
    return {"recovered_fraction": lambda k, f, s: np.clip((1.0 - k) * f + k * (1.0 - np.sqrt(s.u)), 0.0, 1.0)}


def _below(s):
    """Whether a sample is on the elastic branch."""
    return s.u < 1.0


def _reverse():
    return {"strain": lambda k, e, s: e - k * (1.0 - s.u) ** 4 * _below(s)}


def _reverse_threshold():
    # Reverse yield begins when the load has fallen to 0.45 of its peak.
    return {"strain": lambda k, e, s: e - k * np.maximum(1.0 - s.u / 0.45, 0.0) ** 1.5}


def _reverse_square():
    return {"strain": lambda k, e, s: e - k * (s.delta / 0.02) * np.maximum(1.0 - s.u / 0.7, 0.0) ** 3}


# --- cycles ----------------------------------------------------------------------------------------------------------
def _lag(s, rise):
    """Lag of a reload between its start and the largest load; equals 4 u (1 - u) for a reload from zero load."""
    v = np.clip((s.u - s.path.turn) / np.maximum(1.0 - s.path.turn, 1e-9), 0.0, 1.0)
    return np.where(s.path.reload, rise(v), 0.0)


def _hysteresis():
    return {"strain": lambda k, e, s: e - k * s.delta * _lag(s, lambda v: 4.0 * v * (1.0 - v))}


def _hysteresis_skewed():
    # Slip begins late: the lag peaks in the upper half of the reload.
    return {"strain": lambda k, e, s: e - k * s.delta * _lag(s, lambda v: 6.75 * v**2 * (1.0 - v))}


def _ratchet():
    # Every finished reload leaves the same permanent strain, gathered while it runs.
    def strain(k, e, s):
        running = _lag(s, lambda v: v)
        begun = s.path.reloads
        return e + k * np.where(s.path.reload, begun - 1.0 + running, begun)

    return {"strain": strain}


def _ratchet_settling():
    # Shake-down: each further cycle adds less, in proportion to the elastic recovery.
    def strain(k, e, s):
        begun = s.path.reloads
        before = np.sqrt(np.maximum(begun - 1.0, 0.0))
        part = np.where(s.path.reload, _lag(s, lambda v: v**2), 1.0)
        return e + k * np.where(begun > 0, before + (np.sqrt(begun) - before) * part, 0.0)

    return {"strain": strain}


# --- the law of loading ----------------------------------------------------------------------------------------------
def _hardening():
    # k = 1 / (2 m) in the loading term and in the exponent of unloading.
    return {
        "flow": lambda k, y, x, s: y + s.C1 * (np.maximum(x, 1e-12) ** (1.0 + k) - x),
        "recovered_fraction": lambda k, f, s: f ** (1.0 / (1.0 + k)),
    }


def _hardening_normalised():
    # The strength is referred to a strain of 0.2, and the contact coefficient follows 1.43 exp(-0.97 / m).
    def flow(k, y, x, s):
        return y + s.C1 * x * (np.exp(-1.94 * k * (1.0 + k)) * (np.maximum(x, 1e-12) / 0.2) ** k - 1.0)

    return {"flow": flow}


def _hardening_loading():
    return {"flow": lambda k, y, x, s: y * (np.maximum(x, 1e-12) / 0.3) ** k}


def _size():
    return {"C1": lambda k, C, s: C * (s.particle.De / 200.0) ** -k}


def _size_gradient():
    # Strain-gradient hardening: sqrt(1 + length / size).
    return {
        "C1": lambda k, C, s: C * np.sqrt(np.maximum(1.0 + k * 200.0 / s.particle.De, 0.05) / np.maximum(1.0 + k, 0.05))
    }


def _size_linear():
    return {"C1": lambda k, C, s: C * np.maximum(1.0 + k * (200.0 / s.particle.De - 1.0), 0.05)}


def _shape_second():
    return {"shape": lambda k, eta, s: eta + k * (1.0 - s.particle.q) ** 2}


def _shape_in_plane():
    return {"shape": lambda k, eta, s: eta + k * np.log(s.particle.D1 / s.particle.D2) ** 2}


def _shape_power():
    # The shape factor as a power of D_e / D3 beyond its first order.
    return {"shape": lambda k, eta, s: eta + k * (s.particle.q**-1.0 - 1.0 - (1.0 - s.particle.q))}


def _pop_in(at, size):
    def observable(k, g, s):
        passed = s.sigma_P[:, :, None] >= at[:, None, :] * s.peak[:, :, None]
        return g + k * s.particle.De * (passed * size[:, None, :]).sum(axis=2)

    return {"observable": observable}


def _pop_in_burst(at, size):
    # The crack runs over a few per cent of the load instead of at once.
    def observable(k, g, s):
        over = (s.sigma_P / s.peak)[:, :, None] - at[:, None, :]
        return g + k * s.particle.De * (size[:, None, :] * -np.expm1(-np.maximum(over, 0.0) / 0.02)).sum(axis=2)

    return {"observable": observable}


def _draw_pop_in(rng, count):
    events = 2
    size = rng.exponential(1.0, (count, events)) * (rng.random((count, events)) < 0.6)
    if not size.any():
        size[0, 0] = 1.0
    return {"at": rng.uniform(0.15, 0.95, (count, events)), "size": size}


def _draw_cascade(rng, count):
    events = 7
    return {"at": rng.uniform(0.1, 0.98, (count, events)), "size": 0.35 * rng.exponential(1.0, (count, events))}


def _toe():
    return {"strain": lambda k, e, s: e - k * np.exp(-s.sigma_P / 0.6)}


def _toe_power():
    # Asperities flattened as a power of the stress.
    return {"strain": lambda k, e, s: e - k / (1.0 + s.sigma_P / 0.3) ** 1.5}


def _toe_exponent():
    return {"strain": lambda k, e, s: e + k * (1.0 - np.exp(-np.sqrt(s.sigma_P / 0.25)))}


def _friction():
    def flow(k, y, x, s):
        eps = np.minimum(x / s.eta, 0.9)
        return y * (1.0 + 2.0 * k / 3.0 * contact_radius(eps, 1.0) / (2.0 * (1.0 - eps)))

    return {"flow": flow}


def _friction_slab():
    # Slab analysis with the height measured from D3 and sticking in the middle of the contact.
    def flow(k, y, x, s):
        eps = np.minimum(x / s.eta, 0.9)
        height = np.maximum(s.particle.D3 / s.particle.De - 0.6 * eps, 0.1)
        z = 2.0 * k * 1.1 * np.sqrt(eps) / height
        return y * np.where(z > 1e-6, 2.0 * (np.expm1(z) - z) / np.maximum(z, 1e-9) ** 2, 1.0 + z / 3.0)

    return {"flow": flow}


def _humid(s):
    return (s.particle.columns["relative_humidity_percent"] - 40.0) / 10.0


def _humidity():
    return {
        "C1": lambda k, C, s: C * np.exp(-k * _humid(s)),
        "modulus": lambda k, E, s: E * np.exp(-0.5 * k * _humid(s)),
    }


def _humidity_glass():
    # Softening about 55 % as at a glass transition.
    def drop(k, s):
        rh = s.particle.columns["relative_humidity_percent"]
        return np.exp(-4.0 * k * (1.0 / (1.0 + np.exp(-(rh - 55.0) / 8.0)) - 0.13))

    return {"C1": lambda k, C, s: C * drop(k, s), "modulus": lambda k, E, s: E * drop(0.5 * k, s)}


def _tau(rng, count):
    return {"tau": float(np.exp(rng.uniform(np.log(10.0), np.log(90.0))))}


LISTED = (
    Form("frame_compliance", "exact", "C F", 1e-3, _frame, (5e-5, 5e-3), parameter="compliance_um_per_mN"),
    Form("frame_compliance", "stiffening", "C F0 (F/F0)^0.8", 1e-3, _frame_stiffening, (5e-5, 5e-3)),
    Form("frame_compliance", "seated", "C F0 ln(1 + F/F0)", 1e-3, _frame_seated, (5e-5, 5e-3)),
    Form("thermal_drift", "exact", "v t", 1e-3, _drift, (1e-5, 1e-2), (1, -1), parameter="rate_um_per_s"),
    Form(
        "thermal_drift",
        "decaying",
        "v tau (1 - exp(-t/tau))",
        1e-3,
        _drift_decaying,
        (1e-5, 2e-2),
        (1, -1),
        draw=lambda rng, count: {"tau": float(rng.uniform(60.0, 200.0))},
    ),
    Form(
        "thermal_drift",
        "per_test",
        "v_i t, v_i of one sign and a spread of 50 %",
        1e-3,
        _drift_per_test,
        (1e-5, 1e-2),
        (1, -1),
        draw=lambda rng, count: {"share": 1.0 + 0.5 * rng.standard_normal(count)},
    ),
    Form("creep", "exact", "tau de/dt + e = c sigma", 1e-4, _creep, (1e-5, 3e-3), draw=_tau),
    Form(
        "creep",
        "logarithmic",
        "c ln(1 + t/tau) as memory kernel",
        1e-4,
        _creep_logarithmic,
        (1e-6, 1e-3),
        draw=lambda rng, count: {"tau": float(rng.uniform(2.0, 10.0))},
    ),
    Form(
        "creep",
        "power",
        "c (t/60 s)^0.3 as memory kernel",
        1e-4,
        _creep_power,
        (1e-6, 3e-3),
        draw=lambda rng, count: {"power": 0.3},
    ),
    Form("rate_dependence", "exact", "C1 (1 + m ln(rate/rate0))", 0.02, _rate, (0.003, 0.1)),
    Form("rate_dependence", "power", "sigma (rate/rate0)^m", 0.02, _rate_power, (0.003, 0.1)),
    Form("rate_dependence", "root", "C1 (1 + m sqrt(rate/rate0))", 0.02, _rate_cowper, (0.003, 0.1)),
    Form("adhesion", "exact", "sigma - s phi^1.5 r(phi)", 0.5, _adhesion, (0.02, 3.0), largest=6.0),
    Form(
        "adhesion",
        "dugdale",
        "sigma - s (1 - f^2)(1 - exp(-(f/0.35)^2))",
        0.5,
        _adhesion_dugdale,
        (0.02, 3.0),
        largest=6.0,
    ),
    Form("damage", "exact", "E exp(-k (eps_P - e0))", 1.0, _damage, (0.1, 8.0), largest=14.0),
    Form("damage", "lemaitre", "E / (1 + k (eps_P - 0.15)^2 / 0.25)", 1.0, _damage_lemaitre, (0.1, 12.0), largest=80.0),
    Form("damage", "work", "E exp(-k w / w0)", 1.0, _damage_work, (0.05, 3.0), largest=8.0),
    Form("densification_stiffening", "exact", "E exp(-b p)", 1.0, _densification, (0.2, 10.0), largest=30.0),
    Form(
        "densification_stiffening", "power", "E ((1-p)/(1-p0))^b", 1.0, _densification_power, (0.2, 8.0), largest=30.0
    ),
    Form(
        "densification_stiffening",
        "linear",
        "E (1 + b (eps_P - 0.35))",
        1.0,
        _densification_linear,
        (0.1, 6.0),
        largest=6.0,
    ),
    Form(
        "reload_hysteresis", "exact", "h d_el 4 u (1 - u) on reloads", 0.05, _hysteresis, (0.01, 0.4), needs=(RELOAD,)
    ),
    Form(
        "reload_hysteresis",
        "skewed",
        "h d_el 6.75 v^2 (1 - v) on reloads",
        0.05,
        _hysteresis_skewed,
        (0.01, 0.4),
        needs=(RELOAD,),
    ),
    Form("ratcheting", "exact", "c per reload", 1e-3, _ratchet, (5e-5, 1e-2), needs=(RELOAD,)),
    Form("ratcheting", "settling", "c sqrt(number of reloads)", 1e-3, _ratchet_settling, (5e-5, 1e-2), needs=(RELOAD,)),
    Form(
        "finite_hardening_exponent",
        "exact",
        "C1 x^(1+k), unloading exponent 2 (1+k), k = 1/(2m)",
        0.02,
        _hardening,
        (0.005, 0.25),
        largest=0.6,
    ),
    Form(
        "finite_hardening_exponent",
        "normalised",
        "C1 x c(m) (x/0.2)^k",
        0.02,
        _hardening_normalised,
        (0.005, 0.25),
        largest=0.6,
    ),
    Form("finite_hardening_exponent", "whole", "sigma (x/0.3)^k", 0.02, _hardening_loading, (0.005, 0.25), largest=0.6),
    Form("unloading_shape", "exact", "s^(1+k) for s", 0.1, _unloading_shape, (0.01, 0.6), (1, -1), largest=0.7),
    Form(
        "unloading_shape",
        "power_law",
        "(1-k) s + k (1 - sqrt(u))",
        0.1,
        _unloading_shape_power,
        (0.02, 1.0),
        largest=1.0,
    ),
    Form("size_effect", "exact", "C1 (D_e/200)^-n", 0.5, _size, (0.05, 0.8), largest=1.5),
    Form(
        "size_effect", "gradient", "C1 sqrt((1 + k 200/D_e)/(1 + k))", 0.5, _size_gradient, (0.1, 50.0), largest=100.0
    ),
    Form("size_effect", "linear", "C1 (1 + k (200/D_e - 1))", 0.5, _size_linear, (0.05, 0.8), largest=1.2),
    Form("shape_second_order", "exact", "eta + b (1 - q)^2", 0.3, _shape_second, (0.03, 1.5), (1, -1), largest=3.0),
    Form(
        "shape_second_order", "in_plane", "eta + c ln^2(D1/D2)", 0.1, _shape_in_plane, (0.02, 0.6), (1, -1), largest=1.5
    ),
    Form(
        "shape_second_order",
        "power",
        "eta + b (1/q - 1 - (1 - q))",
        0.3,
        _shape_power,
        (0.02, 1.0),
        (1, -1),
        largest=1.0,
    ),
    Form("pop_in", "exact", "sum D_j H(F - F_j)", 2e-3, _pop_in, (3e-4, 0.05), draw=_draw_pop_in),
    Form(
        "pop_in",
        "burst",
        "sum D_j (1 - exp(-(F - F_j)/(0.02 F_max)))",
        2e-3,
        _pop_in_burst,
        (3e-4, 0.05),
        draw=_draw_pop_in,
    ),
    Form("pop_in", "cascade", "seven small D_j H(F - F_j)", 2e-3, _pop_in, (3e-4, 0.05), draw=_draw_cascade),
    Form("toe_asperity", "exact", "-d D_e exp(-sigma_max/0.6)", 3e-3, _toe, (3e-4, 0.05)),
    Form("toe_asperity", "power", "-d D_e (1 + sigma_max/0.3)^-1.5", 3e-3, _toe_power, (3e-4, 0.05)),
    Form("toe_asperity", "root", "d D_e (1 - exp(-sqrt(sigma_max/0.25)))", 3e-3, _toe_exponent, (3e-4, 0.05)),
    Form("platen_friction", "exact", "sigma (1 + (2 mu/3) a_c/h)", 0.05, _friction, (0.01, 0.6), largest=3.0),
    Form(
        "platen_friction",
        "slab",
        "sigma 2 (exp(z) - 1 - z)/z^2, z = 2 mu a/h",
        0.05,
        _friction_slab,
        (0.01, 0.6),
        largest=2.0,
    ),
    Form("misalignment", "exact", "alpha a_c", 0.01, _tilt, (1e-3, 0.08)),
    Form("misalignment", "wedge", "alpha D_e sqrt(1 - exp(-eps/0.12))", 0.01, _tilt_wedge, (1e-3, 0.08)),
    Form("platen_sink_in", "exact", "F/(2 a_c E*)", 1e-4, _sink_in, (5e-6, 1e-3)),
    Form("platen_sink_in", "growing", "F/(2 a(F) E*)", 1e-4, _sink_in_hertz, (5e-6, 1e-3)),
    Form("reverse_plasticity", "exact", "-c (1 - u)^4 on unloading", 2e-3, _reverse, (2e-4, 0.03)),
    Form("reverse_plasticity", "threshold", "-c (1 - u/0.45)_+^1.5", 2e-3, _reverse_threshold, (2e-4, 0.03)),
    Form("reverse_plasticity", "cubic", "-c (d_el/0.02)(1 - u/0.7)_+^3", 2e-3, _reverse_square, (2e-4, 0.03)),
    Form(
        "humidity",
        "exact",
        "C1 exp(-k dw), E exp(-k dw/2), dw = (RH - 40)/10",
        0.1,
        _humidity,
        (0.01, 0.4),
        needs=(HUMIDITY,),
        largest=0.6,
    ),
    Form(
        "humidity",
        "glass",
        "softening about 55 % RH",
        0.1,
        _humidity_glass,
        (0.01, 0.4),
        needs=(HUMIDITY,),
        largest=0.6,
    ),
)


# --- on no list ------------------------------------------------------------------------------------------------------
def _bump():
    # A shell that buckles: stiffer in one window of strain, on loading only.
    return {"flow": lambda k, y, x, s: y * (1.0 + k * np.exp(-(((x / s.eta - 0.15) / 0.035) ** 2)))}


def _ripple():
    # Layers that collapse one after the other.
    return {"strain": lambda k, e, s: e + k * np.sin(2.0 * np.pi * s.eps_P / 0.06)}


def _kink():
    # A second spring comes off at 0.6 of the peak load.
    return {"strain": lambda k, e, s: e - k * np.maximum(0.6 - s.u, 0.0)}


def _locking():
    # Pores of one size lock at a master strain.
    return {"flow": lambda k, y, x, s: y * (1.0 + k / (1.0 + np.exp(-(x - 0.33) / 0.012)))}


def _room():
    # The room's air conditioning.
    return {"observable": lambda k, g, s: g + k * np.sin(2.0 * np.pi * s.t / 47.0)}


def _encoder():
    # Interpolation error of the displacement gauge.
    return {"observable": lambda k, g, s: g + k * np.sin(2.0 * np.pi * g / 10.0)}


def _backlash():
    # Dead band of the drive at every reversal into unloading.
    return {"observable": lambda k, g, s: g + k * (1.0 - np.exp(-(1.0 - s.u) / 0.02)) * s.path.unloading}


def _seating():
    # Every particle settles on its base at the same stress.
    return {"strain": lambda k, e, s: e + k / (1.0 + np.exp(-(s.sigma_P - 3.0) / 0.25))}


def _wobble():
    # The controller rings after each reversal.
    return {
        "observable": lambda k, g, s: (
            g + k * np.exp(-s.path.since_turn / 6.0) * np.cos(2.0 * np.pi * s.path.since_turn / 9.0)
        )
    }


def _mid_bump():
    # Interlocked fibres let go in the middle of unloading.
    return {"strain": lambda k, e, s: e - k * np.exp(-(((s.u - 0.5) / 0.1) ** 2)) * _below(s)}


def _shape_strain():
    # The shape factor fades as the particle is squeezed flat, with a knee.
    return {"flow": lambda k, y, x, s: y * (1.0 - k * (s.eta - 1.0) * np.maximum(x / s.eta - 0.2, 0.0))}


def _second_contact():
    # A shoulder of the particle touches at a given displacement and carries load like a spring.
    def flow(k, y, x, s):
        gap = 0.12 * (1.0 + 0.3 * (s.particle.q - 0.6))
        return y + k * np.maximum(x / s.eta - gap, 0.0) * np.exp(-np.maximum(x / s.eta - gap, 0.0) / 0.05)

    return {"flow": flow}


UNLISTED = (
    Form("stiffness_bump", "unlisted", "sigma (1 + k exp(-((eps-0.15)/0.035)^2))", 0.03, _bump, largest=0.5),
    Form("strain_ripple", "unlisted", "k sin(2 pi eps_P / 0.06)", 1e-3, _ripple),
    Form("unloading_kink", "unlisted", "-k (0.6 - u)_+", 2e-3, _kink),
    Form(
        "pore_locking",
        "unlisted",
        "sigma (1 + k logistic((x-0.33)/0.012))",
        0.03,
        _locking,
        (0.0, np.inf),
        (1,),
        largest=1.0,
    ),
    Form("room_temperature", "unlisted", "k sin(2 pi t / 47 s)", 0.05, _room),
    Form("gauge_interpolation", "unlisted", "k sin(2 pi gamma / 10 um)", 0.05, _encoder),
    Form("drive_backlash", "unlisted", "k (1 - exp(-(1-u)/0.02)) on unloading", 0.2, _backlash),
    Form("common_seating", "unlisted", "k logistic((sigma_P - 3)/0.25)", 2e-3, _seating),
    Form("controller_ringing", "unlisted", "k exp(-t/6 s) cos(2 pi t/9 s) after reversals", 0.1, _wobble),
    Form("mid_unloading_bump", "unlisted", "-k exp(-((u-0.5)/0.1)^2) on unloading", 1e-3, _mid_bump),
    Form("fading_shape", "unlisted", "sigma (1 - k (eta-1)(eps-0.2)_+)", 0.5, _shape_strain, largest=6.0),
    Form("second_contact", "unlisted", "+ k (eps-gap)_+ exp(-(eps-gap)/0.05)", 1.0, _second_contact, largest=40.0),
)

MECHANISMS = tuple(dict.fromkeys(form.mechanism for form in LISTED))
EXACT = {form.mechanism: form for form in LISTED if form.form == "exact"}
VARIANTS = {name: tuple(f for f in LISTED if f.mechanism == name and f.form != "exact") for name in MECHANISMS}
BY_NAME = {(form.mechanism, form.form): form for form in (*LISTED, *UNLISTED)}

__all__ = ["BY_NAME", "EXACT", "LISTED", "MECHANISMS", "UNLISTED", "VARIANTS", "Effect", "Form", "recovered_fraction"]
