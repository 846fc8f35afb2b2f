"""When to calibrate again: the time at which the probability of conformity falls below a stated one.

What a model says of the future is what changes in it with the time of the record: a drift, whose rate is known from
runs that lie apart, so that a value and its uncertainty go on growing after the last reading. Runs differ by a
deviation that is as large tomorrow as it was during the calibration: it lowers the probability everywhere, and sets no
date. Where nothing in the model changes with time, there is no answer, and the reason is said.
Source: ILAC-G24/OIML D 10:2022 leaves the method to the laboratory; this one states its probability.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.mixture import inclusion
from bayescal._model.departure import Departure
from bayescal._model.effect import Effect
from bayescal._model.unknown_effect import covariate_in
from bayescal._use.conformity import Limits
from bayescal._use.limited_quantity import LimitedQuantity

DAY = 86400.0
YEAR = 365.25 * DAY
# Where the search ends: a horizon and no claim; beyond it only "not within 10 years" is said.
HORIZON = 10 * YEAR
FIRST = 60.0  # s, the first time looked at, shorter than any interval between calibrations
TIMES = 160  # looked at, evenly in the logarithm: each is 1.13 times the one before
STEPS = 50  # of bisection between two of them
FAR = 3.0  # spans of the record beyond which a drift is extrapolated so far that it is said

ADVICE = (
    "For a recalibration interval, calibrate in runs that lie weeks apart, with their time, and let the model hold a "
    "drift, such as bias.drift."
)


@dataclass(frozen=True)
class Recalibration:
    """When the probability of conformity falls below a stated one.

    Attributes:
        stated: the probability.
        after: s after the last reading of the calibration; None where it does not fall within the horizon, or
            that cannot be said.
        date: of that time, ISO 8601, where the readings have dates.
        why_not: why there is no time; empty where there is one.
        notes: what to know, each a sentence.
    """

    stated: float
    after: float | None
    date: str | None = None
    why_not: str = ""
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.after is None:
            return self.why_not
        if self.after == 0:
            return f"the probability of conformity is below {self.stated:g} already"
        when = f", {self.date}" if self.date else ""
        return (
            f"the probability of conformity falls below {self.stated:g} {in_words(self.after)} after the last "
            f"reading{when}"
        )


def recalibration(
    quantity: LimitedQuantity, limits: Limits, calibration: Calibration, stated: float
) -> Recalibration:
    """When the probability of conformity falls below a stated one, by the drift in the model.

    Args:
        quantity: that is limited.
        limits: of it, in its unit.
        calibration: whose last reading the time counts from.
        stated: the probability.
    """
    if reason := _no_answer(quantity, calibration, stated):
        return Recalibration(stated, None, why_not=reason, notes=(ADVICE,) * bool(quantity.place))

    def probability(later: float) -> float:
        return quantity.drawn(later).probability(limits)

    after = first_below(probability, stated)
    if after is None:
        years = HORIZON / YEAR
        return Recalibration(
            stated, None, why_not=f"not within {years:g} years by the drift that the model holds"
        )
    time = calibration.readings["time"]
    span = float(np.ptp(time))
    notes = []
    if after > FAR * span:
        notes.append(
            f"The drift is extrapolated to {after / span:.0f} times the {in_words(span)} of the record, as if it "
            "went on as it was: calibrate again sooner to see whether it does."
        )
    since, date = calibration.readings.since, None
    if since is not None:
        begin = datetime.fromtimestamp(since, UTC)
        date = (begin + timedelta(seconds=float(time.max()) + after)).date().isoformat()
    return Recalibration(stated, after, date, notes=tuple(notes))


def first_below(probability: Callable[[float], float], stated: float) -> float | None:
    """The first time, s, from which a probability is below a stated one; None where it is so nowhere up to the horizon.

    A fall and rise between two of the times looked at, each 1.13 times the one before, is not seen.
    """
    if probability(0.0) < stated:
        return 0.0
    before = 0.0
    for time in np.geomspace(FIRST, HORIZON, TIMES):
        if probability(float(time)) < stated:
            above, below = before, float(time)
            for _ in range(STEPS):
                middle = 0.5 * (above + below)
                above, below = (middle, below) if probability(middle) >= stated else (above, middle)
                if below - above <= 1e-6 * below:
                    break
            return above
        before = float(time)
    return None


def _no_answer(quantity: LimitedQuantity, calibration: Calibration, stated: float) -> str:
    """Why the model says nothing of the future; empty where it does."""
    name = quantity.limit.quantity
    if not quantity.place:
        return f"{name} is one number of the model, which holds no change of it in time"
    if not quantity.follows_time:
        return f"the model cannot say when: nothing in it that acts on {name} changes with the time of the record"
    # What is less probable than a failure at the stated probability cannot decide about the date.
    shares = inclusion(calibration)
    likely = (e for e in calibration.model.effects if shares[e.name] > 1 - stated)
    forms = [e.name for e in likely if _describes_the_record(e)]
    if forms:
        return f"the model cannot say when: {forms[0]} describes the record and is no law of what comes after it"
    return ""


def _describes_the_record(effect: Effect) -> bool:
    """Whether an effect is a form in time that the readings drew, which ends with them."""
    if isinstance(effect, Departure):
        return effect.along == "time"
    return (covariate_in(effect.name) or "").startswith("time")


def in_words(seconds: float) -> str:
    """A duration in the unit in which people say it."""
    for size, name in ((YEAR, "years"), (DAY, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s"
