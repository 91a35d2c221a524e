"""The same packing in the same die under the same stroke: this law beside LAMMPS's MDR and Hertz contacts.

Run `uv run --group bench-dem python benchmarks/bench_dem_lammps.py --write` (some minutes). Spheres of 80 to 120 um
without friction, compressed between a moving and a fixed punch. MDR's modulus and yield stress, and Hertz's modulus,
are fitted to the paper's mean curve of one sphere between plates, up and down again, with LAMMPS's own wall contact.
The three take turns, chunk by chunk, in one process on one core and with the same time step; compilation is not
counted. The skin of LAMMPS's lists is the best of 10, 20 and 30 um; ours is 30 um while spheres fly about and 10 um
from density 0.5, which `advance` allows as long as it shrinks. "mcc single" has forces, velocities and history in
single precision (`in_single`); LAMMPS and "mcc" compute in double precision. Speed per second of CPU time is what a
shared machine can tell; wall time stands beside it. Contacts are pairs whose spheres of initial size overlap. MDR lets
radii grow and adds a bulk response where little surface is left free; a sum of pair contacts, as here, has neither, so
that lower stresses are expected of it at high density.
"""

from __future__ import annotations

import itertools
import os
import sys
import time

import _lammps
import _report
import numpy as np

DAMPING, DENSITY, CHUNK = 0.1, 1540.0, 200
LOOSE, SKIN = 3e-5, 1e-5  # [m]
MARKS = (0.7, 0.85)
PEAK = 0.4  # strain at which the plate test unloads: few contacts of a compact of density 0.85 are further compressed


def plate_test():
    """Compressions [m] of one side and forces [N] on a sphere of 100 um: the paper's mean curve, up and down."""
    import jax
    import jax.numpy as jnp

    from mcc_jax import Particle, paper_law
    from mcc_jax.dem import half_contact, wall_force

    radius = 50e-6
    side = half_contact(paper_law(), Particle(100.0, 100.0, 100.0))
    up = np.linspace(0.02, PEAK, 30) * radius
    recovered = float(jnp.sqrt(side.c * wall_force(side, jnp.asarray(0.0), jnp.asarray(up[-1])) / up[-1]))
    down = up[-1] - np.linspace(0.1, 0.9, 8) * recovered
    history = np.concatenate([0 * up, 0 * down + up[-1]])
    path = np.concatenate([up, down])
    force = jax.vmap(wall_force, (None, 0, 0))(side, jnp.asarray(history), jnp.asarray(path))
    return radius, path, np.asarray(force)


def fitted():
    """Contacts of LAMMPS fitted to the plate test, and how well they do."""
    from scipy.optimize import least_squares

    radius, path, force = plate_test()
    loading = path.argmax() + 1

    def off(logs):
        return (_lammps.plate_curve(_lammps.mdr(*np.exp(logs)), radius, path) - force) / force.max()

    # Both set the loading curve, the modulus alone the recovery: a scan first, as the yield point makes steps.
    scan = [
        (np.sum(off(x) ** 2), x)
        for e in (3e7, 1e8, 2e8, 4e8, 1e9)
        for y in (1e6, 2e6, 3e6, 5e6)
        for x in [np.log([e, y])]
    ]
    best = least_squares(off, min(scan, key=lambda s: s[0])[1], diff_step=1e-3, x_scale=0.1)
    per_modulus = _lammps.plate_curve(_lammps.hertz(1e6, 0.0), radius, path[:loading]) / 1e6
    modulus = float(per_modulus @ force[:loading] / (per_modulus @ per_modulus))
    young, strength = (float(x) for x in np.exp(best.x))
    error = 100 * np.sqrt(np.mean(off(best.x)[:loading] ** 2)), 100 * np.sqrt(np.mean(off(best.x)[loading:] ** 2))
    hertz_error = 100 * np.sqrt(np.mean((modulus * per_modulus - force[:loading]) ** 2)) / force.max()
    rows = [
        {
            "contact": "MDR",
            "E [MPa]": young / 1e6,
            "Y [MPa]": strength / 1e6,
            "rms off on loading [% of peak]": float(error[0]),
            "on unloading": f"{error[1]:.3g}",
        },
        {
            "contact": "Hertz",
            "E [MPa]": modulus / 1e6,
            "Y [MPa]": "-",
            "rms off on loading [% of peak]": float(hertz_error),
            "on unloading": "elastic",
        },
    ]
    return {"MDR": _lammps.mdr(young, strength, DAMPING), "Hertz": _lammps.hertz(modulus, DAMPING)}, rows


