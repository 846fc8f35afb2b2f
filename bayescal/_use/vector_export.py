"""A correction of three axes as a file: C99, JSON and Python, YAML for Kalibr and OpenVINS, autopilot parameters.

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

C, Python and JSON hold all of a correction. The others get the nearest of their form, and say what that leaves out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayescal._core.atomic_file import write_text
from bayescal._core.errors import InputError
from bayescal._core.json_shape import OneOf, read_json
from bayescal._core.quoting import c_comment, identifier, python_words
from bayescal._core.version import __version__
from bayescal._data.unit_conversion import STANDARD_GRAVITY, convert, same_dimension
from bayescal._use.code_writer import include_guard, refuse_without_uncertainty, sensor_name
from bayescal._use.expression_graph import template
from bayescal._use.firmware_parameters import AUTOPILOTS
from bayescal._use.plain_correction import PlainCorrection, plain_correction
from bayescal._use.vector_correction import NEWTON_STEPS, SIZES, VectorCorrection

NOTHING = "Nothing is left out."
SHAPE = {
    "made_by": str,
    "calibration": str,
    "instrument": str,
    "outputs": (str, str, str),
    "unit": str,
    "equation": str,
    "order_of_terms": str,
    "beside?": [str],
    "reference_degC": float,
    "temperatures_degC": OneOf(None, (float, float)),
    "reach": float,
    "terms": [[float]],
    "covariance": [[float]],
    "noise": float,
    "notes": [str],
    "axes_of?": str,
    "covariance_with_axes_of?": [[float]],
}


def data(correction: VectorCorrection) -> dict[str, Any]:
    """What the JSON file holds."""
    shared = correction.shared
    return {
        "made_by": f"bayescal {__version__}",
        "calibration": correction.source,
        "instrument": correction.instrument,
        "outputs": list(correction.outputs),
        "unit": correction.unit,
        "equation": "outputs = offset + matrix·f (+ higher orders) (+ beside·g), each a polynomial of T − reference",
        "order_of_terms": "offset x y z; matrix by rows; second order xx yy zz xy xz yz by rows; cubes; beside by rows",
        "beside": list(correction.beside),
        "reference_degC": correction.reference,
        "temperatures_degC": None if correction.low is None else [correction.low, correction.high],
        "reach": correction.reach,
        "terms": correction.terms.tolist(),
        "covariance": correction.covariance.tolist(),
        "noise": correction.noise,
        "notes": list(correction.notes),
        "axes_of": correction.axes_of,
        **({} if shared is None else {"covariance_with_axes_of": shared.tolist()}),
    }


def load_vector_correction(path: str | Path) -> VectorCorrection:
    """A correction from its JSON file.

    Raises:
        InputError: there is no such file, or it is none.
    """
    try:
        found = read_json(Path(path), SHAPE)
        terms = np.array(found["terms"], dtype=float)
        covariance = np.array(found["covariance"], dtype=float)
        if (
            terms.ndim != 2
            or terms.shape[1] - 9 * bool(found.get("beside")) not in SIZES
            or covariance.shape != 2 * (terms.size,)
        ):
            raise ValueError(
                f"terms of shape {terms.shape} with a covariance of shape {covariance.shape}"
            )
        low, high = found["temperatures_degC"] or (None, None)
        shared = found.get("covariance_with_axes_of")
        return VectorCorrection(
            outputs=tuple(found["outputs"]),
            unit=found["unit"],
            reference=found["reference_degC"],
            low=low,
            high=high,
            terms=terms,
            covariance=covariance,
            noise=found["noise"],
            notes=tuple(found["notes"]),
            source=found["calibration"],
            beside=tuple(found.get("beside", ())),
            instrument=found["instrument"],
            reach=found["reach"],
            axes_of=found.get("axes_of", ""),
            shared=None if shared is None else np.array(shared, dtype=float),
        )
    except (OSError, ValueError) as error:
        raise InputError(
            f"{Path(path).name} is no correction of three axes ({error}): give a JSON file that `export` wrote"
        ) from None


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


def _parameter_file(correction: VectorCorrection, format: str) -> str:
    autopilot = AUTOPILOTS[format]
    values, left = autopilot_parameters(correction, format)
    said = (
        f"Made by bayescal {__version__}, {correction.calibrated_at}",
        *correction.notes,
        left or NOTHING,
        *autopilot.head,
    )
    lines = [autopilot.line(name, float(value)) for name, value in values.items()]
    return "\n".join([*(f"# {c_comment(one)}" for one in said), *lines, ""])


def as_text(
    correction: VectorCorrection,
    format: str,
    *,
    name: str | None = None,
    others: Sequence[VectorCorrection] = (),
    uncertainty: bool = True,
) -> str:
    """The correction in a format, as `export_vector` writes it.

    Raises:
        InputError: another format, or one that has no place for this quantity, for others or for no uncertainty; a name
            that is none in C.
    """
    unit = [correction, *others]
    names = names_in_unit(name, unit) if others else [sensor_name(name, correction.instrument)]
    named = dict(zip(names, unit, strict=True))
    if others and format not in TOGETHER:
        raise InputError(
            f"{format} holds one triad: several go into one file as {', '.join(TOGETHER)}; write the others to files "
            "of their own"
        )
    if not uncertainty:
        refuse_without_uncertainty(format)
    writers: Mapping[str, Callable[[], str]] = {
        "json": lambda: json.dumps(data(correction), indent=1, ensure_ascii=False) + "\n",
        "c": lambda: "\n".join(_header(n, c, uncertainty) for n, c in named.items()),
        "python": lambda: _module(named, uncertainty),
        "yaml": lambda: kalibr_yaml_of(correction, *others),
        **{one: partial(_parameter_file, correction, one) for one in AUTOPILOTS},
    }
    if format not in writers:
        raise InputError(f"format {format!r} is not one of {', '.join(writers)}")
    return writers[format]()


def names_in_unit(name: str | None, unit: Sequence[VectorCorrection]) -> list[str]:
    """What the sensors of a unit are called in C and Python: after their instruments, behind a name of the unit.

    Raises:
        InputError: the name is none in C, or two are of one instrument.
    """
    first = "" if name is None else f"{sensor_name(name, '')}_"
    found = [sensor_name(None, f"{first}{one.instrument}") for one in unit]
    if twice := [n for n in found if found.count(n) > 1]:
        raise InputError(
            f"two of these are of {unit[found.index(twice[0])].instrument}: a unit has one of each; write the other to "
            "a file of its own, with a name"
        )
    return found


def _header(name: str, c: VectorCorrection, uncertainty: bool) -> str:
    """One correction as C99."""
    return template("vector.h.jinja", {"comment": c_comment}).render(
        c=c,
        name=name,
        guard=include_guard(
            name, c.terms.tolist(), c.covariance.tolist(), c.reference, c.low, c.high, uncertainty
        ),
        uncertainty=uncertainty,
        recorded=c.low is not None,
        thermal=len(c.terms) > 1,
        # Twelve numbers, and no equation to solve.
        plain=not uncertainty and c.terms.shape == (1, 12),
        inverse=np.linalg.inv(c.matrix).tolist(),
        newton=1 if c.order == 1 else NEWTON_STEPS,
    )


def _module(named: Mapping[str, VectorCorrection], uncertainty: bool) -> str:
    """Corrections as one Python module."""
    held = {n: data(c) for n, c in named.items()}
    for one in () if uncertainty else held.values():
        del one["covariance"]
        one.pop("covariance_with_axes_of", None)
    return template("vector.py.jinja", {"comment": python_words}).render(
        named=named,
        data={n: repr(one) for n, one in held.items()},
        uncertainty=uncertainty,
        newton=NEWTON_STEPS,
    )


SUFFIXES = {".json": "json", ".h": "c", ".py": "python", ".yaml": "yaml", ".yml": "yaml"}
TOGETHER = ("c", "python", "yaml")  # formats of several triads in one file


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
        format: "json", "c", "python", "yaml", "px4-params" or "ardupilot-params", whatever the suffix.
        others: beside it in one file of C, Python or YAML, in the same body axes: gyroscopes beside accelerometers.
        name: of the sensor in C and Python; that of the instrument if not given. With `others`, of the unit.
        uncertainty: with the covariance; False for C and Python that give what acts alone: of a plain offset and matrix
            twelve numbers are left.

    Raises:
        InputError: another suffix or format, others or no uncertainty in a format that holds none such, two triads of
            one instrument, a name that is none in C, or a place that cannot be written to.
    """
    chosen = format_of(path, format)
    text = as_text(correction, chosen, name=name, others=others, uncertainty=uncertainty)
    return write_text(text, path)


def format_of(path: str | Path | None, format: str | None) -> str:
    """A format, or that of a path's suffix.

    Raises:
        InputError: no format is given, and the suffix is of none.
    """
    chosen = format or SUFFIXES.get(Path(path or "").suffix.lower())
    if chosen is None:
        raise InputError(
            f"{path}: a correction is written as {', '.join(SUFFIXES)}, or give the format"
        )
    return chosen


def _si(unit: str) -> tuple[float, str]:
    for target in ("m/s^2", "rad/s"):
        if same_dimension(unit, target) or (target == "m/s^2" and same_dimension(unit, "g")):
            return float(np.asarray(convert(np.ones(1), unit, target))[0]), target
    return 1.0, unit


def _list(values: np.ndarray) -> str:
    return f"[{', '.join(f'{v:.9g}' for v in values)}]"


def _rows(matrix: np.ndarray) -> list[str]:
    return [f"    - {_list(row)}" for row in matrix]
