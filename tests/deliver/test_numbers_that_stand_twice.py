"""A number that stands twice is one number: on the screen, in result.json, in every export, in what is corrected."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._cli.output import coefficients_text
from bayescal._core.formatting import with_error
from bayescal_models import (
    accelerometer_triad,
    differential_pair,
    gyro_triad,
    inclinometer,
    magnetometer_triad,
    mems_gyro,
    ng_accelerometer,
    quartz_beam_accelerometer,
    still_sensor,
)
from tests.support.inside import result_of, text_of
from tests.support.made_up import split_search

yaml = pytest.importorskip("yaml")
Trail = Callable[[], bc.SearchPath]


def searched(module: Any, hidden: dict[str, Any] | None = None, **how: Any) -> bc.SearchPath:
    readings = module.simulate(hidden, seed=3)
    model = module.INSTRUMENT.for_readings(readings).baseline()
    return bc.calibrate(model, readings, method=bc.LeastSquares(draws=400), **how)


@cache
def triad_trail() -> bc.SearchPath:
    """Of accelerometers whose second order is hardly visible: structures with and without it share the probability."""
    campaign = accelerometer_triad.Campaign(poses=14, temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))
    readings = accelerometer_triad.simulate({"square.constant": 1.2}, seed=3, campaign=campaign)
    return bc.calibrate(accelerometer_triad.INSTRUMENT.baseline(), readings)


slow = partial(pytest.param, marks=pytest.mark.slow)
SEARCHED = (
    ng_accelerometer,
    quartz_beam_accelerometer,
    differential_pair,
    inclinometer,
    still_sensor,
)
ONE_OUTPUT: list[Any] = [
    pytest.param(split_search.trail, id="averaged over structures"),
    pytest.param(lambda: searched(mems_gyro, max_effects=0), id="gyro"),
    *(slow(partial(searched, module), id=module.INSTRUMENT.name) for module in SEARCHED),
]
THREE_AXES: list[Any] = [
    pytest.param(triad_trail, id="averaged over structures"),
    slow(partial(searched, gyro_triad, {"bias.g_sensitivity": 0.003}), id="gyroscopes"),
    slow(partial(searched, magnetometer_triad), id="magnetometers"),
]


def on_screen(trail: bc.SearchPath) -> dict[str, str]:
    """Name → mean ± standard uncertainty, as the table of coefficients shows it."""
    rows = (re.split(r"  +", line) for line in coefficients_text(trail, verbose=True).splitlines())
    return {row[0]: row[1] for row in rows if len(row) > 3}


def in_result(trail: bc.SearchPath) -> dict[str, str]:
    """What result.json says that is used."""
    data = json.loads(json.dumps(result_of(trail)))
    rows = (*data["coefficients"], *data["hyperparameters"])
    used = ((row["name"], row["averaged"] or row) for row in rows)
    return {name: with_error(row["mean"], row["sd"]) for name, row in used}


@pytest.mark.parametrize("made", ONE_OUTPUT)
def test_of_one_output(made: Trail) -> None:
    trail = made()
    screen, data = on_screen(trail), in_result(trail)
    both = {name: cell for name, cell in screen.items() if name in data}
    assert both and all(cell == data[n] or "skewed" in cell for n, cell in both.items())
    instrument = trail.final.calibration.model.instrument
    if instrument.use is None:  # of pairs nothing is exported
        return
    members = {"axis": "x"} if instrument.name == "inclinometer" else None
    compensator = bc.compensator(trail.calibration, members=members)
    program = compensator.program
    sds = np.sqrt(np.diag(program.covariance))
    compared = 0
    for unknown, sd in zip(program.unknowns, sds, strict=True):
        if (
            unknown.name not in screen
        ):  # of a new member, of a curve, or of effects counted as at one place
            assert "(" in unknown.name or ": " in unknown.name
            continue
        compared += 1
        exported = with_error(unknown.mean, sd)
        cell = screen[unknown.name]
        assert exported == cell or cell.endswith("skewed")
        for language in ("c", "python"):
            line = f"{unknown.name} = {unknown.mean:.9g} +- {sd:.3g}"
            assert line in text_of(program, language)
    assert compared > 0
    inputs: dict[str, Any] = {i.name: 0.2 * i.low + 0.8 * i.high for i in compensator.inputs}
    reading = float(trail.final.calibration.readings["output"][0])
    by_draws, exported = (
        compensator(output=reading, noise=False, warn=False, method=method, **inputs)
        for method in ("draws", "first order")
    )
    # The equation may bend within the uncertainty; where it does not, all digits are the same.
    own = exported.uncertainty[0]
    assert by_draws.value[0] == pytest.approx(exported.value[0], abs=0.02 * own)
    assert by_draws.uncertainty[0] == pytest.approx(own, rel=0.01)
    said = json.loads(text_of(program, "json"))
    assert [u["mean"] for u in said["unknowns"]] == [u.mean for u in program.unknowns]
    assert np.array_equal(said["covariance"], program.covariance)


@pytest.mark.slow
@pytest.mark.parametrize("made", THREE_AXES)
def test_of_three_axes(made: Trail, tmp_path: Path) -> None:
    from bayescal._cli.deliverables import triad_text

    trail = made()
    correct = bc.vector_correction(trail.calibration)
    text = triad_text(trail, correct)
    screen = dict(re.split("  +", line)[:2] for line in text.splitlines() if "  " in line)
    data = json.loads(json.dumps(result_of(trail)))["vector"]
    data = data["averaged"] or data
    assert data["terms"] == correct.terms.tolist()
    assert np.allclose(data["uncertainty"], correct.uncertainty, rtol=1e-12)
    c, python, json_ = (text_of(correct, f) for f in ("c", "python", "json"))
    assert json.loads(json_)["terms"] == data["terms"]
    assert json.loads(json_)["covariance"] == data["covariance"]
    for row in correct.rows:
        assert screen[str(row)] == with_error(row.value, row.uncertainty)
        words = f"{row.value:.9g} +- {row.uncertainty:.3g}"
        assert words in c and words in python and repr(row.value) in c and repr(row.value) in python
    # Coefficients are the correction in other words, where a new run brings nothing of its own.
    coefficients = on_screen(trail)
    for i, a in enumerate("xyz"):
        factor = 1e-3 if correct.unit == "g" else 1.0  # mg
        offset = correct.offset[i] / factor, correct.uncertainty[0, i] / factor
        assert with_error(*offset) == coefficients[f"bias.constant[{a}]"]
    # Where nothing acts, what is corrected is the offset.
    found = correct(correct.offset[None], correct.reference, noise=0.0)
    assert found.vector == pytest.approx(0.0, abs=1e-12)
    spread = correct.matrix @ found.covariance[0] @ correct.matrix.T
    assert np.sqrt(np.diag(spread)) == pytest.approx(correct.uncertainty[0, :3], rel=1e-6)
    plain = yaml.safe_load(text_of(correct, "yaml"))["imu0"]
    assert np.array(next(iter(plain.values()))["matrix"]).shape == (3, 3)
