"""The textbook hierarchical calibration in PyMC, sampled by nutpie: one NUTS over everything, default settings."""

from __future__ import annotations

import time
from importlib.util import find_spec
from typing import Any

import numpy as np
from _textbook import CENTRE, COEFFICIENTS, POPULATION, TERMS, TextbookData, law_stress, within_budget


def _model(data: TextbookData, centred: bool) -> Any:
    import pymc as pm
    import pytensor.tensor as pt

    with pm.Model() as model:
        a = pm.Normal("a", 1, 1)
        Ebar = pm.Deterministic("Ebar", pt.exp(pm.Normal("log_Ebar", np.log(1e4), 1.5)))
        noise = pm.HalfNormal("noise", 0.1)
        coefficients = []
        for j in TERMS:
            mu = pm.Normal(f"mu_{j}", CENTRE[j], 1)
            tau = pm.HalfNormal(f"tau_{j}", 0.5)
            count = len(data.flatness)
            if centred:
                start = pm.Normal.dist(CENTRE[j], 0.1, shape=count)
                log_C = pm.Normal(f"log_C{j}", mu, tau, shape=count, initval=start)
            else:
                log_C = mu + tau * pm.Normal(f"z_{j}", 0, 1, shape=count)
            coefficients.append(pm.Deterministic(f"C{j}", pt.exp(log_C)))
        expected = law_stress(pt, data, a, Ebar, *coefficients)
        density = pm.logp(pm.Normal.dist(expected, noise), data.stress)
        pm.Potential("stress", pt.sum(data.mask * density))
    return model


def _run(data: TextbookData, draws: int, warmup: int, chains: int, centred: bool, seed: int) -> dict[str, Any]:
    import nutpie

    start = time.perf_counter()
    model = _model(data, centred)
    # Jitter by 1, the default, is a factor of e^5 in the quintic's last term: chains stay where that throws them.
    calm = ("mu_", "log_C", "z_")
    compiled = nutpie.compile_pymc_model(
        model, jitter_rvs={variable for variable in model.free_RVs if not variable.name.startswith(calm)}
    )
    trace = nutpie.sample(
        compiled, draws=draws, tune=warmup, chains=chains, seed=seed, save_warmup=False, progress_bar=False
    )
    posterior = {name: trace.posterior[name].to_numpy() for name in POPULATION + COEFFICIENTS}
    divergences = int(trace.sample_stats["diverging"].sum())
    return {"posterior": posterior, "seconds": time.perf_counter() - start, "divergences": divergences}


def sample(
    data: TextbookData, draws: int, warmup: int, chains: int, centred: bool, seed: int, timeout_s: float
) -> dict[str, Any]:
    """Draw from the posterior in a process of its own; arguments and result as of `_textbook_numpyro.sample`.

    Raises:
        ModuleNotFoundError: if PyMC or nutpie is not installed.
    """
    missing = [name for name in ("pymc", "nutpie") if find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(f"this baseline needs {' and '.join(missing)}: uv sync --group bench")
    return within_budget(_run, (data, draws, warmup, chains, centred, seed), timeout_s)
