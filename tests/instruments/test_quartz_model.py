"""The quartz beam accelerometer's model: 15 columns of rank 12, what is not measured, and what is left on new ramps."""

from __future__ import annotations

import re

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import quartz_beam_accelerometer as quartz
from tests.support.inside import coefficient_factor, frame_of

# 5 temperatures twice, three ramps a reading every 2.5 min: 159 rows, one shape for every fit here.
SMALL = {"temperatures": (-40.0, -10.0, 20.0, 45.0, 70.0), "interval": 150.0}
NULLS = (
    "{0}.constant_circuit − {0}.constant_head",
    "{0}.temperature_circuit − {0}.temperature_head − {0}.gradient",
    "{0}.temperature_circuit_quadratic − {0}.temperature_head_quadratic − {0}.gradient_quadratic − "
    "2·{0}.temperature_x_gradient",
)
OF_CIRCUIT = (
    "{0}.temperature_circuit_quadratic − {0}.temperature_head_quadratic + {0}.gradient_quadratic − "
    "2·{0}.temperature_x_gradient_circuit"
)


def design(readings: bc.Measurements, effects, slot: str) -> np.ndarray:
    """Columns of linear effects, output unit per reported unit, (n, p)."""
    frame = frame_of(readings)
    columns = [np.asarray(e.evaluate(frame, {}))[:, 0] for e in effects]
    unit = quartz.INSTRUMENT.slot(slot).unit
    factors = [coefficient_factor(e.coefficients[0].unit, unit) for e in effects]
    weight = readings["acceleration"] if slot == "scale" else 1.0
    return (np.stack(columns) * np.array(factors)[:, None] * weight).T


def fifteen(slot: str, crossed_by: str = "head") -> list[bc.Effect]:
    """The document's columns for one slot."""
    return [e for e in quartz.two_thermometers(crossed_by).effects if e.slot == slot]


def rank(columns: np.ndarray) -> int:
    return int(np.linalg.matrix_rank(columns / np.linalg.norm(columns, axis=0), tol=1e-10))


def assert_nothing(columns: np.ndarray, effects: list[bc.Effect], combinations: list[str]) -> None:
    """Columns add up to nothing along each combination; all are different."""
    names = [e.name for e in effects]
    along = np.zeros((len(combinations), len(names)))
    for row, words in zip(along, combinations, strict=True):
        for sign, times, name in re.findall(r"(^|[−+] )(\d·)?([\w.]+)", words):
            row[names.index(name)] = (-1 if sign == "− " else 1) * float(times.rstrip("·") or 1)
    assert np.linalg.matrix_rank(along) == len(combinations)
    assert np.abs(columns @ along.T).max() < 1e-9 * np.abs(columns).max()


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return quartz.simulate(seed=1, campaign=quartz.Campaign(device="beams", **SMALL))


@pytest.fixture(scope="module")
def two(readings: bc.Measurements) -> bc.Calibration:
    return bc.fit(quartz.two_thermometers(), readings, bc.LeastSquares())


@pytest.mark.parametrize("slot", ["bias", "scale"])
def test_the_fifteen_columns_have_rank_twelve(slot: str) -> None:
    ramps = quartz.simulate(seed=5)
    for by in ("head", "circuit"):
        effects = fifteen(slot, by)
        columns = design(ramps, effects, slot)
        assert columns.shape[1] == 15
        assert rank(columns) == 12
        words = NULLS if by == "head" else (*NULLS[:2], OF_CIRCUIT)
        assert_nothing(columns, effects, [one.format(slot) for one in words])


def test_soaked_points_have_rank_four_for_all_that_is_not_a_rate() -> None:
    """δt is one value at soak, so powers of t1, t2, δt and t2·δt give 1, t, t², t³ and no more."""
    world = quartz.Campaign(attitudes=(), soak=6 * 3600.0, thermometer_noise=0.0)
    everything = quartz.simulate(seed=5, campaign=world)
    soaked = everything.select(~np.isnan(everything["temperature_point"]))
    effects = [e for e in fifteen("bias") if "rate" not in e.name]
    assert rank(design(soaked, effects, "bias")) == 4


