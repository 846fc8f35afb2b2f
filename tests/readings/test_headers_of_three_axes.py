"""Outputs of three axes by their headers: a triple in their dimension needs no option where there is just one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import accelerometer_triad, gyro_triad, magnetometer_triad

ACCELEROMETERS = (
    "ax ay az",
    "a_x a_y a_z",
    "Accel X,Accel Y,Accel Z",
    "x y z",
    "fx fy fz",
    "gx gy gz",
)
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
    ("uT", "bx by bz"),
    ("uT", "x_mag y_mag z_mag"),
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
