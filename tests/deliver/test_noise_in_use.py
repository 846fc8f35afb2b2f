"""The noise of a reading in use is the law's at that reading: decisions, budgets, compensation and exports.

A pressure sensor is made up with a known scatter, 4,000 readings, seeds as stated; readings in use are simulated with
the same scatter at one place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from tests.support.tiers import slow_but

N, READINGS = 4000, 100_000
RUN = N // 2  # readings
SENSOR = bc.Instrument(
    name="pressure_sensor",
    title="a pressure sensor beside a gauge",
    columns=(
        bc.Column("run", None, required=False),
        bc.Column("time", "s", required=False),
        bc.Column("temperature", "degC"),
        bc.Column("pressure", "kPa"),
        bc.Column("output", "kPa"),
    ),
    slots=(bc.Slot("zero", "kPa"), bc.Slot("scale", "1")),
    response=lambda s, r: s["zero"] + (1 + s["scale"]) * r["pressure"],
    effects=(
        effects.constant("zero", 1.0, "kPa", source="ours"),
        effects.constant("scale", 0.1, "1", source="ours"),
    ),
    noise=bc.White(bc.HalfCauchy(0.05)),
    use=bc.Use("pressure", "kPa"),
    source="ours",
)


class Proportional(bc.Noise):
    """A law of one's own: s² + (p·x)², x the pressure in 100 kPa."""

    law: ClassVar[str] = "proportional_to_pressure"
    gaussian: ClassVar[bool] = True  # former name of `is_gaussian`

    @property
    def needs(self):
        return ("pressure",)

    def parameters(self):
        return {"noise.white": bc.HalfCauchy(0.05), "noise.share": bc.HalfCauchy(0.05)}

    def variance(self, parameters, frame):
        share = parameters["noise.share"] * frame["pressure"] / 100
        return parameters["noise.white"] ** 2 + share**2


class Case(NamedTuple):
    """A law, its true standard deviation by column, a range, and the place where a reading scatters most."""

    law: bc.Noise
    sd: Callable[[dict[str, np.ndarray]], np.ndarray]
    over: str
    worst: dict[str, float]
    tails: float = math.inf  # degrees of freedom


def _grows(column: str, low: float, high: float, rate: float = 1.0):
    return lambda c: 0.02 * np.exp(rate * (2 * (c[column] - low) / (high - low) - 1))


CASES = {
    "temperature": Case(
        bc.Heteroscedastic("temperature"),
        _grows("temperature", 10.0, 60.0),
        "temperature 20..50 °C",
        {"temperature": 50.0},
    ),
    "what is measured": Case(
        bc.Heteroscedastic("pressure"),
        _grows("pressure", 0.0, 200.0),
        "pressure 50..150 kPa",
        {"pressure": 150.0},
    ),
    "in proportion": Case(
        bc.Heteroscedastic("pressure", proportional=True),
        lambda c: np.hypot(0.01, 0.05 * c["pressure"] / 100),
        "pressure 10..180 kPa",
        {"pressure": 180.0},
    ),
    "a law of one's own": Case(
        Proportional(),
        lambda c: np.hypot(0.01, 0.05 * c["pressure"] / 100),
        "pressure 50..200 kPa",
        {"pressure": 200.0},
    ),
    "elapsed": Case(
        bc.Heteroscedastic("elapsed"),
        _grows("elapsed", 0.0, 20_000.0, -1.0),
        "elapsed 5000..15000 s",
        {"elapsed": 5000.0},
    ),
    "beside correlated noise": Case(
        bc.SummedNoise(8.0, 65536.0, ("correlated",), scatter="temperature"),
        _grows("temperature", 10.0, 60.0),
        "temperature 20..50 °C",
        {"temperature": 50.0},
    ),
    "heavy tails": Case(
        bc.StudentT(), lambda c: np.full(len(c["temperature"]), 0.02), "", {}, tails=4.0
    ),
}


