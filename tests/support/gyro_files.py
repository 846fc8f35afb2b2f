"""A gyro's columns, and the head of its files: what the tests of reading share."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

import bayescal as bc

VOLTS = bc.NominalScale("V", gain=0.001, offset=1.2)


@dataclass(frozen=True)
class Gyro:
    name: str = "test_gyro"
    nominal_scale: bc.NominalScale | None = VOLTS
    columns: tuple[bc.Column, ...] = (
        bc.Column("run", None, "label of the run", required=False),
        bc.Column("group", None, required=False, allowed=("outer", "inner")),
        bc.Column("temperature_point", "degC", required=False),
        bc.Column("time", "s", required=False),
        bc.Column("temperature", "degC", "thermometer", low=-273.15, high=250.0),
        bc.Column("lab_temperature", "degC", required=False),
        bc.Column("position_angle", "rad", required=False, low=-6.3, high=6.3),
        bc.Column("rate_input", "deg/s", required=False, default=0.0),
        bc.Column("output", "deg/s"),
    )


GYRO = Gyro()
HEAD = "run,time [s],temperature [degC],output [deg/s]\n"
GOOD = HEAD + "a,0,20,1.5\na,10,25,1.6\nb,0,30,1.8\n"


def refused(path, message: str, **options) -> None:
    with pytest.raises(bc.InputError, match=message):
        bc.read(path, GYRO, **options)
