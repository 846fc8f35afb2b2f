"""The numbers that decide what is found, doubted or refused: each with its unit, its reason, and where that is from.

They hold for everything that runs inside `with use_settings(SearchSettings(found=0.99)):`; what differs from the usual
ones is written into `result.json`. Those of what is asked of a record before a fit are `RecordSettings`, those of when
draws are trusted `SamplingSettings`.
"""

from __future__ import annotations

from dataclasses import dataclass

from bayescal._core.settings_in_force import OutcomeSettings, in_force


@dataclass(frozen=True)
class SearchSettings(OutcomeSettings):
    """What a search holds for missing, and how far it looks.

    Attributes:
        found: probability from which an effect, or one of a set, is said to be missing: odds of 19, the level of every
            interval here.
        lead: probability from which what is not found is named as a lead: odds of 1 to 4, worth a further run.
        shown: probability from which a noise law is printed.
        nothing: prior probability that the model is complete: neither answer is favoured (docs/mathematics.md).
        unknown_share: of the prior weight of what is missing, for what no named effect describes: a formula that is
            known beforehand is likelier than one that is not.
        matters: of the noise, rms, that a description without a name may explain, and the model still count as
            complete: it makes the noise by a fiftieth larger.
        averaged: probability from which a structure takes part in the average: all others together move a standard
            uncertainty by less than the digits that are printed.
        alike: cosine of two fitted contributions from which they are one to these readings: 0.95 leaves a tenth of
            the squares to tell them apart by.
        power: share of repeated campaigns in which an effect of the minimum detectable size would be found; the usual
            0.8 of the design of experiments (J. Cohen, Statistical Power Analysis, 1988).
        visible: share of an effect's information that nuisances leave, below which a plausible size must still be seen.
        detectable: plausible sizes that an effect would need to be seen, beyond which this experiment cannot test it;
            a plausible size is known to an order of magnitude.
        beam: most probable structures whose neighbours are looked at before the walk ends; with 4 it finds what
            enumeration finds in tests/search/test_structures.py.
        near: nats behind the best, up to which a structure is refitted: e⁻⁶ = 0.0025, a quarter of a hundredth.
        refitted: neighbours that are refitted of each structure looked at, at least and at most.
        pairs: of effects among them, for those that show together alone.
        other_law: nats behind the best, from which a structure under another noise law is not refitted.
        finer_noise: whether sums of noise terms are weighed where correlated noise is probable. On the chamber ramp
            they open gates which one Ornstein–Uhlenbeck process leaves shut; searches of thousands of readings take
            three to five times as long, those of hundreds as long as without.
        strong: nats from which a log Bayes factor is evidence: odds of twenty (Kass and Raftery, J. Am. Stat. Assoc. 90
            (1995) 773).
        very_strong: nats from which it settles a question: odds of a hundred and fifty (likewise).
        factors: on a candidate's plausible size, which is known to an order of magnitude, and their prior
            probabilities: real coefficients on the chamber ramp stood 3 to 8 such sizes out.
        drawn: of the probability of the likeliest noise law of a sensor at rest, from which another one has its share
            of the draws; a tenth of them would be too few for figures of its own.
        neighbours: standard deviations by which the correlation of neighbouring readings must leave that of readings
            farther apart, before noise of neighbours alone (rounding, or the sensor's own averaging) is tried.
        line: and that a frequency must stand above its neighbours in a record's spectrum, before a tone is tried.
        sure: of either, before every sum is given that term; the best one is weighed without it all the same.
        worth: of a standard uncertainty, that a campaign must take off to be worth it: no printed digit moves below.
        simple: share of a free curve's variance, from which a simple formula will do for it.
        narrow: of a covariate's range, below which a selection of readings is said to lie at part of it.
        stands_for: of what the best dependence explains in a selection, that another must explain to stand for it.
        fewest_for_noise: readings from which a noise law can be told at all: a fourth moment is then known to a half.
        determined: information on a combination of coefficients, in units of its prior's, that poses to add must come
            to: its standard deviation is then below 0.7 of the prior's.
        plainer: of the log volume that the best pose takes off, from which one that is easier to set does as well.
    """

    found: float = 0.95
    lead: float = 0.2
    shown: float = 0.01
    nothing: float = 0.5
    unknown_share: float = 0.1
    matters: float = 0.2
    averaged: float = 0.01
    alike: float = 0.95
    power: float = 0.8
    visible: float = 0.01
    detectable: float = 10.0
    beam: int = 4
    near: float = 6.0
    refitted: tuple[int, int] = (2, 10)
    pairs: int = 4
    other_law: float = 100.0
    finer_noise: bool = True
    strong: float = 3.0
    very_strong: float = 5.0
    factors: tuple[tuple[float, float], ...] = ((1.0, 0.6), (3.0, 0.3), (10.0, 0.1))
    drawn: float = 0.1
    neighbours: float = 2.0
    line: float = 4.5
    sure: float = 6.0
    worth: float = 0.05
    simple: float = 0.97
    narrow: float = 0.8
    stands_for: float = 0.5
    fewest_for_noise: int = 30
    determined: float = 1.0
    plainer: float = 0.5


