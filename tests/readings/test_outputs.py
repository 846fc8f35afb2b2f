"""Several outputs of one file: the channels of a unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad, gyro_triad, magnetometer_triad, still_sensor

INSTRUMENT = still_sensor.INSTRUMENT
TIME = np.arange(40) * 10.0
TEMPERATURE = 20 + 0.125 * TIME


def unit(folder: Path, head: str = "time [s],temperature [degC],gyro_x [deg/s],acc_x [ug]") -> Path:
    path = folder / "unit.csv"
    table = np.column_stack([TIME, TEMPERATURE, 0.5 + 0.25 * TIME, 3.0 - TIME])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path


def test_each_output_is_read_in_its_own_unit_and_the_others_are_no_covariates(tmp_path) -> None:
    found = bc.read(unit(tmp_path), INSTRUMENT, outputs=["gyro_x", "acc_x"])
    assert list(found) == ["gyro_x", "acc_x"]
    np.testing.assert_array_equal(found["gyro_x"]["output"], 0.5 + 0.25 * TIME)
    np.testing.assert_array_equal(found["acc_x"]["output"], 3.0 - TIME)
    assert [one.unit("output") for one in found.values()] == ["deg/s", "ug"]
    assert all(set(one.columns) == {"time", "temperature", "output"} for one in found.values())


def test_units_may_be_given_for_all_of_them(tmp_path) -> None:
    path = unit(tmp_path, "time [s],temperature [degC],gyro_x,acc_x")
    units = {"gyro_x": "rad/s", "acc_x": "mg"}
    found = bc.read(path, INSTRUMENT, outputs=["gyro_x", "acc_x"], units=units)
    np.testing.assert_allclose(found["gyro_x"]["output"], np.rad2deg(0.5 + 0.25 * TIME), rtol=1e-12)
    np.testing.assert_allclose(found["acc_x"]["output"], 1e3 * (3.0 - TIME), rtol=1e-12)


def test_what_is_wrong_with_all_outputs_is_said_at_once_and_no_sentence_twice(tmp_path) -> None:
    path = unit(tmp_path, "time [s],temperature [degF2],gyro_x [m],acc_x")
    with pytest.raises(bc.InputError) as refused:
        bc.read(path, INSTRUMENT, outputs=["gyro_x", "acc_x", "gyro_z"])
    said = [str(problem) for problem in refused.value.problems]
    assert len(said) == len(set(said))
    for word in ("temperature", "acc_x", "gyro_z"):
        assert any(word in one for one in said), (word, said)


# Outputs of three axes by their headers: a triple in their dimension needs no option where there is just one.
ACCELEROMETERS = (
    "ax ay az", "a_x a_y a_z", "Accel X,Accel Y,Accel Z", "x y z", "fx fy fz", "gx gy gz",
)  # fmt: skip
GYROSCOPES = (
    "gx gy gz",
    "omega_x omega_y omega_z",
    "angular_velocity_x angular_velocity_y angular_velocity_z",
)
KINDS = {
    "m/s^2": (accelerometer_triad.INSTRUMENT, 9.80665, "rad/s"),
    "rad/s": (gyro_triad.INSTRUMENT, np.pi / 180, "m/s^2"),
    "uT": (magnetometer_triad.INSTRUMENT, 1.0, "m/s^2"),
}
CASES = [
    *(("m/s^2", names) for names in ACCELEROMETERS),
    *(("rad/s", names) for names in GYROSCOPES),
    *(("uT", names) for names in ("bx by bz", "x_mag y_mag z_mag")),
]


def table(folder: Path, *triples: tuple[str, str]) -> tuple[Path, np.ndarray]:
    """A file of triples of columns, each (names, unit); and the numbers of the first."""
    values = 1 + np.random.default_rng(1).uniform(size=(12, 3 * len(triples)))
    headers = [
        f"{name} [{unit}]"
        for names, unit in triples
        for name in (names.split(",") if "," in names else names.split())
    ]
    path = folder / "log.csv"
    np.savetxt(path, values, delimiter=",", header=",".join(headers), comments="")
    return path, values[:, :3]


@pytest.mark.parametrize(("unit", "names"), CASES)
def test_the_one_triple_in_their_dimension_is_read(unit: str, names: str, tmp_path: Path) -> None:
    instrument, factor, other = KINDS[unit]
    path, values = table(tmp_path, (names, unit), ("p q r", other))
    readings = bc.read(path, instrument)
    each = slice(None, None, len(readings) // len(values))
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(readings[f"output_{axis}"][each], values[:, i] / factor)


def test_of_two_triples_the_user_says_which(tmp_path: Path) -> None:
    path, values = table(tmp_path, ("left_x left_y left_z", "g"), ("right_x right_y right_z", "g"))
    with pytest.raises(bc.InputError, match="left_x"):
        bc.read(path, accelerometer_triad.INSTRUMENT)
    columns = {f"output_{a}": f"left_{a}" for a in "xyz"}
    readings = bc.read(path, accelerometer_triad.INSTRUMENT, columns=columns)
    np.testing.assert_allclose(readings["output_z"], values[:, 2])
