"""A correction of three axes in forms that hold less: files for Kalibr, OpenVINS, RealSense, ROS, and autopilots.

Equations of what reads them, and their sources:

* Kalibr (imu_models, scale-misalignment): a_measured = M·a + b + n, M lower triangular, the body's x axis that of the
  sensor x; https://github.com/ethz-asl/kalibr/wiki/Multi-IMU-and-IMU-intrinsic-calibration. A rotation takes ours
  there. A gyroscope has that rotation, ω_measured = M·C_gyro_i·ω + A·C_gyro_i·a + b, in rad/s and m/s².
* OpenVINS (kalibr_imu_chain.yaml, ov_msckf/VioManagerOptions.h): a_measured = Ta·R_IMUtoACC·a + b, ω_measured =
  Tw·R_IMUtoGYRO·ω + Tg·a + b; of T it keeps the lower triangle under the model "kalibr". It is read by OpenCV, which
  wants a first line that YAML's other readers refuse (modules/core/src/persistence_yml.cpp): a file of its own.
* RealSense (librealsense, tools/rs-imu-calibration/rs-imu-calibration.py, calibration.json): corrected = Sᵀ·y − bias,
  the nine numbers of scale_and_alignment being S by rows; in m/s² and rad/s.
* ROS (imu_calib, src/accel_calib/accel_calib.cpp): corrected = SM·y − bias of accelerometers, SM by rows, in m/s².
* PX4 (src/lib/sensor_calibration): corrected = (raw − OFF)·SCALE on each axis of an accelerometer, in m/s², raw −
  OFF of a gyroscope, in rad/s; a symmetric matrix with ODIAG beside it for a magnetometer, in gauss.
* ArduPilot (AP_InertialSensor_Backend, AP_Compass_Backend): (raw − INS_ACCOFFS)·INS_ACCSCAL in m/s², raw − INS_GYROFFS
  in rad/s; for a compass DIA/ODI·(raw + OFS), symmetric, in mG.

Each gets the nearest of its form, and says what that leaves out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.plain_correction import PlainCorrection, plain_correction
from bayescal._annexes.imu.vector_correction import VectorCorrection

NOTHING = "Nothing is left out."
KINDS = {"rad/s": "gyroscope", "m/s^2": "accelerometer"}


def kalibr_yaml_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """The intrinsics as Kalibr and OpenVINS state them, in m/s² or rad/s where the unit is one of these.

    Others are in the same body axes, such as gyroscopes by moves between poses of these accelerometers: Kalibr's axes
    are then those of the first.
    """
    every = (correction, *others)
    frames = np.eye(3), *[_split(_in_kalibr(correction).matrix)[1]] * len(others)
    triads = [_intrinsics(c, frame) for c, frame in zip(every, frames, strict=True)]
    filters = {"row": _list, "rows": _rows, "comment": ws.c_comment}
    layout = ws.template("bayescal._annexes.imu", "intrinsics.yaml.jinja", filters)
    notes = dict.fromkeys(note for c in every for note in c.notes)
    return _head("Intrinsics of three axes, made", notes) + layout.render(triads=triads)


def openvins_yaml_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """kalibr_imu_chain.yaml of OpenVINS, without its noise: the lines that `bayescal noise --yaml` writes go below it.

    Raises:
        InputError: a correction is neither of accelerometers nor of gyroscopes.
    """
    every = _inertial("openvins", (correction, *others))
    notes = [f"{kind}: {c.calibrated_at} {c.notes}" for kind, c in every.items()]
    held = {name: np.eye(3) for name in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC")}
    held["Tg"] = np.zeros((3, 3))
    for kind, one in every.items():
        held |= _openvins(one)
        plain, (factor, unit) = _in_kalibr(one), si_of(one.unit)
        bias = _list(plain.offset * factor)
        notes += [f"{kind}: {plain.said or NOTHING}"]
        notes += [f"bias of the {kind}, which OpenVINS estimates: {bias} {unit}"]
    lines = ["imu0:", "  T_i_b:", _rows(np.eye(4)), "  time_offset: 0.0", '  model: "kalibr"']
    lines += [f"  {name}:\n{_rows(matrix)}" for name, matrix in held.items()]
    head = _head("Intrinsics of an inertial unit, made", notes)
    return "\n".join(["%YAML:1.0", head + lines[0], *lines[1:], ""])


def _head(title: str, notes: Iterable[str]) -> str:
    said = (f"# {ws.c_comment(note)}" for note in notes)
    return "\n".join([f"# {title} by bayescal {bc.__version__}", *said, ""])


def _openvins(correction: VectorCorrection) -> dict[str, np.ndarray]:
    """Matrices of one triad by OpenVINS' names."""
    factor, unit = si_of(correction.unit)
    plain = _in_kalibr(correction)
    lower, turn = _split(plain.matrix)
    if unit == "m/s^2":
        return {"Ta": lower, "R_IMUtoACC": turn}
    by_gravity = np.zeros((3, 3))
    if correction.beside:
        by_gravity = plain.terms[12:].reshape(3, 3) * factor / ws.STANDARD_GRAVITY
    return {"Tw": lower, "R_IMUtoGYRO": turn, "Tg": by_gravity}


