"""Is a mechanism named where nature uses a formula that the library lacks?

Run `python benchmarks/study_left_out.py [--part i/n] [--strength 100]`; a part goes on where it stopped. `--table`
draws `results/left_out.md` of all parts.

Each formula of the library in turn is nature's in a simulated campaign of eight particles (that of `study_formulas`),
at the middle of its further numbers and so many standard deviations of noise strong (less where its largest plausible
amplitude gives less), and is not in the library that `discover` searches. A formula of which one of another mechanism
leaves less than `LEAST` is left aside: without its own, tests point to the other.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.stats import beta
from study_formulas import at_their_middle, campaign, gram

import mcc_jax as mcc
from mcc_jax.discovery import discover
from mcc_jax.discovery.base import base_fit
from mcc_jax.discovery.screen import located, with_signatures
from mcc_jax.effects import LIBRARY, Variant

RESULTS = Path(__file__).parent / "results"
LEAST = 10.0
"""Formulas that their largest plausible amplitude makes weaker than so many standard deviations are left aside, and
those that are told from a formula of another mechanism by less."""


def answer(variant: Variant, unit: float) -> dict[str, Any]:
    """What is said of a campaign with a formula that the library lacks."""
    hidden = mcc.HiddenEffect(variant, unit * variant.plausible[0])
    mechanism = LIBRARY[variant.mechanism]
    others = tuple(v for v in mechanism.variants if v != variant)
    library = {**LIBRARY, variant.mechanism: replace(mechanism, variants=others)}
    begun = time.perf_counter()
    found = discover(campaign((hidden,)), library=library, posterior=False, confirm=False, experiments=False)
    told = [[e.mechanism, e.variant.name, round(e.misfit, 3)] for e in found.effects]
    return {"verdict": found.verdict, "told": told, "seconds": time.perf_counter() - begun}


def solve(part: int, parts: int, strength: float) -> None:
    """Answer every `parts`-th formula, from the `part`-th on."""
    base = base_fit(campaign(), mcc.Model(), threshold_MPa=0.0, progress=lambda _: None)
    variants = [v for m in LIBRARY.values() for v in m.variants if not (v.random_per_test or located(v))]
    product = gram(base, with_signatures(base, base.state, at_their_middle(variants)).columns)
    sd = np.sqrt(np.diagonal(product))
    units = np.minimum(strength / sd, [v.plausible[1] / v.plausible[0] for v in variants])
    sign, cosine = np.array([v.sign or 0 for v in variants]), product / np.outer(sd, sd)
    pair = np.outer(sign, sign)
    alike = np.where(pair == 0, np.abs(cosine), np.maximum(pair * cosine, 0.0))
    left = (units * sd)[:, None] * np.sqrt(np.maximum(1 - alike**2, 0.0))
    twin = np.array([[v.mechanism != w.mechanism for w in variants] for v in variants]) & (left < LEAST)
    file = RESULTS / "left_out" / f"{strength:g}_{part}_of_{parts}.jsonl"
    file.parent.mkdir(exist_ok=True)
    done = {json.loads(line)["formula"] for line in file.read_text().splitlines()} if file.exists() else set()
    # Shuffled, so that what a stopped run has done is a fair sample of the library.
    for k in np.random.default_rng(0).permutation(len(variants))[part - 1 :: parts]:
        v = variants[k]
        name = f"{v.mechanism}:{v.name}"
        if name in done or units[k] * sd[k] < LEAST or twin[k].any():
            continue
        row = {"formula": name, "sd": round(float(units[k] * sd[k]), 1), **answer(v, float(units[k]))}
        with file.open("a") as out:
            out.write(json.dumps(row) + "\n")
        print(row, flush=True)


def names_of(row: dict[str, Any]) -> tuple[str, set[str]]:
    """The true mechanism, and those that were named."""
    return row["formula"].partition(":")[0], {name for name, *_ in row["told"]}


def table() -> str:
    """Rates with their 95 % intervals (Jeffreys), and what went wrong."""
    rows = [
        json.loads(line) | {"asked": file.name.partition("_")[0]}
        for file in sorted((RESULTS / "left_out").glob("*.jsonl"))
        for line in file.read_text().splitlines()
    ]
    heads = ["strength", "formulas", "named alone", "a second name", "on no list", "wrong name alone", "nothing"]
    text = f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|\n"
    for asked in sorted({r["asked"] for r in rows}, key=float):
        some = [(r["verdict"], *names_of(r)) for r in rows if r["asked"] == asked]
        counts = [
            sum(names == {m} for _, m, names in some),
            sum(m in names and len(names) > 1 for _, m, names in some),
            sum(verdict == "UNLISTED" for verdict, *_ in some),
            sum(bool(names) and m not in names for _, m, names in some),
            sum(verdict in ("NO_GAP", "FIT_NOT_CONVERGED") for verdict, *_ in some),
        ]
        low_high = [100 * beta.ppf((0.025, 0.975), x + 0.5, len(some) - x + 0.5) for x in counts]
        cells = [f"{x} ({a:.0f} to {b:.0f} %)" for x, (a, b) in zip(counts, low_high, strict=True)]
        text += f"| {asked} | {len(some)} | {' | '.join(cells)} |\n"
    text += "\n| formula left out | sd | verdict | told |\n|---|---|---|---|\n"
    for r in rows:
        mechanism, names = names_of(r)
        if names != {mechanism}:
            told = ", ".join(f"{m}:{v}" for m, v, _ in r["told"])
            text += f"| {r['formula']} | {r['sd']:.0f} | {r['verdict']} | {told} |\n"
    return text


def main() -> None:
    """A part, or the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", default="1/1")
    parser.add_argument("--strength", type=float, default=100.0)
    parser.add_argument("--table", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if given.table:
        (RESULTS / "left_out.md").write_text(table())
    else:
        solve(*map(int, given.part.split("/")), given.strength)


if __name__ == "__main__":
    main()
