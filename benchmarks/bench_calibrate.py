"""How fast is the joint calibration, against SciPy and lmfit, and against the textbook model in NumPyro and PyMC?

Run `uv run --group bench python benchmarks/bench_calibrate.py --write` (ten minutes); `--budget 60` for a look.

All rows see the same campaign: the paper's 20 particles. The textbook samplers get the time budget and are ended then.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

import _report
import _textbook
import _textbook_numpyro
import _textbook_pymc
import jax
import numpy as np
from _numpy_residual import numpy_residual

from mcc_jax import Campaign, HiddenEffect, Instrument, Model, Programme
from mcc_jax.calibrate import least_squares, sample
from mcc_jax.calibrate.least_squares import solve
from mcc_jax.campaign import write_campaign
from mcc_jax.effects import find_variant
from mcc_jax.simulate import paper_campaign

IMPORTED = "import mcc_jax.calibrate, arviz_stats.base, scipy.optimize, scipy.stats"
"""What a new process finds as byte code, as after any earlier import."""

COLD = """
import jax, sys
jax.config.update("jax_enable_x64", True)
from mcc_jax import sample, read_campaign
sample(read_campaign(sys.argv[1]))
"""


def squares(repeats: int) -> tuple[list[dict], list[dict]]:
    """Ours, SciPy's and lmfit's, from the same start to the same optimum."""
    import lmfit
    from scipy.optimize import least_squares as scipy_least_squares

    campaign = paper_campaign(0)
    whole = least_squares(campaign)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        least_squares(campaign)
        seconds.append(time.perf_counter() - start)
    shared = np.asarray(whole.solution.value.shared)
    first = np.concatenate([[1.0], shared[1:2] + 0.05, shared[2:]])
    alone = []
    for _ in range(repeats):
        start = time.perf_counter()
        found = solve(whole.fit, whole.settings, whole.selection.tests, float(first[0]), first[2:], float(first[1]))
        jax.block_until_ready(found.value)
        alone.append(time.perf_counter() - start)
    ours = np.concatenate([np.asarray(found.value.local).ravel(), np.asarray(found.value.shared)])
    residual = numpy_residual(whole.selection.tests, whole.settings)
    ours_loss, ours_here = float(found.loss), float(0.5 * np.sum(residual(ours) ** 2))
    assert abs(ours_loss - ours_here) < 1e-6 * ours_loss, (ours_loss, ours_here)
    local = np.concatenate([np.asarray(whole.fit.point.latent)[:, :3], np.asarray(whole.fit.point.zero)[:, None]], 1)
    x0 = np.concatenate([local.ravel(), first])
    rows = [
        {
            "row": "mcc_jax, everything (starts, noise, spread, fit)",
            "seconds": float(np.median(seconds)),
            "loss": ours_loss,
            "largest difference": 0.0,
        },
        {
            "row": "mcc_jax, the least squares alone",
            "seconds": float(np.median(alone)),
            "loss": ours_loss,
            "largest difference": 0.0,
        },
    ]
    start = time.perf_counter()
    scipy_found = scipy_least_squares(residual, x0, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    rows.append(
        _row("scipy.optimize.least_squares", time.perf_counter() - start, scipy_found.x, scipy_found.cost, ours)
    )
    parameters = lmfit.Parameters()
    for i, value in enumerate(x0):
        parameters.add(f"p{i}", value=float(value))
    start = time.perf_counter()
    fitted = lmfit.minimize(
        lambda p: residual(np.array(list(p.valuesdict().values()))), parameters, xtol=1e-12, ftol=1e-12
    )
    x = np.array(list(fitted.params.valuesdict().values()))
    rows.append(_row("lmfit.minimize", time.perf_counter() - start, x, 0.5 * fitted.chisqr, ours))
    best = min(row["seconds"] for row in rows[2:])
    verdicts = [
        _report.verdict("least squares, warm [s]", rows[1]["seconds"], 0.1),
        _report.verdict("everything, warm [s]", rows[0]["seconds"], 0.1),
        _report.verdict("least squares / faster of SciPy and lmfit", rows[1]["seconds"] / best, 0.1),
        _report.verdict("same optimum (SciPy), relative", rows[2]["largest difference"], 1e-6),
    ]
    return rows, verdicts


def _row(name: str, seconds: float, x: np.ndarray, loss: float, ours: np.ndarray) -> dict:
    difference = np.max(np.abs(x - ours) / np.maximum(np.abs(ours), 1.0))
    return {"row": name, "seconds": seconds, "loss": float(loss), "largest difference": float(difference)}


def posterior(repeats: int, budget: float) -> tuple[list[dict], list[dict]]:
    """Ours, from new processes and warm, and the textbook model's."""
    with tempfile.TemporaryDirectory() as kept:
        campaign = paper_campaign(0)
        write_campaign(campaign, f"{kept}/campaign")
        cold, again = (_new_process(kept) for _ in range(2))
    rows = [_warm("mcc_jax, warm", campaign, Model(), repeats)]
    rows.append(_warm("mcc_jax, creep in the tests and in the law, warm", *creeping(), repeats))
    warm, least = rows[0]["seconds"], rows[0]["smallest bulk ESS"]
    data = _textbook.data_from_campaign(campaign)
    settings = {"draws": 1000, "warmup": 1000, "chains": 2, "seed": 0, "timeout_s": budget}
    for name, module, centred in (
        ("textbook, NumPyro, centred", _textbook_numpyro, True),
        ("textbook, NumPyro, not centred", _textbook_numpyro, False),
        ("textbook, PyMC and nutpie, centred", _textbook_pymc, True),
    ):
        run = module.sample(data, centred=centred, **settings)
        if run["posterior"] is None:
            rows.append({**_sampler(name, budget, 0.0, float("inf"), 0, False), "note": run["why_not"]})
            continue
        table = _textbook.summary(run["posterior"])
        ess, rhat = min(r["ess_bulk"] for r in table), max(r["rhat"] for r in table)
        rows.append(
            _sampler(name, run["seconds"], ess, rhat, int(run["divergences"]), all(r["converged"] for r in table))
        )
    ours = least / warm
    verdicts = [
        _report.verdict("posterior from a new process, nothing compiled before [s]", cold, 15.0),
        _report.verdict("posterior from a new process, compiled by an earlier one [s]", again, 15.0),
        _report.verdict("posterior, warm [s]", warm, 1.5),
        _report.verdict("posterior with one effect, warm [s]", rows[1]["seconds"], 4.0),
        _report.verdict("smallest bulk ESS", float(least), 2000, at_least=True),
        _report.verdict("divergences", rows[0]["divergences"] + rows[1]["divergences"], 0),
    ]
    for row in rows[2:]:
        ratio = ours / row["ESS per s"] if row["ESS per s"] > 0 else float("inf")
        verdicts.append(_report.verdict(f"ESS per second over {row['row']}", ratio, 100, at_least=True))
    return rows, verdicts


