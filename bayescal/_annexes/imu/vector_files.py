"""Corrections of three axes as a kind of corrections: the files they are written to, and read from again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.autopilot import AUTOPILOTS
from bayescal._annexes.imu.vector_correction import VectorCorrection
from bayescal._annexes.imu.vector_parameters import READ_BY_OTHERS, left_out, parameter_file
from bayescal._annexes.imu.vector_text import headers, module, vector_from_data

THREE_AXES = ws.CorrectionKind(
    of=VectorCorrection,
    axes="three axes",
    writers={
        "json": ws.as_data,
        "c": headers,
        "python": module,
        **{name: ws.in_form(write) for name, write in READ_BY_OTHERS.items()},
        **{autopilot: ws.in_form(parameter_file, autopilot) for autopilot in AUTOPILOTS},
    },
    suffixes={".json": "json", ".h": "c", ".py": "python", ".yaml": "yaml", ".yml": "yaml"},
    is_data=lambda data: "terms" in data,
    read=vector_from_data,
    loader="load_vector_correction",
    together=("c", "python", "yaml", "openvins", "realsense"),
    left_out=left_out,
)


KINDS = (THREE_AXES,)


def export_vector(
    correction: VectorCorrection,
    path: str | Path,
    format: str | None = None,
    *,
    others: Sequence[VectorCorrection] = (),
    name: str | None = None,
    uncertainty: bool = True,
) -> Path:
    """Write by the suffix of the path (.h, .py, .json, .yaml) or in a `format`.

    Args:
        correction: to write.
        path: of the file.
        format: "json", "c", "python", "yaml" (Kalibr), "openvins", "realsense", "ros", "px4-params" or
            "ardupilot-params", whatever the suffix.
        others: beside it in one file of C, Python, Kalibr, OpenVINS or RealSense, in the same body axes: gyroscopes
            beside accelerometers.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        uncertainty: with the covariance; False for C and Python that give what acts alone: of a plain offset and matrix
            twelve numbers are left.

    Raises:
        InputError: another suffix or format, others or no uncertainty in a format that holds none such, two triads of
            one instrument, a name that is none in C, or a place that cannot be written to.
    """
    how = {"name": name, "others": others, "uncertainty": uncertainty}
    return ws.write_text(ws.as_text(correction, ws.format_of(path, format), **how), path)


def load_vector_correction(path: str | Path) -> VectorCorrection:
    """A correction of three axes from its JSON file.

    Raises:
        InputError: there is no such file, it is none, or damaged.
    """
    found = ws.load_correction(path)
    if not isinstance(found, VectorCorrection):
        raise bc.InputError(
            f"{Path(path).name} is of one output: bayescal.load_compensator loads it"
        )
    return found
