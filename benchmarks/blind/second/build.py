"""One case made: campaign, displacement with noise, and the answer."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import campaign, effects, noise, particles
from .law import is_monotone, simulate
from .projection import Projection
from .strength import amplitude_for, in_all_modes

ATTEMPTS = 30
FREE_ATTEMPTS = 3
"""Fresh draws before the bound of the amplitude is lowered, by a tenth each time, to get a monotone loading curve."""

MODULUS_SCATTER = 0.1
FURTHER_RELOAD = 0.3
"""Share of campaigns with partial unloading that get a further reload though no effect asks for it."""

PAIR_ATTEMPTS, PAIR_COSINE, PAIR_SHARE = 20, 0.6, 14.5 / 15
"""Two effects are drawn again while their cosine is larger, or either has less than this share of its lambda."""

LEFT_OVER = 12.2
"""Lambda that an unlisted effect keeps, at least, beside the best listed one."""

NULL_FORMULAS = {
    "clean": "base law, white + OU noise",
    "t4": "base law, t4-tailed noise",
    "scale": "base law, per-particle noise scale sd(ln)=0.5",
    "escatter": "base law, Ebar scatters 10 % between particles",
}


class Built(NamedTuple):
    """A campaign, the measured displacement in um, and what is hidden."""

    campaign: campaign.Campaign
    displacement: np.ndarray
    answer: dict


def build(case, seed):
    """Make a case; `seed` is a list of integers. Draws again while the changed loading curve falls somewhere."""
    for attempt in range(ATTEMPTS):
        built = _attempt(case, np.random.default_rng([*seed, attempt]), attempt)
        if built is not None:
            return built
    raise AssertionError("the last attempt is always taken")


def _attempt(case, rng, attempt):
    hidden = [_formula(rng, *named)(rng) for named in case.effects]
    reloads = 0
    if case.protocol != "P0":
        reloads = max([effect.reloads for effect in hidden], default=0)
        if not reloads and rng.random() < FURTHER_RELOAD:
            reloads = 1
    humid = case.humidity or any(effect.humidity for effect in hidden)
    drawn = campaign.draw(
        rng,
        case.count,
        case.protocol,
        humidity=particles.humidity_levels(rng, case.count) if humid else None,
        reloads=reloads,
        noise_kind=case.noise,
        wide=any(effect.wide for effect in hidden),
        low_turn=any(effect.low_turn for effect in hidden),
        modulus_scatter=MODULUS_SCATTER if case.noise == "escatter" else 0.0,
    )
    projection = Projection(drawn)
    answer = {"tier": case.tier}
    if not hidden:
        curves = projection.base
        answer |= {"mechanism": "none", "mechanisms": [], "formula": NULL_FORMULAS[case.noise]}
        answer |= {"amplitude": 0.0, "unit": "", "lambda": 0.0}
    elif case.tier == "pair":
        curves, more = _pair(case, rng, projection, hidden)
        answer |= more
    else:
        made = _single(case, projection, hidden[0], attempt)
        if made is None:
            return None
        curves, more = made
        answer |= more
    displacement = curves + noise.sample(rng, drawn.noise, drawn.path)
    if not np.all(np.isfinite(displacement)):
        raise ArithmeticError(f"a curve that is not finite in {case}")
    return Built(drawn, displacement, answer | _circumstances(case, drawn, reloads))


def _formula(rng, mechanism, number):
    if mechanism == "unlisted":
        return effects.UNLISTED[number]
    formulas = effects.LISTED[mechanism]
    return formulas[int(rng.integers(len(formulas))) if number is None else number]


def _single(case, projection, effect, attempt):
    """Curves and answer of one hidden effect; None where its loading curve falls and another draw is left."""
    cap_share = 0.9 ** max(0, attempt - FREE_ATTEMPTS)
    theta, more = case.amplitude, {}
    if theta is None:
        theta, _ = amplitude_for(projection, effect, case.target, effect.mode, cap_share)
    if case.tier == "unlisted":
        theta, more = _beside_listed(case, projection, effect, theta, cap_share)
    hidden = [(effect, theta)]
    monotone = is_monotone(projection.campaign, hidden)
    if not monotone and attempt < ATTEMPTS - 1:
        return None
    curves = simulate(projection.campaign, hidden)
    found = in_all_modes(projection, curves, hidden)
    return curves, {
        **more,
        "mechanism": effect.mechanism,
        "mechanisms": [effect.mechanism] if effect.mechanism != "unlisted" else [],
        "formula": effect.describe(),
        "amplitude": theta,
        "unit": effect.unit,
        "lambda_all": found,
        "lambda": found[effect.mode],
        "lambda_mode": effect.mode,
        "lambda_target": case.target,
        "monotone": monotone,
        "max_abs_change_um": round(float(np.abs(curves - projection.base).max()), 3),
    }


def _beside_listed(case, projection, effect, theta, cap_share):
    """Amplitude at which enough is left beside the most similar listed formula."""
    left = projection.project(simulate(projection.campaign, [(effect, theta)]) - projection.base, effect.mode)
    cosine, name = _most_similar(projection, left / np.linalg.norm(left), effect.mode)
    alone = np.sqrt(max(0, 1 - cosine**2))
    target = float(case.target)
    if case.target * alone < LEFT_OVER:
        target = LEFT_OVER * case.target / (case.target * alone)
    theta, reached = amplitude_for(projection, effect, target, effect.mode, cap_share)
    return theta, {
        "best_listed": name,
        "best_listed_abs_rho": round(cosine, 3),
        "lambda_left": round(reached * np.sqrt(1 - cosine**2), 2),
    }


def _most_similar(projection, direction, mode):
    """Largest cosine between a whitened direction and a listed formula, and that formula's mechanism."""
    best = (0, "")
    for name, formulas in effects.LISTED.items():
        if name == "humidity" and projection.campaign.particles.humidity is None:
            continue
        for formula in formulas:
            if formula.mode == "pop":
                continue
            listed = formula(np.random.default_rng(7))

            def left(theta, listed=listed):
                return projection.project(simulate(projection.campaign, [(listed, theta)]) - projection.base, mode)

            small = left(listed.start)
            size = np.linalg.norm(small)
            if size < 1e-3:
                continue
            # Formulas bend with their amplitude: compare where they are weak.
            if size > 5:
                small = left(listed.start * (5 / size))
            cosine = abs(float(direction @ small) / np.linalg.norm(small))
            if cosine > best[0]:
                best = (cosine, name)
    return best


