"""Which campaigns, with what hidden in them: names, strengths and circumstances, drawn anew from a master seed."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from .settings import BETWEEN_PARTICLES, FAULT_CHECKS, MECHANISMS, SETTINGS, Drawing
from .world import generators

KINDS = ("single", "pair", "null", "unlisted", "fault")
PROTOCOLS = ("P0", "P1", "P2")


@dataclass(frozen=True)
class Case:
    """One campaign: enough, with the master seed, to make it again.

    number: place in the plan. effects: (mechanism, formula, lambda). protocol: P0 up and down, P1 cycles and a hold, P2
    the same at two rates. noise: kind of noise. humidity: whether a column of humidities tempts. fault: of the tester.
    subset: whether baselines run on it.
    """

    number: int
    kind: str
    generator: str
    effects: tuple[tuple[str, str, float], ...]
    protocol: str
    particles: int
    noise: str
    humidity: bool = False
    fault: str = ""
    subset: bool = False

    def record(self) -> dict[str, Any]:
        """As JSON takes it."""
        return asdict(self)

    def rng(self, master: int, attempt: int) -> np.random.Generator:
        """Random numbers of one attempt at this case."""
        return np.random.default_rng([master, self.number, attempt])


def from_record(record: dict[str, Any]) -> Case:
    """Inverse of `Case.record`, also after a trip through JSON."""
    return Case(**{**record, "effects": tuple((m, f, float(v)) for m, f, v in record["effects"])})


def keys(master: int, count: int) -> list[str]:
    """Names of the campaigns of a plan in an order that says nothing."""
    order = np.random.default_rng([master, 1]).permutation(count)
    return [f"c{place:03d}" for place in order]


def plan(master: int, drawing: Drawing = SETTINGS.drawing) -> list[Case]:
    """All cases, stratified: which formula meets which strength, protocol, noise and number differs with the seed."""
    rng = np.random.default_rng([master, 0])
    cases = [
        *_singles(rng, drawing),
        *_pairs(rng, drawing),
        *_nulls(rng, drawing),
        *_unlisted(rng, drawing),
        *_faults(rng, drawing),
    ]
    return _with_subset([replace(case, number=k) for k, case in enumerate(cases)], drawing)


def digest(master: int) -> str:
    """Hash of the plan, which changes with it."""
    return hashlib.sha256(repr(plan(master)).encode()).hexdigest()


def _turns(rng: np.random.Generator, values: Sequence[Any]) -> Iterator[Any]:
    """The values over and over, each round in a new order."""
    while True:
        yield from (values[k] for k in rng.permutation(len(values)))


def _singles(rng: np.random.Generator, drawing: Drawing) -> Iterator[Case]:
    """A Latin square: every mechanism at every strength, half of the strengths by each generator."""
    known, levels = generators(), drawing.single_levels
    noises, counts = _turns(rng, drawing.noises), _turns(rng, drawing.particles)
    first = int(rng.integers(2))
    for row, m in enumerate(rng.permutation(len(MECHANISMS))):
        mechanism = MECHANISMS[m]
        columns = rng.permutation(len(levels))
        formulas = {name: _turns(rng, known[name].formulas(mechanism)) for name in known}
        ways = {name: itertools.count(int(rng.integers(len(PROTOCOLS)))) for name in known}
        for place, k in enumerate(columns):
            name = list(known)[(place + row + first) % 2]
            formula = next(formulas[name])
            allowed = known[name].protocols(mechanism, formula)
            count = next(counts)
            if mechanism in BETWEEN_PARTICLES:
                least = max(drawing.particles) if levels[k] >= drawing.strong else drawing.enough_particles
                count = max(count, least)
            protocol = allowed[next(ways[name]) % len(allowed)]
            effects = ((mechanism, formula, levels[k]),)
            yield Case(0, "single", name, effects, protocol, count, next(noises), bool(rng.random() < 0.25))


def _pairs(rng: np.random.Generator, drawing: Drawing) -> Iterator[Case]:
    """Every mechanism in as many pairs as there are matchings, no pair twice."""
    known = generators()
    noises = _turns(rng, drawing.noises)
    counts = _turns(rng, [n for n in drawing.particles if n >= drawing.enough_particles])
    levels, names = _turns(rng, drawing.pair_levels), _turns(rng, tuple(known))
    taken = set(drawing.no_pair)
    for _ in range(drawing.matchings):
        while True:
            order = [MECHANISMS[k] for k in rng.permutation(len(MECHANISMS))]
            couples = list(zip(order[::2], order[1::2], strict=True))
            if not any(frozenset(couple) in taken for couple in couples):
                break
        taken |= {frozenset(couple) for couple in couples}
        for couple in couples:
            name = next(names)
            formulas = [str(rng.choice(known[name].formulas(mechanism))) for mechanism in couple]
            both = [known[name].protocols(m, f) for m, f in zip(couple, formulas, strict=True)]
            protocol = "P2" if ("P2",) in both else PROTOCOLS[int(rng.integers(1, 3))]
            effects = tuple((m, f, next(levels)) for m, f in zip(couple, formulas, strict=True))
            count, noise = next(counts), next(noises)
            if set(couple) & set(BETWEEN_PARTICLES):  # many particles, and no scatter that hides the effect
                count, noise = max(drawing.particles), "clean" if noise in drawing.scattering else noise
            yield Case(0, "pair", name, effects, protocol, count, noise)


def _nulls(rng: np.random.Generator, drawing: Drawing) -> Iterator[Case]:
    """Nothing hidden, in every kind of noise."""
    names, counts = _turns(rng, tuple(generators())), _turns(rng, drawing.particles)
    for noise, number in drawing.nulls.items():
        protocols = _turns(rng, PROTOCOLS)
        for _ in range(number):
            humid = bool(rng.random() < 0.25)
            yield Case(0, "null", next(names), (), next(protocols), next(counts), noise, humid)


def _unlisted(rng: np.random.Generator, drawing: Drawing) -> Iterator[Case]:
    """Effects on no list; lambda is what the best listed formula leaves."""
    known, levels = generators(), _turns(rng, drawing.unlisted_levels)
    noises = _turns(rng, drawing.noises)
    counts = _turns(rng, [n for n in drawing.particles if n >= min(drawing.particles[1:])])
    formulas = {name: _turns(rng, known[name].unlisted()) for name in known}
    for k in range(drawing.unlisted):
        name = list(known)[k % 2]
        formula = next(formulas[name])
        protocol = str(rng.choice(known[name].protocols("unlisted", formula)))
        yield Case(0, "unlisted", name, (("unlisted", formula, next(levels)),), protocol, next(counts), next(noises))


def _faults(rng: np.random.Generator, drawing: Drawing) -> Iterator[Case]:
    """Faults of the tester, no effect."""
    names, counts = _turns(rng, tuple(generators())), _turns(rng, drawing.particles)
    protocols = _turns(rng, PROTOCOLS)
    for fault in FAULT_CHECKS:
        for _ in range(drawing.faults):
            yield Case(0, "fault", next(names), (), next(protocols), next(counts), "clean", fault=fault)


def _with_subset(cases: list[Case], drawing: Drawing) -> list[Case]:
    """Mark the campaigns on which baselines run, evenly over mechanisms, strengths and kinds of noise."""
    marked: set[int] = set()
    for kind in KINDS:
        of_kind = [case for case in cases if case.kind == kind]
        if kind == "single":  # two of each mechanism, the strengths in turn
            levels = drawing.single_levels
            row = {case.effects[0][0]: k for k, case in enumerate(of_kind[:: len(levels)])}
            each = drawing.subset[kind] // len(MECHANISMS)
            step = len(levels) // each
            marked |= {
                case.number
                for case in of_kind
                if (levels.index(case.effects[0][2]) - row[case.effects[0][0]]) % step == 0
            }
        else:
            wanted = drawing.subset[kind]
            marked |= {of_kind[k * len(of_kind) // wanted].number for k in range(wanted)}
    return [replace(case, subset=case.number in marked) for case in cases]
