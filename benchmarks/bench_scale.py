"""How do time and memory of the posterior grow with the number of particles?

Run `uv run --group bench python benchmarks/bench_scale.py --write` (twelve minutes). Every size runs in its own
process, twice: the second run shows the time without compilation. Memory is the process's peak, the campaign included,
of the first run; the second one has the first one's result beside it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time

import _report

TARGETS = {"seconds": 150.0, "GiB": 4.0}


def campaign_of(count: int, points: int):
    """A simulated campaign of this many particles, and which of their laws are monotone."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import numpy as np

    from mcc_jax.campaign import PAPER_DIAMETERS_UM, particle_batch
    from mcc_jax.geometry import Particle
    from mcc_jax.simulate import Instrument, Programme, law_for_each, paper_population, simulate_campaign

    rng = np.random.default_rng(0)
    diameters = PAPER_DIAMETERS_UM[rng.integers(0, 20, count)] * rng.uniform(0.95, 1.05, (count, 3))
    plastic = paper_population().sample(jax.random.key(0), count)
    laws = law_for_each(plastic, 1.43, 16_000.0)
    stress = jnp.asarray(rng.uniform(7, 16, count))
    peaks = np.asarray(eqx.filter_vmap(Particle.force)(particle_batch(diameters), stress))
    instrument = Instrument(displacement_noise_um=0.02, force_noise_mN=0.05)
    monotone = np.asarray(plastic.is_monotone if count == 1 else jax.vmap(lambda p: p.is_monotone)(plastic))
    programme = Programme.cycles(points=points)
    return simulate_campaign(laws, diameters, peaks, programme, instrument=instrument), monotone


def one_size(count: int, points: int) -> dict:
    """Calibrate a simulated campaign of this many particles, in this process."""
    import resource

    import jax

    jax.config.update("jax_enable_x64", True)
    from mcc_jax.calibrate import sample

    campaign, monotone = campaign_of(count, points)
    seconds, peaks = [], []
    for _ in range(2):
        start = time.perf_counter()
        result = sample(campaign, chains=2, draws=1000)
        seconds.append(time.perf_counter() - start)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
    named = result.named_population()
    return {
        "particles": count,
        "kept": len(result.particles),
        "not monotone": int((~monotone).sum()),
        "first run [s]": seconds[0],
        "second run [s]": seconds[1],
        "peak memory [GiB]": peaks[0],
        "with a second run beside its result [GiB]": peaks[1],
        "a": f"{named['a'].mean():.5f} +- {named['a'].std():.5f}",
        "modulus [MPa]": f"{named['effective_modulus_MPa'].mean():.1f} +- {named['effective_modulus_MPa'].std():.1f}",
        "smallest ESS": float(min(result.ess_bulk.values())),
        "largest k": float(result.pareto_k.max()),
        "particles with k above 0.7": int((result.pareto_k > 0.7).sum()),
        "k of the population": result.pareto_k_joint,
        "divergences": result.divergences,
        "failures": "; ".join(result.failures()),
        "notes": "; ".join(result.notes),
    }


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--one", type=int, help="run this size here and print its row as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(one_size(arguments.one, arguments.points)))
        return
    rows = []
    for size in arguments.sizes:
        command = [sys.executable, __file__, "--one", str(size), "--points", str(arguments.points)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(rows[-1], flush=True)
    largest = rows[-1]
    verdicts = [
        _report.verdict(
            f"{largest['particles']} particles, first run [s]", largest["first run [s]"], TARGETS["seconds"]
        ),
        _report.verdict("peak memory [GiB]", largest["peak memory [GiB]"], TARGETS["GiB"]),
    ]
    if len(rows) > 1:
        growth = largest["second run [s]"] / rows[0]["second run [s]"]
        ratio = largest["particles"] / rows[0]["particles"]
        verdicts.append(_report.verdict(f"time for {ratio:.0f} times the particles", growth, ratio))
    settings = _report.settings(_report.environment("jax", "numpyro", "numpy"))
    tables = {"Targets": verdicts, "Runs": rows, "Settings": settings}
    _report.write("scale", "The posterior of many particles", tables, arguments.write)


if __name__ == "__main__":
    main()