def compaction(count, speed, contacts, chunk=CHUNK, until=0.875):
    """Rows of (relative density, forces, pairs, seconds of CPU and wall) as the three take turns."""
    import jax
    import jax.numpy as jnp

    from mcc_jax import paper_law
    from mcc_jax.dem import (
        Interaction,
        Motion,
        advance,
        close_pairs,
        die,
        in_single,
        relative_density,
        scattered,
        spheres,
        stable_time_step,
        start,
    )

    packing = spheres(paper_law(), jax.random.uniform(jax.random.key(0), (count,), minval=80.0, maxval=120.0), DENSITY)
    die_radius = 6e-4 * (count / 1000) ** (1 / 3)
    position, height = scattered(jax.random.key(0), packing.radius, die_radius)
    radius = np.asarray(packing.radius)
    time_step = stable_time_step(packing)
    motion = Motion.of(time_step, Interaction(damping=DAMPING))
    first_state = start(packing, die(die_radius, height), position, LOOSE)
    ours = {"mcc": (packing, motion, first_state), "mcc single": in_single(packing, motion, first_state)}
    down = jnp.asarray([[0.0, 0.0, 0.0], [0.0, 0.0, -speed], [0.0, 0.0, 0.0]])
    theirs = {
        name: _lammps.DieCompaction(
            contact, np.asarray(position), radius, DENSITY, die_radius, height, SKIN, time_step, speed
        )
        for name, contact in contacts.items()
    }
    first = relative_density(packing, die_radius, 0.0, height)
    chunks = int(height * (1 - first / until) / (speed * time_step * chunk))
    rows = []
    for k in range(chunks):
        row = {"density": relative_density(packing, die_radius, 0.0, height - speed * (k + 0.5) * chunk * time_step)}
        skin = LOOSE if row["density"] < 0.5 else SKIN
        for name, (spheres_, how, before) in ours.items():

            def chunk_of(arguments=(spheres_, how, before), skin=skin):
                return advance(*arguments, down, 1, chunk, skin)

            (state, out), cpu, wall = _timed(chunk_of)
            if k == 0 or state.edges.capacity != before.edges.capacity:  # it compiled: once more, from the same state
                (state, out), cpu, wall = _timed(chunk_of)
            ours[name] = spheres_, how, state
            pairs = len(close_pairs(np.asarray(state.position), radius, 0.0))
            row[name] = (float(out.on_wall[0, 1, 2]), pairs, pairs, cpu, wall)
            row["beyond"], row["touching"] = int(out.beyond_tested[0]), int(out.contacts[0])
        for name, peer in theirs.items():
            force, cpu, wall = _timed(lambda p=peer: p.advance(chunk))
            row[name] = (force, len(close_pairs(peer.position(), radius, 0.0)), peer.contacts(), cpu, wall)
        rows.append(row)
        if k % 10 == 0:
            print(f"N = {count}: chunk {k} of {chunks}, density {row['density']:.3f}", flush=True)
    return {"rows": rows, "area": np.pi * die_radius**2, "steps": count * chunk, "time_step": time_step}


def _timed(work):
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    return result, time.process_time() - cpu, time.perf_counter() - wall