def _pair(case, rng, projection, hidden):
    """Curves and answer of two effects of one lambda that are not nearly the same."""
    drawn = projection.campaign
    for attempt in range(PAIR_ATTEMPTS):
        if attempt:
            hidden = [_formula(rng, *named)(rng) for named in case.effects]
        mode = "free_zero" if any(effect.mode == "free_zero" for effect in hidden) else "free"
        sized = [(effect, *amplitude_for(projection, effect, case.target, mode)) for effect in hidden]
        both = [(effect, theta) for effect, theta, _ in sized]
        first, second = (projection.fit(simulate(drawn, [one]), mode)[0] for one in both)
        cosine = float(first @ second / np.linalg.norm(first) / np.linalg.norm(second))
        strong = min(reached for *_, reached in sized) > PAIR_SHARE * case.target
        if abs(cosine) < PAIR_COSINE and strong and is_monotone(drawn, both):
            break
    curves = simulate(drawn, both)
    found = in_all_modes(projection, curves, both)
    return curves, {
        "mechanism": "+".join(effect.mechanism for effect in hidden),
        "mechanisms": [effect.mechanism for effect in hidden],
        "formula": " ; ".join(effect.describe() for effect in hidden),
        "amplitude": [theta for _, theta in both],
        "unit": [effect.unit for effect in hidden],
        "rho": round(cosine, 3),
        "lambda_each": [round(reached, 2) for *_, reached in sized],
        "lambda_all": found,
        "lambda": found[mode],
        "lambda_mode": mode,
    }


def _circumstances(case, drawn, reloads):
    tested, loaded, noisy = drawn.particles, drawn.path, drawn.noise
    return {
        "protocol": case.protocol + (f"+{reloads}reload" if reloads else ""),
        "rates_mN_s": [float(rate) for rate in loaded.rates],
        "n_particles": len(tested),
        "noise": case.noise,
        "has_rh": tested.humidity is not None,
        "truth": {
            "a": float(tested.a),
            "effective_modulus_MPa": float(tested.mean_modulus),
            "noise_white_um": float(noisy.white),
            "noise_ou_um": float(noisy.wander),
            "ou_length_MPa": float(noisy.length),
        },
    }
