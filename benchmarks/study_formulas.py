"""Does what a formula's siblings leave of it lie in the span of its mechanism's misfit?

Run `python benchmarks/study_formulas.py --write`; it writes `results/formulas.md`.

One simulated campaign holds all that any formula needs. Each formula of the library in turn, at the middle of its
further numbers and `LAMBDA` standard deviations of noise strong once the particles' own numbers and the population are
integrated out, is taken for nature's and out of the library, to first order. The table:

- sd: its strength, less than `LAMBDA` where its largest plausible amplitude gives less;
- left: what the best sibling, over all of its grid, leaves of it, as a share of its square;
- in the span: how much of that the misfit explains that `discover` gives to the sibling (`misfit_columns`), its
  coefficients normal with the prior's median size and the amplitude free;
- rest: what then remains, in sd. Below 3 or so no second name can gain by it.
Bold: more than 0.2 of the length is left, and less than 90 % of that lies in the span. Formulas whose numbers differ
from test to test have no misfit in `discover`, and no rows here.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import mcc_jax as mcc
from mcc_jax.discovery.base import Base, base_fit
from mcc_jax.discovery.design import design_of
from mcc_jax.discovery.evidence import LinearModel, visible
from mcc_jax.discovery.misfit import coordinates, functions, misfit_columns, scaled
from mcc_jax.discovery.screen import Candidate, candidates_of, located, with_signatures
from mcc_jax.discovery.settings import DECISIONS
from mcc_jax.effects import LIBRARY, Variant

RESULT = Path(__file__).parent / "results" / "formulas.md"
PARTICLES, LAMBDA, SPAN, LEFT = 8, 100.0, 0.9, 0.04


class Row(NamedTuple):
    """A formula and its best sibling: its strength [sd], and the shares of its square that are left."""

    truth: Variant
    sibling: str
    strength: float
    left: float
    misfit: float


def campaign(effects: Sequence[mcc.HiddenEffect] = ()) -> mcc.Campaign:
    """Sizes, shapes, rooms, rates, holds; rising peaks and cycles between the same two loads."""
    R, H = mcc.Ramp, mcc.Hold
    steps = [R(0.4, 1.0), H(20.0), R(0.1, 4.0), R(0.4, 4.0), R(0.7, 8.0), H(60.0), R(0.0, 2.0), H(20.0)]
    steps += [R(0.7, 4.0), R(0.2, 4.0), R(0.7, 2.0), R(0.2, 4.0), R(0.85, 0.5), R(1.0, 8.0), H(120.0), R(0.0, 2.0)]
    tests = mcc.paper_campaign(
        4,
        instrument=mcc.Instrument(0.05, 0.05),
        programme=mcc.Programme("load", steps, points=300),
        effects=effects,
        relative_humidity_percent=np.resize([15.0, 75.0, 45.0, 30.0, 60.0, 70.0, 25.0], 20),
    )
    return tests.without(*tests.particles[PARTICLES:])


def gram(base: Base, columns: Any) -> np.ndarray:
    """Products of columns in units of noise, particles' own numbers and the population integrated out."""
    design = design_of(base, base.state).with_amplitudes(columns)
    return LinearModel(base.hyperparameters, design).shared().information


def remaining(products: np.ndarray, precision: np.ndarray) -> float:
    """What normal coefficients of the other columns leave of the first, as a share of its square."""
    rest, value = products[1:, 1:], products[1:, 0]
    x = np.linalg.lstsq(rest + np.diag(precision), value, rcond=1e-14)[0]
    return float((products[0, 0] - 2 * x @ value + x @ rest @ x) / products[0, 0])


def in_span(
    base: Base, at: Any, columns: Any, pair: tuple[int, int], best: dict[str, int], truth: Variant, sibling: Variant
) -> Row:
    """Strength of a formula, and what a sibling leaves of it: alone, and with its misfit."""
    k, s = pair
    products = gram(base, columns[..., [k, s]])
    unit = min(LAMBDA / np.sqrt(products[0, 0]), truth.plausible[1] / truth.plausible[0])
    amplitude = unit * products[0, 1] / products[1, 1]
    siblings = [columns[..., j] for name, j in best.items() if name != sibling.name]
    here = design_of(base, base.state)
    seen = visible(base.hyperparameters, here, columns[..., s : s + 1])[0]
    smooth = functions(LIBRARY[sibling.mechanism].coordinates, at)
    span = seen * misfit_columns(amplitude * columns[..., s], smooth, siblings)
    count = span.shape[-1]
    products = gram(base, np.concatenate([unit * columns[..., [k, s]], span], -1))
    alone = remaining(products[:2, :2], np.zeros(1))
    misfit = remaining(products, np.array([0.0] + [DECISIONS.misfit**-2] * count))
    return Row(truth, sibling.name, float(np.sqrt(products[0, 0])), alone, misfit)


def at_their_middle(variants: Sequence[Variant]) -> list[Candidate]:
    """Formulas at the middle of their further numbers."""
    return [Candidate(v, {n.name: n.middle for n in v.nuisances}) for v in variants]


def rows_of(base: Base, candidates: list[Candidate]) -> list[Row]:
    """Every formula at the middle of its further numbers, left out in turn."""
    variants = list(dict.fromkeys(c.variant for c in candidates))
    every = [*at_their_middle(variants), *candidates]
    columns = with_signatures(base, base.state, every).columns
    at = scaled(
        {
            k: np.asarray(x)
            for k, x in base.each(coordinates, base.state.point, base.forms, base.state.population[0]).items()
        },
        np.asarray(base.tests.mask),
    )
    products, rows = gram(base, columns), []
    length = np.sqrt(np.maximum(np.diagonal(products), 1e-300))
    for k, v in enumerate(variants):
        likeness = products[k] / length if v.sign else np.abs(products[k] / length)
        siblings: dict[str, list[int]] = {}
        for j, other in enumerate(candidates, len(variants)):
            if other.mechanism == v.mechanism and other.variant != v:
                siblings.setdefault(other.variant.name, []).append(j)
        best = {name: max(js, key=lambda j: likeness[j]) for name, js in siblings.items()}
        s = max(best.values(), key=lambda j: likeness[j])
        rows.append(in_span(base, at, columns, (k, s), best, v, every[s].variant))
    return rows


def line(r: Row) -> str:
    """A line of the table."""
    share = 1 - r.misfit / r.left if r.left > 1e-6 else 1.0
    inside = f"**{share:.3f}**" if share < SPAN and r.left > LEFT else f"{share:.3f}"
    rest = r.strength * np.sqrt(max(r.misfit, 0.0))
    cells = [r.truth.mechanism, r.truth.name, f"{r.strength:.0f}", r.sibling, f"{r.left:.4f}", inside, f"{rest:.1f}"]
    return f"| {' | '.join(cells)} |\n"


def main() -> None:
    """Draw the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    jax.config.update("jax_enable_x64", True)
    base = base_fit(campaign(), mcc.Model(), threshold_MPa=0.0, progress=lambda _: None)
    assert not base.snaps.any()
    candidates = [c for c in candidates_of(LIBRARY) if not (c.variant.random_per_test or located(c.variant))]
    head = "| mechanism | formula | sd | best sibling | left | in the span | rest [sd] |\n" + "|---" * 7 + "|\n"
    text = head + "".join(map(line, rows_of(base, candidates)))
    print(text)
    if parser.parse_args().write:
        RESULT.write_text(text)


if __name__ == "__main__":
    main()