def summary(count, run):
    """Rows of the tables of densities and of speed."""
    rows, names = run["rows"], ("mcc", "mcc single", "MDR", "Hertz")
    density = np.array([row["density"] for row in rows])
    at, speed = [], []
    for mark in MARKS:
        row = rows[int(np.abs(density - mark).argmin())]
        for name in names:
            force, pairs, own, *_ = row[name]
            at.append(
                {
                    "N": count,
                    "relative density": round(row["density"], 3),
                    "contact": name,
                    "punch [MPa]": force / run["area"] / 1e6,
                    "pairs in contact": pairs,
                    "by its own count": own,
                    "beyond the tested range": f"{row['beyond']} of {row['touching']}"
                    if name.startswith("mcc")
                    else "-",
                }
            )
    for part, least in (("whole stroke", 0.0), ("density above 0.6", 0.6)):
        some = [row for row in rows if row["density"] > least]
        for what, column in (("CPU", 3), ("wall", 4)):
            rate = {n: run["steps"] * len(some) / sum(row[n][column] for row in some) for n in names}
            speed.append(
                {
                    "N": count,
                    "part": part,
                    "time": what,
                    **{f"{n} [particle-steps/s]": f"{x:.3g}" for n, x in rate.items()},
                    "mcc / MDR": rate["mcc"] / rate["MDR"],
                    "mcc / Hertz": rate["mcc"] / rate["Hertz"],
                    "mcc single / MDR": rate["mcc single"] / rate["MDR"],
                    "mcc single / Hertz": rate["mcc single"] / rate["Hertz"],
                    "at least MDR": bool(rate["mcc"] >= rate["MDR"]),
                }
            )
    return at, speed


def figure(runs, path):
    """Punch stress against relative density, one panel a size."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(
        1, len(runs), figsize=(4.6 * len(runs), 3.6), sharey=True, layout="constrained", squeeze=False
    )
    style = {
        "mcc": ("this law", "C0", "-"),
        "MDR": ("LAMMPS granular/mdr", "C3", "-"),
        "Hertz": ("LAMMPS hertz/material", "0.6", "--"),
    }
    for panel, (count, run) in zip(axes[0], runs.items(), strict=True):
        density = [row["density"] for row in run["rows"]]
        for name, (label, colour, line) in style.items():
            stress = [row[name][0] / run["area"] / 1e6 for row in run["rows"]]
            panel.plot(density, stress, line, color=colour, lw=1.4, label=label)
        beyond = [row["density"] for row in run["rows"] if row["beyond"] > 0.05 * row["touching"]]
        if beyond:
            panel.axvspan(
                beyond[0],
                density[-1],
                color="C0",
                alpha=0.1,
                lw=0,
                label="law: over 5 % of contacts\nbeyond the tested range",
            )
        panel.set(title=f"N = {count}", xlabel="relative density")
    axes[0, 0].set_ylabel("stress on the top punch (MPa)")
    axes[0, 0].legend(frameon=False, fontsize=8)
    drawn.savefig(path, dpi=150)


def main():
    """Print the tables and, if asked, keep them and the figure."""
    options = _report.parser(__doc__)
    options.add_argument("--sizes", type=int, nargs="+", default=[200, 1000])
    options.add_argument("--speed", type=float, default=4.0, help="of the punch [m/s]")
    chosen = options.parse_args()
    if _lammps.session() is None:
        print("skipped: LAMMPS is not installed (uv run --group bench-dem)")
        return
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX makes its threads: LAMMPS has one
    import jax

    jax.config.update("jax_enable_x64", True)
    contacts, fit = fitted()
    print(_report.table(fit), flush=True)
    runs = {count: compaction(count, chosen.speed, contacts) for count in chosen.sizes}
    at, speed = zip(*(summary(count, run) for count, run in runs.items()), strict=True)
    values = {
        **_report.environment("jax", "lammps", "numpy"),
        "command": " ".join(["bench_dem_lammps.py", *sys.argv[1:]]),
        "punch [m/s]": chosen.speed,
        "time step [s]": f"{next(iter(runs.values()))['time_step']:.3g}",
        "skin [um]": f"{1e6 * LOOSE:g} (mcc below density 0.5), {1e6 * SKIN:g}",
        "steps a chunk": CHUNK,
    }
    tables = {
        "Plate test of one sphere": fit,
        "Compaction": list(itertools.chain(*at)),
        "Speed": list(itertools.chain(*speed)),
        "Settings": _report.settings(values),
    }
    _report.write("dem_lammps", "Die compaction beside LAMMPS", tables, chosen.write)
    if chosen.write:
        figure(runs, _report.RESULTS / "dem_lammps.png")


if __name__ == "__main__":
    main()
