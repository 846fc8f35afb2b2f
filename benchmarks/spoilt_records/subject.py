"""An instrument of the gauntlet: how it is simulated, what is hidden in it, what is true, which column is which."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._model.frame import reference_name
from benchmarks.hidden_effects.bank import instrument_named

Columns = dict[str, np.ndarray]  # a file: each column's cells, in the order of the rows
LATER = 500_000  # added to the seed of the second campaign


@dataclass(frozen=True)
class Campaign:
    """A record, a second one to judge by, and what is true of both.

    Attributes:
        record, holdout: columns.
        units: of each column of numbers.
        hidden: effects hidden in both, by size.
    """

    record: Columns
    holdout: Columns
    units: dict[str, str]
    hidden: dict[str, float]


@dataclass(frozen=True)
class Shift:
    """A coefficient that the model holds, and what the output gains for each unit of it.

    Attributes:
        names: of the coefficient, or of all members of its group, which change alike.
        size: its prior standard deviation; of an instrument that takes its sizes from the readings, the true value.
        column: the gain, from the columns of a file.
    """

    names: tuple[str, ...]
    size: float
    column: Callable[[Columns], np.ndarray]


@dataclass(frozen=True)
class Subject:
    """An instrument of the gauntlet.

    Attributes:
        name: of the instrument.
        hidden: effects that are hidden in turn, with their sizes.
        true: coefficients that are true of every campaign; those of polynomials about `T0`.
        drawn: from the seed and what is hidden, true coefficients that are drawn for each campaign.
        exact: hidden effects whose law is that of the catalogue, and the coefficient's true value for each unit of
            size; of the others the coefficient is not judged.
        noise: standard deviation of a reading, output unit.
        zero, slope: coefficients that a device may have far from nominal.
        thermometer: column that the model's temperature is read from.
        partner: column of numbers that could be mistaken for the thermometer's; empty if there is none.
        sibling: a second thermometer of the unit itself; empty if there is none.
        input: column of the known input, in which a wrong unit or sign would show; empty if there is none.
        group: column of labels whose members are records in time of their own.
        polynomials: names of constant, line, quadratic … in the thermometer's temperature, a tuple for each slot.
        T0: about which the true ones are, °C.
        lag: a thermal lag that can be hidden; empty if there is none.
        wrong_unit: factor by which another unit of the known input is mistaken for its own; 1 if there is none.
        sign: whether a known input tells the output's sign.
        one_unit: whether a second campaign is one of the same unit only if it is taken at the same time.
        options: of the simulator.
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
        """A record with these effects hidden in it, or with the subject's own, one in every second seed."""
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
        """An effect at the size at which its part of the output has an rms of so many times the noise."""
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
        """True coefficients by name, about a fit's own reference temperature; about `T0` where it has none.

        Args:
            hidden: effects in the record, by size.
            hold_at: temperatures at which the fit's coefficients hold, °C.
            seed: of the campaign.
            changed: what a kind of record adds to coefficients.
        """
        values = {**self.true, **self.drawn(seed, hidden)}
        for effect, size in hidden.items():
            values |= {n: size * share for n, share in self.exact.get(effect, {}).items()}
        for name, change in changed.items():
            values[name] = values.get(name, 0.0) + change
        reference = hold_at.get(reference_name(self.thermometer), self.T0)
        for names in self.polynomials:
            values |= _about(reference - self.T0, {n: values.get(n, 0.0) for n in names}, names)
        return values


def _about(shift: float, values: Mapping[str, float], names: tuple[str, ...]) -> dict[str, float]:
    """Coefficients of the same polynomial about another temperature; zero ones only where they become another."""
    powers = range(len(names))
    moved = {
        names[k]: sum(
            values[names[n]] * math.comb(n, k) * shift ** (n - k) for n in powers if n >= k
        )
        for k in powers
    }
    return {n: v for n, v in moved.items() if v or values[n]}


def _halves(readings: bc.Measurements) -> tuple[bc.Measurements, bc.Measurements]:
    """Every other reading, and those between."""
    rows = np.arange(len(readings))
    return readings.select(rows % 2 == 0), readings.select(rows % 2 == 1)
