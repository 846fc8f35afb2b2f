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
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal import InputError, __version__
from bayescal._annexes.imu.autopilot import AUTOPILOTS
from bayescal._annexes.imu.plain_correction import PlainCorrection, plain_correction
from bayescal._annexes.imu.vector_correction import VectorCorrection
from bayescal.workshop import (
    STANDARD_GRAVITY,
    c_comment,
    convert,
    identifier,
    json_text,
    same_dimension,
)

NOTHING = "Nothing is left out."


def kalibr_yaml_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """The intrinsics as Kalibr and OpenVINS state them, in m/s² or rad/s where the unit is one of these.

    Args:
        correction: of accelerometers or of gyroscopes.
        others: in the same body axes, such as gyroscopes by moves between poses of these accelerometers. Kalibr's axes
            are then those of the first.
    """
    every = (correction, *others)
    notes = dict.fromkeys(note for c in every for note in c.notes)
    frame = _split(_in_kalibr(correction).matrix)[1]
    return "\n".join(
        [
            f"# Intrinsics of three axes, made by bayescal {__version__}",
            *(f"# {c_comment(note)}" for note in notes),
            "imu0:",
            *_intrinsics(correction, np.eye(3)),
            *(line for one in others for line in _intrinsics(one, frame)),
            "",
        ]
    )


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
        bias, unit = _in_kalibr(one).offset * si_of(one.unit)[0], si_of(one.unit)[1]
        notes += [f"{kind}: {_in_kalibr(one).said or NOTHING}"]
        notes += [f"bias of the {kind}, which OpenVINS estimates: {_list(bias)} {unit}"]
    return "\n".join(
        [
            "%YAML:1.0",
            f"# Intrinsics of an inertial unit, made by bayescal {__version__}",
            *(f"# {c_comment(note)}" for note in notes),
            "imu0:",
            *("  T_i_b:", *_rows(np.eye(4)), "  time_offset: 0.0", '  model: "kalibr"'),
            *(line for name, matrix in held.items() for line in (f"  {name}:", *_rows(matrix))),
            "",
        ]
    )


def _openvins(correction: VectorCorrection) -> dict[str, np.ndarray]:
    """Matrices of one triad by OpenVINS' names."""
    factor, unit = si_of(correction.unit)
    plain = _in_kalibr(correction)
    lower, turn = _split(plain.matrix)
    if unit == "m/s^2":
        return {"Ta": lower, "R_IMUtoACC": turn}
    by_gravity = np.zeros((3, 3))
    if correction.beside:
        by_gravity = plain.terms[12:].reshape(3, 3) * factor / STANDARD_GRAVITY
    return {"Tw": lower, "R_IMUtoGYRO": turn, "Tg": by_gravity}


def realsense_json_of(correction: VectorCorrection, *others: VectorCorrection) -> str:
    """calibration.json of librealsense; what is not given is left as it is measured.

    Raises:
        InputError: a correction is neither of accelerometers nor of gyroscopes.
    """
    every = _inertial("realsense", (correction, *others))
    as_measured = {"scale_and_alignment": np.eye(3).ravel().tolist(), "bias": [0.0, 0.0, 0.0]}
    imu: dict[str, Any] = dict.fromkeys(("accelerometer", "gyroscope"), as_measured)
    said = [f"Made by bayescal {__version__}"]
    for kind, one in every.items():
        back, bias = _after(one)
        imu[kind] = {"scale_and_alignment": back.T.ravel().tolist(), "bias": bias.tolist()}
        said += [one.calibrated_at, *one.notes, f"{kind}: {_plain(one).said or NOTHING}"]
    return json_text({"imus": [imu], "said": said}, indent=1)


