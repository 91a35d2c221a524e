"""Kinds of wrong answers: campaigns in formulas that the library does not have, and whether they are answered rightly.

`python benchmarks/kinds.py steps --set 0` answers five campaigns of a kind; sets 1 and 2 are for measuring, not for
work on the method: 1 has other formulas, 2 the formulas of both with other particles. A line for each campaign is kept
in `benchmarks/results/kinds/`; what is there is not run again. `--score` counts what is there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blind.run import read_outcomes
from jax.scipy.special import erf

import mcc_jax as mcc
from mcc_jax.campaign import PAPER_DIAMETERS_UM, Campaign, particle_batch
from mcc_jax.effects import AbstractEffect, Nuisance, Variant
from mcc_jax.effects.record import UNLOAD
from mcc_jax.simulate import (
    HiddenEffect,
    Instrument,
    Programme,
    Ramp,
    law_for_each,
    paper_population,
    simulate_campaign,
)
from mcc_jax.simulate.campaign import PAPER_PEAK_STRESS_MPA

RESULTS = Path(__file__).parent / "results" / "kinds"
EACH = 5  # campaigns of a set
INSTRUMENT = Instrument(displacement_noise_um=0.05, force_noise_mN=0.02, zero_um=0.5)


class Inside(AbstractEffect):
    """Displacement inside the law; the amplitude is in um for steps, else over the particle's size."""

    seed: Any = None

    formulas: ClassVar = {
        "two_heights": lambda e, c: c.particle.displacement(
            1 - (jnp.exp(-c.peak_stress / 0.2) + jnp.exp(-c.peak_stress / 1.5)) / 2
        ),
        "ripple": lambda e, c: c.particle.displacement(jnp.sin(2 * jnp.pi * c.peak_strain / 0.05)),
        "seating": lambda e, c: c.particle.displacement(jax.nn.sigmoid((c.peak_stress - 4.0) / 0.2)),
        "bump": lambda e, c: (
            -c.particle.displacement(jnp.exp(-(((c.load_share - 0.45) / 0.1) ** 2)) * (c.load_share < 1))
        ),
        "exponential_sizes": lambda e, c: _events(e, c, 8, lambda x, k: -jnp.log(x) / 4),
        "pareto_sizes": lambda e, c: _events(e, c, 8, lambda x, k: 0.1 * x ** (-1 / 1.5)),
        "aftershocks": lambda e, c: _events(e, c, 8, lambda x, k: 0.6**k, spread=0.08),
        "cascade": lambda e, c: _events(e, c, 12, lambda x, k: 0.2 * jnp.ones_like(x)),
        "bursts": lambda e, c: _events(e, c, 4, lambda x, k: -jnp.log(x) / 2, width=0.02),
        "two_sizes": lambda e, c: _events(e, c, 6, lambda x, k: jnp.where(x < 0.3, 1.0, 0.15)),
        "growing": lambda e, c: _events(e, c, 7, lambda x, k: 0.08 * (k + 1)),
        "lognormal_sizes": lambda e, c: _events(e, c, 8, lambda x, k: 0.15 * jnp.exp(jax.scipy.special.ndtri(x))),
        "late_cascade": lambda e, c: _events(e, c, 10, lambda x, k: 0.2 * jnp.ones_like(x), low=0.6),
        "slow_bursts": lambda e, c: _events(e, c, 4, lambda x, k: -jnp.log(x) / 2, width=0.05),
    }

    def inside(self, context: Any) -> Any:
        return self.amplitude * self.of(context)


def _events(
    e: Any, c: Any, count: int, size: Callable[..., Any], *, low: float = 0.1, spread: float = 0.0, width: float = 0.0
) -> Any:
    """Steps at places and of sizes that follow from one number of the test."""
    k = jnp.arange(count)
    place, x = ((e.seed * factor * (k + 1) + 0.37 * k) % 1.0 for factor in (97.31, 61.77))
    place = low + (0.95 - low) * (place[0] + spread * place if spread else place)
    reached = c.peak_stress[..., None] / 12.0 - place
    grown = jnp.where(reached > 0, -jnp.expm1(-reached / width) if width else 1.0, 0.0)
    return jnp.sum(grown * size(jnp.clip(x, 0.01, 0.99), k), -1)