def creeping() -> tuple[Campaign, Model]:
    """Twenty particles that creep, loaded twice with a hold at each peak, and the law that has it."""
    hidden = HiddenEffect(find_variant("creep:logarithmic"), 2e-4, {"tau_s": 3.0})
    programme = Programme.cycles(levels=(0.5, 1.0), hold_s=10.0, points=160)
    noise = Instrument(displacement_noise_um=0.08, force_noise_mN=0.05)
    campaign = paper_campaign(0, programme=programme, instrument=noise, effects=[hidden])
    return campaign, Model().with_effects("creep:logarithmic")


def _warm(name: str, campaign: Campaign, model: Model, repeats: int) -> dict:
    """Several seeds, after one that compiles."""
    sample(campaign, model)
    seconds, results = [], []
    for seed in range(repeats):
        start = time.perf_counter()
        results.append(sample(campaign, model, seed=seed))
        seconds.append(time.perf_counter() - start)
    # The worst of all seeds: one seed's smallest ESS is itself a matter of luck.
    least = min(min(result.ess_bulk.values()) for result in results)
    worst = max(max(result.rhat.values()) for result in results)
    divergences = sum(result.divergences for result in results)
    return _sampler(name, float(np.median(seconds)), least, worst, divergences, all(r.converged for r in results))


def _new_process(kept: str) -> float:
    """Seconds from the start of Python to the posterior of the campaign in a folder; compiled functions are kept there,
    as the command line keeps them."""
    keep = {
        "JAX_COMPILATION_CACHE_DIR": f"{kept}/compiled",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        "PYTHONPYCACHEPREFIX": f"{kept}/bytecode",
        "PYTHONDONTWRITEBYTECODE": "",
    }
    # As a user's process: `run_all.KEEP_MEMORY` has the threads that compile wait for each other.
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"} | keep
    subprocess.run([sys.executable, "-c", IMPORTED], check=True, env=environment)
    start = time.perf_counter()
    subprocess.run([sys.executable, "-c", COLD, f"{kept}/campaign"], check=True, env=environment)
    return time.perf_counter() - start


def _sampler(name: str, seconds: float, ess: float, rhat: float, divergences: int, converged: bool) -> dict:
    return {
        "row": name,
        "seconds": float(seconds),
        "smallest bulk ESS": float(ess),
        "ESS per s": float(ess / seconds),
        "R-hat": float(rhat),
        "divergences": divergences,
        "converged": converged,
        "note": "",
    }


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--budget", type=float, default=200.0, help="seconds for each textbook sampler")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    fits, fit_verdicts = squares(arguments.repeats)
    samplers, sampler_verdicts = posterior(arguments.repeats, arguments.budget)
    settings = {
        "campaign": "paper_campaign(0): 20 particles, 301 points each",
        "budget of the textbook samplers": f"{arguments.budget:g} s, 2 chains, 1000 + 1000",
        **_report.environment("jax", "numpyro", "optimistix", "scipy", "lmfit", "pymc", "nutpie"),
    }
    tables = {
        "Targets": fit_verdicts + sampler_verdicts,
        "Least squares": fits,
        "Posterior": samplers,
        "Settings": _report.settings(settings),
    }
    _report.write("calibrate", "Speed of the joint calibration", tables, arguments.write)


if __name__ == "__main__":
    main()
