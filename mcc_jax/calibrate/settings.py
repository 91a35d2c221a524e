"""Every number that decides something in a calibration, with where it comes from.

They have been found by trial on simulated campaigns unless a source is named: `benchmarks/study_posterior.py` (whether
intervals cover), `study_modes.py` (fast against joint), `study_noise.py` and `bench_scale.py` repeat what they rest on.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperSettings:
    """What the paper's own steps leave out, and where they begin.

    Attributes:
        unloaded_from: points of unloading below this share of the peak stress are left out: strain there depends on
            stress with an infinite slope.
        smallest_share: a factor of the quintic is kept at least this share of the largest stress, so that its logarithm
            exists.
        spread_from: the spread of stress is fitted from so many thresholds on, 1 MPa in the paper.
        shape_factor: shape factors beyond this, twice the paper's largest, come from curves that do not collapse.
        reading_um: what no record of displacement is better than [um]: counted as misfit at every point, so that the
            noise of a record without any, of a simulation say, is small but not nothing.
    """

    unloaded_from: float = 0.05
    smallest_share: float = 1e-6
    spread_from: float = 5.0
    shape_factor: float = 4.0
    reading_um: float = 2e-4


@dataclass(frozen=True)
class SelectionSettings:
    """Which points and particles take part.

    Attributes:
        least_points: fewer usable points cannot carry three coefficients, a zero and their noise.
        most_points: longer records are thinned to about so many rows.
        climb: displacement must grow over loading by this many times its noise, or there is no curve to fit.
        turns_share: of records with more segments than one for so many rows that are kept, hundreds of cycles, whole
            cycles are left out: turning points that are always kept would be most of what is left.
        lengths: numbers of points that records are padded to, and beyond them in steps of the last: campaigns of
            similar length share one compilation.
    """

    least_points: int = 12
    most_points: int = 400
    climb: float = 8.0
    turns_share: int = 4
    lengths: tuple[int, ...] = (64, 128, 192, 320, 448)


@dataclass(frozen=True)
class FitSettings:
    """How particles, noise and population are fitted.

    Attributes:
        zeros, zero_reach: so many zeros of displacement are tried within this share of the effective diameter.
        variations: what is added to the linear start's b1, b3, b5 for further starts.
        steps, first_steps: most steps of a particle's fit, and how many all particles of many blocks take before the
            late ones go on by themselves.
        unseen: how many times the least sum of squares a fit without an unseen snap-through may leave, to be preferred.
        gain: log probability still to gain at which a fit is finished, where residuals are as large as the noise.
        alone: standard deviation of the logarithms that a particle by itself is allowed around the prior's centre.
        narrowest: least such standard deviation under the population: any smaller is badly scaled.
        noise_blocks: the noise of campaigns of more blocks is estimated from the particles of so many.
        rounds, most_rounds: how often noise, population and particles are taken in turn, at least, and at most where
            effects have to be linearised anew.
        still: log density still to gain at which effects are not linearised anew: a tenth of a standard deviation.
        halvings: how often a step of a model with effects is halved, at most, until it raises the density.
        widest: largest standard deviation of the logarithm of an effect's positive number over which the law's bend is
            taken: beyond, it is the correction by the exact likelihood that counts.
        steepest: largest shear or power of the coordinates of an effect's numbers (`straightening`).
        student_steps: how often weights of readings and noise are taken in turn, in each round.
        sharp: posterior standard deviation of the logarithm of a polynomial's coefficient below which one Newton step
            integrates a particle out.
        densities, densities_at_once: at how many coordinates the population's density is asked for in one go, and how
            many of them are worked out side by side, a part of the former without remainder.
        difference: step of differences of that density, in standard deviations: rounding and the next term of the
            series are both below 1e-4 of the curvature.
        mode_gain: twice the log probability still to gain, by Newton's method, at which the mode is reached.
        attempts: how often the search for the mode begins anew where it stopped.
        outlying: a particle whose noise differs by so many standard deviations keeps its own scale.
        shapes: values of a that least squares begins from besides the population's mode.
        open: a combination of shared parameters is open where its curvature, each scaled to its own, is smaller.
        least_spread: least standard deviation of log C in the residuals of least squares: with any smaller the problem
            is badly scaled.
    """

    zeros: int = 21
    zero_reach: float = 0.04
    variations: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0), (0.05, -0.1, 0.03), (-0.05, 0.06, -0.02))
    steps: int = 200
    first_steps: int = 10
    unseen: float = 4.0
    gain: float = 1e-6
    alone: float = 1.5
    narrowest: float = 1e-3
    noise_blocks: int = 4
    rounds: int = 2
    most_rounds: int = 20
    still: float = 0.005
    halvings: int = 8
    widest: float = 1.0
    steepest: float = 3.0
    student_steps: int = 4
    sharp: float = 0.03
    densities: int = 250
    densities_at_once: int = 10
    difference: float = 0.02
    mode_gain: float = 1e-6
    attempts: int = 4
    outlying: float = 5.0
    shapes: tuple[float, float] = (0.0, 2.5)
    open: float = 1e-3
    least_spread: float = 1e-4


@dataclass(frozen=True)
class SamplingSettings:
    """How the posterior is drawn, and when it counts as converged.

    Attributes:
        rhat, ess, pareto_k: the gate: R-hat at most, bulk ESS at least, Pareto k at most (Vehtari et al. 2021, 2024).
        freedom: degrees of freedom of the Student proposal: its tails are wider than the posterior's.
        rounds: how many distributions are proposed from, at most.
        enough: effective draws per coordinate that a distribution may be fitted to; their weights are tempered if need
            be.
        good_share: effective share of the proposed draws from which on no further distribution is fitted.
        nodes, newton, parts: where the first is not good enough, distributions around the most probable population at
            so many values on either side of each spread, a standard deviation apart, found in so many steps; each gets
            one part in so many of a trial.
        least: least effective number of proposed draws with which they are used; fewer, and NUTS runs.
        proposed: so many times as many effective draws as are kept are proposed, at most as many as all rounds would;
            of large campaigns, whose densities are dear, as many as are kept.
        trial: draws that a proposal is tried on, and fitted to; of large campaigns a quarter.
        accept: acceptance that NUTS aims at. Where spreads are small what all particles share is narrow (a funnel), and
            with fewer than some ten particles the usual 0.8 lets trajectories diverge there.
        fallback_accept, tree_depth: of NUTS where importance sampling failed. Around its mode, in coordinates scaled by
            the curvature there, a density that is near normal takes 15 leapfrog steps a draw; one that needs more than
            31 would take minutes, and shows in R-hat.
        restless, restless_of_many: a particle whose weight scatters by more than this share of its mean gets several
            candidates per draw; of many particles, whose weights are not applied, a mean is then wrong by at most this
            share of its standard deviation.
        candidates, candidates_of_many: how many a restless particle gets: first, and the few that scatter even then.
        few: how many restless particles get most candidates; of many particles one in a hundred.
        reach: every other candidate is drawn from a distribution so many times as wide: there lies what a summary is
            too narrow for.
        compared: up to so many draws of single particles every one is compared with the exact likelihood and the
            weights are applied; of larger campaigns some are, and the population is corrected by regression.
        probes: draws of the population at which the sum of all particles' log ratios is worked out for that.
        unsteady: most that a particle's log ratio may change over the posterior of many particles, which is narrow for
            one of them: what changes more gets more candidates, or does not count.
        lowest: log ratio that counts where the exact likelihood vanishes: differences of infinities say nothing.
        unsure: standard error of the correction, in standard deviations of the posterior, that a reader is told of.
        kept: at most so many draws of single particles are kept; of very large campaigns every n-th draw.
        curves, points: curves per chain and particle that are predicted for ArviZ, and most points of them all: of
            large campaigns the first particles only.
        points_draws: draws per chain kept where every point has a likelihood of its own.
    """

    rhat: float = 1.01
    ess: float = 400.0
    pareto_k: float = 0.7
    freedom: int = 10
    rounds: int = 6
    enough: int = 5
    nodes: int = 3
    newton: int = 4
    parts: int = 4
    good_share: float = 0.5
    least: float = 800.0
    proposed: float = 1.5
    trial: int = 4000
    accept: float = 0.99
    fallback_accept: float = 0.95
    tree_depth: int = 5
    restless: float = 0.3
    restless_of_many: float = 0.1
    candidates: tuple[int, ...] = (16, 32)
    candidates_of_many: tuple[int, ...] = (2, 16)
    few: int = 4
    reach: float = 3.0
    compared: int = 400_000
    probes: int = 25
    unsteady: float = 0.1
    lowest: float = -1e3
    unsure: float = 0.3
    kept: int = 4_000_000
    curves: int = 50
    points: int = 2_000_000
    points_draws: int = 250


@dataclass(frozen=True)
class JudgementSettings:
    """When an answer must not be called fine, a particle is unlike all others, and how much is done about it.

    Attributes:
        misfit: share of the range of displacement that the law misses with every particle's own coefficients; with the
            law's own data and a tester's noise it stays below 0.01.
        noise_share: share of the residual's variance that correlated noise holds: at half it is as large as read-out
            noise.
        outlying: a particle is unlike the others if the logarithm of its residual lies so many robust standard
            deviations (1.4826 times the median absolute deviation) above their median: of 1000 normal ones none does.
        times: and if its residual is so many times their median, at least: smaller differences do no harm.
        share: of the particles, at most, can be unlike all others; more are a mixture.
        least: particles, at least, to know what is usual.
        answers: so many sets of flagged particles are left out in turn to tell the answer without them, at most.
        few: flagged particles are left out for such an answer if they are at least this share of all: fewer than one
            in a hundred hardly move what all share, and the answer would cost a whole calibration of many particles.
        left: particles, at least, that an answer without the flagged ones rests on.
        unknown: the modulus counts as unknown if its standard deviation is at least this share of it: the 95 % interval
            then spans a factor of seven, nearly that of the prior (50), in which most solids lie.
    """

    misfit: float = 0.05
    noise_share: float = 0.5
    outlying: float = 5.0
    times: float = 3.0
    share: float = 0.2
    least: int = 5
    answers: int = 4
    few: float = 0.01
    left: int = 3
    unknown: float = 0.5


@dataclass(frozen=True)
class Numerics:
    """How many numbers are worked on at once: they change the time, and not the answer beyond rounding.

    Attributes:
        rows, rows_of_accelerators: single draws of single particles: a processor keeps no more in its cache.
        group: restless particles that are drawn together.
        side_by_side: pieces that draws are cut into on a CPU, on any number of cores.
        blocks: sizes of a campaign that is one block: those between are filled up, so that few sizes are compiled. The
            last is the most particles of a block: on a processor larger ones are no faster, smaller ones slower.
    """

    rows: int = 640
    rows_of_accelerators: int = 40_000
    group: int = 64
    side_by_side: int = 2
    blocks: tuple[int, ...] = (4, 8, 12, 16, 20, 24, 32, 40, 48, 64)


PAPER, SELECTION, FIT, SAMPLING = PaperSettings(), SelectionSettings(), FitSettings(), SamplingSettings()
JUDGEMENT, NUMERICS = JudgementSettings(), Numerics()
