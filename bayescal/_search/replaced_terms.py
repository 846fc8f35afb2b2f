"""Terms of the first model that added effects replace: collinearity and change of their coefficients.

If a thermometer is wrong and temperature has the same profile in every run, an unknown function of the time within a
run explains the full effect of temperature, and predicts hold-out data of that profile. The coefficient of temperature
is then nearly zero, with a small standard uncertainty, and the residuals do not show the error.

So each term of the first model is compared in the first and the last model, by two measures: its tolerance, the share
of its whitened columns that the other columns leave (Belsley, Kuh & Welsch, Regression Diagnostics, 1980, ch. 3), with
and without added effects of other columns; and its coefficient.
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

MIN_TOLERANCE = limit("term.replaced", "left_share")
MIN_RATIO = limit("term.replaced", "corrected_share")
MAX_SHIFT_SD = limit("term.replaced", "moved_sd")


class TermComparison(NamedTuple):
    """A term of the first model, compared with the same term in the last model."""

    term: Effect  # effect of the first model
    added: tuple[Effect, ...]  # effects added since
    tolerance: float  # ratio of its tolerances with and without the added effects
    shift: float  # change of its coefficient, standard uncertainties in the first model
    ratio: float  # its coefficient's magnitude in the last model over that in the first
    runs: int  # number of runs in the readings
    suggested_run: str  # the run that would separate the term from the added effects

    @property
    def is_measured(self) -> bool:
        """Return whether the last model's coefficient still measures the term.

        A named effect is a separate cause and may rightly change the coefficient. It replaces the term if the shift is
        significant (above a multiple of 1/√tolerance former standard uncertainties), and the coefficient is less than
        half its former value or nearly collinear with the effect. An unnamed effect has no physical interpretation:
        either a significant shift or near collinearity suffices, as it may describe the term itself.
        """
        # Estimates with and without further columns of zero effect differ by chance by √(1/tolerance − 1) former
        # standard uncertainties (J. Hausman, Econometrica 46 (1978) 1251): below 1/√tolerance.
        is_chance = self.shift**2 * min(self.tolerance, 1.0) <= MAX_SHIFT_SD**2
        if self.is_unnamed:
            return is_chance and not self.is_confounded
        return is_chance or not (self.is_confounded or self.ratio < MIN_RATIO)

    @property
    def is_unnamed(self) -> bool:
        """Return whether an effect without physical interpretation, not along time, was added."""
        return any(e.unnamed and e.along != "time" for e in self.added)

    @property
    def is_confounded(self) -> bool:
        """Return whether the term is nearly collinear with the added effects (low tolerance)."""
        return self.tolerance < MIN_TOLERANCE

    @property
    def claim(self) -> Claim:
        """Return the claim on the term: why its coefficient is not measured, or that it is confounded."""
        added_names, column = tuple(e.name for e in self.added), self.term.varies
        details = {"by": added_names, "column": column, "left": self.tolerance}
        if self.is_measured:
            return Claim("term.confounded", self.term.name, **details)
        code = "term.replaced" if self.ratio < MIN_RATIO else "term.replaceable"
        details |= {"cure": "runs" if self.runs > 1 else "one run", "another": self.suggested_run}
        return Claim(code, self.term.name, **details, kept=self.ratio, moved=self.shift)


def find_replaced_terms(
    first: Calibration, last: Calibration, latent: Collection[str] = ()
) -> list[TermComparison]:
    """Return terms of the first model that added effects may replace, the most shifted first."""
    first_effects = {e.name for e in first.model.effects}.union(latent)
    added = [e for e in last.model.effects if e.name not in first_effects]
    terms: list[TermComparison] = []
    for term in last.model.effects:
        if term.name not in first.model.names or term.shapes or len(term.coefficients) != 1:
            continue
        if not term.varies or term.coefficients[0].per:
            continue
        candidates = [e for e in added if not _list_own_columns(e) & _list_own_columns(term)]
        if candidates:
            terms.append(_compare_term(term, candidates, first, last))
    return sorted(terms, key=lambda term: -term.shift)


def _list_own_columns(effect: Effect) -> set[str]:
    """Return the numeric columns on which an effect depends, without the time for lags and rates."""
    columns = set(effect.varies) | (set(effect.columns) - {"time"})
    along = strip_rate(effect.along or "")
    return columns | ({along} if along not in ("", "elapsed") else set())


def _compare_term(
    term: Effect, added: Sequence[Effect], first_fit: Calibration, last_fit: Calibration
) -> TermComparison:
    first, last = first_fit.linear, last_fit.linear
    is_term = np.array([owner == term.name for owner in last.owners])
    is_added = np.isin(last.owners, [e.name for e in added])
    is_other_term = np.isin(last.owners, first.owners) & ~is_term
    column = last.white_nuisance[:, is_term].sum(axis=1)
    # Tolerance with the added effects over that without: residual of the column c on the others, times c (ridge).
    groups = is_other_term, is_other_term | is_added
    without, squares = (float(column @ last.deflate(column, is_other)) for is_other in groups)
    tolerance = squares / max(without, 1e-300)
    # Its one coefficient, less the prior mean, in its unit.
    i, j = first.owners.index(term.name), last.owners.index(term.name)
    first_mean, last_mean = float(first.z[i] * first.sd[i]), float(last.z[j] * last.sd[j])
    ratio = abs(last_mean) / abs(first_mean) if first_mean else np.inf
    shift = abs(last_mean - first_mean) / first.uncertainty(i)
    runs = len(last_fit.readings.records.rows) if last_fit.readings.has("time") else 1
    suggestion = suggest_run(last_fit, term.varies)
    return TermComparison(term, tuple(added), tolerance, shift, ratio, runs, suggestion)


def has_repeated_profile(readings: Measurements, column: str) -> bool:
    """Return whether a temperature has the same profile over time in all runs, two or more."""
    if not (readings.has("time") and readings.has(column)):
        return False
    if len(readings.records.rows) < 2:
        return False
    times, column_values = readings["time"], readings[column]
    profiles = ((times[r] - times[r[0]], column_values[r]) for r in readings.records.in_time)
    ((first, first_values), *others), correlation = profiles, limit("profile.one", "correlation")
    for time, values in others:
        is_inside = time <= first[-1]
        if is_inside.sum() < 3 or np.ptp(values[is_inside]) == 0:
            return False
        profile = np.interp(time[is_inside], first, first_values)
        if np.ptp(profile) == 0 or np.corrcoef(profile, values[is_inside])[0, 1] < correlation:
            return False
    return True


def list_profile_claims(calibration: Calibration) -> list[Claim]:
    """Return a claim if all runs have one temperature profile and the model has effects of time or lag."""
    readings, model = calibration.readings, calibration.model
    effects = [e for e in model.effects if "time" in e.columns or e.along == "elapsed"]
    columns = [n for n in sorted(model.columns) if readings.has(n) and readings.unit(n) == "degC"]
    columns = [n for n in columns if n != "temperature_point" and has_repeated_profile(readings, n)]
    if not (effects and columns):
        return []
    details = {"column": columns[0], "another": suggest_run(calibration, columns[:1])}
    return [Claim("profile.one", *(e.name for e in effects), **details)]


def suggest_run(calibration: Calibration, columns: Sequence[str]) -> str:
    """Return advice on the run that best separates effects of columns: one that starts at the other temperature."""
    column, *other_columns = columns
    if other_columns or column not in calibration.frame.rates:
        return f"Vary {' and '.join(columns)} independently in another run."
    values = calibration.readings[column]
    start = np.median([values[rows][0] for rows in calibration.readings.records.in_time])
    ends = sorted((values.max(), values.min()), key=lambda end: -abs(start - end))
    far_end, near_end = (number(float(end), 3) for end in ends)
    return f"Another profile would separate them: a run from {far_end} to {near_end} °C and back."
