"""The cases: what is hidden where, at what strength. Nothing here is random.

Tiers: "exact" and "variant" hide one listed mechanism at a given lambda, in the specification's formula and in another;
"units" one at an amplitude that laboratories see, whatever its lambda; "null" nothing; "unlisted" what is on no list;
"pair" two mechanisms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from . import effects

TIERS = ("exact", "variant", "units", "null", "unlisted", "pair")

USUAL = (
    ("frame_compliance", 0, 1.5e-3, "P0"),
    ("thermal_drift", 1, 1.0e-3, "P1"),
    ("creep", 1, 1.0e-4, "P1"),
    ("rate_dependence", 1, 0.03, "P2"),
    ("adhesion", 0, 0.8, "P1"),
    ("damage", 0, 1.5, "P1"),
    ("finite_hardening_exponent", 1, 0.04, "P0"),
    ("pop_in", 2, 0.6, "P0"),
    ("toe_asperity", 2, 0.006, "P0"),
    ("platen_friction", 1, 0.08, "P1"),
    ("misalignment", 1, 0.02, "P0"),
    ("humidity", 1, 0.12, "P1"),
    ("size_effect", 0, 0.5, "P0"),
)
"""Mechanism, number of the formula, amplitude in the formula's unit, protocol."""

PAIRS = (
    ("frame_compliance", "pop_in", "P1"),
    ("creep", "misalignment", "P1"),
    ("rate_dependence", "reload_hysteresis", "P2"),
    ("toe_asperity", "adhesion", "P0"),
    ("ratcheting", "platen_friction", "P1"),
    ("thermal_drift", "unloading_shape", "P1"),
)
PAIR_LAMBDA, UNLISTED_LAMBDA = 15, 20

NULLS = ("clean", "clean", "t4", "t4", "scale", "scale", "escatter", "escatter")
_NOISES = ("clean", "clean", "t4", "clean", "scale", "clean")


@dataclass(frozen=True)
class Case:
    """effects: (mechanism, number of the formula or None for a random one); target: lambda, or None with `amplitude`.

    noise: see `noise.draw`; "escatter" is clean noise and a modulus that differs between particles.
    """

    tier: str
    effects: tuple[tuple[str, int | None], ...]
    protocol: str
    count: int = 20
    noise: str = "clean"
    target: float | None = None
    amplitude: float | None = None
    humidity: bool = False


def plan():
    """All cases, in the order in which they are drawn."""
    cases = list(_singles())
    cases += [
        Case(
            "units",
            ((mechanism, number),),
            protocol,
            40 if mechanism == "size_effect" else 20,
            _NOISES[(len(cases) + k) % len(_NOISES)],
            amplitude=amplitude,
        )
        for k, (mechanism, number, amplitude, protocol) in enumerate(USUAL)
    ]
    for k, noise in enumerate(NULLS):
        protocol = "P2" if k == len(NULLS) - 1 else ("P0", "P1")[k % 2]
        cases.append(Case("null", (), protocol, noise=noise, humidity=k == 3))
    for k, formula in enumerate(effects.UNLISTED):
        protocol = formula.protocols[k % len(formula.protocols)]
        cases.append(Case("unlisted", (("unlisted", k),), protocol, target=UNLISTED_LAMBDA))
    for first, second, protocol in PAIRS:
        cases.append(Case("pair", ((first, None), (second, None)), protocol, target=PAIR_LAMBDA))
    # A column of humidity tempts where it explains nothing.
    return [replace(case, humidity=True) if k % 9 == 4 else case for k, case in enumerate(cases)]


def _singles():
    """Each listed mechanism in two or three formulas, noises in turn, some with few and some with many particles."""
    number = 0
    for m, (mechanism, formulas) in enumerate(effects.LISTED.items()):
        jobs = [(0, 12), (0, 20), (1, 12), (1, 20), (2, 12 if m % 2 else 20)]
        for j, (k, target) in enumerate(jobs):
            formula = formulas[k]
            count = 20
            if j == 1 and m % 3 == 0:
                count = 10
            if j == 3 and m % 4 == 1:
                count = 40
            if formula.wide or (target == 20 and formula.many_at_20):
                count = 40
            protocol = formula.protocols[(j + m) % len(formula.protocols)]
            tier = "exact" if k == 0 else "variant"
            yield Case(tier, ((mechanism, k),), protocol, count, _NOISES[number % len(_NOISES)], target)
            number += 1
