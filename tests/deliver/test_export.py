"""What is exported computes what Python computes: C99 in double and single precision, Python, JSON."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import run
from tests.support.export_check import inputs_of, needs_compiler, random_rows, run_header, tilted
from tests.support.inside import compensate_file
from tests.support.made_up import bent_sensor, split_search

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


MADE = {
    "bent": lambda: bc.compensator(bent_sensor.calibration()),
    "gyro": lambda: bc.compensator(bent_sensor.gyro()),
    "inclinometer": lambda: tilted()[0],
    "averaged over structures": lambda: bc.compensator(split_search.trail().calibration),
}


@pytest.fixture(scope="module", params=list(MADE))
def compensator(request) -> bc.Compensator:
    """One with memory, shapes, a user's own effect and no closed inverse; a straight line; angles."""
    return MADE[request.param]()


@pytest.fixture(scope="module")
def rows(compensator) -> np.ndarray:
    return random_rows(compensator, 10_000)


def expected(compensator: bc.Compensator, rows: np.ndarray) -> np.ndarray:
    """By JAX: value, uncertainty without and with noise."""
    given = inputs_of(compensator, rows)
    plain = compensator(output=rows[:, 0], method="first order", noise=False, **given)
    noisy = compensator(output=rows[:, 0], method="first order", **given)
    return np.column_stack([plain.value, plain.uncertainty, noisy.uncertainty])


@pytest.mark.slow
@needs_compiler
def test_the_header_in_double_precision_agrees_to_twelve_digits(
    compensator, rows, tmp_path
) -> None:
    found, want = run_header(compensator, rows, tmp_path), expected(compensator, rows)
    np.testing.assert_allclose(found[:, 1:3], want[:, 1:], rtol=1e-12)
    # A value near zero is a difference of large numbers: its digits are those of the reading, in the value's unit.
    value, wanted = found[:, 0], want[:, 0]
    np.testing.assert_array_equal(np.isnan(value), np.isnan(wanted))
    floor = 1e-3 * np.abs(wanted).max()
    assert np.max(np.abs(value - wanted) / np.maximum(np.abs(wanted), floor)) < 1e-12


@needs_compiler
def test_the_header_in_single_precision_agrees_to_its_own_rounding(
    compensator, rows, tmp_path
) -> None:
    found = run_header(compensator, rows, tmp_path, "float")
    value, _, inclination = compensator.program.run(rows[:, 0], inputs_of(compensator, rows))
    eps, want = float(np.finfo(np.float32).eps), expected(compensator, rows)
    size = inclination * np.abs(rows[:, 0]).max()  # in the value's unit
    assert np.max(np.abs(found[:, 0] - value) / size) < 16 * eps
    np.testing.assert_allclose(found[:, 1:3], want[:, 1:], rtol=1e-4)


@needs_compiler
def test_the_header_flags_each_input_outside_its_range(compensator, rows, tmp_path) -> None:
    row = np.array([np.median(rows, axis=0)] * (1 + len(compensator.inputs)))
    for k, i in enumerate(compensator.inputs):
        row[1 + k, 1 + k] = i.high + 0.5 * (i.high - i.low)
    flags = run_header(compensator, row, tmp_path)[:, 3].astype(int)
    own = (1 << len(compensator.inputs)) - 1
    bits = [0 if i.settled else 1 << k for k, i in enumerate(compensator.inputs)]
    assert [f & own for f in flags] == [0, *bits]


def test_an_effect_that_firmware_cannot_compute_is_refused(tmp_path) -> None:
    gyro = bent_sensor.gyro()
    sorting = bc.Effect(
        "bias.sorted",
        "bias",
        basis=lambda r: jnp.sort(jnp.stack([r["temperature"], r["temperature"] ** 2]), axis=0)[0],
        coefficients=(bc.Coefficient("deg/s/degC"),),
        columns=("temperature",),
    )
    fit = bc.fit(gyro.model + sorting, gyro.readings, bc.LeastSquares(draws=40), strict=False)
    with pytest.raises(bc.ModelError):
        bc.compensator(fit).export(tmp_path / "gyro.h")


# A file is compensated by two columns more; all else stays as it was, or nothing is written.


TEXT = (
    b"\xef\xbb\xbf# logged by hand\r\nnote;when;board [degC];gyro x [deg/s]\r\n"
    b'"a;b";1;40.5;25.25\r\n\r\nsecond;2;1.0e2;-7.5\r\nthird;3;55;0'
)
OWN = ("--instrument", f"{Path(mems_gyro.__file__).parent / 'model.py'}:INSTRUMENT")
RENAMED = {"output": "gyro x", "temperature": "board"}