def test_soaked_points_leave_rates_unidentified() -> None:
    everything = quartz.simulate(seed=5, campaign=quartz.Campaign(attitudes=()))
    soaked = everything.select(~np.isnan(everything["temperature_point"]))
    for readings, known in ((soaked, False), (quartz.simulate(seed=5), True)):
        effects = fifteen("bias")
        sd = np.array([e.coefficients[0].size for e in effects])
        white = design(readings, effects, "bias") * sd / 5.0  # µg of noise
        left = np.diag(np.linalg.inv(np.eye(len(sd)) + white.T @ white))  # of prior variances
        named = {e.name for e, share in zip(effects, left, strict=True) if share > 0.9}
        rates = {"bias.rate_circuit", "bias.rate_head", "bias.temperature_x_rate"}
        assert (rates <= named) != known
        assert not known or not rates & named


def test_truth_of_the_model_class_is_recovered(readings: bc.Measurements) -> None:
    """Coefficients drawn from their priors, simulated temperatures, the model's own columns."""
    random = np.random.default_rng(8)
    truth, output = {}, readings["acceleration"].copy()
    for slot in ("bias", "scale"):
        effects = fifteen(slot)
        values = [e.coefficients[0].size * random.standard_normal() for e in effects]
        truth |= dict(zip([e.name for e in effects], values, strict=True))
        output = output + design(readings, effects, slot) @ np.array(values)
    made = readings.with_column("output", output + 5.0 * random.standard_normal(len(readings)))
    found = bc.fit(quartz.two_thermometers(), made, bc.LeastSquares())
    inside = 0
    for name, value in truth.items():
        draws = found.samples(name)
        assert abs(draws.mean() - value) < 4.5 * draws.std()
        low, high = np.quantile(draws, [0.025, 0.975])
        inside += low <= value <= high
    assert inside >= 24  # of 30
    for a, b in (("constant_circuit", "constant_head"),):  # the sum is measured, the parts are not
        total = found.samples(f"bias.{a}") + found.samples(f"bias.{b}")
        assert total.mean() == pytest.approx(truth[f"bias.{a}"] + truth[f"bias.{b}"], abs=30)
        assert total.std() < 0.01 * found.samples(f"bias.{a}").std()
    assert np.std(bc.predict(found).mean - output) < 5.0


def left(calibration: bc.Calibration, campaign: quartz.Campaign) -> float:
    """True bias minus the model's, µg rms, on another campaign at 0 g."""
    held = quartz.simulate(seed=9, campaign=campaign)
    return float(np.std(quartz.true_values(campaign).bias - bc.predict(calibration, held).mean))


def test_two_thermometers_hold_on_ramps_of_other_speeds(
    two: bc.Calibration, readings: bc.Measurements
) -> None:
    one = bc.fit(quartz.of_circuit(3), readings, bc.LeastSquares())
    for speed in (1.0, 3.0):
        held = quartz.Campaign(
            device="beams", repeats=0, attitudes=(0.0,), ramp_speeds=(speed,), interval=150.0
        )
        assert left(two, held) < 25 < 200 < left(one, held)


def test_frequency_is_converted_to_micro_g() -> None:
    made = bc.Measurements.from_arrays(
        quartz.INSTRUMENT,
        units={"output": "Hz", "acceleration": "g"},
        temperature_circuit=[20.0, 30.0],
        temperature_head=[20.0, 30.0],
        acceleration=[1.0, -1.0],
        output=[100.2, -99.8],
    )
    np.testing.assert_allclose(made["output"], [1_002_000, -998_000])
    np.testing.assert_allclose(made["acceleration"], [1e6, -1e6])
