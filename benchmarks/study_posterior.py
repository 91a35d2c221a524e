"""Is the posterior's uncertainty honest? Simulation-based calibration of the joint posterior.

For every campaign the truth is drawn from the prior (population, particles, peak stresses), the tests are simulated as
a tester would record them, and the posterior is sampled. If everything is right, the true value's rank among posterior
draws is uniform (Talts et al. 2018), and intervals cover as often as they say. Settings:

- prior: 20 particles with the sizes of the paper's Table 1, everything drawn from priors around the paper's values;
- collapsed: the same with tau_C3 = 4.9e-9 (the paper's value) in truth;
- five: 5 particles;
- wide: the library's default priors, whose corners hold powders that nobody has seen (C1 of 1 MPa, snap-through).

Run `uv run --group bench python benchmarks/study_posterior.py --write` (50 minutes on 2 cores);
`--campaigns 20` for a look.
"""

from __future__ import annotations

import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import _report
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax.calibrate import JointModel, LogNormalPrior, NakagamiPrior, NormalPrior, Priors, calibrate_bayes
from mcc_jax.calibrate.arviz import prior_draws
from mcc_jax.calibrate.model import prior_numbers
from mcc_jax.campaign import PAPER_DIAMETERS_UM, particle_batch
from mcc_jax.geometry import Particle
from mcc_jax.law import Plastic
from mcc_jax.simulate import Instrument, Programme, law_for_each, simulate_campaign

QUANTITIES = ("a", "effective_modulus_MPa", "mu_C1", "mu_C3", "mu_C5", "tau_C1", "tau_C3", "tau_C5")
COLLAPSED = 4.9e-9
THINNED = 199
INSTRUMENT = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05, zero_um=2.0)
POINTS = 180


AROUND = Priors(
    a=NormalPrior(1.4, 0.4),
    effective_modulus_MPa=LogNormalPrior(16_000.0, 0.5),
    C1=LogNormalPrior(6.7, 0.2),
    C5=LogNormalPrior(2.7, 0.1),
    softening=LogNormalPrior(0.33, 0.3),
    tau_C1=NakagamiPrior(0.3),
    tau_C3=NakagamiPrior(0.02, shape=0.125),
    tau_C5=NakagamiPrior(0.08),
)


def draw_truth(seed: int, count: int, collapsed: bool, model: JointModel):
    """A population from the prior, N of the paper's particles, and their laws and peak forces."""
    rng = np.random.default_rng([seed, 1])
    chosen = np.sort(rng.choice(len(PAPER_DIAMETERS_UM), size=count, replace=False))
    diameters = PAPER_DIAMETERS_UM[chosen]
    particles = particle_batch(diameters)
    low, high = np.asarray(prior_numbers(model.chosen_priors, eqx.filter_vmap(lambda p: p.flatness)(particles)).a)[2:]
    truth = {k: v[0, 0] for k, v in prior_draws(model.chosen_priors, low, high, (1, 1), seed).items()}
    if collapsed:
        truth["tau"] = np.array([truth["tau"][0], COLLAPSED, truth["tau"][2]])
    C = np.exp(truth["mu"] + truth["tau"] * rng.standard_normal((count, 3)))
    laws = law_for_each(
        eqx.filter_vmap(Plastic)(*jnp.asarray(C).T), float(truth["a"]), float(truth["effective_modulus_MPa"])
    )
    stress = rng.uniform(7, 16, count)
    peaks = np.asarray(eqx.filter_vmap(Particle.force)(particles, jnp.asarray(stress)))
    return truth, diameters, laws, peaks


def one_campaign(seed: int, count: int, collapsed: bool, model: JointModel):
    """Rank and probability of the truth in the posterior, by quantity, and how the run went."""
    truth, diameters, laws, peaks = draw_truth(seed, count, collapsed, model)
    programme = Programme.cycles(points=POINTS)
    campaign = simulate_campaign(laws, diameters, peaks, programme, instrument=INSTRUMENT, seed=seed)
    posterior = calibrate_bayes(campaign, model=model, seed=seed)
    named = posterior.named_population()
    values = {"a": truth["a"], "effective_modulus_MPa": truth["effective_modulus_MPa"]}
    for j, name in enumerate(("C1", "C3", "C5")):
        values[f"mu_{name}"], values[f"tau_{name}"] = truth["mu"][j], truth["tau"][j]
    rng = np.random.default_rng([seed, 2])
    row = {"seed": seed}
    for name in QUANTITIES:
        draws = named[name].ravel()
        some = draws[np.linspace(0, len(draws) - 1, THINNED).round().astype(int)]
        below, equal = int((some < values[name]).sum()), int((some == values[name]).sum())
        row[f"rank {name}"] = below + int(rng.integers(equal + 1))
        row[f"share {name}"] = float((draws < values[name]).mean())
        row[f"z {name}"] = float((draws.mean() - values[name]) / draws.std())
    monotone = np.asarray(eqx.filter_vmap(lambda law: law.is_monotone)(laws))
    row |= {
        "kept": len(posterior.particles),
        "not monotone": int((~monotone).sum()),
        "rhat": max(posterior.rhat.values()),
        "ess": min(posterior.ess_bulk.values()),
        "divergences": posterior.divergences,
        "k": float(posterior.pareto_k.max()),
        "k joint": posterior.pareto_k_joint,
        "failures": "; ".join(posterior.failures()),
    }
    return row


