"""Is the posterior's uncertainty honest? Simulation-based calibration of the posterior.

For every campaign the truth is drawn from the prior (population, effects, particles, peak stresses), the tests are
simulated as an instrument would record them, and the posterior is sampled. If all is right, the true value's rank
among posterior draws is uniform (Talts et al. 2018), and intervals cover as often as they say. Settings:

- prior: 20 particles with the sizes of the paper's Table 1, everything drawn from priors around the paper's values;
- creep: the same with logarithmic creep, whose amplitude and time are drawn from the model's own priors;
- collapsed: tau_C3 = 4.9e-9 (the paper's value) in truth;
- five: 5 particles;
- wide: the library's default priors, whose corners hold powders that nobody has seen (C1 of 1 MPa, snap-through).

Run `uv run --group bench python benchmarks/study_posterior.py --setting creep --part 0/6`, each part some ten minutes
on 2 cores: it keeps what it has in `results/sbc/` and goes on from there. `--write` draws tables and figure of all.
"""

from __future__ import annotations

import json
from pathlib import Path

import _report
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax import HiddenEffect
from mcc_jax.calibrate import LogNormalPrior, Model, NakagamiPrior, NormalPrior, Priors, sample
from mcc_jax.calibrate.draws import effect_numbers
from mcc_jax.calibrate.priors import population_sites
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


CREEP = "creep:logarithmic"
CAMPAIGNS = 300
FOLDER = Path(__file__).parent / "results" / "sbc"
SETTINGS = ("prior", "creep", "collapsed", "five", "wide")


def model_of(setting: str) -> Model:
    """What is assumed in a setting."""
    model = Model(priors=None if setting == "wide" else AROUND)
    return model.with_effects(CREEP) if setting == "creep" else model


def quantities(setting: str) -> tuple[str, ...]:
    """What is ranked in a setting."""
    return (*QUANTITIES, "creep", "creep.tau_s") if setting == "creep" else QUANTITIES


def draw_truth(seed: int, setting: str):
    """A population from the prior by names, N of the paper's particles, their laws, peak forces and effects."""
    model = model_of(setting)
    rng = np.random.default_rng([seed, 1])
    chosen = np.sort(rng.choice(len(PAPER_DIAMETERS_UM), size=5 if setting == "five" else 20, replace=False))
    diameters = PAPER_DIAMETERS_UM[chosen]
    particles = particle_batch(diameters)
    flatness = eqx.filter_vmap(lambda p: p.flatness)(particles)
    drawn = population_sites(model, np.asarray(flatness), None, np.random.default_rng([seed, 0])).population
    p = jax.tree.map(lambda x: np.asarray(x)[0], drawn)
    tau = np.array([p.tau[0], COLLAPSED, p.tau[2]]) if setting == "collapsed" else p.tau
    truth = {"a": float(p.a), "effective_modulus_MPa": float(np.exp(p.log_modulus))}
    for j, name in enumerate(("C1", "C3", "C5")):
        truth |= {f"mu_{name}": p.mu[j], f"tau_{name}": tau[j]}
    truth |= {name: float(value) for name, value in effect_numbers(p, model).items()}
    C = np.exp(p.mu + tau * rng.standard_normal((len(chosen), 3)))
    laws = law_for_each(eqx.filter_vmap(Plastic)(*jnp.asarray(C).T), truth["a"], truth["effective_modulus_MPa"])
    peaks = np.asarray(eqx.filter_vmap(Particle.force)(particles, jnp.asarray(rng.uniform(7, 16, len(chosen)))))
    effects = [
        HiddenEffect(v, truth[v.mechanism], {n.name: truth[f"{v.mechanism}.{n.name}"] for n in v.nuisances})
        for v in model.effects
    ]
    return truth, diameters, laws, peaks, effects


def one_campaign(seed: int, setting: str) -> dict:
    """Rank and probability of the truth in the posterior, by quantity, and how the run went."""
    truth, diameters, laws, peaks, effects = draw_truth(seed, setting)
    programme = Programme.cycles(points=POINTS, hold_s=10.0 if effects else 0.0)
    told = {"instrument": INSTRUMENT, "seed": seed, "effects": effects}
    campaign = simulate_campaign(laws, diameters, peaks, programme, **told)
    posterior = sample(campaign, model_of(setting), seed=seed, without_flagged=False)
    named = posterior.named_population()
    rng = np.random.default_rng([seed, 2])
    row = {"seed": seed}
    for name in quantities(setting):
        draws = named[name].ravel()
        some = draws[np.linspace(0, len(draws) - 1, THINNED).round().astype(int)]
        below, equal = int((some < truth[name]).sum()), int((some == truth[name]).sum())
        row[f"rank {name}"] = below + int(rng.integers(equal + 1))
        row[f"share {name}"] = float((draws < truth[name]).mean())
        row[f"z {name}"] = float((draws.mean() - truth[name]) / draws.std())
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


def band(count: int, level: float, draws: int = 20_000) -> float:
    """How far, in its own standard deviation, the ECDF of `count` uniform ranks strays with this probability."""
    rng = np.random.default_rng(0)
    grid = np.arange(1, THINNED + 1) / (THINNED + 1)
    ranks = np.sort(rng.integers(0, THINNED + 1, (draws, count)), axis=1)
    return float(np.quantile([_stray(r, grid) for r in ranks], level))


