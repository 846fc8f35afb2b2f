"""A correction of three axes in reduced forms: a file for Kalibr, and the calibration parameters of autopilots.

Equations of these readers, and their sources:

* Kalibr (imu_models, scale-misalignment): a_measured = M·a + b + n, M lower triangular, the body's x axis that of the
  sensor x; https://github.com/ethz-asl/kalibr/wiki/Multi-IMU-and-IMU-intrinsic-calibration. A rotation takes ours
  there. A gyroscope has that rotation, ω_measured = M·C_gyro_i·ω + A·C_gyro_i·a + b, in rad/s and m/s².
* PX4 (src/lib/sensor_calibration): corrected = (raw − OFF)·SCALE on each axis of an accelerometer, in m/s², raw −
  OFF of a gyroscope, in rad/s; a symmetric matrix with ODIAG beside it for a magnetometer, in gauss.
* ArduPilot (AP_InertialSensor_Backend, AP_Compass_Backend): (raw − INS_ACCOFFS)·INS_ACCSCAL in m/s², raw − INS_GYROFFS
  in rad/s; for a compass DIA/ODI·(raw + OFS), symmetric, in mG.

Each gets the least-squares projection on its form, with a note of what that leaves out.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import polar

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.plain_correction import PlainCorrection, plain_correction
from bayescal._annexes.imu.vector_correction import VectorCorrection

NONE_LEFT = "Nothing is left out."
KINDS = {"rad/s": "gyroscope", "m/s^2": "accelerometer"}


def kalibr_yaml_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """Format the intrinsics as Kalibr defines them, in m/s² or rad/s where the unit converts to these.

    Others are in the same body axes, such as gyroscopes by moves between poses of these accelerometers: Kalibr's axes
    are then those of the first.
    """
    corrections = (correction, *others)
    frames = np.eye(3), *[_split(_in_kalibr(correction).matrix)[1]] * len(others)
    triads = [_intrinsics(c, frame) for c, frame in zip(corrections, frames, strict=True)]
    filters = {"row": _list, "rows": _rows, "comment": ws.c_comment}
    layout = ws.template("bayescal._annexes.imu", "intrinsics.yaml.jinja", filters)
    notes = dict.fromkeys(note for c in corrections for note in c.notes)
    return layout.render(version=bc.__version__, notes=notes, triads=triads)


def _in_kalibr(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, with_secondary=si_of(correction.unit)[1] == "rad/s")


def _split(matrix: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Factor a matrix into a lower triangle times a rotation."""
    lower = np.linalg.cholesky(matrix @ matrix.T)
    return lower, np.linalg.solve(lower, matrix)


def _intrinsics(correction: VectorCorrection, frame: np.ndarray) -> dict[str, Any]:
    """Return the template's values of one triad; `frame` rotates the body axes of the calibration to Kalibr's."""
    factor, unit = si_of(correction.unit)
    plain, kind = _in_kalibr(correction), KINDS.get(unit)
    lower, turn = _split(plain.matrix)
    by_force = None
    if kind == "gyroscope" and correction.beside:
        by_force = plain.terms[12:].reshape(3, 3) * factor / ws.STANDARD_GRAVITY @ turn.T
    return {
        "name": f"{kind}s" if kind else ws.identifier(correction.instrument),
        "calibrated_at": correction.calibrated_at,
        "left_out": plain.omitted or NONE_LEFT,
        **{"kind": kind, "unit": unit, "lower": lower, "turn": turn @ frame.T},
        **{"bias": plain.offset * factor, "bias_uncertainty": plain.uncertainty[:3] * factor},
        "matrix": plain.matrix,
        "matrix_uncertainty": plain.uncertainty[3:12].reshape(3, 3),
        "by_force": by_force,
    }


# Of the first sensor of a kind: offset, scale, and what stands beside the diagonal, each for an axis.
PARAMETERS = {
    "px4-params": {
        "accelerometer": ("CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE"),
        "gyroscope": ("CAL_GYRO0_{}OFF",),
        "magnetometer": ("CAL_MAG0_{}OFF", "CAL_MAG0_{}SCALE", "CAL_MAG0_{}ODIAG"),
    },
    "ardupilot-params": {
        "accelerometer": ("INS_ACCOFFS_{}", "INS_ACCSCAL_{}"),
        "gyroscope": ("INS_GYROFFS_{}",),
        "magnetometer": ("COMPASS_OFS_{}", "COMPASS_DIA_{}", "COMPASS_ODI_{}"),
    },
}


