"""What an added effect takes over of the first model: a term that no longer explains what it explained before.

A thermometer that is wrong explains little. Where temperature has one profile in every run, an unknown function of the
time within a run then explains all of it, predicts hold-out data of that profile as well, and the coefficient of
temperature is left small, with the uncertainty of a model in which it does not matter: no residual shows it.

So a term of the first model is followed to the last. Of its columns, whitened, the part that the other columns leave
(its tolerance; Belsley, Kuh & Welsch, Regression Diagnostics, 1980, ch. 3) is compared with and without what was added
that depends on other columns; and its coefficient with where it stood.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.claim import Claim, limit
from bayescal._core.formatting import number
from bayescal._data.measurements import Measurements
from bayescal._model.effect import Effect
from bayescal._model.frame import strip_rate

LEFT_SHARE = limit("term.replaced", "left_share")
CORRECTED_SHARE = limit("term.replaced", "corrected_share")
MOVED_SD = limit("term.replaced", "moved_sd")


class TakenOver(NamedTuple):
    """A term of the first model, and what stands for it in the last."""

    term: Effect  # the first model's
    by: tuple[Effect, ...]  # effects that were added
    tolerance: float  # of its squares beside the first model's others, what these leave
    moved: float  # of its coefficient, former standard uncertainties
    ratio: float  # its coefficient, in parts of what it was
    runs: int  # how many the readings have
    another: str  # the run that would tell

    @property
    def measured(self) -> bool:
        """Return whether the last model's coefficient is still that of the term.

        A named effect is a cause of its own, and may well correct what the first model took for the term: it stands for
        the term if it halved the coefficient, or left next to nothing of it, and moved it beyond chance, which grows
        with 1/√(what is left). What has no name is no cause but a description: one that can take up the term describes
        it too, and where it moves the coefficient beyond chance, the readings do not tell which of both values it has.
        """
        # Estimates with and without further columns, whose effect is zero, differ by √(1/left − 1) former standard
        # uncertainties by chance (J. Hausman, Econometrica 46 (1978) 1251): below 1/√left.
        by_chance = self.moved**2 * min(self.tolerance, 1.0) <= MOVED_SD**2
        if self.unnamed:
            return by_chance and not self.confounded
        return by_chance or not (self.confounded or self.ratio < CORRECTED_SHARE)

    @property
    def unnamed(self) -> bool:
        """Return whether a description that may repeat from run to run was added."""
        return any(e.unnamed and e.along != "time" for e in self.by)

    @property
    def confounded(self) -> bool:
        """Return whether the readings hardly tell the term from what was added."""
        return self.tolerance < LEFT_SHARE

    @property
    def claim(self) -> Claim:
        """Return why the term's coefficient is not measured, or what its uncertainty holds."""
        by, column = tuple(e.name for e in self.by), self.term.varies
        details = {"by": by, "column": column, "left": self.tolerance}
        if self.measured:
            return Claim("term.confounded", self.term.name, **details)
        code = "term.replaced" if self.ratio < CORRECTED_SHARE else "term.replaceable"
        details |= {"cure": "runs" if self.runs > 1 else "one run", "another": self.another}
        return Claim(code, self.term.name, **details, kept=self.ratio, moved=self.moved)


def taken_over(
    first: Calibration, last: Calibration, latent: Collection[str] = ()
) -> list[TakenOver]:
    """Return terms of the first model that added effects may replace, the most shifted first."""
    had = {e.name for e in first.model.effects}.union(latent)
    added = [e for e in last.model.effects if e.name not in had]
    terms: list[TakenOver] = []
    for term in last.model.effects:
        if term.name not in first.model.names or term.shapes or len(term.coefficients) != 1:
            continue
        if not term.varies or term.coefficients[0].per:
            continue
        by = [e for e in added if not _own_columns(e) & _own_columns(term)]
        if by:
            terms.append(_followed(term, by, first, last))
    return sorted(terms, key=lambda taken: -taken.moved)


def _own_columns(effect: Effect) -> set[str]:
    """Return numeric columns that an effect depends on, without the time of lags and rates."""
    named = set(effect.varies) | (set(effect.columns) - {"time"})
    along = strip_rate(effect.along or "")
    return named | ({along} if along not in ("", "elapsed") else set())


def _followed(
    term: Effect, by: Sequence[Effect], before: Calibration, after: Calibration
) -> TakenOver:
    first, last = before.linear, after.linear
    is_term = np.array([owner == term.name for owner in last.owners])
    theirs = np.isin(last.owners, [e.name for e in by])
    others = np.isin(last.owners, first.owners) & ~is_term
    column = last.white_nuisance[:, is_term].sum(axis=1)
    # Tolerance beside the first model's others over that beside these and what was added: what the addition alone
    # took. Ridge regression by the priors' weights: c less what the others take of it, times c.
    both = others, others | theirs
    without, with_added = (float(column @ last.deflate(column, is_other)) for is_other in both)
    # Where its one coefficient stands, in the unit of its prior.
    i, j = first.owners.index(term.name), last.owners.index(term.name)
    m0, m1 = float(first.z[i] * first.sd[i]), float(last.z[j] * last.sd[j])
    ratio = abs(m1) / abs(m0) if m0 else np.inf
    tolerance, moved = with_added / max(without, 1e-300), abs(m1 - m0) / first.uncertainty(i)
    runs = len(after.readings.records.rows) if after.readings.has("time") else 1
    another = another_run(after, term.varies)
    return TakenOver(term, tuple(by), tolerance, moved, ratio, runs, another)


def repeated(readings: Measurements, column: str) -> bool:
    """Return whether a temperature has the same profile over time in all runs, two or more."""
    if not (readings.has("time") and readings.has(column)):
        return False
    if len(readings.records.rows) < 2:
        return False
    clock, values_of = readings["time"], readings[column]
    profiles = ((clock[r] - clock[r[0]], values_of[r]) for r in readings.records.in_time)
    ((first, first_values), *others), correlation = profiles, limit("profile.one", "correlation")
    for time, values in others:
        inside = time <= first[-1]
        if inside.sum() < 3 or np.ptp(values[inside]) == 0:
            return False
        other = np.interp(time[inside], first, first_values)
        if np.ptp(other) == 0 or np.corrcoef(other, values[inside])[0, 1] < correlation:
            return False
    return True


def claims_of_profiles(calibration: Calibration) -> list[Claim]:
    """Return a claim where all runs have one profile and the model changes within runs."""
    readings, model = calibration.readings, calibration.model
    thermal = [e for e in model.effects if "time" in e.columns or e.along == "elapsed"]
    warm = [n for n in sorted(model.columns) if readings.has(n) and readings.unit(n) == "degC"]
    warm = [n for n in warm if n != "temperature_point" and repeated(readings, n)]
    if not (thermal and warm):
        return []
    details = {"column": warm[0], "another": another_run(calibration, warm[:1])}
    return [Claim("profile.one", *(e.name for e in thermal), **details)]


def another_run(calibration: Calibration, columns: Sequence[str]) -> str:
    """Return which run would tell most: over the range of a temperature, from its other end."""
    column, *others = columns
    if others or column not in calibration.frame.rates:
        return f"Vary {' and '.join(columns)} otherwise in another run."
    values = calibration.readings[column]
    begins = np.median([values[rows][0] for rows in calibration.readings.records.in_time])
    ends = sorted((values.max(), values.min()), key=lambda end: -abs(begins - end))
    far, near = (number(float(end), 3) for end in ends)
    return f"One run of another profile would tell: from {far} to {near} °C and back."
