"""The numbers that decide a verdict, each with where it comes from, and those of the numerics, which decide nothing."""

from __future__ import annotations

from dataclasses import dataclass

from .._format import described


@dataclass(frozen=True)
class Decisions:
    """Prior odds, and what it takes to say something. Logarithms are natural.

    Attributes:
        level: a verdict other than NO_GAP needs a bootstrap p value below it: one false alarm in twenty campaigns.
        pair: log prior odds of one name against two, over the number of pairs: e^5 = 150; a second study of
            prototypes was right in 88 of 106 campaigns with it.
        margin: nats by which two names must lead everything with at most one: one more than the odds, since what a
            name's misfit leaves invites a second; 91 of the same 106, true pairs led by 12 to 482.
        unlisted: log prior odds of a listed name against a smooth discrepancy that no mechanism explains; beside a
            name it costs `pair`, too, as any second cause does.
        set_mass: names are reported, best first, until they hold this posterior probability together.
        misfit, misfit_log_sd, misfit_most: size of what a mechanism's formulas miss of its effect, median, standard
            deviation of the logarithm, and the most: 0.03 to 0.3 is what the library's own formulas leave of each
            other; with a size of 1 every mechanism imitates every other, and strong effects would have it.
        scatter: scale of the half-normal prior of how much an amplitude differs from particle to particle, as a share
            of it: toes need 0.1 (`misfit` and this are integrated out together).
        general, general_log_sd: size of a smooth discrepancy in standard deviations of white noise, likewise.
        jump: share of the tests in which a sudden step is expected, a priori: where it is looked for once more.
        contradicted: standard errors by which held-out particles must be predicted worse with what was found before it
            is taken back: beyond two a difference is hardly chance.
        readings: of a branch that are compared, about, of a material that the law was not made for: what the law
            misses there is each particle's own over a fifth of a branch, and a few readings in each such piece show it.
        foreign_misfit: share of the range of displacement that the law must miss for that; with its own data and a
            tester's noise it misses less.
    """

    level: float = 0.05
    pair: float = 5.0
    margin: float = 10.0
    unlisted: float = 5.0
    set_mass: float = 0.95
    misfit: float = 0.1
    misfit_log_sd: float = 0.8
    misfit_most: float = 0.3
    scatter: float = 0.1
    general: float = 3.0
    general_log_sd: float = 1.5
    jump: float = 0.25
    contradicted: float = 2.0
    readings: int = 24
    foreign_misfit: float = 0.01

    __repr__ = described()


@dataclass(frozen=True)
class Telling:
    """What is told beside a verdict; no verdict depends on it.

    Attributes:
        place: places of disagreement are told until they hold this share of it.
        lead: what remains beside a name is told if its log posterior odds exceed this.
        alike: correlation of projected signatures from which on two mechanisms look alike.
        detectable: estimate over standard error that is found with 95 % probability at the level: 1.645 for the
            probability, 2.95 for the best of as many mechanisms as there are.
        enough: probability of the right name alone from which on a further experiment is proposed without a doubt.
        even: the least with which one is proposed: particles are too dear for less than an even chance.
        one_term: share of what two terms of a formula explain from which on one term will do.
        jumps, checks: sudden steps and checks that a summary lists.
        within: so far over 1 the lower end of chi2 per point may lie where a gap is called closed.
    """

    place: float = 0.85
    lead: float = 3.0
    alike: float = 0.9
    detectable: float = 4.6
    enough: float = 0.9
    even: float = 0.5
    one_term: float = 0.9
    jumps: int = 5
    checks: int = 3
    within: float = 0.05


AT_PEAKS = "modulus_at_peaks_MPa"
"""In `discovery.json`, the modulus that acts at the peaks of the tests."""

POPULATION = 5
"""Numbers of the population, which come first among what all particles share: a, log modulus, means of b1, b3, b5."""

HYPERPARAMETERS = 8
"""Those of the base law: four of the noise, and the spreads of b1, b3, b5 and e."""


