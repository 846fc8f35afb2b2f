"""Commands average long logs where they are asked to, and propose it where they are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from tests.support.command_line import QUICK, needs_installation, run

pytestmark = needs_installation
STILL = ("--instrument", "still_sensor")


def write_log(path: Path, rows: int, seed: int, spike: float = 0.0) -> Path:
    """Ten readings a second at rest, a slow wave of temperature, noise of 20 µg."""
    rng = np.random.default_rng(seed)
    time = 0.1 * np.arange(rows)
    temperature = 25 + 5 * np.sin(time / 200.0)
    output = 300 + 12 * (temperature - 25) + rng.normal(0.0, 20.0, rows)
    output[rows // 3] += spike
    columns = {"time [s]": time, "temperature [degC]": temperature, "output [ug]": output}
    pd.DataFrame(columns).round(4).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("averaged") / "log.csv", 6000, 1)


def test_a_calibration_of_means_is_saved_verified_and_predicts(log: Path, tmp_path: Path) -> None:
    fitted = run("fit", log, *STILL, *QUICK, "--average", "1s", "--out", tmp_path)
    assert fitted.status == 0, fitted.err
    loaded = bc.load(tmp_path / "calibration.nc")
    assert len(loaded.readings) == 600
    assert run("check", tmp_path / "calibration.nc").status == 0
    predicted = run("predict", tmp_path / "calibration.nc", log, "--average", "1 s", "--json").data
    assert predicted["rows"] == 600
    assert predicted["rmse"] == pytest.approx(predicted["expected_rmse"], rel=0.1)


@pytest.mark.slow
def test_a_loop_over_means_sets_spikes_aside_before(tmp_path: Path) -> None:
    log, kept = (write_log(tmp_path / f"{n}.csv", 3000, n, spike=2000.0) for n in (2, 3))
    asked = ("--average", "1s", "--max-effects", 1, *QUICK, "--json")
    found = run("calibrate", log, *STILL, "--holdout", kept, *asked)
    assert found.status == 0, found.err
    step = found.data["steps"][-1]
    assert step["holdout_rmse"] == pytest.approx(20 / np.sqrt(10), rel=0.2)