@dataclass(frozen=True)
class GuardSettings(OutcomeSettings):
    """What keeps a result from being used as it is.

    Attributes:
        unlikely: probability that the model is complete, below which it is not to be used as it is.
        correlated_z: standard deviations of the lag-1 autocorrelation, above which noise is not what its law says; one
            record in 30,000 by chance.
        correlated: the coefficient itself, below which it changes no standard uncertainty by more than a tenth.
        rare: p-value of a test that asks once for each covariate and in every step: hundreds in one session.
        significant: p-value of the tests without a Bayes factor.
        one_sided: p-value of one side, whose fourth power is about that of both sides at once.
        outlier: leave-one-out standard deviations, of which a thousand normal readings have none.
        same_covariate: rank correlation from which two covariates are taken for one.
        within: of the squares of a step between runs, that lie within runs where it is one between them.
        worse: error against that of an earlier step, or of other coefficients, above which it matters: below a
            twentieth no use of a result changes.
        chance: p-value below which hold-out data contradict a result, two or three tests of it each time, so that
            chance refuses a few right results in a hundred; `python -m benchmarks holdout` counts them.
        expected: times the scatter that a model expects of hold-out data, beyond which they are of something else.
        surprised: times what the other groups expect of one, beyond which it is not like them.
        conflict: prior standard deviations from the prior's mean, beyond which readings and prior contradict each
            other.
        off_scale: of the noise: what contributes less or more at a plausible size is in a wrong unit.
        free: times a plausible size, which is none any more.
        sizes: times a candidate's plausible size, which is known to an order of magnitude.
        wider: contraction below which the posterior is wider than the prior can be.
        modes_apart: standard deviations between two modes, from which one does not describe the other.
        modes_nearly: nats between two modes, below which one does not stand for both.
        records: lengths of the record, beyond which no time constant can be told.
        left: of a term's squares that what was added leaves to it, below which its variance grows tenfold (a variance
            inflation factor of 10: D. Belsley, E. Kuh and R. Welsch, Regression Diagnostics, 1980).
        corrected: of a coefficient's former value: a correction leaves more than this while the term stays what it was.
        still_depends: nats by which residuals may depend on a covariate, and the model still be used: twice what is
            very strong, since the largest of many covariates counts.
        weak: information against the prior's, below which a direction of coefficients counts as not measured: the
            posterior's standard deviation is then 0.95 of the prior's.
        unmeasured: of a coefficient's unit vector within such directions, above which it is not measured at all.
        concerned: of a direction's squared length, from which a coefficient is named in it.
        tied: expected lag-1 autocorrelation, from which neighbours are what the fit leaves, such as two about a free
            level, and say nothing of the noise.
        farthest: share of the readings, those farthest from the model, whose signs are tested.
        in_order: share of the steps of an input to a value that come from one value, above which it goes through its
            values in one order: of ten such steps one may be another.
        few_in_group: readings, below which a group's error is a matter of chance: it is three times too large once in
            10⁷ groups of 5.
        run_region: readings that a run needs for a region of its own where a model fails.
        of_a_law: coefficients of an effect; more of them stand for a function, whose values are not sizes of a law.
        filter_quantile: of the posterior of N and K, that a filter is given: noise taken as too small makes it
            overconfident.
        filter_reaches: of the law's Allan deviation, that a filter's two terms must reach at every averaging time.
        event: times the usual change between neighbouring averages at rest, beyond which one is an event and no noise:
            of thirty that are normal, the largest reaches it once in ten thousand records.
        bent: of the noise, by which a response may depart from its linearisation at plausible sizes.
        back: standard deviations from what was simulated, beyond which a coefficient has not come back.
        identifiable: contraction below which a coefficient is not; two that are one have a half each.
        moved: former standard uncertainties of a coefficient, beyond which chance does not move it.
    """

    unlikely: float = 0.05
    correlated_z: float = 4.0
    correlated: float = 0.1
    rare: float = 1e-5
    significant: float = 1e-3
    one_sided: float = 0.12
    outlier: float = 4.0
    same_covariate: float = 0.95
    within: float = 0.05
    worse: float = 1.05
    chance: float = 0.01
    expected: float = 2.0
    surprised: float = 3.0
    conflict: float = 4.0
    off_scale: tuple[float, float] = (1e-6, 1e6)
    free: float = 1e3
    sizes: float = 10.0
    wider: float = -1.0
    modes_apart: float = 3.0
    modes_nearly: float = 3.0
    records: float = 10.0
    left: float = 0.1
    corrected: float = 0.5
    still_depends: float = 10.0
    weak: float = 0.1
    unmeasured: float = 0.99
    concerned: float = 0.1
    tied: float = 0.99
    farthest: float = 0.1
    in_order: float = 0.9
    few_in_group: int = 5
    run_region: int = 8
    of_a_law: int = 2
    filter_quantile: float = 0.95
    filter_reaches: float = 0.95
    event: float = 7.0
    bent: float = 0.1
    back: float = 4.0
    identifiable: float = 0.6
    moved: float = 4.0


def searching() -> SearchSettings:
    """The settings of searches that hold here."""
    return in_force(SearchSettings)


def guarding() -> GuardSettings:
    """The settings of guards that hold here."""
    return in_force(GuardSettings)
