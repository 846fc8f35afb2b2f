"""What readings cannot tell apart is one set: in the model together, as uncertain as the priors leave each of it."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_dividing_head, inclinometer, mems_gyro
from tests.support.tiers import slow_but

PAGE = Path(__file__).resolve().parents[2] / "docs" / "equivalent_effects.md"
QUICK = bc.LeastSquares(draws=1000)
ONE_EFFECT: dict[str, Any] = {"method": QUICK, "max_effects": 1, "widen_noise": False}
SLOPE = 0.0535  # °/s/°C


def ramp(seed: int, drift: float, wobble: float = 0.0) -> bc.Measurements:
    """Of 55 minutes, 30 to 80 °C, in one run; a drift in parts of what the slope does, a chamber that wobbles, °C."""
    random, time = np.random.default_rng(seed), 30.0 * np.arange(110)
    part = time / time[-1] - 0.5
    temperature = 55 + 50 * part + wobble * np.sin(2 * np.pi * time / 900)
    output = 21.4 + SLOPE * (temperature - 55) + 50 * drift * SLOPE * part
    return bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT,
        run=np.full(time.size, "1"),
        time=time,
        temperature=temperature,
        output=output + 0.05 * random.standard_normal(time.size),
    )


@cache
def calibrated(seed: int, drift: float, wobble: float = 0.0) -> bc.SearchPath:
    readings = ramp(seed, drift, wobble)
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, **ONE_EFFECT)


def off(calibration: bc.Calibration, name: str, truth: float) -> float:
    values = calibration.samples(name)
    return float(abs(values.mean() - truth) / values.std())


@pytest.mark.parametrize(
    "ramp", slow_but([(1, 0.3)], [(1, 0.3), (2, -0.3, 0.3), (4, 0.0)]), ids=str
)
def test_slope_of_one_slow_ramp_is_as_uncertain_as_a_drift(ramp) -> None:
    path = calibrated(*ramp)
    assert off(path.calibration, "bias.temperature", SLOPE) < 3
    assert path.calibration.samples("bias.temperature").std() > 0.05 * SLOPE
    (claim,) = (c for c in path.gate.claims if c.code == "equivalent.undecided")
    assert claim.subjects == ("bias.drift",) and claim.numbers["beside"] == ("bias.temperature",)
    assert claim.numbers["experiment"] in dict(mems_gyro.INSTRUMENT.experiments)
    assert not path.ok


def test_predictions_are_sharp_along_the_profile_and_wide_elsewhere() -> None:
    used, readings = calibrated(1, 0.3).calibration, ramp(9, 0.3)
    along = bc.predict(used, readings)
    assert along.model_sd.max() < 0.5 * 0.05
    back = readings.with_column("temperature", readings["temperature"][::-1])
    assert bc.predict(used, back).model_sd.max() > 5 * 0.05


def test_a_ramp_that_goes_back_tells_a_drift() -> None:
    there = ramp(1, 0.0)
    path = np.interp(there["time"], [0, 1650, 3270], [30, 80, 30])
    output = there["output"] + SLOPE * (path - there["temperature"])
    readings = there.with_column("temperature", path).with_column("output", output)
    found = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, **ONE_EFFECT)
    assert found.final.discovery is not None and not found.final.discovery.equivalent
    assert found.calibration.samples("bias.temperature").std() < 0.01 * SLOPE


def rows(instrument: str) -> list[set[str]]:
    """Sets of effects that the page has of an instrument, without what is in the first model."""
    said = PAGE.read_text("utf-8").splitlines()
    lines = [line.split("|") for line in said if line.startswith(f"| {instrument} |")]
    return [{*re.findall(r"`([^`]+)`(?! \(in\))", "|".join(line[2:4]))} for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", [accelerometer_dividing_head, inclinometer], ids=["dividing head", "inclinometer"]
)
def test_every_set_of_the_page_is_said(module: Any) -> None:
    readings = module.simulate(seed=1)
    fitted = bc.fit(module.INSTRUMENT.baseline(), readings, bc.LeastSquares(draws=100))
    found = bc.discover(fitted, max_effects=0, widen_noise=False)
    said = [{*claim.subjects} for claim in found.equivalent]
    expected = rows(module.INSTRUMENT.name)
    assert expected and sorted(map(sorted, said)) == sorted(map(sorted, expected))
    # What is to be added holds what cannot be told from the model as it is.
    assert {*found.latent} <= {e.name for e in found.best}
