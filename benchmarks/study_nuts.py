"""Do NUTS with particles integrated out, NUTS on the explicit model, and `mcc.sample` draw from one posterior?

Run `python benchmarks/study_nuts.py --law base|creep|varying [--particles 6]`; `--table` draws the table of all runs.

One campaign (seed 0; 6 particles, or as many as are asked for), 4 chains of 1000 + 1000 draws each. `creep` has one
shared effect, amplitude and time; `varying` lets its amplitude differ from test to test. Differences are of the sites
of the contract, to `mcc.sample`, in its standard deviations (median over sites) and in Monte Carlo standard errors of
the difference (largest), of means and of standard deviations. Draws of `mcc.sample`, resampled by weight, count for
as many as its effective number.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from arviz_stats.base.array import array_stats
from numpyro.infer import MCMC

import mcc_jax as mcc

RESULTS = Path(__file__).parent / "results"
WARMUP, DRAWS, CHAINS = 1000, 1000, 4


def case(law: str, particles: int) -> tuple[mcc.Campaign, mcc.Model]:
    """The campaign and its model."""
    if law == "base":
        campaign, model = mcc.paper_campaign(0), mcc.Model()
    else:
        programme = mcc.Programme.cycles(levels=(0.5, 1.0), hold_s=10.0, points=120)
        hidden = mcc.HiddenEffect(mcc.effects.find_variant("creep:logarithmic"), 2e-4, {"tau_s": 3.0})
        campaign = mcc.paper_campaign(0, programme=programme, instrument=mcc.Instrument(0.08, 0.05), effects=[hidden])
        model = mcc.Model().with_effects("creep:logarithmic", varying=("creep",) if law == "varying" else ())
    return campaign.without(*campaign.particles[particles:]), model


def moments(draws: np.ndarray) -> tuple[float, float, float, float]:
    """Mean and standard deviation of draws of shape (chain, draw), and the Monte Carlo standard error of each."""
    errors = (float(array_stats.mcse(draws, chain_axis=0, draw_axis=1, method=name)) for name in ("mean", "sd"))
    return float(draws.mean()), float(draws.std()), *errors


def run(law: str, particles: int) -> list[dict[str, Any]]:
    """One row for each of the two ways of NUTS."""
    campaign, model = case(law, particles)
    fit = mcc.fit(campaign, model)
    posterior = mcc.sample(campaign, model, seed=1, without_flagged=False)
    wanted = {k: v for k, v in posterior.named_population().items() if not k.startswith("mu_")}
    for name in ("C1", "C3", "C5"):
        wanted[f"{name}_median"] = np.exp(posterior.named_population()[f"mu_{name}"])
    # Draws that were resampled by weight are worth fewer than there are.
    worth = min(posterior.ess_bulk.values()) / posterior.C[..., 0, 0].size
    rows = []
    for explicit in (False, True):
        start = time.perf_counter()
        mcmc = MCMC(
            fit.nuts(explicit=explicit),
            num_warmup=WARMUP,
            num_samples=DRAWS,
            num_chains=CHAINS,
            chain_method="vectorized",
            progress_bar=False,
        )
        given = (fit.tests,) if explicit else (fit.tests, fit.marginal)
        mcmc.run(jax.random.key(0), *given, extra_fields=("num_steps", "diverging"))
        fields, draws = mcmc.get_extra_fields(), mcmc.get_samples(group_by_chain=True)
        sites = {}
        for name in wanted.keys() & draws.keys():
            own = np.asarray(draws[name])
            (m1, s1, *e1), (m2, s2, *e2) = moments(own), moments(wanted[name])
            sites[name] = {
                "sd": (m1 - m2) / s2,
                "z": (m1 - m2) / np.hypot(e1[0], e2[0] / worth**0.5),
                "z of sd": (s1 - s2) / np.hypot(e1[1], e2[1] / worth**0.5),
                "rhat": float(array_stats.rhat(own, chain_axis=0, draw_axis=1)),
                "ess": float(array_stats.ess(own, chain_axis=0, draw_axis=1)),
            }
        column = {key: np.array([one[key] for one in sites.values()]) for key in ("sd", "z", "z of sd", "rhat", "ess")}
        rows.append(
            {
                "law": law,
                "particles": particles,
                "way": "explicit" if explicit else "integrated out",
                "seconds": time.perf_counter() - start,
                "steps": float(np.mean(fields["num_steps"])),
                "divergences": int(np.sum(fields["diverging"])),
                "rhat": float(column["rhat"].max()),
                "ess": float(column["ess"].min()),
                "median difference [sd]": float(np.median(np.abs(column["sd"]))),
                "largest z of means": float(np.abs(column["z"]).max()),
                "largest z of sds": float(np.abs(column["z of sd"]).max()),
                "sites": sites,
                "sample converged": posterior.converged,
                "Pareto k of particles": float(np.max(posterior.pareto_k)),
            }
        )
        print({k: v for k, v in rows[-1].items() if k != "sites"}, flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """A line each."""
    keys = [key for key in rows[0] if key != "sites"]
    lines = [f"| {' | '.join(keys)} |", "|" + "---|" * len(keys)]
    for row in rows:
        cells = (f"{row[key]:.3g}" if isinstance(row[key], float) else str(row[key]) for key in keys)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run one case, or draw the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--law", choices=("base", "creep", "varying"), default="base")
    parser.add_argument("--particles", type=int, default=6)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.table:
        rows = [row for file in sorted((RESULTS / "nuts").glob("*.json")) for row in json.loads(file.read_text())]
        (RESULTS / "nuts.md").write_text(table(rows))
        print(table(rows))
        return
    rows = run(arguments.law, arguments.particles)
    (RESULTS / "nuts").mkdir(exist_ok=True)
    file = RESULTS / "nuts" / f"{arguments.law}_{arguments.particles}.json"
    file.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
