"""Does any contact give back more energy than it took? Random load-unload-reload paths for each form, and for pairs.

Run `uv run python benchmarks/study_energy.py --write`: it writes `benchmarks/results/energy.md`. Every path has a law
and a particle of its own (pairs: two unlike ones), peaks from 1e-9 to twice the end of the tests, full and partial
releases and reloads. Energies are integrals of the force, not the library's own.

`--effects creep:growing_contact ...` walks paths of force over random times with these formulas instead, each at an
amplitude and further numbers of its own, and writes `energy_effects.md`.
"""

import _report
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import energy_paths  # noqa: E402

from mcc_jax.effects import find_variant  # noqa: E402
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


def largest_with_effect(variant, paths):
    """Largest gain along paths of force that end at full release, as a share of the energy put in."""
    worst = -np.inf
    for seed in range(0, paths, BATCH):
        count = min(BATCH, paths - seed)
        law, particle = energy_paths.draw(seed, count, Unloading.PRINTED, StrainScaling.RAW)
        taken, given = energy_paths.with_effect(variant, law, particle, seed, count)
        worst = max(worst, float(np.max((given - taken) / taken)))
    return worst


def with_effects(names, paths):
    """A table of formulas and the largest gain along their paths."""
    rows = []
    for name in names:
        gain = largest_with_effect(find_variant(name), paths)
        rows.append(f"| {name} | {gain:.3g} | {'none gains' if gain <= 0 else 'GAINS'} |")
        print(rows[-1], flush=True)
    head = [
        "# Energy along random paths with effects",
        "",
        f"{paths} paths of {energy_paths.TURNS} releases for each formula, the last one full; a gain is a share of the",
        "energy put in, its largest value over the paths; negative is lost. Written by `benchmarks/study_energy.py",
        "--effects`.",
        "",
        "| formula | gain of a whole path | |",
        "|---|---|---|",
    ]
    return [*head, *rows]


def main():
    parser = _report.parser(__doc__)
    parser.add_argument("--paths", type=int, default=100_000, help="for each form")
    parser.add_argument("--effects", nargs="+", help="formulas, as mechanism:variant")
    arguments = parser.parse_args()
    if arguments.effects:
        table = with_effects(arguments.effects, arguments.paths)
        if arguments.write:
            RESULT.with_stem("energy_effects").write_text("\n".join(table) + "\n", encoding="utf-8")
        return
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
        f"{arguments.paths} paths of {energy_paths.TURNS} releases for each row; a gain is a share of the energy put",
        f"in, its largest value over the paths; negative is lost. Rounding: {ROUNDING:g}. Written by",
        "`benchmarks/study_energy.py`.",
        "",
        "| contact | form | scaling | gain of a whole path | gain from release to release | |",
        "|---|---|---|---|---|---|",
    ]
    if arguments.write:
        RESULT.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
