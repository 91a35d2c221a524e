"""How fast is the contact law, against loops written by hand, its own gradient and its own inverse?

Run `uv run --group bench python benchmarks/bench_law.py`; `--write` keeps the tables in `benchmarks/results/`.

- contacts: many contacts, one step each, every contact with its own law, size and history: what a particle code does.
- paths: many particles along a path of loading, unloading and reloading: what a calibration does.

The library's rows run as its docs advise for very many contacts (`mcc_jax.in_blocks`): a block that fits the cache at a
time, on one device for each core. `--plain` times them under `jax.vmap` alone instead.

Rows take turns, so that other work on the machine falls on all of them; a ratio is the median over the rounds.
Compilation is timed apart. The references are checked to give the same forces.
"""

from __future__ import annotations

import functools
import os
import time

os.environ.setdefault("EQX_ON_ERROR", "nan")

import _numba_law
import _report
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mcc_jax import in_blocks
from mcc_jax.geometry import Particle
from mcc_jax.law import History, MccLaw, Plastic

TARGETS = {"references": 1.5, "gradient": 3.0, "load control": 4.0, "traces": 1}


def draw(rng, n):
    """Parameters of n particles around the paper's population, a few of them with a curve that is not monotone."""
    return {
        "C1": rng.lognormal(1.9027, 0.2985, n),
        "C3": np.full(n, 3.0086756543596),
        "C5": rng.lognormal(0.9784, 0.0797, n),
        "a": rng.uniform(1.2, 1.6, n),
        "modulus": rng.uniform(12e3, 20e3, n),
        "D1": rng.uniform(100, 300, n),
        "D2": rng.uniform(100, 300, n),
        "D3": rng.uniform(70, 100, n),
    }


def reach(p):
    """Displacement at scaled strain 1 [um]."""
    return p["D1"] * p["D2"] / p["D3"] / (1 + p["a"] * (1 - p["D3"] ** 2 / (p["D1"] * p["D2"])))


def modules(p):
    """The library's laws and particles of these parameters."""
    law = eqx.filter_vmap(lambda C1, C3, C5, a, E: MccLaw(Plastic(C1, C3, C5), a, E))(
        *(jnp.asarray(p[name]) for name in ("C1", "C3", "C5", "a", "modulus"))
    )
    return law, eqx.filter_vmap(Particle)(*(jnp.asarray(p[name]) for name in ("D1", "D2", "D3")))


class Row:
    """One thing that is timed."""

    def __init__(self, name, call, compile_s=float("nan")):
        self.name, self.call, self.compile_s, self.seconds = name, call, compile_s, []

    def run(self):
        start = time.perf_counter()
        jax.block_until_ready(self.call())
        self.seconds.append(time.perf_counter() - start)

    @property
    def best(self):
        return min(self.seconds)

    def record(self):
        median, best = (1e3 * f(self.seconds) for f in (np.median, min))
        return {"row": self.name, "compile [s]": self.compile_s, "median [ms]": float(median), "min [ms]": best}


def compiled(name, function, *arguments):
    """A row for the compiled function and its result."""
    start = time.perf_counter()
    call = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    return Row(name, lambda: call(*arguments), seconds), call(*arguments)


def squared_residual(function):
    """What a fit adds up, of one contact or one path."""

    def loss(law, particle, state, given, measured):
        return jnp.sum((function(law, particle, state, given)[1] - measured) ** 2)

    return loss


def largest_difference(values, reference):
    """Largest difference relative to the value, for the smallest ones to a billionth of the largest."""
    return float(np.max(np.abs(values - reference) / (np.abs(reference) + 1e-9 * np.max(np.abs(reference)))))


def traces(function, *arguments):
    """How often the function is traced while every number changes three times."""
    count = 0

    def counted(*args):
        nonlocal count
        count += 1
        return function(*args)

    call = jax.jit(jax.vmap(counted))
    for factor in (1.0, 1.01, 0.99):
        jax.block_until_ready(call(*jax.tree.map(lambda x, f=factor: x * f, arguments)))
    return count


