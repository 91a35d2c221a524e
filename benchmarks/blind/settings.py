"""Every number that the bench chooses: what is drawn, when a solver is stopped, which bars the scorer reads."""

from __future__ import annotations

from dataclasses import dataclass, field

MECHANISMS = (
    "frame_compliance", "thermal_drift", "creep", "rate_dependence", "adhesion", "damage", "densification_stiffening",
    "reload_hysteresis", "ratcheting", "finite_hardening_exponent", "unloading_shape", "size_effect",
    "shape_second_order", "pop_in", "toe_asperity", "platen_friction", "misalignment", "platen_sink_in",
    "reverse_plasticity", "humidity",
)  # fmt: skip
"""Names of the listed mechanisms."""

BETWEEN_PARTICLES = ("size_effect", "shape_second_order", "humidity")
"""Mechanisms that show as differences between particles only."""

FAULT_CHECKS = {"force_zero": "zero of force", "clipping": "saturation", "breakage": "breakage"}
"""Fault of a tester: the check among `findings` of `discovery.json` that tells it."""


@dataclass(frozen=True)
class Drawing:
    """What campaigns are drawn.

    Attributes:
        single_levels: strengths lambda of single effects; every mechanism gets each of them once.
        pair_levels: strengths of the members of a pair, each measured alone.
        unlisted_levels: strengths of effects on no list that the best listed formula leaves.
        matchings: ways to pair all mechanisms off, each of which gives one pair for every two mechanisms.
        nulls: campaigns without an effect, by kind of noise.
        unlisted: campaigns with an effect on no list.
        faults: campaigns of each kind of fault of the tester.
        noises: kinds of noise that campaigns with an effect take in turn.
        scattering: kinds of noise that make particles differ.
        particles: numbers of particles that campaigns take in turn.
        enough_particles: least number for effects that show between particles only.
        strong: strength from which on these get the largest number.
        no_pair: mechanisms that are one quantity with two signs, so that no data can show both.
        subset: campaigns of each kind on which baselines run.
        largest_unlisted: strength that an unlisted effect never exceeds, however much of it a listed one takes.
        attempts: fresh draws while a loading curve snaps through.
        weak_attempts: fresh draws while the amplitude's bound keeps the effect below its strength.
        reached: share of the strength that counts as reached.
        snap_strain, snap_ratio: a step of strain between two readings counts as snapping through from this size on if
            it is also so many times the largest step of the base law.
    """

    single_levels: tuple[float, ...] = (5.0, 10.0, 20.0, 35.0, 60.0, 100.0, 170.0, 300.0)
    pair_levels: tuple[float, ...] = (20.0, 30.0, 50.0, 90.0, 150.0)
    unlisted_levels: tuple[float, ...] = (10.0, 15.0, 25.0, 50.0, 100.0)
    matchings: int = 4
    nulls: dict[str, int] = field(
        default_factory=lambda: {
            "clean": 60,
            "rough": 25,
            "smooth": 25,
            "heavy": 25,
            "scale": 25,
            "modulus": 20,
            "shape": 20,
        }
    )
    unlisted: int = 30
    faults: int = 10
    noises: tuple[str, ...] = (*("clean",) * 6, "rough", "smooth", "heavy", "scale", "modulus", "shape")
    scattering: tuple[str, ...] = ("modulus", "shape")
    particles: tuple[int, ...] = (5, 10, 20, 20, 40, 60)
    enough_particles: int = 20
    strong: float = 60.0
    no_pair: tuple[frozenset[str], ...] = (frozenset({"damage", "densification_stiffening"}),)
    subset: dict[str, int] = field(
        default_factory=lambda: {"single": 40, "pair": 10, "null": 30, "unlisted": 10, "fault": 10}
    )
    largest_unlisted: float = 400.0
    attempts: int = 6
    weak_attempts: int = 3
    reached: float = 0.9
    snap_strain: float = 0.03
    snap_ratio: float = 4.0


@dataclass(frozen=True)
class Running:
    """How a solver is run.

    Attributes:
        timeout_s: longest time for one campaign, compiling included.
        start_timeout_s: longest time for a worker process to start.
        renew_after: campaigns after which the worker process is replaced, because memory maps run out.
        closure_stride: every which row of a closure's correction is kept in the outcome.
    """

    timeout_s: float = 600.0
    start_timeout_s: float = 300.0
    renew_after: int = 8
    closure_stride: int = 4


@dataclass(frozen=True)
class Scoring:
    """Bars and limits of the scorer.

    Attributes:
        slack: a strength counts as reached from this share of it on, because amplitudes are found by search.
        seen, strong, where: strengths from which on a single effect, a strong one, and places count.
        weak: strength up to which singles are compared with the oracle.
        apart: projected correlation below which both members of a pair should be named.
        pair: least strength of a pair's members.
        unlisted: residual strength from which on UNLISTED should be said.
        held: share of the true squared difference that the named places should hold.
        curve: largest error of a closure on held-out particles, over the range of the hidden curve.
        chi2_slack: what chi2 per point may be off beside its own standard errors.
        quantile: of the normal distribution, for 95 % intervals.
        floor: least probability that enters a log score.
        bins: of the calibration curve.
        ambiguous_nats: difference of log evidence between truth and winner below which a wrong verdict is ambiguous.
    """

    slack: float = 0.95
    seen: float = 10.0
    strong: float = 50.0
    where: float = 20.0
    weak: float = 7.5
    apart: float = 0.8
    pair: float = 20.0
    unlisted: float = 10.0
    held: float = 0.7
    curve: float = 0.1
    chi2_slack: float = 0.02
    quantile: float = 1.959964
    floor: float = 1e-6
    bins: int = 10
    ambiguous_nats: float = 3.0