def ros_yaml_of(correction: VectorCorrection) -> str:
    """imu_calib.yaml of ROS' imu_calib, of accelerometers.

    Raises:
        InputError: of something else.
    """
    if "accelerometer" not in _inertial("ros", (correction,)):
        raise InputError("ros: imu_calib corrects accelerometers, and these are gyroscopes")
    back, bias = _after(correction)
    notes = (correction.calibrated_at, *correction.notes, _plain(correction).said or NOTHING)
    lines = [f"# Made by bayescal {__version__}", *(f"# {c_comment(note)}" for note in notes)]
    return "\n".join([*lines, f"SM: {_list(back.ravel())}", f"bias: {_list(bias)}", ""])


def _plain(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, beside=False)


def _after(correction: VectorCorrection) -> tuple[np.ndarray, np.ndarray]:
    """Matrix, and what is taken off behind it, m/s² or rad/s: what acts = matrix·y − bias."""
    plain = _plain(correction)
    back = np.linalg.inv(plain.matrix)
    return back, back @ plain.offset * si_of(correction.unit)[0]


def _inertial(format: str, every: Sequence[VectorCorrection]) -> dict[str, VectorCorrection]:
    """Triads by what they are of, "accelerometer" or "gyroscope".

    Raises:
        InputError: one is of neither.
    """
    kinds = {"rad/s": "gyroscope", "m/s^2": "accelerometer"}
    found = {kinds.get(si_of(c.unit)[1], ""): c for c in every}
    if "" in found:
        raise InputError(
            f"{format} holds accelerometers and gyroscopes, and these outputs are in [{found[''].unit}]"
        )
    return found


def _in_kalibr(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, beside=si_of(correction.unit)[1] == "rad/s")