@dataclass(frozen=True)
class Numerics:
    """Grids, sizes and numbers of steps: finer ones cost time and change nothing that is told.

    Attributes:
        noise_factors, length_factors, spread_factors: settings of correlated noise and of spreads, over those of the
            base fit, at which all formulas are screened and a discrepancy on no list begins. Noise that swallowed a gap
            hides what explains it.
        block: particles that are linearised at once.
        contenders: mechanisms that are fitted at their own optimum.
        formulas: formulas of each of them where `very_strong`, else one; of the two leading ones up to `all_formulas`.
        seconds: second names that are tried beside each of the two leading names, and pairs that lead to first order.
        strong: nats by which a name must beat nothing before several of its formulas and second names are tried, and
            another kind or setting of noise the one at hand.
        very_strong: the same, from which on first order cannot be relied on to choose the formula; so far below another
            hypothesis a discrepancy that begins is not worked out.
        locations, phases: values tried of a number that differs from test to test: of a place somewhere between two
            that lie far apart, which must be met closely, and of a phase.
        steps, still: Gauss-Newton steps at most, and the change of the log posterior at which they end.
        flat, evaluations: slope of the log posterior, per expected standard deviation of a hyperparameter, at which its
            mode is reached (0.2 is 0.02 nats away), and iterations at most.
        aside: how far from there, in the same unit, slopes are compared for its curvature.
        drifts: drifts of every test's own that are fitted at their own optimum.
        little: factor on correlated noise that has swallowed a gap, where what explains it begins to be fitted.
        worse, early: nats by which each of so many first steps may make things worse before half of it is taken back;
            later ones by `still`.
        followed, agree: how often at most the prior of a misfit follows the amplitude of its formula, and the
            difference of their logarithms at which it need not.
        hats, degree: hat functions of each coordinate of a misfit, and total degree of smooth products.
        splines, fine_splines: cosines of each coordinate of a discrepancy that no mechanism explains, and of stress.
        columns, entries: columns that are freed of the noise at once, at least and at most, and about how many numbers
            they hold together, so that they stay in a processor's own memory.
        waves, drive_waves: periods that a periodic discrepancy may have over the range of travel and of time, and over
            that of micrometres, which is the widest among particles of several sizes.
        bootstrap: campaigns drawn for the p value.
        places: bins of load in which disagreement is looked for.
        thinned: places of a sudden step, in each test, in the bootstrap.
        jumps: sudden steps of one test at most.
        shares: points of the common path on which the residuals of two tests are multiplied.
        copies, particles: further particles that are tried in an experiment, over those of the campaign, and at most.
        turns: points that turning points may add to a programme's own.
    """

    noise_factors: tuple[float, ...] = (1.0, 0.4, 0.15, 0.05)
    length_factors: tuple[float, ...] = (1.0, 0.3)
    spread_factors: tuple[float, ...] = (1.0, 0.5)
    block: int = 8
    contenders: int = 5
    formulas: int = 2
    all_formulas: int = 8
    seconds: int = 3
    strong: float = 8.0
    very_strong: float = 50.0
    steps: int = 25
    still: float = 0.05
    flat: float = 0.2
    evaluations: int = 40
    aside: float = 0.1
    worse: float = 5.0
    early: int = 4
    drifts: int = 6
    little: float = 0.1
    locations: int = 32
    phases: int = 14
    followed: int = 4
    agree: float = 0.1
    hats: int = 8
    splines: int = 12
    fine_splines: int = 24
    degree: int = 2
    columns: tuple[int, int] = (6, 18)
    entries: int = 270_000
    waves: int = 12
    drive_waves: int = 26
    bootstrap: int = 400
    places: int = 5
    thinned: int = 24
    jumps: int = 3
    shares: int = 60
    copies: tuple[float, ...] = (0.5, 1, 2, 3, 5, 10)
    particles: int = 200
    turns: int = 16


DECISIONS = Decisions()
TELLING = Telling()
NUMERICS = Numerics()
