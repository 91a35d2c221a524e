"""The textbook hierarchical calibration in NumPyro: one NUTS over everything, default settings."""

from __future__ import annotations

import time
from typing import Any

from _textbook import CENTRE, COEFFICIENTS, POPULATION, TERMS, TextbookData, law_stress, within_budget


def _model(data: TextbookData, centred: bool) -> None:
    import jax.numpy as jnp
    import numpyro
    from numpyro import distributions as dist

    a = numpyro.sample("a", dist.Normal(1, 1))
    Ebar = numpyro.deterministic("Ebar", jnp.exp(numpyro.sample("log_Ebar", dist.Normal(jnp.log(1e4), 1.5))))
    noise = numpyro.sample("noise", dist.HalfNormal(0.1))
    coefficients = []
    for j in TERMS:
        mu = numpyro.sample(f"mu_{j}", dist.Normal(CENTRE[j], 1))
        tau = numpyro.sample(f"tau_{j}", dist.HalfNormal(0.5))
        with numpyro.plate("particles", len(data.flatness)):
            if centred:
                log_C = numpyro.sample(f"log_C{j}", dist.Normal(mu, tau))
            else:
                log_C = mu + tau * numpyro.sample(f"z_{j}", dist.Normal(0, 1))
        coefficients.append(numpyro.deterministic(f"C{j}", jnp.exp(log_C)))
    expected = law_stress(jnp, data, a, Ebar, *coefficients)
    with numpyro.handlers.mask(mask=data.mask):
        numpyro.sample("stress", dist.Normal(expected, noise), obs=data.stress)


def _run(data: TextbookData, draws: int, warmup: int, chains: int, centred: bool, seed: int) -> dict[str, Any]:
    import jax
    import numpy as np
    import numpyro

    numpyro.set_platform("cpu")
    numpyro.set_host_device_count(chains)
    numpyro.enable_x64()
    start = time.perf_counter()
    kernel = numpyro.infer.NUTS(_model, init_strategy=numpyro.infer.init_to_median)
    mcmc = numpyro.infer.MCMC(kernel, num_warmup=warmup, num_samples=draws, num_chains=chains, progress_bar=False)
    mcmc.run(jax.random.key(seed), data, centred)
    samples = mcmc.get_samples(group_by_chain=True)
    posterior = {name: np.asarray(samples[name]) for name in POPULATION + COEFFICIENTS}
    divergences = int(np.sum(mcmc.get_extra_fields()["diverging"]))
    return {"posterior": posterior, "seconds": time.perf_counter() - start, "divergences": divergences}


def sample(
    data: TextbookData, draws: int, warmup: int, chains: int, centred: bool, seed: int, timeout_s: float
) -> dict[str, Any]:
    """Draw from the posterior in a process of its own, on the CPU in float64, all chains at once.

    Args:
        data: from `data_from_campaign`.
        draws: draws of each chain after warm-up.
        warmup: draws of each chain that adapt the sampler.
        chains: number of chains.
        centred: draw log C_ij itself; otherwise its distance from the population's mean in units of tau_j.
        seed: seed of everything.
        timeout_s: wall-clock budget [s]; the process is ended when it is used up.

    Returns:
        `posterior` (arrays by name, shape (chains, draws) for `POPULATION`, (chains, draws, N) for C1, C3 and C5),
        `seconds` (compilation, warm-up and sampling), `divergences`, and `why_not`. When the budget was not enough,
        `why_not` says so and all else is None.
    """
    return within_budget(_run, (data, draws, warmup, chains, centred, seed), timeout_s)