def _split(matrix: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """A matrix as a lower triangle times a rotation."""
    lower = np.linalg.cholesky(matrix @ matrix.T)
    return lower, np.linalg.solve(lower, matrix)


def _intrinsics(correction: VectorCorrection, frame: np.ndarray) -> list[str]:
    """Lines of one triad; `frame` rotates the body axes of the calibration to Kalibr's."""
    factor, unit = si_of(correction.unit)
    turns, plain = unit == "rad/s", _in_kalibr(correction)
    lower, turn = _split(plain.matrix)
    name = {"rad/s": "gyroscopes", "m/s^2": "accelerometers"}.get(unit)
    lines = [
        f"  {name or identifier(correction.instrument)}:",
        f"    # {c_comment(correction.calibrated_at)}",
        f"    # {c_comment(plain.said or NOTHING)}",
        "    # Kalibr, scale-misalignment: measured = M*f + bias, M lower triangular, x axis of the body = sensor x",
        "    M:",
        *_rows(lower),
        "    # from the body axes of this calibration to those: f_kalibr = R*f"
        if np.array_equal(frame, np.eye(3))
        else "    # from the axes of the first M to those of this one",
        f"    {'C_gyro_i' if turns else 'R'}:",
        *_rows(turn @ frame.T),
        f"    # bias, {c_comment(unit)}, and its standard uncertainty",
        f"    bias: {_list(plain.offset * factor)}",
        f"    bias_uncertainty: {_list(plain.uncertainty[:3] * factor)}",
        "    # measured = matrix*f + bias, in the body axes of this calibration, and standard uncertainties",
        "    matrix:",
        *_rows(plain.matrix),
        "    matrix_uncertainty:",
        *_rows(plain.uncertainty[3:12].reshape(3, 3)),
    ]
    if name is None:
        return lines
    held = _openvins(correction)
    if turns and correction.beside:
        lines += ["    # sensitivity to specific force in the axes of M, rad/s per m/s^2", "    A:"]
        lines += _rows(held["Tg"] @ turn.T)
    return [
        *lines,
        "  # OpenVINS: measured = T*R*f + bias, of gyroscopes + Tg*a, in the body axes of this calibration",
        *(line for name, matrix in held.items() for line in (f"  {name}:", *_rows(matrix))),
    ]


def autopilot_parameters(
    correction: VectorCorrection, autopilot: str
) -> tuple[dict[str, float], str]:
    """Parameters of PX4 ("px4-params") or ArduPilot ("ardupilot-params"), of its first sensor, by name; what they lack.

    Raises:
        InputError: another autopilot, or a quantity that it has no such parameters for.
    """
    if autopilot not in AUTOPILOTS:
        raise InputError(f"format {autopilot!r} is not one of {', '.join(AUTOPILOTS)}")
    px4 = autopilot == "px4-params"
    if same_dimension(correction.unit, "g") or same_dimension(correction.unit, "m/s^2"):
        plain = plain_correction(correction, "diagonal", beside=False)
        factor, _ = si_of(correction.unit)
        off = "CAL_ACC0_{}OFF" if px4 else "INS_ACCOFFS_{}"
        scale = "CAL_ACC0_{}SCALE" if px4 else "INS_ACCSCAL_{}"
        found = {off.format(a): plain.offset[i] * factor for i, a in enumerate("XYZ")}
        found |= {scale.format(a): 1 / plain.matrix[i, i] for i, a in enumerate("XYZ")}
        return found, plain.said
    if same_dimension(correction.unit, "rad/s"):
        plain = plain_correction(correction, "none", beside=False)
        factor, _ = si_of(correction.unit)
        off = "CAL_GYRO0_{}OFF" if px4 else "INS_GYROFFS_{}"
        return {off.format(a): plain.offset[i] * factor for i, a in enumerate("XYZ")}, plain.said
    if same_dimension(correction.unit, "uT"):
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
        gauss = np.asarray(convert(plain.offset, correction.unit, "gauss"))
        beside = dict(zip("XYZ", (symmetric[0, 1], symmetric[0, 2], symmetric[1, 2]), strict=True))
        if px4:
            found = {f"CAL_MAG0_{a}OFF": gauss[i] for i, a in enumerate("XYZ")}
            found |= {f"CAL_MAG0_{a}SCALE": symmetric[i, i] for i, a in enumerate("XYZ")}
            return found | {f"CAL_MAG0_{a}ODIAG": v for a, v in beside.items()}, said
        found = {f"COMPASS_OFS_{a}": -1e3 * gauss[i] for i, a in enumerate("XYZ")}
        found |= {f"COMPASS_DIA_{a}": symmetric[i, i] for i, a in enumerate("XYZ")}
        return found | {f"COMPASS_ODI_{a}": v for a, v in beside.items()}, said
    raise InputError(
        f"{autopilot}: there are parameters for accelerometers, gyroscopes and magnetometers, and these outputs are in "
        f"[{correction.unit}]"
    )


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
    said = f"Made by bayescal {__version__}, {correction.calibrated_at}", *correction.notes
    every = map(c_comment, (*said, left or NOTHING))
    return AUTOPILOTS[format].text(every, {name: float(v) for name, v in values.items()})


def si_of(unit: str) -> tuple[float, str]:
    """Return the factor from a unit to m/s² or rad/s, and that unit; 1 and the unit itself where it is of neither."""
    for target in ("m/s^2", "rad/s"):
        if same_dimension(unit, target) or (target == "m/s^2" and same_dimension(unit, "g")):
            return float(np.asarray(convert(np.ones(1), unit, target))[0]), target
    return 1.0, unit


def _list(values: np.ndarray) -> str:
    """Numbers as YAML 1.1 takes them for such: a power of ten has a point before it."""
    written = (f"{v:.15g}" for v in values)
    pointed = (re.sub(r"^(-?[0-9]+)e", r"\1.0e", v) for v in written)
    return f"[{', '.join(pointed)}]"


def _rows(matrix: np.ndarray) -> list[str]:
    return [f"    - {_list(row)}" for row in matrix]


READ_BY_OTHERS: dict[str, Callable[..., str]] = {
    "yaml": kalibr_yaml_of,
    "openvins": openvins_yaml_of,
    "realsense": realsense_json_of,
    "ros": ros_yaml_of,
}