@pytest.fixture(scope="module")
def gyro() -> bc.Compensator:
    return bc.compensator(bent_sensor.gyro())


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    return bent_sensor.gyro().save(tmp_path_factory.mktemp("saved") / "calibration.nc")


def test_every_line_of_a_csv_stays_as_it_was(gyro, tmp_path) -> None:
    (tmp_path / "in.csv").write_bytes(TEXT)
    done = compensate_file(gyro, tmp_path / "in.csv", tmp_path / "out.csv", columns=RENAMED)
    before, after = TEXT.split(b"\n"), (tmp_path / "out.csv").read_bytes().split(b"\n")
    assert done.rows == 3 and done.columns == ("gyro x_compensated", "gyro x_standard_uncertainty")
    heads = b";gyro x_compensated [deg/s];gyro x_standard_uncertainty [deg/s]\r"
    assert after[1] == before[1].rstrip() + heads
    assert after[0] == before[0] and after[3] == before[3]
    want = gyro(output=[25.25, -7.5, 0.0], temperature=[40.5, 100.0, 55.0])
    rows = [line for line in after[2:] if line.strip()]
    for i, (row, old) in enumerate(zip(rows, [b for b in before[2:] if b.strip()], strict=True)):
        assert row.startswith(old.rstrip() + b";")
        value, uncertainty = (float(cell) for cell in row.decode().strip().split(";")[-2:])
        assert (value, uncertainty) == (want.value[i], want.uncertainty[i])
    assert done.outside == {"temperature": 1}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_all_formats_keep_their_columns_and_gain_two(suffix, tmp_path) -> None:
    """Of a model with memory: the record is read whole, time and all."""
    bent, record = bc.compensator(bent_sensor.calibration()), bent_sensor.readings(2)
    path, out = tmp_path / f"in{suffix}", tmp_path / f"out{suffix}"
    record.write(tmp_path / "in.csv")
    if suffix == ".parquet":
        pd.read_csv(tmp_path / "in.csv").to_parquet(path)
    done = compensate_file(bent, path, out)
    assert done.rows == len(record) and done.unsolved == 0
    want, back = bent(record), bc.read(out, bent_sensor.SENSOR)
    for name in record.columns:
        np.testing.assert_array_equal(back[name], record[name])
    np.testing.assert_allclose(back["output_compensated"], want.value, rtol=1e-12)
    np.testing.assert_allclose(back["output_standard_uncertainty"], want.uncertainty, rtol=1e-12)
    if suffix == ".parquet":
        fields = pq.read_schema(out)
        assert fields.field(len(fields) - 1).metadata == {b"units": b"ug"}


def test_a_refused_file_leaves_the_old_one_whole(gyro, tmp_path) -> None:
    out = tmp_path / "out.csv"
    out.write_text("precious")
    good = "temperature [degC],output [deg/s]\n" + "40,1\n" * 5
    cases = (
        good + "40,warm\n",
        good.replace("temperature", "pressure"),
        good.replace("[degC]", "[rad]"),
        "temperature [degC],output [deg/s],output_compensated\n40,1,2\n",
        good + "40\n",
    )
    for text in cases:
        (tmp_path / "in.csv").write_text(text)
        with pytest.raises(bc.InputError):
            compensate_file(gyro, tmp_path / "in.csv", out)
        assert out.read_text() == "precious"
        assert sorted(p.name for p in tmp_path.iterdir()) == ["in.csv", "out.csv"]
    with pytest.raises(bc.InputError):
        compensate_file(gyro, tmp_path / "in.csv", tmp_path / "out.parquet")


def test_the_commands_compensate_export_and_budget(saved, tmp_path) -> None:
    bent_sensor.gyro().readings.write(tmp_path / "in.csv")
    ran = run("compensate", saved, tmp_path / "in.csv", "-o", tmp_path / "out.csv", *OWN, "--json")
    assert ran.status == 0, ran.err
    assert ran.data["rows"] == len(bent_sensor.gyro().readings)
    ran = run(
        "budget", saved, "--at", "temperature=60", "--at", "rate_input=50", "-k", 3, "--json", *OWN
    )
    assert ran.status == 0, ran.err
    assert ran.data["k"] == 3 and ran.data["at"] == {"rate_input": 50.0, "temperature": 60.0}
