"""Hold-out data cut from the record that was fitted go on with its lags, its runs and its correlated noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro, still_sensor
from tests.support.inside import Whitening, said_of_holdout
from tests.support.tiers import slow_but

SENSOR, QUICK = still_sensor.INSTRUMENT, bc.LeastSquares(draws=200)
STEP, TAU, LAG, NOISE = 20.0, 1500.0, 40.0, 1.0


def lagging(rows: int = 900, seed: int = 1) -> dict[str, Any]:
    """A body of 25 minutes behind a temperature that goes up and down."""
    random, time = np.random.default_rng(seed), STEP * np.arange(rows)
    temperature = 30 + 12 * np.sin(time / 1300 + seed) + 3 * np.sin(time / 371)
    behind = np.zeros(rows)
    for i in range(1, rows):
        kept, step = np.exp(-STEP / TAU), temperature[i] - temperature[i - 1]
        behind[i] = kept * behind[i - 1] + step * np.expm1(-STEP / TAU) / (STEP / TAU)
    output = 2 * (temperature - 30) + LAG * behind + NOISE * random.standard_normal(rows)
    return {"time": time, "temperature": temperature, "output": output}


def readings(columns: dict[str, Any], rows: np.ndarray) -> bc.Measurements:
    chosen: dict[str, Any] = {name: values[rows] for name, values in columns.items()}
    return bc.Measurements.from_arrays(SENSOR, units={"output": "ug"}, **chosen)


WHOLE = lagging()
EARLY, LATE = np.arange(600), np.arange(600, 900)
BLOCKS = np.arange(900) // 15 % 2 == 1  # of five minutes, a fifth of the time constant


def fitted(part: bc.Measurements) -> bc.Calibration:
    model = SENSOR.for_readings(part).baseline() + "bias.thermal_lag"
    return bc.fit(model, part, QUICK, strict=False)


@pytest.mark.parametrize("cut", slow_but(["end"], ["end", "blocks"]))
def test_a_lag_goes_on_in_hold_out_data_cut_from_the_record(cut: str) -> None:
    kept = LATE if cut == "end" else np.flatnonzero(BLOCKS)
    used = EARLY if cut == "end" else np.flatnonzero(~BLOCKS)
    calibration, later = fitted(readings(WHOLE, used)), readings(WHOLE, kept)
    # between blocks the fit interpolates the temperature, which costs a little
    assert bc.predict(calibration, later).rmse < (1.2 if cut == "end" else 3.0) * NOISE
    moved = later.with_column("time", later["time"] + 1e6)  # of another day: the past is not known
    assert bc.predict(calibration, moved).rmse > 10 * NOISE


def test_a_clock_of_dates_goes_on_in_a_second_file(tmp_path: Path) -> None:
    start = np.datetime64("2026-03-01T10:00:00")
    for name, rows in (("early.csv", EARLY), ("late.csv", LATE)):
        lines = ["time,temperature [degC],output [ug]"]
        for i in rows:
            at = start + np.timedelta64(int(WHOLE["time"][i]), "s")
            lines.append(
                f"{at},{WHOLE['temperature'][i]:.6f},{WHOLE['output'][i]:.6f}".replace("T", " ")
            )
        (tmp_path / name).write_text("\n".join(lines) + "\n", "utf-8")
    early, late = (bc.read(tmp_path / name, SENSOR) for name in ("early.csv", "late.csv"))
    assert late["time"][0] == 0.0
    assert bc.predict(fitted(early), late).rmse == pytest.approx(NOISE, rel=0.2)


def test_correlated_noise_goes_on_from_the_last_readings() -> None:
    random = np.random.default_rng(3)
    rows, tau = 600, 2000.0
    time, kept = STEP * np.arange(rows), np.exp(-STEP / tau)
    wander = np.zeros(rows)
    for i in range(1, rows):
        wander[i] = kept * wander[i - 1] + 20 * np.sqrt(1 - kept**2) * random.standard_normal()
    columns = {
        "time": time,
        "temperature": 30 + 5 * np.sin(time / 900),
        "output": wander + NOISE * random.standard_normal(rows),
    }
    early, late = readings(columns, np.arange(560)), readings(columns, np.arange(560, 565))
    model = (
        SENSOR.for_readings(early)
        .baseline()
        .with_noise(bc.OrnsteinUhlenbeck(200.0, 2e4, correlated=bc.HalfCauchy(20.0)))
    )
    calibration = bc.fit(model, early, QUICK, strict=False)
    found = bc.predict(calibration, late)
    first = found.residual[0]
    assert abs(first) < 4 * found.sd[0] < 0.5 * 4 * 20  # the next reading is known better than any
    assert np.all(np.diff(found.sd) > 0)  # and those after it less and less


@pytest.mark.parametrize(
    "terms",
    [("walk",), pytest.param(("correlated", "smooth"), marks=pytest.mark.slow)],
    ids="+".join,
)
def test_a_level_that_noise_and_coefficients_share_is_uncertain_once(terms) -> None:
    """A prediction between readings and beyond them is that of the dense process, coefficients integrated out."""
    random, time = np.random.default_rng(5), STEP * np.arange(400)
    temperature = 30 + 5 * np.sin(time / 900)
    walk = np.cumsum(0.5 * random.standard_normal(400))
    output = 4 * temperature + walk + NOISE * random.standard_normal(400)
    columns = {"time": time, "temperature": temperature, "output": output}
    held = (np.arange(400) // 40 % 3 == 1) | (np.arange(400) >= 360)
    early, late = readings(columns, np.flatnonzero(~held)), readings(columns, np.flatnonzero(held))
    law = bc.SummedNoise(STEP, time[-1], terms, bc.HalfCauchy(10.0), bc.HalfCauchy(100.0))
    calibration = bc.fit(SENSOR.for_readings(early).baseline().with_noise(law), early, QUICK)
    found = bc.predict(calibration, late)
    values = calibration.problem.hyper(calibration.mode.v)
    inside, spread = law.slow_part(
        values,
        time[~held],
        np.eye(np.sum(~held)),
        np.full(np.sum(~held), values["noise.white"] ** 2),
        time[held],
    )
    design = np.column_stack([np.ones(400), temperature - 30])
    # Universal kriging: N. Cressie, Statistics for Spatial Data (1993), section 3.4.
    known, left = design[~held], design[held] - inside @ design[~held]
    record = calibration.problem.record
    half = Whitening(law, values, record)(np.eye(record.size))
    precise = half.T @ half
    covariance = np.linalg.inv(known.T @ precise @ known)
    x = covariance @ known.T @ precise @ output[~held]
    expected = design[held] @ x + inside @ (output[~held] - known @ x)
    sd = np.sqrt(
        np.einsum("ij,jk,ik->i", left, covariance, left) + spread + values["noise.white"] ** 2
    )
    np.testing.assert_allclose(found.sd, sd, rtol=0.15)
    assert np.max(np.abs(found.mean - expected) / sd) < 0.3


# Hold-out data that are readings of the fit are said to be so.


@pytest.fixture(scope="module")
def campaign() -> bc.Measurements:
    return still_sensor.simulate(seed=1)


def test_hold_out_data_that_are_the_readings(campaign: bc.Measurements) -> None:
    later = campaign.with_column("time", campaign["time"] + 86400.0)
    renamed = campaign.with_column("run", np.char.add("later ", campaign["run"]))
    for holdout in (campaign, later, renamed):
        assert f" {len(campaign)} of the {len(campaign)} " in said_of_holdout(campaign, holdout)
    half = campaign.select(np.arange(0, len(campaign), 2))
    assert f" {len(half)} of the {len(half)} " in said_of_holdout(campaign, half)


def test_hold_out_data_that_are_new(campaign: bc.Measurements) -> None:
    assert said_of_holdout(campaign, still_sensor.simulate(seed=2)) == ""
    rows = np.arange(len(campaign)) % 2 == 0
    assert said_of_holdout(campaign.select(rows), campaign.select(~rows)) == ""
    rounded = campaign.with_column("output", 1000 * np.rint(campaign["output"] / 1000))
    rounded = rounded.with_column("temperature", 20 * np.rint(campaign["temperature"] / 20))
    assert said_of_holdout(rounded, rounded) == ""  # equal numbers say nothing there


@pytest.mark.parametrize("step", [0.15, 0.05])
def test_other_readings_share_rounded_numbers_by_chance(step: float) -> None:
    def rounded(seed: int) -> bc.Measurements:
        found = mems_gyro.simulate(seed=seed)
        for name, to in (("output", step), ("temperature", 0.5), ("board_temperature", 0.5)):
            found = found.with_column(name, to * np.floor(found[name] / to))
        return found

    fitted = rounded(1)
    assert said_of_holdout(fitted, rounded(101)) == ""
    assert said_of_holdout(fitted, fitted.select(np.arange(200))) != ""