class Observed(AbstractEffect):
    """Displacement between particle and read-out, in um per unit of the amplitude."""

    formulas: ClassVar = {
        "power_frame": lambda e, c: (c.force / 300.0 + 1e-9) ** 0.8,
        "giving_way": lambda e, c: jnp.maximum(c.force / 300.0 - 0.5, 0.0),
        "screw": lambda e, c: jnp.sin(2 * jnp.pi * c.displacement / 9.0),
        "room": lambda e, c: jnp.sin(2 * jnp.pi * c.record.time / 61.0),
        "saw": lambda e, c: (c.record.time / 83.0) % 1.0,
        "backlash": lambda e, c: jnp.where(c.record.kind == UNLOAD, -jnp.expm1(-(1 - c.load_share) / 0.03), 0.0),
        "warming": lambda e, c: jnp.expm1(c.record.time / 800.0),
        "wedge": lambda e, c: jnp.sqrt(-jnp.expm1(-c.peak_strain / 0.1) + 1e-9),
    }

    def observe(self, context: Any) -> Any:
        return self.amplitude * self.of(context)


class Flow(AbstractEffect):
    """Factor on the terms of loading; `terms` says on which."""

    terms: tuple[float, float, float] = (1.0, 1.0, 1.0)

    formulas: ClassVar = {
        "huh_kang": lambda e, p, r, x: 1 + e.amplitude * (_L(r) + 0.15 * _L(r) ** 2),
        "tanh": lambda e, p, r, x: 1 + 3 * e.amplitude * jnp.tanh(_L(r) / 3),
        "root_rate": lambda e, p, r, x: 1 + e.amplitude * (jnp.exp(0.5 * _L(r)) - 1),
        "log_one_plus": lambda e, p, r, x: 1 + e.amplitude * jnp.log1p(jnp.exp(_L(r))),
        "power_rate": lambda e, p, r, x: jnp.exp(e.amplitude * _L(r)),
        "saturating": lambda e, p, r, x: 1 + 2 * e.amplitude * jnp.exp(_L(r)) / (1 + jnp.exp(_L(r))),
        "log_stress_rate": lambda e, p, r, x: 1 + e.amplitude * jnp.log(p.stress(r.loading_rate + 1e-9) / 0.05),
        "root_stress_rate": lambda e, p, r, x: 1 + e.amplitude * jnp.sqrt(p.stress(r.loading_rate + 1e-9) / 0.05),
        "stiffening": lambda e, p, r, x: 1 + e.amplitude * (1 + erf((x - 0.25) / 0.02)) / 2,
        "second_wall": lambda e, p, r, x: 1 + e.amplitude * jnp.maximum(p.displacement(x) - 45.0, 0.0) / 20.0,
        "slender": lambda e, p, r, x: 1 + e.amplitude * (x + 1e-9) ** 0.75 / (1.05 - jnp.minimum(x, 0.9)),
        "hall_petch": lambda e, p, r, x: 1 + e.amplitude * (jnp.sqrt(200.0 / p.effective_diameter) - 1),
        "inverse_size": lambda e, p, r, x: 1 + e.amplitude * (200.0 / p.effective_diameter - 1),
        "quadratic_humidity": lambda e, p, r, x: 1 - e.amplitude * ((r.relative_humidity / 45.0) ** 2 - 1),
    }

    def loading(self, law: Any, particle: Any, record: Any, strain: Any) -> Any:
        factor = jnp.maximum(self.of(particle, record, strain), 0.05) + 0 * strain
        one = jnp.ones_like(factor)
        return tuple(jnp.where(on != 0, factor, one) for on in self.terms)


def _L(record: Any) -> Any:
    """ln of the force rate over 2 mN/s."""
    return jnp.log(jnp.where(record.loading_rate > 0, record.loading_rate, 2.0) / 2.0)


class Stiffness(AbstractEffect):
    """Factor on the modulus at the peak."""

    formulas: ClassVar = {
        "power_damage": lambda e, c: 1 - e.amplitude * (c.peak_strain + 1e-9) ** 1.5,
        "late_damage": lambda e, c: 1 / (1 + e.amplitude * c.peak_strain**3 * 8),
    }

    def stiffness(self, context: Any) -> Any:
        return jnp.maximum(self.of(context), 0.1)


def hidden(mechanism: str, make: type[AbstractEffect], formula: str, amplitude: float, **fixed: Any) -> HiddenEffect:
    """An effect in a formula of our own, and the mechanism it belongs to."""
    seeds = (Nuisance("seed", (0.1, 0.9), (0.0, 1.0), "", random_per_test=True),) if mechanism == "pop_in" else ()
    known = {"formula": formula, **fixed}
    variant = Variant(mechanism, formula, make, "size", "-", 1, (1e-9, 1e9), formula, "-", "-", seeds, fixed=known)
    return HiddenEffect(variant, amplitude)