def band(count: int, level: float = 0.95, draws: int = 4000) -> float:
    """How far, in its own standard deviation, the ECDF of `count` uniform ranks strays with this probability."""
    rng = np.random.default_rng(0)
    grid = np.arange(1, THINNED + 1) / (THINNED + 1)
    ranks = np.sort(rng.integers(0, THINNED + 1, (draws, count)), axis=1)
    return float(np.quantile([_stray(r, grid) for r in ranks], level))


def _stray(ranks: np.ndarray, grid: np.ndarray) -> float:
    ecdf = np.searchsorted(np.sort(ranks), np.arange(THINNED), side="right") / len(ranks)
    return float(np.max(np.abs(ecdf - grid) / np.sqrt(grid * (1 - grid) / len(ranks))))


def judge(rows: list[dict], setting: str) -> list[dict]:
    """A line per quantity: coverage of intervals and the ECDF test of its ranks."""
    grid = np.arange(1, THINNED + 1) / (THINNED + 1)
    limit = band(len(rows))
    table = []
    for name in QUANTITIES:
        ranks, share = (np.array([row[f"{kind} {name}"] for row in rows]) for kind in ("rank", "share"))
        line = {"setting": setting, "quantity": name}
        fixed = setting == "collapsed" and name == "tau_C3"
        for level in (50, 80, 95):
            covered = np.abs(share - 0.5) <= level / 200
            # A truth at the bound 0 lies below every central interval: one from 0 is the one to ask for.
            if fixed:
                covered = share <= level / 100
            line[f"{level} % interval covers"] = f"{100 * covered.mean():.1f} %"
            line[f"within 5 at {level}"] = bool(abs(100 * covered.mean() - level) <= 5) or (
                fixed and covered.mean() > level / 100
            )
        within = [line.pop(f"within 5 at {v}") for v in (50, 80, 95)]
        line["ECDF strays"] = "truth is fixed" if fixed else round(_stray(ranks, grid), 2)
        line["at most"] = round(limit, 2)
        line["verdict"] = bool((fixed or _stray(ranks, grid) <= limit) and all(within))
        table.append(line)
    return table


def plot(results: dict[str, list[dict]], file: Path) -> None:
    """Rank histograms, one row per setting."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        len(results), len(QUANTITIES), figsize=(18, 2.4 * len(results)), sharey="row", squeeze=False
    )
    for line, (setting, rows) in zip(axes, results.items(), strict=True):
        expected = len(rows) / 10
        sd = np.sqrt(len(rows) * 0.1 * 0.9)
        for axis, name in zip(line, QUANTITIES, strict=True):
            axis.axhspan(expected - 1.96 * sd, expected + 1.96 * sd, color="0.85")
            axis.hist([row[f"rank {name}"] for row in rows], bins=np.linspace(0, THINNED + 1, 11), color="#0072B2")
            axis.set_title(name.replace("effective_modulus_MPa", "modulus"), fontsize=9)
            axis.set_xticks([0, THINNED + 1], ["0", "1"])
        line[0].set_ylabel(f"{setting}\ncampaigns")
    figure.supxlabel("rank of the truth among posterior draws, in shares")
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def _in_float64() -> None:
    jax.config.update("jax_enable_x64", True)


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--campaigns", type=int, default=700)
    parser.add_argument("--first", type=int, default=0, help="seed of the first campaign: others are a fresh study")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--settings", nargs="+", default=["prior", "collapsed", "five"])
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    seeds = range(arguments.first, arguments.first + arguments.campaigns)
    results: dict[str, list[dict]] = {}
    verdicts, runs = [], []
    for setting in arguments.settings:
        count = 5 if setting == "five" else 20
        model = JointModel(priors=None if setting == "wide" else AROUND)
        started = time.perf_counter()
        rows = []
        work = partial(one_campaign, count=count, collapsed=setting == "collapsed", model=model)
        with ProcessPoolExecutor(arguments.workers, get_context("spawn"), _in_float64) as pool:
            for row in pool.map(work, seeds, chunksize=5):
                rows.append(row)
                if len(rows) % 20 == 0:
                    print(f"{setting}: {len(rows)} campaigns, {time.perf_counter() - started:.0f} s", flush=True)
        results[setting] = rows
        verdicts += judge(rows, setting)
        runs.append(
            {
                "setting": setting,
                "campaigns": len(rows),
                "s per campaign": round((time.perf_counter() - started) / len(rows), 2),
                "not converged": sum(bool(row["failures"]) for row in rows),
                "R-hat at most": round(max(row["rhat"] for row in rows), 3),
                "bulk ESS at least": round(min(row["ess"] for row in rows)),
                "divergences": sum(row["divergences"] for row in rows),
                "particles not monotone": sum(row["not monotone"] for row in rows),
                "particles not kept": sum(count - row["kept"] for row in rows),
            }
        )
        for row in rows:
            if row["failures"]:
                print(
                    setting,
                    row["seed"],
                    row["not monotone"],
                    round(row["k"], 2),
                    row["k joint"],
                    row["failures"][:250],
                )
    tables = {"Coverage": verdicts, "Runs": runs}
    settings = {
        "points per test": POINTS,
        "seeds": f"{seeds.start} to {seeds.stop - 1}",
        "instrument": str(INSTRUMENT),
        **_report.environment("jax", "numpyro", "numpy"),
    }
    tables["Settings"] = _report.settings(settings)
    _report.write("posterior", "Simulation-based calibration of the joint posterior", tables, arguments.write)
    folder = Path(__file__).parent / "results" if arguments.write else Path(tempfile.gettempdir())
    plot(results, folder / "posterior_ranks.png")


if __name__ == "__main__":
    main()