@dataclass(frozen=True)
class Testers:
    """Noise and faults of testers; ranges are of campaigns, evenly in the logarithm where they start above zero.

    Attributes:
        white_um, force_mN: white noise of displacement and of force.
        wander_um: standard deviation of the correlated residual; strong_wander times as much where it is the nuisance.
        usual_MPa: its length on the load path; of a nuisance length_MPa, or length_s where it wanders in time.
        scale_sd: of the logarithm of a particle's own factor, where these differ.
        scatter: kind of nuisance: standard deviation of the logarithm of each particle's modulus, or strain's factor.
        zero_um: standard deviation of the zero of displacement between tests.
        steepest_um_per_mN: largest slope of a curve by which an error of the force counts.
        offset: of the zero of force, over the median largest force.
        clipped_from: quantile of the particles' largest displacements at which the gauge ends.
        broken: most particles that break, and one in how many.
        breaks_at, jump, dip: share of the largest load, jump over the diameter, factor of the force for three readings.
        rows_after: readings after which half of the broken records end.
    """

    white_um: tuple[float, float] = (0.02, 0.05)
    force_mN: tuple[float, float] = (0.0, 0.03)
    wander_um: tuple[float, float] = (0.06, 0.15)
    strong_wander: float = 1.5
    usual_MPa: tuple[float, float] = (0.5, 2.0)
    length_MPa: tuple[float, float] = (1.0, 4.0)
    length_s: tuple[float, float] = (10.0, 60.0)
    scale_sd: float = 0.5
    scatter: dict[str, float] = field(default_factory=lambda: {"modulus": 0.10, "shape": 0.05})
    zero_um: float = 2.0
    steepest_um_per_mN: float = 5.0
    offset: tuple[float, float] = (0.01, 0.04)
    clipped_from: tuple[float, float] = (0.4, 0.8)
    broken: tuple[int, int] = (3, 4)
    breaks_at: tuple[float, float] = (0.4, 0.9)
    jump: tuple[float, float] = (0.05, 0.2)
    dip: tuple[float, float] = (0.5, 0.8)
    rows_after: tuple[int, int] = (5, 15)


@dataclass(frozen=True)
class Refitting:
    """How strengths are found.

    Attributes:
        step: of differences, in logarithms.
        zero_sd_um: prior standard deviation of each test's zero.
        least_spread: standard deviation that a spread has at least.
        rounds, halvings: of Gauss-Newton.
        settled: relative gain of a round below which it ends.
        close: relative error of lambda that is close enough, after `search` trials at most.
        weak: lambda up to which a signature counts as linear.
    """

    step: float = 1e-4
    zero_sd_um: float = 10.0
    least_spread: float = 1e-6
    rounds: int = 8
    halvings: int = 5
    settled: float = 0.004
    close: float = 0.015
    search: int = 9
    weak: float = 3.0


@dataclass(frozen=True)
class Baselines:
    """Oracle, stepwise AIC and smooth discrepancy.

    Attributes:
        names: most names that stepwise AIC adds.
        padded: particles to which tests are filled up, so that formulas compile once.
        lengths: correlation lengths of the discrepancy, over the range of its two coordinates.
        sizes: standard deviations of the discrepancy, over the particle's diameter.
        waves: cosines of the discrepancy along each coordinate.
        hyperparameters: nats that the discrepancy must gain for its two hyperparameters.
        draws, level: simulated nulls of the oracle, and its family-wise level of "anything at all".
        second: nats that the oracle's second name must gain.
        unlisted: tail probability of the oracle's remaining chi2 from which on no listed formula will do.
        followed, strong: formulas that the oracle follows to finite amplitudes, from this statistic on.
        reach, scanned: how far in the logarithm, and at how many amplitudes, it looks on either side of the linear one.
        combinations: formulas of a pair that `refit` fits at most.
    """

    names: int = 3
    padded: int = 60
    lengths: tuple[float, ...] = (0.1, 0.2, 0.4)
    sizes: tuple[float, ...] = (0.001, 0.003, 0.01, 0.03)
    waves: int = 8
    hyperparameters: float = 2.0
    draws: int = 2000
    level: float = 0.05
    second: float = 6.0
    unlisted: float = 1e-6
    followed: int = 6
    strong: float = 5.0
    reach: float = 2.5
    scanned: int = 10
    combinations: int = 9


@dataclass(frozen=True)
class Settings:
    """All choices of the bench."""

    testers: Testers = field(default_factory=Testers)
    refitting: Refitting = field(default_factory=Refitting)
    baselines: Baselines = field(default_factory=Baselines)
    drawing: Drawing = field(default_factory=Drawing)
    running: Running = field(default_factory=Running)
    scoring: Scoring = field(default_factory=Scoring)


SETTINGS = Settings()
