"""A recorded column that ran with the thermometer may have acted in its place: coefficients hold what it may have."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor

QUICK = bc.LeastSquares(draws=400)
SLOPE = 40.0  # µg/°C, of the temperature alone


@cache
def humid(seed: int, along: float = 1.0, share: float = 0.3) -> bc.Measurements:
    """Humidity follows the temperature (r = 0.99998), or partly so, and does a share of what the temperature does."""
    readings, random = still_sensor.simulate(seed=seed, interval=60), np.random.default_rng(seed)
    temperature = readings["temperature"]
    free = np.cumsum(random.standard_normal(len(readings)))
    own = along * temperature + (1 - along) * free / free.std() * temperature.std()
    humidity = 0.5 * own + 0.003 * temperature.std() * random.standard_normal(len(readings))
    output = readings["output"] + share * SLOPE * (2 * humidity - 2 * humidity.mean())
    return bc.Measurements.from_arrays(
        still_sensor.instrument("ug"),
        units={"humidity": "%"},
        run=readings["run"],
        time=readings["time"],
        temperature=temperature,
        humidity=humidity,
        output=output,
    )


def line(readings: bc.Measurements) -> bc.Model:
    return still_sensor.INSTRUMENT.for_readings(readings).baseline()


def not_measured(calibration: bc.Calibration) -> list[str]:
    """The combinations of which a calibration says that they are not measured."""
    said = " ".join(calibration.remarks.split()).split("not measured: ")[1:]
    return [one.partition(":")[0] for one in said]


def off(calibration: bc.Calibration, true: float = SLOPE) -> float:
    slope = calibration.samples("bias.temperature")
    return float(abs(slope.mean() - true) / slope.std())


@pytest.mark.parametrize("seed", [1, 2])
def test_the_slope_holds_what_a_column_that_ran_with_the_thermometer_may_have_done(
    seed: int,
) -> None:
    readings = humid(seed)
    assert np.corrcoef(readings["temperature"], readings["humidity"])[0, 1] > 0.9999
    fit = bc.fit(line(readings), readings, QUICK)
    assert off(fit) < 2
    (_said,) = not_measured(fit)
    # What both do together is known as well as before.
    assert fit.samples("bias.temperature").mean() == pytest.approx(1.3 * SLOPE, rel=0.01)
    assert bc.predict(fit).model_sd.max() < 0.5 * bc.predict(fit).sd.max()


def test_a_column_that_is_no_cause_takes_nothing_away() -> None:
    readings = humid(1, share=0.0).without_causes(["humidity"])
    fit = bc.fit(line(readings), readings, QUICK)
    slope = fit.samples("bias.temperature")
    assert slope.std() < 0.01 * SLOPE and off(fit) < 4
    assert not_measured(fit) == []


def test_a_column_that_the_readings_tell_apart_takes_nothing_away() -> None:
    readings = humid(1, along=0.5, share=0.0)
    alone = readings.without_causes(["humidity"])
    with_it, without = (bc.fit(line(r), r, QUICK) for r in (readings, alone))
    slopes = [c.samples("bias.temperature") for c in (with_it, without)]
    np.testing.assert_array_equal(slopes[0], slopes[1])


def test_another_thermometer_is_no_other_cause() -> None:
    readings = humid(1, share=0.0).without_causes(["humidity"])
    columns: dict[str, Any] = {n: readings[n] for n in ("run", "time", "temperature", "output")}
    columns["near"] = 0.9 * columns["temperature"]
    instrument, units = still_sensor.instrument("ug"), {"near": "degC"}
    twice = bc.Measurements.from_arrays(instrument, units=units, **columns)
    assert not_measured(bc.fit(line(twice), twice, QUICK)) == []


@pytest.mark.slow
def test_a_calibration_holds_it_to_the_end(tmp_path: Path) -> None:
    """Searched, averaged, saved, loaded, compensated, budgeted, decided: one uncertainty of the slope."""
    readings = humid(2)
    path = bc.calibrate(line(readings), readings)
    used = path.calibration
    assert off(path.final.calibration) < 2 and off(used) < 2
    again = bc.load(used.save(tmp_path / "c.nc"))
    np.testing.assert_array_equal(
        again.samples("bias.temperature"), used.samples("bias.temperature")
    )
    assert not_measured(again) == not_measured(used) != []
    sd = float(used.samples("bias.temperature").std())
    compensated = bc.compensator(used)
    t0 = float(used.reference["T0"])  # pyright: ignore[reportArgumentType]
    at = bc.budget(used, {"temperature": t0 + 20.0})
    assert at.uncertainty == pytest.approx(20 * sd, rel=0.05)
    (source,) = (s for s in at.sources if "humidity" in s.name)
    assert source.kind == "B" and source.share > 0.9
    found = compensated(output=0.0, temperature=t0 + 20.0, noise=False, method="first order")
    assert float(found.uncertainty[0]) == pytest.approx(20 * sd, rel=0.05)
