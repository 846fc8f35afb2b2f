"""An instrument of the benchmark of faulty records: its simulator, hidden effects, truth, and roles of its columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._model.frame import name_reference
from benchmarks.hidden_effects.bank import instrument_named

Columns = dict[str, np.ndarray]  # a file: each column's cells, in the order of the rows
LATER = 500_000  # added to the seed of the second campaign


@dataclass(frozen=True)
class Campaign:
    """A record, a second one that tests the result, and what is true of both.

    Attributes:
        record, holdout: columns of each.
        units: units of the numeric columns.
        hidden: effects hidden in both, with sizes.
    """

    record: Columns
    holdout: Columns
    units: dict[str, str]
    hidden: dict[str, float]


@dataclass(frozen=True)
class Shift:
    """A coefficient of the model, and the change of the output per unit of it.

    Attributes:
        names: names of the coefficient, or of all members of its group, which change alike.
        size: its prior standard deviation; for an instrument with sizes from the readings, the true value.
        column: function from the columns of a file to the change of the output.
    """

    names: tuple[str, ...]
    size: float
    column: Callable[[Columns], np.ndarray]


@dataclass(frozen=True)
class Subject:
    """An instrument of the benchmark.

    Attributes:
        name: name of the instrument.
        hidden: effects that are hidden in turn, with sizes.
        true: true coefficients of every campaign; those of polynomials about `T0`.
        drawn: function from the seed and the hidden effects to true coefficients drawn for each campaign.
        exact: hidden effects whose law is the catalogue's, and the coefficient's true value per unit of size; the
            coefficients of other hidden effects are not judged.
        noise: standard deviation of a reading, output unit.
        zero, slope: coefficients that a device may have far from nominal.
        thermometer: column with the model's temperature.
        partner: numeric column that could be mistaken for the thermometer's; empty if there is none.
        sibling: second thermometer of the unit; empty if there is none.
        input: column of the known input, which would show a wrong unit or sign; empty if there is none.
        group: column of labels whose members are separate records in time.
        polynomials: names of constant, line, quadratic … in the thermometer's temperature, a tuple per slot.
        T0: temperature about which the true coefficients are, °C.
        lag: a thermal lag that can be hidden; empty if there is none.
        wrong_unit: factor between another unit of the known input and its own; 1 if there is none.
        sign: whether a known input determines the output's sign.
        one_unit: whether a second campaign is of the same unit only if it is taken at the same time.
        options: options of the simulator.
    """

    name: str
    hidden: tuple[tuple[str, float], ...]
    true: Mapping[str, float]
    exact: Mapping[str, Mapping[str, float]]
    noise: float
    zero: Shift
    slope: Shift
    thermometer: str = "temperature"
    partner: str = ""
    sibling: str = ""
    input: str = ""
    group: str = "run"
    polynomials: tuple[tuple[str, ...], ...] = ()
    T0: float = 0.0
    lag: str = ""
    wrong_unit: float = 1.0
    sign: bool = False
    one_unit: bool = False
    options: Mapping[str, Any] | None = None
    drawn: Callable[[int, Mapping[str, float]], dict[str, float]] = lambda seed, hidden: {}

    @property
    def instrument(self) -> bc.Instrument:
        return instrument_named(self.name)

    def campaign(self, seed: int, hidden: Mapping[str, float] | None = None) -> Campaign:
        """Simulate a record with these effects, or with one of the subject's own in every second seed."""
        if hidden is None:
            turn = (seed - 1) // 2 % len(self.hidden)
            hidden = dict([self.hidden[turn]]) if seed % 2 else {}
        if self.one_unit:
            record, holdout = _halves(self._simulated(seed, hidden))
        else:
            record, holdout = (self._simulated(s, hidden) for s in (seed, seed + LATER))
        units = {n: u for n in record.columns if (u := record.unit(n)) is not None}
        arrays = ({n: np.array(r[n]) for n in r.columns} for r in (record, holdout))
        return Campaign(*arrays, units=units, hidden=dict(hidden))

    def _simulated(self, seed: int, hidden: Mapping[str, float]) -> bc.Measurements:
        simulate = self.instrument.simulate
        assert simulate is not None
        return simulate(dict(hidden), seed=seed, **(self.options or {}))

    def loud(self, effect: str, times: float) -> dict[str, float]:
        """Return an effect at the size at which the rms of its contribution is so many times the noise."""
        size = dict(self.hidden).get(effect, 1.0)
        without, with_effect = (self._simulated(1, e)["output"] for e in ({}, {effect: size}))
        rms = float(np.std(with_effect - without))
        return {effect: size * times * self.noise / rms}

    def truth(
        self,
        hidden: Mapping[str, float],
        hold_at: Mapping[str, float],
        seed: int,
        changed: Mapping[str, float],
    ) -> dict[str, float]:
        """Return true coefficients by name, about a fit's own reference temperature; about `T0` if it has none.

        Args:
            hidden: effects in the record, with sizes.
            hold_at: reference temperatures of the fit's coefficients, °C.
            seed: seed of the campaign.
            changed: changes of coefficients by a kind of fault.
        """
        values = {**self.true, **self.drawn(seed, hidden)}
        for effect, size in hidden.items():
            values |= {n: size * share for n, share in self.exact.get(effect, {}).items()}
        for name, change in changed.items():
            values[name] = values.get(name, 0.0) + change
        reference = hold_at.get(name_reference(self.thermometer), self.T0)
        for names in self.polynomials:
            values |= _about(reference - self.T0, {n: values.get(n, 0.0) for n in names}, names)
        return values


def _about(shift: float, values: Mapping[str, float], names: tuple[str, ...]) -> dict[str, float]:
    """Return the coefficients of a polynomial about another temperature; zero ones only if they become nonzero."""
    powers = range(len(names))
    moved = {
        names[k]: sum(
            values[names[n]] * math.comb(n, k) * shift ** (n - k) for n in powers if n >= k
        )
        for k in powers
    }
    return {n: v for n, v in moved.items() if v or values[n]}


def _halves(readings: bc.Measurements) -> tuple[bc.Measurements, bc.Measurements]:
    """Return every other reading, and the readings between."""
    rows = np.arange(len(readings))
    return readings.select(rows % 2 == 0), readings.select(rows % 2 == 1)
