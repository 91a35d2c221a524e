"""Is a hidden effect recovered by the model that has it?

Run `python benchmarks/study_hidden.py --setting creep-8 --part 0/2`.

40 campaigns of 12 particles a setting, two cycles with holds of 10 s. In each an effect is hidden, creep or frame
compliance, as strong as the setting says: by the misfit that the base law leaves (chi2 per point of the true noise,
1.3, 3 or 8), or so weak that the root of its squared residual is 5 standard deviations (`creep-weak`). The amplitude
that does so is worked out to first order for each campaign. Kept of each: z of modulus and amplitude and whether their
95 % intervals hold the truth, the standard deviation that the noise has at a point over the true one, and by how much
the log marginal likelihood prefers the true model to the base law.

Every part writes its own rows and goes on from those that stand; `--table` draws the table of all.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import mcc_jax as mcc
from mcc_jax.calibrate.forward import Forms, Point, linearise
from mcc_jax.calibrate.noise import Noise, grams_and_likelihoods
from mcc_jax.effects import find_variant

RESULTS = Path(__file__).parent / "results"
MODULUS_MPA, PARTICLES, CAMPAIGNS = 16_000.0, 12, 40
WEAK = 5.0
INSTRUMENT = mcc.Instrument(0.08, 0.05)
EFFECTS = {"creep": ("creep:logarithmic", {"tau_s": 3.0}), "frame": ("frame_compliance:linear", {})}
SETTINGS = (*(f"{name}-{chi2}" for name in EFFECTS for chi2 in ("1.3", "3", "8")), "creep-weak")


def campaign_of(seed: int, effects: tuple[mcc.HiddenEffect, ...] = ()) -> mcc.Campaign:
    """The paper's material and protocol, 12 particles, two cycles with holds."""
    programme = mcc.Programme.cycles(levels=(0.5, 1.0), hold_s=10.0, interval_s=0.25)
    campaign = mcc.paper_campaign(seed, instrument=INSTRUMENT, programme=programme, effects=effects)
    return campaign.without(*campaign.particles[PARTICLES:])


def strength(base: mcc.calibrate.Fit, name: str, strong: str) -> float:
    """Amplitude whose residual, every particle's own numbers integrated out, is as large as the setting says."""
    formula, further = EFFECTS[name]
    variant = find_variant(formula)
    forms = Forms(base.model.unloading, (variant,))
    theta = np.array([0.0, *(further[n.name] for n in variant.nuisances)])
    true = Noise.of((INSTRUMENT.displacement_noise_um, INSTRUMENT.force_noise_mN, 1e-6, 0.2), jnp.ones(PARTICLES))
    point = Point(base.point.latent, base.point.zero, jnp.asarray(np.broadcast_to(theta, (PARTICLES, len(theta)))))
    linear, model = linearise(point, base.tests, forms), base.model
    kinds = model.zero_prior[1], model.correlation, model.along
    grams, _ = grams_and_likelihoods(true.scale, base.tests, linear, true.logs[None], *kinds)
    information = float(np.asarray(grams)[:, 0, 0, 0].sum())
    points = int(np.asarray(base.tests.mask).sum())
    squares = WEAK**2 if strong == "weak" else (float(strong) - 1) * points
    return float(np.sqrt(squares / information))


def noise_ratio(fit: mcc.calibrate.Fit) -> float:
    """Median over points of the standard deviation of noise that was found over the true one."""
    by_force = np.asarray(linearise(fit.point, fit.tests, fit.model.forms).by_force)
    true = INSTRUMENT.displacement_noise_um**2 + (INSTRUMENT.force_noise_mN * by_force) ** 2
    found = np.asarray(fit.filters.solver.matrix.diag.d)
    return float(np.median(np.sqrt(found / true)[np.asarray(fit.tests.mask)]))


def row(setting: str, seed: int) -> dict[str, object]:
    """What the base law and the true model say of one campaign."""
    name, strong = setting.split("-")
    formula, further = EFFECTS[name]
    variant = find_variant(formula)
    amplitude = strength(mcc.fit(campaign_of(seed)), name, strong)
    campaign = campaign_of(seed, (mcc.HiddenEffect(variant, amplitude, further),))
    model = mcc.Model()
    base = mcc.sample(campaign, model, without_flagged=False)
    found = mcc.sample(campaign, model.with_effects(formula), without_flagged=False)
    compared = mcc.compare(campaign, [found, base])
    kept: dict[str, object] = {"setting": setting, "seed": seed, "amplitude": amplitude}
    draws = found.named_population()
    for label, site, truth in (
        ("modulus", "effective_modulus_MPa", MODULUS_MPA),
        ("amplitude", variant.mechanism, amplitude),
    ):
        values = draws[site].ravel()
        low, high = np.quantile(values, (0.025, 0.975))
        kept[f"z {label}"] = float((values.mean() - truth) / values.std())
        kept[f"covered {label}"] = bool(low <= truth <= high)
    return kept | {
        "modulus of base": float(base.to_json()["effective_modulus_MPa"]["value"]),
        "chi2 of base": float(compared["chi2_per_point"][1]),
        "noise": noise_ratio(found.fit),
        "preferred by": float(compared["log_evidence"][0] - compared["log_evidence"][1]),
        "converged": found.converged,
        "failures": "; ".join(found.failures()),
    }


def table(rows: list[dict[str, object]]) -> str:
    """A line a setting."""
    head = (
        "| setting | campaigns | chi2 of base | modulus of base [GPa] | z modulus | z amplitude | covered modulus "
        "| covered amplitude | noise / truth, range | true model preferred | converged |"
    )
    lines = [head, "|" + "---|" * 11]
    for setting in SETTINGS:
        some = [r for r in rows if r["setting"] == setting]
        if not some:
            continue
        column = {key: np.array([r[key] for r in some]) for key in some[0]}
        z = (f"{column[f'z {n}'].mean():+.2f} +- {column[f'z {n}'].std():.2f}" for n in ("modulus", "amplitude"))
        noise = column["noise"]
        lines.append(
            f"| {setting} | {len(some)} | {np.median(column['chi2 of base']):.1f} "
            f"| {1e-3 * np.median(column['modulus of base']):.2f} | {' | '.join(z)} "
            f"| {column['covered modulus'].sum()} | {column['covered amplitude'].sum()} "
            f"| {np.median(noise):.3f} ({noise.min():.3f} to {noise.max():.3f}) "
            f"| {(column['preferred by'] > 0).sum()} | {column['converged'].sum()} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run one part of a setting, or draw the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--setting", choices=SETTINGS)
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.table:
        rows = [r for file in sorted((RESULTS / "hidden").glob("*.json")) for r in json.loads(file.read_text())]
        (RESULTS / "hidden.md").write_text(table(rows))
        print(table(rows))
        return
    part, parts = map(int, arguments.part.split("/"))
    (RESULTS / "hidden").mkdir(exist_ok=True)
    file = RESULTS / "hidden" / f"{arguments.setting}_{part}_of_{parts}.json"
    found = json.loads(file.read_text()) if file.exists() else []
    for seed in range(part, CAMPAIGNS, parts)[len(found) :]:
        found.append(row(arguments.setting, seed))
        file.write_text(json.dumps(found, indent=1) + "\n")
        print(found[-1], flush=True)


if __name__ == "__main__":
    main()