def measure(kind, p, peak, given, displacement_control, load_control, numpy_arguments, repeats, plain):
    """Rows, verdicts and accuracy of one kind of work."""
    devices = tuple(jax.devices())
    many = jax.vmap if plain else functools.partial(in_blocks, devices=devices)
    state, displacement = eqx.filter_vmap(History)(jnp.asarray(peak)), jnp.asarray(given)
    spread = NamedSharding(Mesh(np.array(devices), ("contacts",)), PartitionSpec("contacts"))
    everything = (*modules(p), state, displacement)
    everything = everything if plain else jax.device_put(everything, spread)
    law, particle, state, displacement = everything
    forward, (_, force) = compiled(displacement_control.__name__, many(displacement_control), *everything)
    load, _ = compiled(load_control.__name__, many(load_control), law, particle, state, force)
    loss, measured = squared_residual(displacement_control), 1.1 * force
    by_law, _ = compiled("gradient by law", many(jax.grad(loss, 0)), *everything, measured)
    rest = many(jax.grad(loss, (1, 2, 3)))
    by_rest, _ = compiled("gradient by size, history, path", rest, *everything, measured)

    arguments = (*p.values(), peak, given)
    references, accuracy = [], []
    for name, call in (
        ("numba", lambda: _numba_law.compile_kernels(False)[kind == "paths"]),
        ("numba fastmath", lambda: _numba_law.compile_kernels(True)[kind == "paths"]),
        ("NumPy", lambda: _numba_law.numpy_step),
    ):
        function = call()
        args = numpy_arguments if name == "NumPy" else arguments
        start = time.perf_counter()
        result = function(*args)[1]
        references.append(Row(name, lambda f=function, a=args: f(*a), time.perf_counter() - start))
        accuracy.append({"work": kind, "reference": name, "largest difference": largest_difference(result, force)})
        assert accuracy[-1]["largest difference"] < 1e-9, accuracy[-1]

    rows = [forward, *references, load, by_law, by_rest]
    for _ in range(repeats):
        for row in rows:
            row.run()

    def verdict(name, row, reference, limit):
        ratio = float(np.median(np.array(row.seconds) / np.array(reference.seconds)))
        return _report.verdict(f"{kind}: {name}", ratio, limit)

    best = min(references, key=lambda row: row.best)
    verdicts = [
        verdict(f"law / best reference ({best.name})", forward, best, TARGETS["references"]),
        verdict("law / numba without fastmath", forward, references[0], TARGETS["references"]),
        verdict("gradient by law / law", by_law, forward, TARGETS["gradient"]),
        verdict("gradient by size, history, path / law", by_rest, forward, TARGETS["gradient"]),
        verdict("load control / displacement control", load, forward, TARGETS["load control"]),
    ]
    count = traces(displacement_control, law, particle, state, displacement)
    verdicts.append(_report.verdict(f"{kind}: traces while numbers change", count, TARGETS["traces"]))
    return [{"work": kind, **row.record()} for row in rows], verdicts, accuracy


def step(law, particle, state, displacement):
    return law.step(particle, state, displacement)


def step_load(law, particle, state, force):
    return law.step_load(particle, state, force)


def path(law, particle, state, displacement):
    return law.path(particle, state, displacement)


def path_load(law, particle, state, force):
    return law.path_load(particle, state, force)


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--contacts", type=int, default=1_000_000)
    parser.add_argument("--particles", type=int, default=10_000)
    parser.add_argument("--points", type=int, default=300, help="per path, a multiple of 3")
    parser.add_argument("--repeats", type=int, default=25)
    parser.add_argument("--plain", action="store_true", help="jax.vmap instead of blocks")
    arguments = parser.parse_args()
    if not arguments.plain:
        jax.config.update("jax_num_cpu_devices", os.cpu_count())
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)

    p = draw(rng, arguments.contacts)
    peak = reach(p) * rng.uniform(0.2, 0.6, arguments.contacts)
    given = peak * rng.uniform(0.96, 1.02, arguments.contacts)
    how = {"plain": arguments.plain, "repeats": arguments.repeats}
    contacts = measure("contacts", p, peak, given, step, step_load, (*p.values(), peak, given), **how)

    p = draw(rng, arguments.particles)
    ramp = np.linspace(0, 1, arguments.points // 3)
    shape = np.concatenate([0.89 * ramp, 0.89 - 0.07 * ramp, 0.82 + 0.18 * ramp])
    given = (reach(p) * rng.uniform(0.4, 0.67, arguments.particles))[:, None] * shape
    peak = np.zeros(arguments.particles)
    columns = (*(v[:, None] for v in p.values()), peak[:, None], given)
    paths = measure("paths", p, peak, given, path, path_load, columns, **how)

    rows, verdicts, accuracy = (a + b for a, b in zip(contacts, paths, strict=True))
    settings = {
        "contacts": arguments.contacts,
        "paths": f"{arguments.particles} x {arguments.points}",
        "repeats": arguments.repeats,
        "dtype": "float64",
        "device": jax.devices()[0].device_kind,
        **_report.environment("jax", "jaxlib", "equinox", "numba", "numpy"),
    }
    tables = {"Targets": verdicts, "Times": rows, "Accuracy": accuracy, "Settings": _report.settings(settings)}
    _report.write("law", "Speed of the contact law", tables, arguments.write)


if __name__ == "__main__":
    main()
