"""Does the library give the same answers on a GPU, and how fast is it there?

Run `python benchmarks/bench_accelerator.py --write` on a machine whose JAX has a GPU, and once more with
`JAX_PLATFORMS=cpu`: contacts of a particle code, steps of a compaction, and the posterior of 20 and of 1000 particles,
each with its compilation and without. Results lie in `benchmarks/results/accelerator.md`, a row for each device.
"""

from __future__ import annotations

import json
import os
import time

import _report
import bench_dem
import bench_scale
import jax

from mcc_jax.calibrate import sample

FILE = _report.RESULTS / "accelerator.json"


def posterior(count):
    """Seconds with and without compilation, and the modulus with its standard deviation."""
    campaign, _ = bench_scale.campaign_of(count, 260)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        answer = sample(campaign, seed=0).answer()
        seconds.append(time.perf_counter() - start)
    modulus = answer["effective_modulus_MPa"]
    return {
        f"posterior of {count}, cold [s]": seconds[0],
        f"warm, {count} [s]": seconds[1],
        f"modulus, {count} [MPa]": f"{modulus['value']:.3f} +- {modulus['sd']:.3f}",
    }


def main():
    arguments = _report.parser(__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    gpu = jax.default_backend() != "cpu"
    name = jax.devices()[0].device_kind if gpu else f"{os.cpu_count()} cores"
    row = {"device": name, "jax": jax.__version__}
    for count in (100_000, 1_000_000):
        pairs, _ = bench_dem.pairs(count)
        row[f"million contacts/s at {count:g}"] = pairs["million contacts/s"]
    row["gradient / value"] = pairs["value and gradient / value"]
    if gpu:
        steps, _ = bench_dem.compaction(10_000, 1e5, rows=5)
        row["million particle-steps/s of 10,000"] = steps["million particle-steps/s"]
    for count in (20, 1000) if gpu else (20,):
        row |= posterior(count)
    print(_report.table([{"what": k, row["device"]: v} for k, v in row.items()]))
    if arguments.write:
        rows = [one for one in json.loads(FILE.read_text()) if one["device"] != row["device"]] if FILE.exists() else []
        FILE.write_text(json.dumps([*rows, row], indent=1) + "\n")
        FILE.with_suffix(".md").write_text(text_of([*rows, row]))


def text_of(rows):
    """The table, a column for each device."""
    names = dict.fromkeys(name for row in rows for name in row if name != "device")
    table = [{"what": name, **{row["device"]: row.get(name, "") for row in rows}} for name in names]
    return f"# On a GPU\n\n{__doc__.splitlines()[0]}\n\n{_report.table(table)}\n"


if __name__ == "__main__":
    main()
