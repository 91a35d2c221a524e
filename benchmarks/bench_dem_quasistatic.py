"""Does quasi-static compaction of N spheres converge, and are its sensitivities right?

Run `uv run python benchmarks/bench_dem_quasistatic.py`; `--write` keeps the tables in `benchmarks/results/`.

Spheres of 80 to 120 um with the paper's mean law are scattered in a die, relaxed (`relaxed`) at the density to start
from, pressed in equal load steps to the density asked for and then released. Started below random close packing
(`--loose 0.5`) they first rearrange: all steps converge there too, but contacts snap from row to row. Reported are

- the share of rows whose load steps all converged,
- the defect of Euler's identity (the force is homogeneous of degree one in all stresses),
- the derivatives with respect to ln C1 and ln Ebar against central differences of the same load steps, on the rows up
  to which every contact is in the same state (open, loading, unloading) on both sides of the difference: only there no
  contact snaps.
"""

from __future__ import annotations

import os
import time

os.environ.setdefault("EQX_ON_ERROR", "nan")

import _report
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mcc_jax import paper_law
from mcc_jax.dem import (
    Solver,
    compact,
    die,
    punch_sensitivity,
    relaxed,
    replay_compaction,
    scattered,
    spheres,
)

STEP = 1e-7
TARGETS = {"converged": 0.95, "Euler identity": 1e-8, "finite differences": 1e-5}


def made(count, seed, loose):
    """The packing as a function of ln C1 and ln Ebar beside the paper's, its start, and the die's height."""
    law, diameter = paper_law(), jax.random.uniform(jax.random.key(seed), (count,), minval=80.0, maxval=120.0)

    def packing_of(values):
        C1, modulus = law.plastic.C1 * jnp.exp(values[0]), law.effective_modulus * jnp.exp(values[1])
        return spheres(eqx.tree_at(lambda x: (x.plastic.C1, x.effective_modulus), law, (C1, modulus)), diameter)

    packing = packing_of(jnp.zeros(2))
    barrel = 0.8 * float(packing.radius.mean()) * count ** (1 / 3)
    height = float(packing.volume) / (np.pi * barrel**2 * loose)
    position, tall = scattered(jax.random.key(seed + 1), packing.radius, barrel)
    state = relaxed(packing, die(barrel, height), position.at[:, 2].multiply(height / tall))
    return packing_of, packing, state, height


def states(packing, state, tape, replayed):
    """Of every pair and wall contact after every load step: open, loading or unloading."""
    radius, position = np.asarray(packing.radius), np.asarray(replayed.position)
    first, second = np.triu_indices(len(radius), 1)
    gap = np.linalg.norm(position[:, first] - position[:, second], axis=2)
    height = np.array([float(step.height) for step in tape])[:, None]
    barrel = float(state.walls[2].radius)
    walls = [position[..., 2], height - position[..., 2], barrel - np.hypot(position[..., 0], position[..., 1])]
    overlap = np.concatenate([radius[first] + radius[second] - gap, *(radius - x for x in walls)], axis=1)
    peak = np.maximum.accumulate(np.maximum(overlap, 0.0), axis=0)
    return np.where(overlap <= 0, 0, np.where(overlap >= peak, 1, 2))


def study(count, loose, density, down, up, seed):
    """One packing: rows of the table of rows, and the summary."""
    packing_of, packing, state, height = made(count, seed, loose)
    lowest = height * loose / density
    heights = np.concatenate(
        [height + (lowest - height) * np.arange(1, down + 1) / down, lowest * (1 + 0.02 * np.arange(1, up + 1) / up)]
    )
    tape, solver = [], Solver(rtol=1e-11)
    begun = time.perf_counter()
    _, rows = compact(packing, state, heights, solver, tape)
    pressed = time.perf_counter() - begun
    found = punch_sensitivity(packing_of, jnp.zeros(2), state, tape, solver)
    last = np.array([step.last for step in tape])
    here = states(packing, state, tape, replay_compaction(packing, state, tape, solver))
    errors, same = [], np.ones(len(tape), bool)
    for k in range(2):
        ends = []
        for h in (STEP, -STEP):
            moved = packing_of(jnp.zeros(2).at[k].set(h))
            again = replay_compaction(moved, state, tape, solver)
            unlike = (states(moved, state, tape, again) != here).any(axis=1)
            same &= ~np.logical_or.accumulate(unlike) & np.asarray(again.converged)
            ends.append(np.asarray(again.on_wall[:, 1]))
        difference = ((ends[0] - ends[1]) / (2 * STEP))[last]
        errors.append(np.abs(difference - found.by_parameter[:, k]) / found.force)
    same, errors = same[last], np.max(errors, axis=0)
    table = [
        {
            "density": float(rows.density[r]),
            "top [N]": float(rows.top[r]),
            "bottom [N]": float(rows.bottom[r]),
            "converged": bool(rows.converged[r]),
            "load steps": int(rows.load_steps[r]),
            "evaluations": int(rows.evaluations[r]),
            "residual": float(found.residual[r]),
            "proximal share": float(found.proximal_share[r]),
            "Euler defect": float(found.euler_defect[r]),
            "dF/dlnC1 / F": float(found.by_parameter[r, 0] / found.force[r]),
            "dF/dlnEbar / F": float(found.by_parameter[r, 1] / found.force[r]),
            "same states": "yes" if same[r] else "no",
            "error of differences / F": float(errors[r]),
            "largest move": float(rows.largest_move[r]),
            "contacts": int(rows.contacts[r]),
            "beyond tested": int(rows.beyond_tested[r]),
        }
        for r in range(len(heights))
    ]
    values = {
        "converged": float(rows.converged.mean()),
        "Euler identity": float(found.euler_defect[found.converged].max()),
        "finite differences": float(errors[same].max()) if same.any() else float("nan"),
    }
    verdict = [
        _report.verdict(name, value, TARGETS[name], at_least=name == "converged") for name, value in values.items()
    ]
    note = {"rows compared with differences": f"{int(same.sum())} of {len(same)}", "compaction [s]": f"{pressed:.0f}"}
    return table, verdict, note


def main():
    """Run the study."""
    options = _report.parser(__doc__)
    options.add_argument("--count", type=int, default=200, help="spheres")
    options.add_argument("--loose", type=float, default=0.62, help="relative density to start from")
    options.add_argument("--density", type=float, default=0.85, help="to press to")
    options.add_argument("--rows", type=int, nargs=2, default=(20, 5), help="rows down and up")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    jax.config.update("jax_enable_x64", True)
    table, verdict, note = study(given.count, given.loose, given.density, *given.rows, given.seed)
    settings = {"spheres": given.count, "start": given.loose, "seed": given.seed, "step of differences": STEP, **note}
    settings |= _report.environment("jax", "optimistix", "lineax")
    _report.write(
        "bench_dem_quasistatic",
        "Quasi-static compaction",
        {"verdict": verdict, "rows": table, "settings": _report.settings(settings)},
        given.write,
    )


if __name__ == "__main__":
    main()
