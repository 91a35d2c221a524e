"""Does any contact give back more energy than it took? Random load-unload-reload paths for each form, and for pairs.

Run `uv run python benchmarks/study_energy.py --write` (a minute): it writes `benchmarks/results/energy.md`. Every path
has a law and a particle of its own (pairs: two unlike ones), peaks from 1e-9 to twice the end of the tests, full and
partial releases and reloads. Energies are integrals of the force, not the library's own.
"""

import _report
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import energy_paths  # noqa: E402

from mcc_jax.law import StrainScaling, Unloading  # noqa: E402

RESULT = _report.RESULTS / "energy.md"
BATCH = 10_000
ROUNDING = 1e-13


def largest(kind, paths, unloading, scaling):
    """Largest gain along whole paths and between two releases, as shares of the energy put in."""
    worst = np.full(2, -np.inf)
    for seed in range(0, paths, BATCH):
        count = min(BATCH, paths - seed)
        law, particle = energy_paths.draw(seed, count, unloading, scaling)
        gains = energy_paths.gains(*kind(law, particle, *energy_paths.choices(seed, count)))
        worst = np.maximum(worst, [part.max() for part in gains])
    return worst


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--paths", type=int, default=100_000, help="for each form")
    arguments = parser.parse_args()
    rows = []
    for name, kind in (("plates", energy_paths.single), ("pair", energy_paths.pair)):
        for unloading in Unloading:
            for scaling in StrainScaling:
                whole, between = largest(kind, arguments.paths, unloading, scaling)
                verdict = "none gains" if whole <= 0 and between <= ROUNDING else "GAINS"
                rows.append(
                    f"| {name} | {unloading.value} | {scaling.value} | {whole:.3g} | {between:.2g} | {verdict} |"
                )
                print(rows[-1], flush=True)
    head = [
        "# Energy along random paths",
        "",
        f"{arguments.paths} paths of {energy_paths.TURNS} releases for each row. A gain is a share of the energy put",
        f"in, the largest over the paths; negative is lost. Rounding: {ROUNDING:g}. By `benchmarks/study_energy.py`.",
        "",
        "| contact | form | scaling | gain of a whole path | gain from release to release | |",
        "|---|---|---|---|---|---|",
    ]
    if arguments.write:
        RESULT.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
