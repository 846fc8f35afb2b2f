"""Every way out of a calibration gives one number: readings as a whole, in C and in Python row by row."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import inclinometer, mems_gyro, still_sensor
from tests.support.export_check import needs_compiler, run_c, tilted, to_identifier
from tests.support.inside import text_of
from tests.support.made_up import bent_sensor, split_search
from tests.support.tiers import slow_but

TIGHT = 1e-12  # of the largest value in a record
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def of(module: Any, *effects: str, members: dict[str, str] | None = None, **campaign: Any):
    """A compensator of an instrument with these effects, and the record that it was fitted to."""
    readings = module.simulate(seed=3, **campaign)
    instrument = module.INSTRUMENT.for_readings(readings)
    model = instrument.baseline()
    model = model + [e for e in effects if e not in model.names and ":" not in e]
    for covariate in (e.removeprefix("unknown:") for e in effects if e.startswith("unknown:")):
        model = model + instrument.unknown(covariate)
    fit = bc.fit(model, readings, bc.LeastSquares(draws=60), strict=False)
    return bc.compensator(fit, members=members), readings


def averaged() -> tuple[bc.Compensator, bc.Measurements]:
    average = split_search.trail().calibration
    return bc.compensator(average), average.readings


def held() -> tuple[bc.Compensator, bc.Measurements]:
    """A lag of a thermometer that stands between readings."""
    readings = mems_gyro.simulate(seed=3, campaign=mems_gyro.Campaign(average=300))
    model = mems_gyro.INSTRUMENT.baseline() + "bias.thermal_lag"
    asked = {"temperature_held": 1.0}
    return bc.compensator(
        bc.fit(model, readings, bc.LeastSquares(draws=60), reference=asked)
    ), readings


MADE: dict[str, Callable[[], tuple[bc.Compensator, bc.Measurements]]] = {
    "gyro": lambda: of(
        *(mems_gyro, "scale.constant", "bias.rate", "bias.thermal_lag", "bias.run"),
        "unknown:temperature",
        campaign=mems_gyro.Campaign(average=300, runs=3, rate_input=(0.0, 100.0, -100.0)),
    ),
    "still sensor": lambda: of(
        still_sensor, "bias.thermal_lag", "bias.thermal_lag_slow", "bias.rate", "bias.warm_up"
    ),
    "inclinometer": lambda: of(
        inclinometer, "zero.temperature", "zero.cross_axis", members={"axis": "x"}
    ),
    "inclinometer, exact": tilted,
    "bent sensor": lambda: (bc.compensator(bent_sensor.calibration()), bent_sensor.readings(2)),
    "averaged over structures": averaged,
    "held between readings": held,
}


FAST = ("gyro", "bent sensor", "held between readings")


@pytest.fixture(scope="module", params=slow_but(FAST, MADE))
def case(request) -> tuple[bc.Compensator, bc.Measurements, np.ndarray]:
    """A compensator, one of its runs in order of time, and what that is compensated to by mean and covariance."""
    compensator, readings = MADE[request.param]()
    readings = one_run(readings)
    whole = compensator(readings, method="first order")
    own = compensator(readings, method="first order", noise=False)
    return compensator, readings, np.column_stack([whole.value, own.uncertainty, whole.uncertainty])


def one_run(readings: bc.Measurements) -> bc.Measurements:
    """The first record of the readings, in the order of time."""
    rows = np.ones(len(readings), bool)
    for group in ("run", "axis", "cell", "device"):
        if readings.has(group):
            rows &= readings.groups(group)[1] == 0
    chosen = np.flatnonzero(rows)
    if readings.has("time"):
        chosen = chosen[np.argsort(readings["time"][chosen], kind="stable")]
    return readings.select(chosen)


def agree(found: np.ndarray, wanted: np.ndarray) -> None:
    scale = np.abs(wanted).max(axis=0)
    assert scale.min() > 0
    assert np.abs(found - wanted).max(axis=0) / scale == pytest.approx(0, abs=TIGHT)


def steps(readings: bc.Measurements) -> np.ndarray:
    """Time since the reading before, below zero at the first."""
    return np.diff(readings["time"], prepend=readings["time"][0] + 1.0)


def columns(compensator: bc.Compensator) -> list[str]:
    """Of a record as an export asks for them: those used now, then those whose past is."""
    now = [i.column for i in compensator.inputs if i.kind == "column"]
    past = [i.column for i in compensator.inputs if i.kind not in ("column", "elapsed")]
    return list(dict.fromkeys([*now, *past]))


DRIVER = """
#include "{header}"
#include <stdio.h>
int main(void)
{{
    double row[{width}];
    static {name}_state state;
    while (fread(row, sizeof(double), {width}, stdin) == {width}) {{
        {name}_columns now;
        {name}_result out;
        double found[3];
        {fill}
        if (!{name}_update(&state, &now, (BAYESCAL_REAL)row[1])) {{
            return 1;
        }}
        out = {name}_correct(&state, (BAYESCAL_REAL)row[0]);
        found[0] = out.value;
        found[1] = out.uncertainty;
        found[2] = out.uncertainty_reading;
        fwrite(found, sizeof(double), 3, stdout);
    }}
    return 0;
}}
"""


@needs_compiler
def test_c_fed_row_by_row(case, tmp_path: Path) -> None:
    compensator, readings, wanted = case
    if not compensator.history:
        pytest.skip("nothing of the past is needed: every reading by itself, as test_export has it")
    header = compensator.export(tmp_path / "calibration.h")
    name, fed = to_identifier(compensator.program.about.instrument), columns(compensator)
    fill = " ".join(f"now.{to_identifier(c)} = row[{2 + k}];" for k, c in enumerate(fed))
    source = DRIVER.format(header=header.name, width=2 + len(fed), name=name, fill=fill)
    rows = np.column_stack([readings["output"], steps(readings), *(readings[c] for c in fed)])
    twice = np.concatenate([rows, rows])  # a run after a run begins anew
    found = run_c(source, twice, tmp_path).reshape(-1, 3)
    agree(found, np.concatenate([wanted, wanted]))


def test_python_fed_row_by_row(case) -> None:
    compensator, readings, wanted = case
    text, space = text_of(compensator.program, "python"), {}
    assert [line for line in text.splitlines() if "import" in line.split()] == ["import math"]
    exec(compile(text, "exported.py", "exec"), space)
    given, found = [readings[c] for c in columns(compensator)], []
    record = space["Record"]() if compensator.history else None
    after = steps(readings) if compensator.history else np.zeros(len(readings))
    for output, dt, *now in zip(readings["output"], after, *given, strict=True):
        if record is None:
            found.append(space["compensate"](output, *now)[:3])
        else:
            record.update(*now, dt=dt)
            found.append(record.correct(output)[:3])
    agree(np.array(found), wanted)