def scattered(case: Case, columns: dict[str, np.ndarray], random: np.random.Generator):
    """Readings with the true scatter of a case."""
    exact, size = 0.3 + 1.002 * columns["pressure"], len(columns["pressure"])
    unit = (
        random.standard_normal(size)
        if case.tails == math.inf
        else random.standard_t(case.tails, size)
    )
    return exact + case.sd(columns) * unit


@cache
def calibrated(name: str) -> bc.Calibration:
    """A fit of a case with its own law, seed 11."""
    case, random = CASES[name], np.random.default_rng(11)
    columns: dict[str, Any] = {
        "time": 10.0 * np.arange(N),
        "temperature": random.uniform(10.0, 60.0, N),
    }
    columns |= {
        "pressure": random.uniform(0.0, 200.0, N),
        "elapsed": columns["time"] % (10.0 * RUN),
    }
    output = scattered(case, columns, random)
    del columns["elapsed"]
    readings = bc.Measurements.from_arrays(
        SENSOR, output=output, run=np.repeat(["a", "b"], RUN), **columns
    )
    return bc.fit(SENSOR.baseline().with_noise(case.law), readings, seed=1)


def place(name: str, size: int, **more: float) -> dict[str, Any]:
    """The worst place of a case, or another one, many times."""
    needed = {i.name for i in bc.compensator(calibrated(name)).inputs}
    at = {"temperature": 35.0, "pressure": 100.0, "elapsed": 10_000.0, **CASES[name].worst, **more}
    return {n: np.full(size, v) for n, v in at.items() if n in needed or n != "elapsed"}


@pytest.mark.parametrize("name", slow_but(["temperature"], CASES))
def test_stated_risk_is_the_share_of_readings_outside(name) -> None:
    case, at = CASES[name], place(name, READINGS)
    compensate = bc.compensator(calibrated(name))
    outputs = scattered(case, {"elapsed": np.zeros(READINGS), **at}, np.random.default_rng(12))
    given = {n: v for n, v in at.items() if n != "pressure"}
    away = (
        compensate(output=outputs, **given, method="first order", warn=False).value - at["pressure"]
    )
    half = float(np.quantile(np.abs(away), 0.97))  # 3 % of readings lie outside
    over = f" over {case.over}" * bool(case.over)
    (found,) = bc.decide(
        calibrated(name), f"corrected reading: ±{half} kPa{over}", rule="simple"
    ).decisions
    assert found.probability == pytest.approx(0.97, abs=0.2 * 0.03)


@pytest.mark.parametrize("name", slow_but(["temperature"], CASES))
def test_every_exit_has_the_noise_of_the_place(name, tmp_path) -> None:
    case, compensate = CASES[name], bc.compensator(calibrated(name))
    spread = 1.0 if case.tails == math.inf else math.sqrt(case.tails / (case.tails - 2))
    space: dict[str, Any] = {}
    exec(compensate.export(tmp_path / "c.py").read_text("utf-8"), space)
    for more in ({}, {"temperature": 30.0, "pressure": 60.0, "elapsed": 8_000.0}):
        at = place(name, 1, **more)
        want = spread * float(case.sd({"elapsed": np.zeros(1), **at})[0]) / 1.002
        inputs = {n: v for n, v in at.items() if n != "pressure"}
        output, names = 0.3 + 1.002 * at["pressure"], [i.name for i in compensate.inputs]
        point = {n: float(v[0]) for n, v in at.items() if n in {"pressure", *names}}
        alone = space["compensate"](float(output[0]), *(point[n] for n in names))
        stated = [
            bc.budget(compensate, point).noise,
            compensate(output=output, **inputs).uncertainty[0],
            compensate(output=output, **inputs, method="first order").uncertainty[0],
            alone[2],
        ]
        np.testing.assert_allclose(stated, want, rtol=0.1)
        np.testing.assert_allclose(stated[3:], stated[2], rtol=1e-9)


def test_noise_of_a_column_that_is_not_there_is_refused() -> None:
    with pytest.raises(bc.InputError, match="temperature"):
        bc.compensator(calibrated("temperature"))(output=100.0)