def _stray(ranks: np.ndarray, grid: np.ndarray) -> float:
    ecdf = np.searchsorted(np.sort(ranks), np.arange(THINNED), side="right") / len(ranks)
    return float(np.max(np.abs(ecdf - grid) / np.sqrt(grid * (1 - grid) / len(ranks))))


def judge(rows: list[dict], setting: str, tests: int) -> list[dict]:
    """A line per quantity: coverage of intervals, and whether the ECDF of its ranks is that of uniform ones.

    The band holds for all `tests` quantities of all settings together with 95 % (Bonferroni).
    """
    grid = np.arange(1, THINNED + 1) / (THINNED + 1)
    limit = band(len(rows), 1 - 0.05 / tests)
    table = []
    for name in quantities(setting):
        ranks, share = (np.array([row[f"{kind} {name}"] for row in rows]) for kind in ("rank", "share"))
        line = {"setting": setting, "quantity": name}
        fixed = setting == "collapsed" and name == "tau_C3"
        for level in (50, 80, 95):
            # A truth at the bound 0 lies below every central interval: one from 0 is the one to ask for.
            covered = share <= level / 100 if fixed else np.abs(share - 0.5) <= level / 200
            error = 100 * np.sqrt(level / 100 * (1 - level / 100) / len(rows))
            line[f"{level} % interval covers"] = f"{100 * covered.mean():.1f} +- {error:.1f} %"
        line["ECDF strays"] = "truth is fixed" if fixed else round(_stray(ranks, grid), 2)
        line["at most"] = round(limit, 2)
        line["verdict"] = bool(fixed or _stray(ranks, grid) <= limit)
        table.append(line)
    return table


def plot(results: dict[str, list[dict]], file: Path) -> None:
    """Rank histograms, one row per setting."""
    import matplotlib.pyplot as plt

    columns = max(len(quantities(setting)) for setting in results)
    figure, axes = plt.subplots(
        len(results), columns, figsize=(2.2 * columns, 2.4 * len(results)), sharey="row", squeeze=False
    )
    for line, (setting, rows) in zip(axes, results.items(), strict=True):
        expected = len(rows) / 10
        sd = np.sqrt(len(rows) * 0.1 * 0.9)
        for axis, name in zip(line, quantities(setting), strict=False):
            axis.axhspan(expected - 1.96 * sd, expected + 1.96 * sd, color="0.85")
            axis.hist([row[f"rank {name}"] for row in rows], bins=np.linspace(0, THINNED + 1, 11), color="#0072B2")
            axis.set_title(name.replace("effective_modulus_MPa", "modulus"), fontsize=9)
            axis.set_xticks([0, THINNED + 1], ["0", "1"])
        line[0].set_ylabel(f"{setting}\ncampaigns")
    figure.supxlabel("rank of the truth among posterior draws, in shares")
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def run(setting: str, part: int, parts: int) -> None:
    """The campaigns of one part, those that are kept already left out."""
    FOLDER.mkdir(exist_ok=True)
    file = FOLDER / f"{setting}_{part}_of_{parts}.json"
    rows = json.loads(file.read_text()) if file.exists() else []
    for seed in range(part, CAMPAIGNS, parts)[len(rows) :]:
        rows.append(one_campaign(seed, setting))
        file.write_text(json.dumps(rows, indent=0) + "\n")
        if len(rows) % 10 == 0:
            print(f"{setting}, part {part}: {len(rows)} campaigns", flush=True)


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--setting", choices=SETTINGS)
    parser.add_argument("--part", default="0/1")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.setting:
        run(arguments.setting, *map(int, arguments.part.split("/")))
        return
    results: dict[str, list[dict]] = {}
    for setting in SETTINGS:
        rows = [row for file in sorted(FOLDER.glob(f"{setting}_*.json")) for row in json.loads(file.read_text())]
        if rows:
            results[setting] = rows
    tests = sum(len(quantities(setting)) for setting in results)
    verdicts = [line for setting, rows in results.items() for line in judge(rows, setting, tests)]
    runs = [
        {
            "setting": setting,
            "campaigns": len(rows),
            "not converged": sum(bool(row["failures"]) for row in rows),
            "R-hat at most": round(max(row["rhat"] for row in rows), 3),
            "bulk ESS at least": round(min(row["ess"] for row in rows)),
            "divergences": sum(row["divergences"] for row in rows),
            "particles not monotone": sum(row["not monotone"] for row in rows),
        }
        for setting, rows in results.items()
    ]
    settings = {"points per test": POINTS, "instrument": str(INSTRUMENT), **_report.environment("jax", "numpyro")}
    tables = {"Coverage": verdicts, "Runs": runs, "Settings": _report.settings(settings)}
    _report.write("posterior", "Simulation-based calibration of the posterior", tables, arguments.write)
    if arguments.write:
        plot(results, Path(__file__).parent / "results" / "posterior_ranks.png")


if __name__ == "__main__":
    main()
