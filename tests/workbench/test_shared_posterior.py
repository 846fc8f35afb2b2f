"""What is clicked and what `calibrate` finds are one posterior: the same forms, the same numbers."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import Session, page_of

pytest.importorskip("panel", reason="bayescal[workbench] is not installed")
pytestmark = pytest.mark.slow
INSTRUMENT = mems_gyro.INSTRUMENT
LIMIT = "bias: ±5 °/s over -10..50 °C"


def behind_its_thermometer(seed: int, quadratic: float) -> bc.Measurements:
    """Return two runs of a sensor whose die is 100 s behind: 0.2 + 0.06·(T − 20) + q·(T − 20)² + N(0, 0.04²) °/s."""
    rng, step, tau, count = np.random.default_rng(seed), 30.0, 100.0, 60
    runs, times = np.repeat(["a", "b"], count), step * np.arange(count)
    temperatures, outputs = [], []
    for _ in range(2):
        corners = np.linspace(0.0, times[-1], 7)
        ambient = np.interp(times, corners, rng.uniform(-20.0, 65.0, 7))
        die = ambient.copy()
        for i in range(1, count):
            behind = tau * (ambient[i] - ambient[i - 1]) / step
            settling = die[i - 1] - ambient[i - 1] + behind
            die[i] = ambient[i] - behind + settling * np.exp(-step / tau)
        outputs.append(0.2 + 0.06 * (die - 20.0) + quadratic * (die - 20.0) ** 2)
        temperatures.append(ambient)
    output = np.concatenate(outputs) + rng.normal(0.0, 0.04, 2 * count)
    columns: dict[str, Any] = {"run": runs, "time": np.concatenate([times, times + 1e5])}
    return bc.Measurements.from_arrays(
        INSTRUMENT, **columns, temperature=np.concatenate(temperatures), output=output
    )


class Page:
    """The workbench's page, without a browser: what it shows, and what is pressed on it."""

    def __init__(self, readings: bc.Measurements, folder: Path) -> None:
        model = INSTRUMENT.for_readings(readings).baseline()
        self.session = Session.open(model, readings, folder=folder)
        self.view: Any = page_of(self.session)

    def part(self, label: str) -> Any:
        (found,) = self.view.select(lambda one: getattr(one, "label", "") == label)
        return found

    def rows(self, label: str) -> list[dict[str, Any]]:
        return self.part(label).rows

    def wait(self, ready: Callable[[], Any]) -> None:
        ends = time.monotonic() + 120.0
        while not ready():
            assert time.monotonic() < ends, "the page did not change"
            time.sleep(0.02)

    def add(self, row: str) -> None:
        """Press *Add* beside a candidate, and wait until what is missing from that state stands there."""
        steps = len(self.rows("Steps"))
        self.part("Candidates")._handle_msg({"row": row, "action": "add"})
        self.wait(lambda: len(self.rows("Steps")) > steps and self.rows("Candidates"))


def estimate(decided: object) -> tuple[float, float]:
    """Return the estimate of the limited quantity and its standard uncertainty, °/s."""
    found = re.search(r"([\d.]+) ± ([\d.]+) °/s", str(decided))
    assert found is not None
    return float(found[1]), float(found[2])


@pytest.mark.parametrize(("seed", "quadratic"), [(1, 6e-4), (8, 8e-5)])
def test_clicks_and_calibrate_give_one_model_and_one_result(
    seed: int, quadratic: float, tmp_path: Path
) -> None:
    """At the size of seed 8 a curve is in doubt: the result is the average over the structures."""
    readings = behind_its_thermometer(seed, quadratic)
    trail = bc.calibrate(INSTRUMENT.baseline(), readings)
    families = {form.name: e.name for e in INSTRUMENT.candidates for form in e.forms}
    page = Page(readings, tmp_path)
    page.wait(lambda: page.rows("Candidates"))
    for _ in range(4):
        names = {row["id"] for row in page.rows("Effects of the model")}
        offered = {row["id"] for row in page.rows("Candidates")}
        assert offered.isdisjoint(names | {families[n] for n in names if n in families})
        found = [row["id"] for row in page.rows("Candidates") if row["kind"] == "found"]
        if not found:
            break
        page.add(found[0])
    assert names == set(trail.final.calibration.model.names)
    value, sd = estimate(bc.decide(page.session.search_path().calibration, [LIMIT]))
    expected, expected_sd = estimate(bc.decide(trail.calibration, [LIMIT]))
    assert value == pytest.approx(expected, abs=0.1 * expected_sd)
    assert sd == pytest.approx(expected_sd, rel=0.05)


def test_a_form_in_the_model_leaves_nothing_of_its_family_missing() -> None:
    readings = behind_its_thermometer(1, 6e-4)
    model = INSTRUMENT.baseline() + "bias.thermal_lag.body"
    found = bc.discover(bc.fit(model, readings, bc.LeastSquares()))
    assert "bias.thermal_lag" not in {c.effect for c in found.candidates}
    assert {n for s in found.findings for n in s.effects} == {"bias.temperature_quadratic"}
