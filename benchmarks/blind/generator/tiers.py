"""The plan of a blind run: which campaigns, with what hidden in them. Only names and seeds."""

from __future__ import annotations

import zlib
from dataclasses import asdict, dataclass, field

import numpy as np

from .effects import EXACT, HUMIDITY, MECHANISMS, RELOAD, UNLISTED, VARIANTS
from .noise import CLEAN, NUISANCES, ROUGH

TIERS = ("T0", "T1", "T2", "T3", "T4", "T5", "T6")
SEEDS = 10

PAIRS = (
    ("frame_compliance", "toe_asperity"),
    ("frame_compliance", "adhesion"),
    ("frame_compliance", "reload_hysteresis"),
    ("frame_compliance", "finite_hardening_exponent"),
    ("frame_compliance", "reverse_plasticity"),
    ("thermal_drift", "toe_asperity"),
    ("thermal_drift", "adhesion"),
    ("thermal_drift", "misalignment"),
    ("thermal_drift", "platen_friction"),
    ("creep", "toe_asperity"),
    ("creep", "adhesion"),
    ("creep", "misalignment"),
    ("creep", "reload_hysteresis"),
    ("creep", "damage"),
    ("creep", "platen_friction"),
    ("adhesion", "toe_asperity"),
    ("adhesion", "misalignment"),
    ("adhesion", "pop_in"),
    ("damage", "toe_asperity"),
    ("damage", "platen_sink_in"),
    ("densification_stiffening", "creep"),
    ("densification_stiffening", "misalignment"),
    ("reload_hysteresis", "toe_asperity"),
    ("reload_hysteresis", "platen_friction"),
    ("reverse_plasticity", "platen_sink_in"),
    ("reverse_plasticity", "toe_asperity"),
    ("platen_sink_in", "pop_in"),
    ("platen_friction", "reverse_plasticity"),
    ("ratcheting", "toe_asperity"),
    ("unloading_shape", "frame_compliance"),
)

# The first is there but struck from the library; the second, its nearest relative, stays.
TWINS = (
    ("creep", "frame_compliance"),
    ("frame_compliance", "platen_sink_in"),
    ("platen_sink_in", "frame_compliance"),
    ("adhesion", "reverse_plasticity"),
    ("reverse_plasticity", "adhesion"),
    ("misalignment", "finite_hardening_exponent"),
    ("toe_asperity", "misalignment"),
    ("damage", "densification_stiffening"),
    ("thermal_drift", "creep"),
    ("finite_hardening_exponent", "misalignment"),
    ("reload_hysteresis", "ratcheting"),
    ("platen_friction", "finite_hardening_exponent"),
)

UNTESTABLE = ("reload_hysteresis", "ratcheting", "humidity", "finite_punch")


@dataclass(frozen=True)
class Case:
    """One campaign: enough, with the master seed, to make it again bit for bit.

    effects: (mechanism, form, lambda). residual: lambda counts what is left after the best single listed mechanism.
    humidity: campaign from three batches; hide_columns: the file does not say so. cell: what the scorer groups by.
    """

    id: str
    tier: str
    cell: str
    protocol: str
    count: int = 20
    resample: bool = False
    effects: tuple[tuple[str, str, float], ...] = ()
    exclude: tuple[str, ...] = ()
    solver_options: dict = field(default_factory=dict)
    noise: dict = field(default_factory=CLEAN.record)
    humidity: bool = False
    hide_columns: bool = False
    residual: bool = False

    def record(self):
        return asdict(self)

    def rng(self, master):
        """Random numbers of this case alone."""
        return np.random.default_rng([int(master), zlib.crc32(self.id.encode())])


def from_record(record):
    """Inverse of `Case.record`, also after a trip through JSON."""
    record = dict(record)
    record["effects"] = tuple((m, f, float(v)) for m, f, v in record["effects"])
    record["exclude"] = tuple(record["exclude"])
    return Case(**record)


def _circumstances(seed, effects=()):
    """Number of particles, sizes, noise and columns: common to all effects, to give none of them away."""
    count = {7: 10, 8: 60}.get(seed % 10, 20)
    names = {name for name, *_ in effects}
    if "size_effect" in names:
        count = 60
    return {
        "count": count,
        "resample": seed % 2 == 1,
        "noise": (ROUGH if seed % 3 == 2 else CLEAN).record(),
        "humidity": "humidity" in names or seed % 4 == 3,
    }


