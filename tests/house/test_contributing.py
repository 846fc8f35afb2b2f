"""The changes that CONTRIBUTING.md makes from beginning to end: each block is run at the end of the file it names."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support import references

PAGE = (Path(__file__).resolve().parents[2] / "CONTRIBUTING.md").read_text("utf-8")
BLOCKS = dict(re.findall(r'^```python title="(.+?)"\n(.*?)^```', PAGE, re.DOTALL | re.MULTILINE))


def put_in(file: str, **imported: Any) -> dict[str, Any]:
    """The names of a module with a block at its end; of the module itself its tables alone have what the block adds."""
    module = file.removesuffix(".py").replace("/", ".")
    space = vars(import_module(module)).copy() if "/" in file else {"__name__": module}
    space |= imported
    exec(compile(BLOCKS[file], file, "exec", 0, True), space)
    return space


@pytest.fixture
def hum() -> Iterator[dict[str, Any]]:
    """Names of the module of noise terms while it has one more."""
    module: Any = import_module("bayescal._model.noise_terms")
    yield put_in("bayescal/_model/noise_terms.py")
    del module.TERMS["hum"]


def test_the_noise_term_is_the_process_that_it_claims_to_be(hum, rng) -> None:
    frame = references.calibration("mems_gyro").frame
    time, run = np.asarray(frame["time"]), np.asarray(frame.codes["run"])
    step, size, frequency, white = 30.0, 0.6, 1e-3, 0.3
    at = {"noise.white": white, "noise.hum": size, "noise.hum.frequency": frequency}
    lag = time[:, None] - time
    dense = size**2 * np.cos(2 * np.pi * frequency * lag) * (run[:, None] == run)
    dense += white**2 * np.eye(len(time))
    law: Any = bc.SummedNoise(step, 4000.0, ("hum",))
    assert not law.stationary  # it has no spectrum: evenly spaced readings are filtered too
    columns = rng.standard_normal((len(time), 2))
    whitened, _ = law.whiten(jnp.asarray(columns), 0.0, at, frame)
    np.testing.assert_allclose(
        whitened, np.linalg.solve(np.linalg.cholesky(dense), columns), rtol=1e-8, atol=1e-8
    )
    for m in (1, 2, 4, 8):
        weight = np.repeat([1 / m, -1 / m], m)
        even = size**2 * np.cos(
            2 * np.pi * frequency * step * np.subtract.outer(*2 * [np.arange(2 * m)])
        )
        term = law.parts[0].allan(at, np.array([m]), step)
        assert term == pytest.approx(0.5 * weight @ even @ weight, rel=1e-9)


def test_contributed_instrument_is_recovered() -> None:
    instrument = put_in("tilt_cell.py")["INSTRUMENT"]
    time = 60.0 * np.arange(240)
    columns = {"time": time, "temperature": 25 + 20 * np.sin(time / 2000), "output": np.cos(time)}
    columns["angle"] = np.random.default_rng(1).uniform(-600, 600, time.size)
    readings = bc.Measurements.from_arrays(instrument, **columns)
    assert "no error" in str(bc.check_instrument(instrument, readings))


def test_the_format_holds_the_covariance() -> None:
    program = bc.compensator(references.calibration("mems_gyro")).program
    quoting: Any = import_module("bayescal._core.quoting")
    space = put_in("bayescal/_use/correction_files.py", format_csv_line=quoting.format_csv_line)
    try:
        rows = list(csv.reader(space["as_text"](program, "csv").splitlines()))
    finally:
        del space["SINGLE_OUTPUT"].suffixes[".csv"], space["SINGLE_OUTPUT"].writers["csv"]
    assert rows[0][3:] == [row[0] for row in rows[1:]]
    covariance = np.array([row[3:] for row in rows[1:]], dtype=float)
    np.testing.assert_array_equal(covariance, program.covariance)


def test_the_check_tells_a_channel_that_was_logged_twice() -> None:
    check = put_in("bayescal/_data/dataset_checks.py")["_of_copies"]
    readings = mems_gyro.simulate(seed=1)
    columns = {name: readings[name] for name in readings.columns}
    assert not check(columns)
    (said,) = check({**columns, "board_temperature": columns["temperature"]})
    assert "logged twice" in said
