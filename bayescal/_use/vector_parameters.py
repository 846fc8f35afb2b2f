"""A correction of three axes in forms that hold less: YAML for Kalibr and OpenVINS, parameters of autopilots.

Equations of what reads them, and their sources:

* Kalibr (imu_models, scale-misalignment): a_measured = M·a + b + n, M lower triangular, the body's x axis that of the
  sensor x; https://github.com/ethz-asl/kalibr/wiki/Multi-IMU-and-IMU-intrinsic-calibration. A rotation takes ours
  there. A gyroscope has that rotation, ω_measured = M·C_gyro_i·ω + A·C_gyro_i·a + b, in rad/s and m/s².
* OpenVINS (kalibr_imu_chain.yaml, ov_msckf/VioManagerOptions.h): a_measured = Ta·R_IMUtoACC·a + b, ω_measured =
  Tw·R_IMUtoGYRO·ω + Tg·a + b; of T it keeps the lower triangle under the model "kalibr".
* PX4 (src/lib/sensor_calibration): corrected = (raw − OFF)·SCALE on each axis of an accelerometer, in m/s², raw −
  OFF of a gyroscope, in rad/s; a symmetric matrix with ODIAG beside it for a magnetometer, in gauss.
* ArduPilot (AP_InertialSensor_Backend, AP_Compass_Backend): (raw − INS_ACCOFFS)·INS_ACCSCAL in m/s², raw − INS_GYROFFS
  in rad/s; for a compass DIA/ODI·(raw + OFS), symmetric, in mG.

Each gets the nearest of its form, and says what that leaves out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayescal._core.errors import InputError
from bayescal._core.quoting import c_comment, identifier
from bayescal._core.version import __version__
from bayescal._data.unit_conversion import STANDARD_GRAVITY, convert, same_dimension
from bayescal._use.autopilot import AUTOPILOTS
from bayescal._use.plain_correction import PlainCorrection, plain_correction
from bayescal._use.vector_correction import VectorCorrection

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


def _in_kalibr(correction: VectorCorrection) -> PlainCorrection:
    return plain_correction(correction, beside=_si(correction.unit)[1] == "rad/s")


def _split(matrix: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """A matrix as a lower triangle times a rotation."""
    lower = np.linalg.cholesky(matrix @ matrix.T)
    return lower, np.linalg.solve(lower, matrix)


def _intrinsics(correction: VectorCorrection, frame: np.ndarray) -> list[str]:
    """Lines of one triad; `frame` rotates the body axes of the calibration to Kalibr's."""
    factor, unit = _si(correction.unit)
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
    by_gravity = np.zeros((3, 3))
    if turns and correction.beside:
        by_gravity = plain.terms[12:].reshape(3, 3) * factor / STANDARD_GRAVITY
        lines += ["    # sensitivity to specific force in the axes of M, rad/s per m/s^2", "    A:"]
        lines += _rows(by_gravity @ turn.T)
    if name is None:
        return lines
    return [
        *lines,
        "  # OpenVINS: measured = T*R*f + bias, of gyroscopes + Tg*a, in the body axes of this calibration",
        f"  {'Tw' if turns else 'Ta'}:",
        *_rows(lower),
        f"  {'R_IMUtoGYRO' if turns else 'R_IMUtoACC'}:",
        *_rows(turn),
        *(["  Tg:", *_rows(by_gravity)] if turns else []),
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
        factor, _ = _si(correction.unit)
        off = "CAL_ACC0_{}OFF" if px4 else "INS_ACCOFFS_{}"
        scale = "CAL_ACC0_{}SCALE" if px4 else "INS_ACCSCAL_{}"
        found = {off.format(a): plain.offset[i] * factor for i, a in enumerate("XYZ")}
        found |= {scale.format(a): 1 / plain.matrix[i, i] for i, a in enumerate("XYZ")}
        return found, plain.said
    if same_dimension(correction.unit, "rad/s"):
        plain = plain_correction(correction, "none", beside=False)
        factor, _ = _si(correction.unit)
        off = "CAL_GYRO0_{}OFF" if px4 else "INS_GYROFFS_{}"
        return {off.format(a): plain.offset[i] * factor for i, a in enumerate("XYZ")}, plain.said
    if same_dimension(correction.unit, "uT"):
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
    return _in_kalibr(correction).said if format == "yaml" else ""


def parameter_file(correction: VectorCorrection, format: str) -> str:
    """Parameters of an autopilot, as it loads them."""
    values, left = autopilot_parameters(correction, format)
    said = f"Made by bayescal {__version__}, {correction.calibrated_at}", *correction.notes
    every = map(c_comment, (*said, left or NOTHING))
    return AUTOPILOTS[format].text(every, {name: float(v) for name, v in values.items()})


def _si(unit: str) -> tuple[float, str]:
    for target in ("m/s^2", "rad/s"):
        if same_dimension(unit, target) or (target == "m/s^2" and same_dimension(unit, "g")):
            return float(np.asarray(convert(np.ones(1), unit, target))[0]), target
    return 1.0, unit


def _list(values: np.ndarray) -> str:
    return f"[{', '.join(f'{v:.9g}' for v in values)}]"


def _rows(matrix: np.ndarray) -> list[str]:
    return [f"    - {_list(row)}" for row in matrix]