def _case(tier, cell, seed, protocol, effects=(), **more):
    settings = {**_circumstances(seed, effects), **more}
    label = "+".join(f"{m}.{f}" for m, f, _ in effects) or cell
    strength = f"-{effects[0][2]:g}" if effects else ""
    return Case(f"{tier}-{label}{strength}-{protocol}-{seed}", tier, cell, protocol, effects=tuple(effects), **settings)


def _needs_reload(form):
    return RELOAD in form.needs


def t0(seeds=SEEDS):
    """Nothing hidden: 50 clean campaigns per seed and 20 of each nuisance."""
    cases = []
    for k in range(50 * seeds):
        count = {7: 10, 8: 60}.get(k % 10, 20)
        cases.append(
            Case(
                f"T0-clean-{k}", "T0", "clean", ("P0", "P1")[k % 2], count=count, resample=k % 4 > 1, humidity=k % 8 > 5
            )
        )
    for name, (noise, options) in NUISANCES.items():
        cases += [
            Case(
                f"T0-{name}-{k}",
                "T0",
                name,
                ("P0", "P1")[k % 2],
                resample=k % 4 > 1,
                noise=noise.record(),
                solver_options=dict(options),
            )
            for k in range(20 * seeds)
        ]
    return cases


def t1(seeds=SEEDS):
    """Exact formulas at lambda 5, 10 and 20 in P0 and P1; fewer at 3, and in P2."""
    cases = []
    for name in MECHANISMS:
        cells = [(p, v, seeds) for p in ("P0", "P1") for v in (5.0, 10.0, 20.0)]
        cells += [(p, 3.0, -(-2 * seeds // 5)) for p in ("P0", "P1")] + [("P2", 10.0, -(-2 * seeds // 5))]
        for protocol, strength, number in cells:
            if protocol == "P0" and _needs_reload(EXACT[name]):
                continue
            cases += [_case("T1", name, k, protocol, [(name, "exact", strength)]) for k in range(number)]
    return cases


def t2(seeds=SEEDS):
    """Variants, taken in turn, at lambda 10 and 20."""
    cases = []
    for name in MECHANISMS:
        for strength in (10.0, 20.0):
            for k in range(seeds):
                form = VARIANTS[name][k % len(VARIANTS[name])]
                protocol = "P1" if _needs_reload(form) or (k // len(VARIANTS[name])) % 2 else "P0"
                cases.append(_case("T2", name, k, protocol, [(name, form.form, strength)]))
    return cases


def t3(seeds=SEEDS):
    """Two effects at lambda 10 each."""
    return [
        _case("T3", "+".join(pair), k, "P1", [(name, "exact", 10.0) for name in pair])
        for pair in PAIRS
        for k in range(seeds)
    ]


def t4(seeds=SEEDS):
    """Effects on no list; lambda counts what the best listed mechanism leaves."""
    return [
        _case("T4", form.mechanism, k, "P1", [(form.mechanism, "unlisted", (10.0, 20.0)[k % 2])], residual=True)
        for form in UNLISTED
        for k in range(seeds)
    ]


def t5(seeds=SEEDS):
    """A listed effect whose name the solver may not use."""
    return [
        _case("T5", f"{name}|{twin}", k, "P1", [(name, "exact", (10.0, 20.0)[k % 2])], exclude=(name,), residual=True)
        for name, twin in TWINS
        for k in range(seeds)
    ]


def t6(seeds=SEEDS):
    """Effects about which the campaign holds no information; the finite punch because no contact reaches its rim."""
    cases = []
    for kind in UNTESTABLE:
        for k in range(seeds):
            hidden = kind == "humidity"
            settings = {"humidity": hidden, "hide_columns": hidden}
            cases.append(_case("T6", kind, k, "P0" if k % 2 or not hidden else "P1", [], **settings))
    return cases


def plan(tiers=TIERS, seeds=SEEDS, fraction=1.0):
    """All cases of the tiers; `fraction` keeps that share of each, drawn once and for all."""
    makers = {"T0": t0, "T1": t1, "T2": t2, "T3": t3, "T4": t4, "T5": t5, "T6": t6}
    chosen = []
    for tier in tiers:
        cases = makers[tier](seeds)
        if fraction < 1.0:
            keep = np.random.default_rng(zlib.crc32(tier.encode())).permutation(len(cases))
            keep = np.sort(keep[: max(1, round(fraction * len(cases)))])
            cases = [cases[i] for i in keep]
        chosen += cases
    return chosen


__all__ = ["HUMIDITY", "PAIRS", "TIERS", "TWINS", "UNTESTABLE", "Case", "from_record", "plan"]