def autopilot_parameters(
    correction: VectorCorrection, autopilot: str
) -> tuple[dict[str, float], str]:
    """Return parameters of an autopilot's first sensor by name, and a sentence on what they leave out."""
    factor, unit = si_of(correction.unit)
    kind = "magnetometer" if ws.same_dimension(unit, "uT") else KINDS.get(unit, "")
    if kind == "accelerometer":
        plain = plain_correction(correction, "diagonal", with_secondary=False)
        values, omission = (plain.offset * factor, 1 / np.diag(plain.matrix)), plain.omitted
    elif kind == "gyroscope":
        plain = plain_correction(correction, "none", with_secondary=False)
        values, omission = (plain.offset * factor,), plain.omitted
    elif kind:
        values, omission = _symmetric(correction, -1e3 if autopilot == "ardupilot-params" else 1.0)
    else:
        raise bc.InputError(
            f"{autopilot}: there are parameters for accelerometers, gyroscopes and magnetometers, and these outputs "
            f"are in [{correction.unit}]"
        )
    named = zip(PARAMETERS[autopilot][kind], values, strict=True)
    return {
        name.format(axis): float(value)
        for name, by_axis in named
        for axis, value in zip("XYZ", by_axis, strict=True)
    }, omission


def _symmetric(
    correction: VectorCorrection, per_gauss: float
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], str]:
    """Return offset, diagonal and off-diagonal of the symmetric matrix of magnetometers; what that leaves out."""
    from scipy.spatial.transform import Rotation  # loads a tenth of a second of SciPy

    plain = plain_correction(correction, with_secondary=False)
    turn, symmetric = polar(np.linalg.inv(plain.matrix))
    hand = np.sign(np.linalg.det(turn))
    angle = np.degrees(Rotation.from_matrix(hand * turn).magnitude())
    turned = f"{'' if hand > 0 else 'a reflection and '}a rotation of {angle:.2g}°"
    omission = f"{plain.omitted} The axes keep {turned} to those of this calibration.".lstrip()
    offset = per_gauss * np.asarray(ws.convert(plain.offset, correction.unit, "gauss"))
    return (offset, np.diag(symmetric), symmetric[[0, 0, 1], [1, 2, 2]]), omission


def left_out(correction: VectorCorrection, format: str) -> str:
    """State what a format cannot hold and how large it is, in a sentence; empty where it holds the whole correction."""
    if format in AUTOPILOTS:
        return autopilot_parameters(correction, format)[1]
    return _in_kalibr(correction).omitted if format == "yaml" else ""


def parameter_file(correction: VectorCorrection, autopilot: str) -> str:
    """Format the parameter file of an autopilot."""
    values, omission = autopilot_parameters(correction, autopilot)
    head = f"Made by bayescal {bc.__version__}, {correction.calibrated_at}", *correction.notes
    comments = map(ws.c_comment, (*head, omission or NONE_LEFT))
    return AUTOPILOTS[autopilot].text(comments, dict(values))


def si_of(unit: str) -> tuple[float, str]:
    """Return the factor from a unit to m/s² or rad/s, and that unit; 1 and the unit itself where it is of neither."""
    for target in ("m/s^2", "rad/s"):
        if ws.same_dimension(unit, target) or (target == "m/s^2" and ws.same_dimension(unit, "g")):
            return float(np.asarray(ws.convert(np.ones(1), unit, target))[0]), target
    return 1.0, unit


def _list(values: np.ndarray) -> str:
    """Format numbers for YAML 1.1, which needs a decimal point before an exponent."""
    written = (f"{v:.15g}" for v in values)
    pointed = (re.sub(r"^(-?[0-9]+)e", r"\1.0e", v) for v in written)
    return f"[{', '.join(pointed)}]"


def _rows(matrix: np.ndarray) -> str:
    return "\n".join(f"    - {_list(row)}" for row in matrix)
