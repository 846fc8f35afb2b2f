"""What the panels of "where it fails" draw, as plain arrays: one source of rows for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bayescal._calibration.check import covariates_of
from bayescal._calibration.check_result import Check, place_in_words
from bayescal._data.unit_conversion import unit_label
from bayescal._workbench.parts.gaps import CutAxis
from bayescal._workbench.parts.style import MARKERS, Palette

AGAINST = "predicted output"  # over which the output is measured against predicted
TIME = "time"  # the column whose long gaps are left out


@dataclass(frozen=True)
class ResidualsOfState:
    """A state's residuals with everything that they can be laid against.

    Attributes:
        step: the state's fit with its check.
        before: residuals of the step that it is compared with, output unit, (n,); None where there is none.
    """

    step: Any
    before: np.ndarray | None

    @property
    def check(self) -> Check:
        return self.step.check

    @cached_property
    def residual(self) -> np.ndarray:
        return np.asarray(self.check.residuals, float)

    @cached_property
    def unit(self) -> str:
        return unit_label(self.check.unit)

    @cached_property
    def measured(self) -> np.ndarray:
        readings = self.step.calibration.readings
        return np.asarray(readings[readings.output], float)

    @cached_property
    def _columns(self) -> list[Any]:
        return covariates_of(self.step.calibration)

    @cached_property
    def covariates(self) -> Mapping[str, np.ndarray]:
        """(n,) each, by name; a group's members as numbers 0, 1, …; at last what the model predicts."""
        columns = {c.name: np.asarray(c.values, float) for c in self._columns}
        return {**columns, AGAINST: self.measured - self.residual}

    @cached_property
    def cut(self) -> CutAxis | None:
        """The axis of time; None without one."""
        return CutAxis.of(self.covariates[TIME]) if TIME in self.covariates else None

    @cached_property
    def places(self) -> Mapping[str, np.ndarray]:
        """(n,) each: where readings stand on the axis of a covariate."""
        cut = {} if self.cut is None else {TIME: self.cut.place(self.covariates[TIME])}
        return {**self.covariates, **cut}

    @cached_property
    def units(self) -> Mapping[str, str]:
        return {**{c.name: unit_label(c.unit or "") for c in self._columns}, AGAINST: self.unit}

    @cached_property
    def levels(self) -> Mapping[str, tuple[str, ...]]:
        """Members of the groups among them."""
        return {c.name: c.levels for c in self._columns if c.levels}

    @property
    def numbers(self) -> dict[str, tuple[np.ndarray, str]]:
        """Values (n,) and unit of every column that a region can be given in."""
        return {n: (v, self.units[n]) for n, v in self.covariates.items() if n not in self.levels}

    def same_readings(self, other: ResidualsOfState) -> bool:
        """Whether another state is of the same readings, with the same columns to lay residuals against."""
        own, others = self.covariates, other.covariates
        same = self.measured is other.measured or np.array_equal(self.measured, other.measured)
        return (
            same
            and [*own] == [*others]
            and (self.units, self.levels, self.runs[0])
            == (other.units, other.levels, other.runs[0])
            and np.array_equal(self.runs[1], other.runs[1])
            and all(np.array_equal(own[n], others[n]) for n in own if n != AGAINST)
        )

    def worst(self, name: str) -> tuple[float, float] | None:
        """Where the worst region over a covariate begins and ends on its axis; None without evidence of one."""
        entry = next((e for e in self.check.entries if e.against == name), None)
        if entry is None or entry.log_bayes_factor <= 0:
            return None
        low, high = entry.worst.low, entry.worst.high
        if entry.by_group:
            low = high = float(self.levels[name].index(str(entry.worst.group)))
        if name == TIME and self.cut is not None:
            low, high = map(float, self.cut.place(np.array([low, high])))
        wide = 0.02 * float(np.ptp(self.places[name])) if low == high else 0.0
        return low - wide, high + wide

    @cached_property
    def runs(self) -> tuple[tuple[str, ...], np.ndarray]:
        return self.step.calibration.readings.groups("run")

    def colours(self, palette: Palette) -> np.ndarray:
        """A colour a reading, by run."""
        cycle = np.array(palette.cycle)
        return cycle[self.runs[1] % len(cycle)]

    def markers(self) -> np.ndarray:
        """A shape a reading, by run: colour is never the only thing that tells them apart."""
        return np.array(MARKERS)[self.runs[1] % len(MARKERS)]

    def start(self, count: int = 2) -> list[str]:
        """What is shown first: the continuous covariates with the strongest evidence, in the order of the columns."""
        ranked = [e.against for e in self.check.entries if not e.by_group]
        chosen = ranked[:count] or [n for n in self.covariates if n != AGAINST][:count]
        return [n for n in self.covariates if n in chosen] or [AGAINST]

    def sentence(self) -> str:
        """The worst region of the strongest covariate, in a sentence."""
        worst = max(self.check.entries, key=lambda e: e.log_bayes_factor, default=None)
        if worst is None:
            return "No column varies: there is nothing to lay the residuals against."
        rms = f"Residuals {self.check.rms:.3g} {self.unit} rms, noise {self.check.noise:.3g} {self.unit}. "
        if worst.log_bayes_factor < 0:
            return rms + "No column says anything of them: no log Bayes factor is above zero."
        side = "positive" if worst.worst.size > 0 else "negative"
        return (
            f"{rms}Against {worst.against} they are systematically {side}: {worst.worst.size:+.3g} {self.unit} on "
            f"average, {place_in_words(worst)} (z = {worst.worst.z:+.1f}; log Bayes factor "
            f"{worst.log_bayes_factor:.1f})."
        ).replace("-", "−")
