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
        fewest_for_noise: readings from which a noise law can be told at all: a fourth moment is then known to a half.
    """

    found: float = 0.95
    lead: float = 0.2
    shown: float = 0.01
    nothing: float = 0.5
    unknown_share: float = 0.1
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
    fewest_for_noise: int = 30


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
    moved: float = 4.0


def searching() -> SearchSettings:
    """The settings of searches that hold here."""
    return in_force(SearchSettings)


def guarding() -> GuardSettings:
    """The settings of guards that hold here."""
    return in_force(GuardSettings)
