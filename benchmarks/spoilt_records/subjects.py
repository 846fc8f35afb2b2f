"""The instruments of the gauntlet: how each is simulated, what is hidden in it, what is true, which column is which."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._model.frame import Reference, reference_name
from bayescal._readings.unit_parsing import STANDARD_GRAVITY
from bayescal_models import differential_pair, mems_gyro
from bayescal_models.differential_pair.simulator import columns_and_truth
from bayescal_models.inclinometer.campaign import X, Y
from bayescal_models.ng_accelerometer.campaign import TRUTH_A
from bayescal_models.quartz_beam_accelerometer.device import CUBIC
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
        exact: hidden effects whose law is that of the catalogue, and the coefficient's true value for each unit of
            size; of the others the coefficient is not judged.
        noise: standard deviation of a reading, output unit.
        zero, slope: coefficients that a device may have far from nominal.
        thermometer: column that the model's temperature is read from.
        partner: column of numbers that could be mistaken for the thermometer's; empty if there is none.
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
    input: str = ""
    group: str = "run"
    polynomials: tuple[tuple[str, ...], ...] = ()
    T0: float = 0.0
    lag: str = ""
    wrong_unit: float = 1.0
    sign: bool = False
    one_unit: bool = False
    options: Mapping[str, Any] | None = None

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
        made = ({n: np.array(r[n]) for n in r.columns} for r in (record, holdout))
        return Campaign(*made, units=units, hidden=dict(hidden))

    def _simulated(self, seed: int, hidden: Mapping[str, float]) -> bc.Measurements:
        simulate = self.instrument.simulate
        assert simulate is not None
        return simulate(dict(hidden), seed=seed, **(self.options or {}))

    def loud(self, effect: str, times: float) -> dict[str, float]:
        """An effect at the size at which its part of the output has an rms of so many times the noise."""
        size = dict(self.hidden).get(effect, 1.0)
        without, beside = (self._simulated(1, e)["output"] for e in ({}, {effect: size}))
        rms = float(np.std(beside - without))
        return {effect: size * times * self.noise / rms}

    def truth(
        self,
        hidden: Mapping[str, float],
        reference: Reference,
        seed: int,
        changed: Mapping[str, float],
    ) -> dict[str, float]:
        """True coefficients by name, about a fit's own reference temperature.

        Args:
            hidden: effects in the record, by size.
            reference: constants of the fit.
            seed: of the campaign.
            changed: what a kind of record adds to coefficients.
        """
        found = dict(self.true)
        if self.name == "differential_pair":
            found |= _of_devices(seed, hidden)
        for effect, size in hidden.items():
            found |= {n: size * each for n, each in self.exact.get(effect, {}).items()}
        for name, more in changed.items():
            found[name] = found.get(name, 0.0) + more
        there = reference.get(reference_name(self.thermometer), self.T0)
        assert isinstance(there, float)
        for names in self.polynomials:
            found |= _about(there - self.T0, {n: found.get(n, 0.0) for n in names}, names)
        return found


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


def _of_devices(seed: int, hidden: Mapping[str, float]) -> dict[str, float]:
    """Scale factors of the accelerometers on the arm, ppm."""
    _, truth = columns_and_truth(hidden, seed=seed, campaign=BATCH)
    pairs = zip(truth.names, truth.scale, strict=True)
    return {f"scale.device({name})": 1e6 * (scale - 1.0) for name, scale in pairs}


def _ones(c: Columns) -> np.ndarray:
    return np.ones(len(c["output"]))


def _opposed(c: Columns) -> np.ndarray:
    """Output of an accelerometer on the arm for each ppm of scale factor."""
    return 1e-6 * np.where(c["group"] == "outer", 1.0, -1.0) * c["acceleration"]


def _tilted(c: Columns) -> np.ndarray:
    """Output of an accelerometer on the tilted table for each ppm of scale factor, its nuisance angles left out."""
    return np.sin(c["tilt"]) * np.sin(c["position_angle"])


BATCH = differential_pair.Campaign(samples=80)
DEVICES = tuple(f"scale.device({side} {k})" for side in ("outer", "inner") for k in (1, 2, 3))
GYRO = mems_gyro.Campaign(rate_input=(0.0, 100.0, -100.0), nonlinearity=0.0)
_CUBIC = ("", "_quadratic", "_cubic")

SUBJECTS = {
    s.name: s
    for s in (
        Subject(
            "mems_gyro",
            hidden=(("bias.temperature_quadratic", 1e-3), ("bias.thermal_lag", 0.05)),
            true={"bias.constant": 21.5, "bias.temperature": 0.0535},
            exact={"bias.temperature_quadratic": {"bias.temperature_quadratic": 1.0}},
            noise=0.05,
            zero=Shift(("bias.constant",), 50.0, _ones),
            slope=Shift(("bias.temperature",), 0.05, lambda c: c["temperature"] - GYRO.T0),
            partner="board_temperature",
            input="rate_input",
            wrong_unit=math.pi / 180.0,
            sign=True,
            polynomials=(("bias.constant", "bias.temperature", "bias.temperature_quadratic"),),
            T0=GYRO.T0,
            lag="bias.thermal_lag",
            options={"campaign": GYRO},
        ),
        Subject(
            "still_sensor",
            hidden=(("bias.temperature_quadratic", 0.4), ("bias.thermal_lag", 15.0)),
            true={"bias.constant": 2000.0, "bias.temperature": 40.0},
            exact={"bias.temperature_quadratic": {"bias.temperature_quadratic": 1.0}},
            noise=20.0,
            zero=Shift(("bias.constant",), 2000.0, _ones),
            slope=Shift(("bias.temperature",), 40.0, lambda c: c["temperature"] - 27.0),
            polynomials=(("bias.constant", "bias.temperature", "bias.temperature_quadratic"),),
            T0=27.0,
            partner="time",
            lag="bias.thermal_lag",
        ),
        Subject(
            "quartz_beam_accelerometer",
            hidden=(("second_order", 30.0), ("bias.thermal_lag", 20.0)),
            true=CUBIC,
            exact={"second_order": {"second_order": 1.0}},
            noise=5.0,
            zero=Shift(("bias.constant_head",), 20_000.0, _ones),
            slope=Shift(("scale.constant_head",), 5000.0, lambda c: 1e-6 * c["acceleration"]),
            thermometer="temperature_head",
            partner="temperature_circuit",
            input="acceleration",
            wrong_unit=STANDARD_GRAVITY,
            sign=True,
            polynomials=tuple(
                (f"{s}.constant_head", *(f"{s}.temperature_head{p}" for p in _CUBIC))
                for s in ("bias", "scale")
            ),
            T0=15.0,
            lag="bias.thermal_lag",
        ),
        Subject(
            "ng_accelerometer",
            hidden=(("second_order", 0.15), ("bias.temperature_quadratic", 0.15)),
            true={name: TRUTH_A[name] for name in TRUTH_A if not name.endswith(".cell")},
            exact={"second_order": {"second_order": 1.0}},
            noise=0.5,
            zero=Shift(("bias.constant",), 5000.0, _ones),
            slope=Shift(("scale.constant",), 10_000.0, _tilted),
            partner="lab_temperature",
            input="tilt",
            wrong_unit=180.0 / math.pi,
            sign=True,
            polynomials=(
                ("bias.constant", "bias.temperature"),
                ("scale.constant", "scale.temperature"),
            ),
            T0=30.0,
            lag="bias.thermal_lag",
        ),
        Subject(
            "inclinometer",
            hidden=(("zero.temperature", 6.0), ("zero.hysteresis", 6.0)),
            true={
                "zero.constant(x)": X.constant,
                "zero.constant(y)": Y.constant,
                "zero.placement(x)": X.slope,
                "zero.placement(y)": Y.slope,
            },
            exact={},
            noise=2.0,
            zero=Shift(("zero.constant(x)", "zero.constant(y)"), 1000.0, _ones),
            slope=Shift(
                ("zero.placement(x)", "zero.placement(y)"),
                2.0,
                lambda c: np.rad2deg(c["placement_angle"]),
            ),
            partner="placement_angle",
            input="placement_angle",
            wrong_unit=math.pi / 180.0,
        ),
        Subject(
            "differential_pair",
            hidden=(("bias.device", 10_000.0), ("scale.second_order", 1000.0)),
            true={},
            exact={},
            noise=BATCH.noise / math.sqrt(BATCH.duration / BATCH.samples),
            zero=Shift((), 10_000.0, _ones),
            slope=Shift(DEVICES, 5000.0, _opposed),
            partner="acceleration",
            input="acceleration",
            wrong_unit=STANDARD_GRAVITY,
            sign=True,
            group="device",
            one_unit=True,
            options={"campaign": BATCH},
        ),
    )
}
