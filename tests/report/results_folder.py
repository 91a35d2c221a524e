"""A folder of results whose truth is known: tests simulated without noise, and results that state that truth."""

import base64
import json
import math
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from asserting import estimate as without_error

from mcc_jax.calibrate import Posterior
from mcc_jax.calibrate.data import rows_from_contact
from mcc_jax.calibrate.results import Calibration, read_saved
from mcc_jax.campaign import Campaign, campaign_segments, file_checksums, write_campaign
from mcc_jax.discovery import Discovery
from mcc_jax.effects import find_variant
from mcc_jax.law import MccLaw, Plastic
from mcc_jax.simulate import Hold, Programme, Ramp, simulate_campaign

SIZES = np.array([[213.54, 196.07, 186.33], [155.32, 217.51, 136.87], [97.56, 100.98, 69.09], [120.0, 110.0, 100.0]])
C = np.array([[7.0, 3.0, 2.7], [6.0, 2.9, 2.6], [8.0, 3.05, 2.75], [6.5, 2.95, 2.65]])
A, MODULUS = 1.43, 16000.0
ZERO = np.array([0.0, 0.5, -0.25, 1.0])
NOISE = 0.02
NAMES = ("1", "B 2", "<img src=x onerror=alert(1)>", "left out")
STEPS = (Ramp(0.5, 5.0), Hold(10.0), Ramp(0.1, 5.0), Ramp(1.0, 5.0), Ramp(0.0, 5.0))
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def campaign(names=NAMES, zero=ZERO):
    one = eqx.filter_vmap(lambda c: MccLaw(Plastic(c[0], c[1], c[2]), A, MODULUS))
    diameter = SIZES[:, 0] * SIZES[:, 1] / SIZES[:, 2]
    peaks = 9e-3 * math.pi * (diameter / 2) ** 2
    plan = Programme("load", STEPS, points=90)
    made = simulate_campaign(one(jnp.asarray(C)), SIZES, peaks, plan, particles=names)
    curves = (replace(c, displacement_um=c.displacement_um + z) for c, z in zip(made.curves, zero, strict=True))
    return replace(made, curves=tuple(curves), columns={})


def estimate(value, sd=0.01):
    return without_error(value, sd)


def calibration(names=NAMES, **changes):
    """`calibration.json` that states the truth; the last particle took no part."""
    particles = []
    for i, name in enumerate(names):
        kept = i < len(names) - 1
        eta = 1 + A * (1 - SIZES[i, 2] ** 2 / (SIZES[i, 0] * SIZES[i, 1]))
        values = {"eta_p": eta, "C1": C[i, 0], "C3": C[i, 1], "C5": C[i, 2], "zero_um": ZERO[i]}
        entry = {key: estimate(value) if kept else without_error(None) for key, value in values.items()}
        why_not = None if kept else "has 3 usable points on loading, fewer than 12"
        particles.append(
            {"particle": name, **entry, "rms_um": NOISE if kept else None, "kept": kept, "why_not": why_not}
        )
    diagnostics = {"rhat_max": 1.004, "ess_bulk_min": 900.0, "divergences": 0, "pareto_k_max": 0.3, "own_misfit": 0.001}
    return {
        "schema": 1,
        "method": "bayes",
        "converged": True,
        "runtime_s": 1.0,
        "seed": 3,
        "law": {"unloading": "printed", "strain_scaling": "raw"},
        "a": estimate(A),
        "effective_modulus_MPa": estimate(MODULUS, 10.0),
        **{f"log_C{k}": {"mean": estimate(m), "sd": estimate(0.1)} for k, m in ((1, 1.9), (3, 1.09), (5, 0.98))},
        "yield_stress_MPa": estimate(0.4),
        "probability_not_monotone": estimate(0.02),
        "noise": {"displacement_um": estimate(NOISE, 0.001)},
        "priors": {"a": {"distribution": "normal", "mean": 1.0, "sd": 1.0}},
        "effects": [],
        "findings": [],
        "particles": particles,
        "warnings": ["particle 'left out' could not be used"],
        "diagnostics": diagnostics,
        "figures": ["figures/forest.png"],
        "files": ["posterior.nc"],
    } | changes


