"""Is the modulus right under holds and a noisy load cell? `python benchmarks/study_noise.py --part 0/4`.

48 campaigns of 12 particles: force noise of 0.05 and 0.3 mN, with and without a hold of 10 s at the peak, three
protocols (one cycle, two cycles, and the second at another rate), four times each. Every campaign has particles and
noise of its own. Every part writes its own rows, and goes on from those that stand; `--table` draws the table of all.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import jax
import numpy as np

import mcc_jax as mcc

RESULTS = Path(__file__).parent / "results"
MODULUS_MPA, PARTICLES, TIMES = 16_000.0, 12, 4
PROTOCOLS = {
    "one cycle": {"levels": (1.0,)},
    "two cycles": {"levels": (0.5, 1.0)},
    "slow": {"levels": (0.5, 1.0), "rate": 0.7},
}


def cases() -> list[tuple[str, float, float, int]]:
    """Protocol, force noise [mN], hold [s] and seed of every campaign."""
    several = product(range(TIMES), PROTOCOLS, (0.05, 0.3), (0.0, 10.0))
    return [(protocol, force, hold, seed) for seed, (_, protocol, force, hold) in enumerate(several)]


def campaign_of(protocol: str, force: float, hold: float, seed: int) -> mcc.Campaign:
    """One campaign: the paper's material, displacement noise of 0.08 um, a reading every 0.25 s."""
    programme = mcc.Programme.cycles(hold_s=hold, interval_s=0.25, **PROTOCOLS[protocol])
    campaign = mcc.paper_campaign(seed, instrument=mcc.Instrument(0.08, force), programme=programme)
    return campaign.without(*campaign.particles[PARTICLES:])


def row(protocol: str, force: float, hold: float, seed: int) -> dict[str, object]:
    """What the posterior says of one campaign."""
    posterior = mcc.sample(campaign_of(protocol, force, hold, seed), seed=0)
    modulus = posterior.to_json()["effective_modulus_MPa"]
    low, high = modulus["interval_95"]
    return {
        "protocol": protocol,
        "force_noise_mN": force,
        "hold_s": hold,
        "seed": seed,
        "modulus_MPa": modulus["value"],
        "sd_MPa": modulus["sd"],
        "z": (modulus["value"] - MODULUS_MPA) / modulus["sd"],
        "covered": bool(low <= MODULUS_MPA <= high),
        "converged": posterior.converged,
    }


def table(rows: list[dict[str, object]]) -> str:
    """Mean z and cover by force noise and hold."""
    lines = ["| force noise [mN] | hold [s] | campaigns | mean z | covered |", "|---|---|---|---|---|"]
    for force in (0.05, 0.3):
        for hold in (0.0, 10.0):
            some = [r for r in rows if r["force_noise_mN"] == force and r["hold_s"] == hold]
            z = np.array([r["z"] for r in some], float)
            lines.append(
                f"| {force} | {hold:g} | {len(some)} | {z.mean():+.2f} | {sum(bool(r['covered']) for r in some)} |"
            )
    z = np.array([r["z"] for r in rows], float)
    covered = sum(bool(r["covered"]) for r in rows)
    lines.append(f"| all | | {len(rows)} | {z.mean():+.2f} +- {z.std() / np.sqrt(len(z)):.2f} | {covered} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run one part, or draw the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", default="0/1")
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.table:
        rows = [r for file in sorted(RESULTS.glob("noise_*_of_*.json")) for r in json.loads(file.read_text())]
        (RESULTS / "noise.md").write_text(table(rows))
        print(table(rows))
        return
    part, parts = map(int, arguments.part.split("/"))
    file = RESULTS / f"noise_{part}_of_{parts}.json"
    found = json.loads(file.read_text()) if file.exists() else []
    for case in cases()[part::parts][len(found) :]:
        found.append(row(*case))
        file.write_text(json.dumps(found, indent=1) + "\n")
        print(found[-1], flush=True)


if __name__ == "__main__":
    main()
