"""The numbers that decide a verdict, each with where it comes from, and those that several modules share."""

from __future__ import annotations

from dataclasses import dataclass

from .._format import described


@dataclass(frozen=True)
class Decisions:
    """Prior odds, and the evidence that an answer needs. Logarithms are natural."""

    # A verdict other than NO_GAP needs a bootstrap p value below it: one false alarm in twenty campaigns.
    level: float = 0.05
    # Log prior odds of one name against two, over the number of pairs: e^5 = 150. With it, and the margin by which two
    # names must lead (what a name's misfit leaves invites a second), prototypes were right in 88 to 91 of 106 cases.
    pair: float = 5.0
    margin: float = 10.0
    unlisted: float = 5.0  # log prior odds of a name against a discrepancy that none explains; together also `pair`
    set_mass: float = 0.95  # names are reported, best first, until they hold this posterior probability together
    # Share of its effect that a mechanism's formulas miss, median, sd of the logarithm, and the most: the library's own
    # leave 0.03 to 0.3 of each other; with a size of 1 every mechanism imitates every other.
    misfit: float = 0.1
    misfit_log_sd: float = 0.8
    misfit_most: float = 0.3
    scatter: float = 0.1  # scale of how much amplitudes differ between particles, as a share: toes need so much
    general: float = 3.0  # size of a smooth discrepancy in standard deviations of white noise, and sd of its logarithm
    general_log_sd: float = 1.5
    jump: float = 0.25  # share of the tests in which a sudden step is expected
    contradicted: float = 2.0  # standard errors by which held-out particles are predicted worse: hardly chance
    # Of a material that the law was not made for, readings of a branch that are compared: its misfit is smooth over a
    # fifth of one; and the share of the range of displacement that the law must miss: with its own it misses less.
    readings: int = 24
    foreign_misfit: float = 0.01

    __repr__ = described()


DECISIONS = Decisions()

UNLISTED = ("UNLISTED",)  # in place of the names of mechanisms: a discrepancy that none explains
AT_PEAKS = "modulus_at_peaks_MPa"  # in `discovery.json`: the modulus that acts at the peaks of the tests
POPULATION = 5  # numbers of the population, which come first in what particles share: a, log modulus, b1, b3, b5
HYPERPARAMETERS = 8  # of the base law: four of the noise, and the spreads of b1, b3, b5 and e

# Nats by which a name must beat nothing before several of its formulas and second names are tried, and another kind or
# setting of noise the one at hand.
STRONG = 8.0
# The same, from which on first order cannot be relied on to choose the formula; a discrepancy that begins so far below
# another hypothesis is not computed.
VERY_STRONG = 50.0

# Settings of correlated noise, over those of the base fit, at which all formulas are screened and a discrepancy on no
# list begins: noise that swallowed a gap hides what explains it.
NOISE_FACTORS = 1.0, 0.4, 0.15, 0.05
LENGTH_FACTORS = 1.0, 0.3

CONTENDERS = 5  # mechanisms fitted at their own optimum, and hypotheses that are compared on held-out particles
EARLY = 4  # Gauss-Newton steps that first order from an amplitude of zero may mislead

# Estimate over standard error that is found with 95 % probability at the level: 1.645 for the probability, 2.95 for
# the best of as many mechanisms as there are.
DETECTABLE = 4.6
ENOUGH = 0.9  # probability of the right name alone from which on a further experiment is proposed without a doubt
WITHIN = 0.05  # so far over 1 the lower end of chi2 per point may lie where a gap is called closed