YIELD, HARDENING = (1.0, 0.0, 0.0), (0.0, 1.0, 1.0)


@dataclass(frozen=True)
class Case:
    """What is hidden in one campaign, and what is right to say."""

    effects: tuple[HiddenEffect, ...] = ()
    form: tuple[str, float] = ("printed", 16_000.0)
    rates: tuple[float, ...] = (2.0,)
    humid: bool = False
    or_unlisted: bool = False  # whether it is right to say that no mechanism does so, too


def _steps(names: str) -> list[Case]:
    return [Case((hidden("pop_in", Inside, name, 0.8),)) for name in names.split()]


def _rate(formula: str, size: float, two: bool, terms: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Case:
    return Case((hidden("rate_dependence", Flow, formula, size, terms=terms),), rates=(1.0, 4.0) if two else (2.0,))


def _one(mechanism: str, make: type[AbstractEffect], formula: str, size: float, **more: Any) -> Case:
    return Case((hidden(mechanism, make, formula, size),), **more)


FRAME, TOE = ("frame_compliance", Observed, "power_frame"), ("toe_asperity", Inside, "two_heights")
FRICTION, DAMAGE = ("platen_friction", Flow, "slender"), ("damage", Stiffness, "power_damage")
SIZE, TILT = ("size_effect", Flow, "hall_petch"), ("misalignment", Observed, "wedge")


def _two(first: Any, size: float, second: Any, lesser: float) -> Case:
    return Case((hidden(*first, size), hidden(*second, lesser)))


# Of each kind the five of set 0, then those of set 1.
KINDS: dict[str, list[Case]] = {
    "forms": [
        Case(form=("punch", 450.0)), Case(form=("punch_exact", 350.0)), Case(form=("punch", 800.0)),
        Case((hidden(*FRAME, 3.0),), form=("punch", 450.0)), Case((hidden(*TOE, 0.008),), form=("punch_exact", 400.0)),
        Case(form=("punch", 300.0)), Case(form=("punch_exact", 600.0)),
        Case((hidden(*DAMAGE, 0.9),), form=("punch", 500.0)),
        Case((hidden(*FRICTION, 0.3),), form=("punch", 400.0)),
        Case((hidden(*SIZE, 0.4),), form=("punch_exact", 450.0)),
    ],
    "steps": _steps("exponential_sizes pareto_sizes aftershocks cascade bursts "
                    "two_sizes growing lognormal_sizes late_cascade slow_bursts"),
    "rate": [
        _rate("huh_kang", 0.05, True), _rate("tanh", 0.06, True, YIELD), _rate("root_rate", 0.08, True),
        _rate("log_stress_rate", 0.06, False), _rate("power_rate", 0.06, True, HARDENING),
        _rate("saturating", 0.1, True), _rate("tanh", 0.07, True, HARDENING),
        _rate("root_stress_rate", 0.08, False, YIELD),
        _rate("root_rate", 0.07, True, YIELD), _rate("log_one_plus", 0.07, True, YIELD),
    ],
    "second": [
        _two(FRAME, 6.0, TOE, 0.002), _two(FRICTION, 0.5, FRAME, 0.6), _two(DAMAGE, 1.2, TOE, 0.002),
        _two(SIZE, 0.5, FRAME, 0.7), _two(TOE, 0.012, DAMAGE, 0.3),
        _two(FRAME, 6.0, DAMAGE, 0.35), _two(FRICTION, 0.5, TOE, 0.002), _two(SIZE, 0.6, DAMAGE, 0.3),
        _two(DAMAGE, 1.2, FRAME, 0.6), _two(TOE, 0.012, FRAME, 0.6),
    ],
    "unlisted": [
        _one("UNLISTED", Flow, "stiffening", 0.3),
        _one("frame_compliance", Observed, "giving_way", 2.0, or_unlisted=True),
        _one("UNLISTED", Observed, "screw", 0.15), _one("UNLISTED", Observed, "room", 0.15),
        _one("UNLISTED", Flow, "second_wall", 0.5),
        _one("UNLISTED", Inside, "bump", 0.004), _one("UNLISTED", Observed, "backlash", 0.6),
        _one("UNLISTED", Inside, "ripple", 0.002), _one("UNLISTED", Inside, "seating", 0.006),
        _one("UNLISTED", Observed, "saw", 0.3),
    ],
    "family": [
        _one("thermal_drift", Observed, "warming", 0.7), _one(*TOE, 0.008),
        _one("size_effect", Flow, "inverse_size", 0.3),
        _one(*FRAME, 3.0), _one("humidity", Flow, "quadratic_humidity", 0.1, humid=True),
        _one(*FRICTION, 0.4), _one(*DAMAGE, 0.9), _one(*SIZE, 0.5), _one("damage", Stiffness, "late_damage", 0.8),
        _one(*TILT, 5.0),
    ],
}  # fmt: skip


def cases_of(kind: str, number: int) -> list[tuple[Case, int]]:
    """The campaigns of a set, and the seed of each."""
    cases = KINDS[kind]
    chosen = cases[number * EACH : (number + 1) * EACH] if number < 2 else cases[1::2]
    return [(case, 100 * number + 7 * k + len(kind)) for k, case in enumerate(chosen)]


def campaign_of(case: Case, seed: int) -> Campaign:
    """Twelve particles, two cycles with holds; of two rates the second from the first reload on."""
    rng, count = np.random.default_rng([seed, 64]), 12
    diameters = PAPER_DIAMETERS_UM[rng.permutation(20)[:count]]
    plastic = paper_population().sample(jax.random.key(seed), 4 * count)
    monotone = np.flatnonzero(jax.vmap(lambda one: one.is_monotone)(plastic))[:count]
    plastic = jax.tree.map(lambda leaf: leaf[monotone], plastic)
    stress = jnp.asarray(rng.uniform(*PAPER_PEAK_STRESS_MPA, count))
    peaks = np.asarray(eqx.filter_vmap(mcc.Particle.force)(particle_batch(diameters), stress))
    humidity = rng.uniform(15, 80, count) if case.humid else None
    programme = Programme.cycles(levels=(0.5, 1.0, 1.0), unload_to=0.3, hold_s=30.0, points=150, rate=case.rates[0])
    down = next(k for k, step in enumerate(programme.steps) if isinstance(step, Ramp) and step.to == 0.3)
    later = [replace(s, rate=case.rates[-1]) if isinstance(s, Ramp) else s for s in programme.steps[down + 1 :]]
    return simulate_campaign(
        law_for_each(plastic, 1.43, case.form[1], case.form[0]),
        diameters,
        peaks,
        replace(programme, steps=(*programme.steps[: down + 1], *later)),
        instrument=INSTRUMENT,
        effects=case.effects,
        seed=seed,
        relative_humidity_percent=humidity,
    )


def is_right(case: Case, found: Mapping[str, Any]) -> bool:
    """Whether an answer has all that is hidden, each first in its set, and nothing else, as in the sealed bench."""
    names = {effect.variant.mechanism for effect in case.effects}
    form = "printed" if case.form[0] == "printed" else "punch"
    if found["form"] != form:
        return False
    if not names:
        return found["verdict"] == "NO_GAP"
    if found["verdict"] == "UNLISTED":
        return case.or_unlisted or names == {"UNLISTED"}
    sets = [set(s) for s in found["sets"]]
    equal = {"rate_dependence", "size_effect"}
    if names <= equal and len(case.rates) == 1 and len(sets) == 1:  # equivalent by construction: declared is right
        return names <= sets[0] <= equal
    return len(sets) == len(names) and {s[0] for s in found["sets"]} == names


def main() -> None:
    """Answer the campaigns of a set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--set", type=int, default=0, choices=(0, 1, 2))
    parser.add_argument("--only", type=int)
    parser.add_argument("--label", default="now")
    parser.add_argument("--score", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    folder = RESULTS / f"{given.kind}_{given.set}_{given.label}"
    folder.mkdir(parents=True, exist_ok=True)
    done = read_outcomes(folder)
    for k, (case, seed) in enumerate(cases_of(given.kind, given.set)):
        if given.score or str(k) in done or (given.only is not None and k != given.only):
            continue
        began = time.perf_counter()
        found = mcc.discover(campaign_of(case, seed), confirm=False, experiments=False, posterior=False)
        line = {
            "key": str(k),
            "hidden": [effect.variant.label for effect in case.effects],
            "verdict": found.verdict,
            "sets": [list(s) for s in found.candidate_set or ()],
            "form": found.model.unloading.value if found.model else "",
            "seconds": round(time.perf_counter() - began, 1),
            "summary": found.summary[:300],
        }
        line["right"] = is_right(case, line)
        done[line["key"]] = line
        with (folder / "part_1.jsonl").open("a") as record:
            record.write("\n" + json.dumps(line))  # after a line that was cut off
        print(json.dumps(line), flush=True)
    print(f"{given.kind}, set {given.set}: {sum(line['right'] for line in done.values())} of {len(done)} right")


if __name__ == "__main__":
    main()