def realsense_json_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """calibration.json of librealsense; what is not given is left as it is measured."""
    every = _inertial("realsense", (correction, *others))
    as_measured = {"scale_and_alignment": np.eye(3).ravel().tolist(), "bias": [0.0, 0.0, 0.0]}
    imu: dict[str, Any] = dict.fromkeys(("accelerometer", "gyroscope"), as_measured)
    said = [f"Made by bayescal {bc.__version__}"]
    for kind, one in every.items():
        back, bias = _after(one)
        imu[kind] = {"scale_and_alignment": back.T.ravel().tolist(), "bias": bias.tolist()}
        said += [one.calibrated_at, *one.notes, f"{kind}: {_plain(one).said or NOTHING}"]
    return ws.json_text({"imus": [imu], "said": said}, indent=1)


def ros_yaml_of(correction: VectorCorrection) -> str:
    """imu_calib.yaml of ROS' imu_calib, of accelerometers."""
    if "accelerometer" not in _inertial("ros", (correction,)):
        raise bc.InputError("ros: imu_calib corrects accelerometers, and these are gyroscopes")
    back, bias = _after(correction)
    notes = (correction.calibrated_at, *correction.notes, _plain(correction).said or NOTHING)
    return _head("Made", notes) + f"SM: {_list(back.ravel())}\nbias: {_list(bias)}\n"


def _plain(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, beside=False)


def _after(correction: VectorCorrection) -> tuple[np.ndarray, np.ndarray]:
    """Matrix, and what is taken off behind it, m/s² or rad/s: what acts = matrix·y − bias."""
    plain = _plain(correction)
    back = np.linalg.inv(plain.matrix)
    return back, back @ plain.offset * si_of(correction.unit)[0]


def _inertial(format: str, every: Sequence[VectorCorrection]) -> dict[str, VectorCorrection]:
    """Triads by what they are of, "accelerometer" or "gyroscope"."""
    found = {KINDS.get(si_of(c.unit)[1], ""): c for c in every}
    if "" in found:
        raise bc.InputError(
            f"{format} holds accelerometers and gyroscopes, and these outputs are in [{found[''].unit}]"
        )
    return found


def _in_kalibr(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, beside=si_of(correction.unit)[1] == "rad/s")


