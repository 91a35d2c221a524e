"""From a case to files: particles, amplitudes, noise, the campaign and its answer."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import designs
from . import noise as noise_
from .effects import BY_NAME, EXACT, HUMIDITY, RELOAD, Effect
from .law import EFFECTIVE_MODULUS_MPA, LOG_C, SHAPE_PARAMETER, is_monotone, monotone_means, simulate
from .law import coefficients as coefficients_of
from .strength import _ADDITIVE, Projection, amplitude_for

LARGEST_LAMBDA = 60.0
# Effects about which a T6 campaign is silent although they are there.
_SILENT = {"reload_hysteresis": 0.1, "ratcheting": 1e-3, "humidity": 0.06}


@dataclass(frozen=True)
class Campaign:
    """Data of one case and its answer."""

    columns: dict[str, np.ndarray]
    time: np.ndarray
    force: np.ndarray
    displacement: np.ndarray
    answer: dict


@dataclass(frozen=True)
class Design:
    """What is drawn before any effect."""

    particles: object
    path: object
    noise: noise_.Noise
    scale: np.ndarray
    effects: tuple[Effect, ...]


def design(case, master, known=None):
    """Particles, path, noise and the circumstances of the effects of one case.

    `known` are the effects of an answer: their signs and what all particles share are taken from there.
    """
    rng = case.rng(master)
    noise = noise_.Noise(**case.noise)
    particles = designs.population(
        rng,
        designs.sizes(rng, case.count, case.resample),
        modulus_spread=noise.modulus_spread,
        snap_through=noise.snap_through,
        humidity=case.humidity,
    )
    path = designs.programme(rng, particles, case.protocol)
    scale = noise_.scales(rng, noise, case.count)
    effects = []
    for place, (mechanism, form, _) in enumerate(case.effects):
        found = BY_NAME[mechanism, form]
        sign = int(rng.choice(found.signs))
        circumstances = found.draw(rng, case.count)
        if known is not None:
            sign = 1 if known[place]["amplitude"] >= 0 else -1
            shared = {k: v for k, v in known[place]["circumstances"].items() if np.ndim(v) == 0}
            circumstances = {**circumstances, **shared}
        effects.append(Effect(found, circumstances, sign))
    if case.tier == "T6" and case.cell in _SILENT:
        effects.append(Effect(EXACT[case.cell]))
    return Design(particles, path, noise, scale, tuple(effects)), rng


def build(case, master, known=None):
    """The campaign of a case and its answer.

    `known` are the effects of another answer, taken as they are instead of being set from lambda: the same material
    tested once more.
    """
    drawn, rng = design(case, master, known)
    particles, path = drawn.particles, drawn.path
    length = noise_.path_length(particles, path)
    on_displacement, on_force = noise_.draw(rng, drawn.noise, length, drawn.scale)

    answer = {"case": case.record(), "master_seed": int(master), "effects": [], "twins": [], "oracle": None}
    active = []
    if case.tier == "T6":
        active = [effect(_SILENT[case.cell])[0] for effect in drawn.effects]
        answer["effects"] = [
            {"mechanism": e.form.mechanism, "form": "exact", "amplitude": _SILENT[case.cell], "lambda": 0.0}
            for e in drawn.effects
        ]
    elif drawn.effects:
        projection = Projection(particles, path, drawn.noise, drawn.scale)
        library = _library(projection, case)
        directions = []
        for effect, (_, _, target) in zip(drawn.effects, case.effects, strict=True):
            direction = _direction(projection, effect)
            allowed = [name for name in library if name not in case.exclude]
            rho = {name: _cosine(direction, library[name][0]) for name in library}
            left = 1.0 - max(
                (_admissible(name, rho[name]) ** 2 for name in allowed if name != effect.form.mechanism), default=0.0
            )
            wanted = target if not case.residual else min(LARGEST_LAMBDA, target / np.sqrt(max(left, 1e-6)))
            if known is None:
                amplitude, reached = amplitude_for(projection, effect, wanted, largest=effect.form.largest)
            else:
                amplitude = abs(known[len(directions)]["amplitude"])
                reached = projection.strength(effect(amplitude))
            active += effect(amplitude)
            low, high = effect.form.plausible
            directions.append((direction, reached))
            span = _span_residual(direction, [library[name][0] for name in allowed if name != effect.form.mechanism])
            answer["effects"].append(
                {
                    "mechanism": effect.form.mechanism,
                    "form": effect.form.form,
                    "equation": effect.form.equation,
                    "amplitude": amplitude * effect.sign,
                    "parameter": effect.form.parameter,
                    "circumstances": {k: np.asarray(v).tolist() for k, v in effect.circumstances.items()},
                    "lambda_target": wanted,
                    "lambda": reached,
                    "lambda_residual": reached * np.sqrt(left) if case.residual or case.exclude else reached,
                    "lambda_outside_span": reached * span,
                    "plausible": bool(low <= amplitude <= high),
                    "rms_um": float(np.sqrt(np.mean(projection.change(effect(amplitude)) ** 2))),
                }
            )
        answer.update(_oracle(projection, library, case, directions, drawn, on_displacement, on_force))
    displacement = simulate(particles, path, tuple(active)) + on_displacement
    after = coefficients_of(
        particles, path, [pair for pair in active if set(pair[0]) <= {"C1", "modulus"} and "C1" in pair[0]]
    )
    log_C1, log_C3, log_C5 = map(float, monotone_means(designs.MARGIN))  # of what is drawn, others being replaced
    answer["truth"] = {
        "a": SHAPE_PARAMETER,
        "effective_modulus_MPa": EFFECTIVE_MODULUS_MPA,
        "log_C1": log_C1,
        "log_C3": log_C3,
        "log_C5": log_C5,
        "log_C1_drawn": float(np.log(particles.C1).mean()),
        "snapping_particles": int((~is_monotone(after["C1"], particles.C3, particles.C5)).sum()),
    }
    columns = {"D1_um": particles.D1, "D2_um": particles.D2, "D3_um": particles.D3}
    if not case.hide_columns:
        columns |= particles.columns
    return Campaign(columns, path.time, path.force + on_force, displacement, answer)


def _library(projection, case):
    """Signatures and allowed signs of the listed mechanisms that this campaign can show, exact forms.

    `pop_in` is left out unless it is the truth: its signature is whatever jumps there are.
    """
    out = {}
    for name, form in EXACT.items():
        if (RELOAD in form.needs and case.protocol == "P0") or (HUMIDITY in form.needs and not case.humidity):
            continue
        if name == "pop_in":
            continue
        effect = Effect(form, {"tau": 30.0} if name == "creep" else {})
        signature = projection.signature(effect)
        if np.linalg.norm(signature) * form.unit > 1e-6:
            out[name] = (signature, form.signs)
    return out


def _direction(projection, effect):
    additive = all(set(hooks) <= _ADDITIVE for hooks, _ in effect(1.0))
    return projection.project(projection.change(effect(effect.unit))) if additive else projection.signature(effect)


def _cosine(v, g):
    return float(v @ g / (np.linalg.norm(v) * np.linalg.norm(g)))


def _admissible(name, rho):
    """rho, or nil if only an impossible sign of the mechanism would give it."""
    return rho if len(EXACT[name].signs) > 1 else max(rho, 0.0)


def _span_residual(direction, signatures):
    """Share of the direction that no combination of the signatures reaches."""
    if not signatures:
        return 1.0
    basis = np.linalg.qr(np.stack([g / np.linalg.norm(g) for g in signatures], axis=1))[0]
    unit = direction / np.linalg.norm(direction)
    return float(np.linalg.norm(unit - basis @ (basis.T @ unit)))


def _oracle(projection, library, case, directions, drawn, on_displacement, on_force):
    """Which mechanisms a score test with the true covariance and the exact formulas could not tell from the truth.

    `twins`: rho with the truth, expected and realised half difference of squared statistics. `oracle`: the best name
    there.
    """
    particles = drawn.particles
    deviations = np.stack(
        [
            *(np.log(getattr(particles, name)) - LOG_C[name][0] for name in LOG_C),
            np.log(particles.modulus / EFFECTIVE_MODULUS_MPA),
            particles.zero,
        ],
        axis=1,
    )
    signal = sum(direction * (reached / np.linalg.norm(direction)) for direction, reached in directions)
    left = projection.residual(np.zeros_like(projection.base), on_displacement, on_force, deviations) + signal
    score = {}
    for name, (signature, _) in library.items():
        if name not in case.exclude:
            score[name] = _admissible(name, float(left @ signature / np.linalg.norm(signature)))
    out = {
        "twins": [],
        "oracle": {"statistics": score, "best": max(score, key=lambda k: abs(score[k])) if score else None},
    }
    if len(directions) == 2:
        out["rho_pair"] = _cosine(directions[0][0], directions[1][0])
        return out
    direction, reached = directions[0]
    own = float(left @ direction / np.linalg.norm(direction))
    for name, (signature, _) in library.items():
        if name == case.effects[0][0] or name in case.exclude:
            continue
        rho = _admissible(name, _cosine(direction, signature))
        out["twins"].append(
            {
                "mechanism": name,
                "rho": rho,
                "expected_dll": 0.5 * reached**2 * (1.0 - rho**2),
                "realised_dll": 0.5 * (own**2 - score[name] ** 2),
            }
        )
    out["twins"].sort(key=lambda twin: -abs(twin["rho"]))
    return out


def write(campaign, folder):
    """Write `particles.csv`, `curves.csv`, `campaign.toml`; returns the SHA-256 of the three."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = list(campaign.columns)
    rows = [
        ",".join([str(i + 1), *(f"{campaign.columns[n][i]:.10g}" for n in names)])
        for i in range(len(campaign.columns["D1_um"]))
    ]
    (folder / "particles.csv").write_text("\n".join([",".join(["particle", *names]), *rows]) + "\n")
    lines = ["particle,time_s,force_mN,displacement_um"]
    for i, (t, F, g) in enumerate(zip(campaign.time, campaign.force, campaign.displacement, strict=True)):
        lines += [
            f"{i + 1},{a:.4f},{b:.5f},{c:.5f}" for a, b, c in zip(t.tolist(), F.tolist(), g.tolist(), strict=True)
        ]
    (folder / "curves.csv").write_text("\n".join(lines) + "\n")
    (folder / "campaign.toml").write_text(
        'control = "load"\nprovenance = "synthetic"\ncorrections = []\npunch_diameter_um = 500.0\n'
        "force_resolution_mN = 0.01\ndisplacement_resolution_um = 0.001\n"
    )
    digest = hashlib.sha256()
    for name in ("particles.csv", "curves.csv", "campaign.toml"):
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()