def discovery(**changes):
    """`discovery.json` with every part filled."""
    frame, rivals = {"mechanism": "frame_compliance", "probability": 0.8}, ["frame_compliance", "platen_sink_in"]
    effect = frame | {"variant": "linear", "p_family_wise": 0.0, "equation": "d = C F"}
    effect |= {"explanation": "A linear spring in series with the particle."}
    effect |= {"parameters": {"compliance_um_per_mN": estimate(0.004, 1e-5)}}
    ranked = frame | {"statistic": 40.0, "estimate": 0.004, "detection_limit": 0.0001, "unit": "um/mN"}
    place = {"segment": "loading", "load_fraction": [0.1, 0.3], "strain": [0.0, 0.4], "share": 0.6}
    place |= {"particles": ["1", "C"], "direction": "more displacement than the law"}
    further = {"experiment": "a hold of 60 s at the largest load", "separates": rivals, "particles": 6, "power": 0.95}
    logs = {f"log_C{k}": {"mean": estimate(m), "sd": without_error(None)} for k, m in ((1, 1.9), (3, 1.0), (5, 0.9))}
    step = {"chi2_per_dof": 2.0, "systematic_um": 0.07, "elpd": 0.0, "elpd_se": 0.0}
    steps = [{"added": None, **step}, {"added": "frame_compliance", **step, "systematic_um": 0.001}]
    return {
        "schema": 1,
        "verdict": "SET",
        "summary": "The law and the 3 tests disagree.",
        "effects": [effect],
        "candidate_set": [rivals],
        "ranking": [ranked],
        "untestable": [{"mechanism": "humidity", "needs": "a column relative_humidity_percent"}],
        "where": [place],
        "closure": None,
        "gap": {"floor": 1.0, "heldout": "leave-one-particle-out", "steps": steps, "closed_fraction": 0.99},
        "parameters_before": {"a": estimate(1.2), "effective_modulus_MPa": estimate(9000.0, 50.0)} | logs,
        "parameters_after": {"a": estimate(A), "effective_modulus_MPa": estimate(MODULUS)} | logs,
        "next_experiments": [further],
        "runtime_s": 2.0,
        "seed": 0,
        "notes": ["few particles"],
        "checks": [],
        "findings": [],
        "leads": [],
        "equivalent_by_construction": [],
        "p_anything_missing": None,
        "figures": ["figures/discovery_before_after.png"],
    } | changes


class Draws(Posterior):
    """Stands in for a saved posterior: draws around the truth, and bands of noise that these tests do not have."""

    def __init__(self, campaign, content, of_a):
        vars(self).update(campaign=campaign, content=content, of_a=of_a, seed=0)

    @property
    def variants(self):
        names = [f"{effect['mechanism']}:{effect['variant']}" for effect in self.to_json()["effects"]]
        return {name: find_variant(name) for name in names}

    @property
    def particles(self):
        return tuple(self.campaign.particles[:-1])

    def named_population(self):
        rng = np.random.default_rng(0)
        named = {"a": self.of_a, "effective_modulus_MPa": MODULUS + 10 * rng.standard_normal((4, 100))}
        for k, mu in ((1, 1.9), (3, 1.09), (5, 0.98)):
            named[f"mu_C{k}"] = mu + 0.01 * rng.standard_normal((4, 100))
            named[f"tau_C{k}"] = np.abs(0.1 + 0.01 * rng.standard_normal((4, 100)))
        return named

    def compared(self):
        segments = campaign_segments(self.campaign)
        rows = [rows_from_contact(c, s, 400) for c, s in zip(self.campaign.curves, segments, strict=True)][:-1]
        return {i: (some, np.ones(len(some), bool)) for i, some in enumerate(rows)}

    def predictions(self, particle):
        i = self.campaign.index(particle)
        um = self.campaign.curves[i].displacement_um[self.compared()[i][0]]
        return um + NOISE * np.random.default_rng(i).standard_normal((500, len(um)))


@dataclass(frozen=True, repr=False)
class Numbers(Calibration):
    """Stands in for a saved calibration without draws."""

    campaign: Campaign
    content: dict


class Found(Discovery):
    """Stands in for a saved discovery: its contents alone."""


def stand_in(file):
    """What `read_saved` gives in these tests: results that state what is written in the file."""
    if not file.read_bytes().startswith(b"{"):
        return read_saved(file)
    content = json.loads(file.read_text())
    if "verdict" in content:
        found = Found(content["verdict"], content["summary"], None, None, 0, 0.0)
        found.__dict__["content"] = content
        return found
    tests = campaign([entry["particle"] for entry in content["particles"]])
    if content["method"] != "bayes":
        return Numbers(tests, content)
    return Draws(tests, content, A + 0.01 * np.random.default_rng(0).standard_normal((4, 100)))


def write_results(folder, names=NAMES):
    """Campaign, calibration, discovery and figures in one folder."""
    tests = campaign(names)
    write_campaign(tests, folder)
    origin = {
        "campaign": {"folder": str(folder), "sha256": file_checksums(folder)},
        "settings": {"threshold_MPa": 0.2, "seed": 3},
        "versions": {"mcc_jax": "0.1.0", "jax": "0.10"},
    }
    for name, content in (("calibration", calibration(names)), ("discovery", discovery())):
        (folder / f"{name}.json").write_text(json.dumps(content | {"provenance": origin}), encoding="utf-8")
        (folder / f"{name}.msgpack").write_text(json.dumps(content), encoding="utf-8")
    (folder / "figures").mkdir()
    for stem in ("forest", "discovery_before_after"):
        (folder / "figures" / f"{stem}.png").write_bytes(PNG)
    return folder


def changed(folder, name="calibration.msgpack", **changes):
    """The results of a folder after changing one of its files."""
    file = folder / name
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    from mcc_jax.report import read_results

    return read_results(folder)