def _split(matrix: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """A matrix as a lower triangle times a rotation."""
    lower = np.linalg.cholesky(matrix @ matrix.T)
    return lower, np.linalg.solve(lower, matrix)


def _intrinsics(correction: VectorCorrection, frame: np.ndarray) -> dict[str, Any]:
    """What the template states of one triad; `frame` rotates the body axes of the calibration to Kalibr's."""
    factor, unit = si_of(correction.unit)
    plain, kind = _in_kalibr(correction), KINDS.get(unit)
    lower, turn = _split(plain.matrix)
    held = _openvins(correction) if kind else {}
    by_force = held["Tg"] @ turn.T if kind == "gyroscope" and correction.beside else None
    return {
        "name": f"{kind}s" if kind else ws.identifier(correction.instrument),
        "calibrated_at": correction.calibrated_at,
        "left_out": plain.said or NOTHING,
        **{"kind": kind, "unit": unit, "lower": lower, "turn": turn @ frame.T},
        **{"bias": plain.offset * factor, "bias_uncertainty": plain.uncertainty[:3] * factor},
        "matrix": plain.matrix,
        "matrix_uncertainty": plain.uncertainty[3:12].reshape(3, 3),
        **{"by_force": by_force, "openvins": held},
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
    """Return parameters of an autopilot by name, of its first sensor, and what they leave out, in a sentence."""
    if autopilot not in PARAMETERS:
        raise bc.InputError(f"format {autopilot!r} is not one of {', '.join(PARAMETERS)}")
    factor, unit = si_of(correction.unit)
    kind = "magnetometer" if ws.same_dimension(unit, "uT") else KINDS.get(unit, "")
    if kind == "accelerometer":
        plain = plain_correction(correction, "diagonal", beside=False)
        values, said = (plain.offset * factor, 1 / np.diag(plain.matrix)), plain.said
    elif kind == "gyroscope":
        plain = plain_correction(correction, "none", beside=False)
        values, said = (plain.offset * factor,), plain.said
    elif kind:
        values, said = _symmetric(correction, -1e3 if autopilot == "ardupilot-params" else 1.0)
    else:
        raise bc.InputError(
            f"{autopilot}: there are parameters for accelerometers, gyroscopes and magnetometers, and these outputs "
            f"are in [{correction.unit}]"
        )
    named = zip(PARAMETERS[autopilot][kind], values, strict=True)
    return {n.format(a): v for n, own in named for a, v in zip("XYZ", own, strict=True)}, said


def _symmetric(
    correction: VectorCorrection, per_gauss: float
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], str]:
    """Offset, diagonal of the symmetric matrix of magnetometers and what stands beside it; what that leaves out."""
    from scipy.spatial.transform import Rotation  # loads a tenth of a second of SciPy

    plain = plain_correction(correction, beside=False)
    back = np.linalg.inv(plain.matrix)
    values, vectors = np.linalg.eigh(back.T @ back)
    symmetric = (vectors * np.sqrt(values)) @ vectors.T
    turn = back @ np.linalg.inv(symmetric)
    hand = np.sign(np.linalg.det(turn))
    angle = np.degrees(Rotation.from_matrix(hand * turn).magnitude())
    kept = f"{'' if hand > 0 else 'a reflection and '}a rotation of {angle:.2g}°"
    said = f"{plain.said} The axes keep {kept} to those of this calibration.".lstrip()
    offset = per_gauss * np.asarray(ws.convert(plain.offset, correction.unit, "gauss"))
    return (offset, np.diag(symmetric), symmetric[[0, 0, 1], [1, 2, 2]]), said


def left_out(correction: VectorCorrection, format: str) -> str:
    """What a format has no place for and how large it is, in a sentence; empty where it holds all of the correction."""
    if format in AUTOPILOTS:
        return autopilot_parameters(correction, format)[1]
    if format in ("realsense", "ros"):
        return _plain(correction).said
    return _in_kalibr(correction).said if format in READ_BY_OTHERS else ""


def parameter_file(correction: VectorCorrection, format: str) -> str:
    """Parameters of an autopilot, as it loads them."""
    values, left = autopilot_parameters(correction, format)
    said = f"Made by bayescal {bc.__version__}, {correction.calibrated_at}", *correction.notes
    every = map(ws.c_comment, (*said, left or NOTHING))
    return AUTOPILOTS[format].text(every, {name: float(v) for name, v in values.items()})


def si_of(unit: str) -> tuple[float, str]:
    """Return the factor from a unit to m/s² or rad/s, and that unit; 1 and the unit itself where it is of neither."""
    for target in ("m/s^2", "rad/s"):
        if ws.same_dimension(unit, target) or (target == "m/s^2" and ws.same_dimension(unit, "g")):
            return float(np.asarray(ws.convert(np.ones(1), unit, target))[0]), target
    return 1.0, unit


def _list(values: np.ndarray) -> str:
    """Numbers as YAML 1.1 takes them for such: a power of ten has a point before it."""
    written = (f"{v:.15g}" for v in values)
    pointed = (re.sub(r"^(-?[0-9]+)e", r"\1.0e", v) for v in written)
    return f"[{', '.join(pointed)}]"


def _rows(matrix: np.ndarray) -> str:
    return "\n".join(f"    - {_list(row)}" for row in matrix)


READ_BY_OTHERS: dict[str, Callable[..., str]] = {
    "yaml": kalibr_yaml_of,
    "openvins": openvins_yaml_of,
    "realsense": realsense_json_of,
    "ros": ros_yaml_of,
}
