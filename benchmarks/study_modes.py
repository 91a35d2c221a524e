"""Does the fast mode give the posterior of the plain joint model?

The same 20 particles by both: the population drawn with the particles integrated out, and NUTS over everything at once
under the exact likelihood, run long. Means are to agree within 0.05 standard deviations, standard deviations within
5 %; what chance alone makes of both (Monte-Carlo standard errors of the two runs together) stands beside.

Run `uv run --group bench python benchmarks/study_modes.py --write` (four minutes on 2 cores); `--draws 300` for
a look.
"""

from __future__ import annotations

import time

import _report
import jax
import numpy as np
from arviz_stats.base import array_stats

from mcc_jax.calibrate import sample
from mcc_jax.simulate import paper_campaign

MOST = 0.05
"""Largest difference of a mean in standard deviations, and of the logarithm of a standard deviation."""
RHAT = 1.005
FAST = 5000
"""Draws of each of four chains of the fast mode: as many as are still weighted by the exact likelihood one by one."""


def compare(name: str, fast: np.ndarray, joint: np.ndarray) -> dict:
    """A line of the table: draws of one quantity, with the axes chain and draw."""
    sd = joint.std()

    def error(method: str) -> float:
        found = [float(array_stats.mcse(d, method=method, chain_axis=0, draw_axis=1)) for d in (fast, joint)]
        return float(np.hypot(*found) / sd)

    mean, width = abs(fast.mean() - joint.mean()) / sd, abs(np.log(fast.std() / sd))
    return {
        "quantity": name,
        "difference of means [sd]": float(mean),
        "its standard error": error("mean"),
        "difference of log sd": float(width),
        "standard error of that": error("sd"),
        "R-hat, joint": float(array_stats.rhat(joint, chain_axis=0, draw_axis=1)),
        "bulk ESS, joint": float(array_stats.ess(joint, method="bulk", chain_axis=0, draw_axis=1)),
        "verdict": bool(mean <= MOST and width <= MOST),
    }


def main() -> None:
    parser = _report.parser(__doc__)
    parser.add_argument("--draws", type=int, default=3000, help="per chain of the joint mode")
    parser.add_argument("--warmup", type=int, default=1000)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    campaign = paper_campaign(0)
    fast = sample(campaign, draws=FAST)
    started = time.perf_counter()
    joint = sample(campaign, mode="joint", draws=arguments.draws, warmup=arguments.warmup)
    seconds = time.perf_counter() - started
    rows = [compare(name, fast.named_population()[name], draws) for name, draws in joint.named_population().items()]
    worst = {key: max(row[key] for row in rows) for key in list(rows[0])[1:6]}
    verdicts = [
        _report.verdict("largest difference of means [sd]", worst["difference of means [sd]"], MOST),
        _report.verdict("largest difference of log sd", worst["difference of log sd"], MOST),
        _report.verdict("largest R-hat of the joint mode", worst["R-hat, joint"], RHAT),
        _report.verdict("divergences of the joint mode", joint.divergences, 0),
    ]
    settings = {
        "campaign": "paper_campaign(0): 20 particles, 301 points each",
        "fast": f"4 chains, {FAST} draws each",
        "joint": f"4 chains, {arguments.warmup} + {arguments.draws} draws each, {joint.leapfrogs:.0f} steps per draw, "
        f"{seconds:.0f} s",
        **_report.environment("jax", "numpyro"),
    }
    tables = {"Targets": verdicts, "Population": rows, "Settings": _report.settings(settings)}
    _report.write("modes", "The fast mode against the plain joint model", tables, arguments.write)


if __name__ == "__main__":
    main()
