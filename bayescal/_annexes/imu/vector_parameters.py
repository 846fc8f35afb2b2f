"""Offset and scale parameters of autopilots from a three-axis correction, and the size of the omitted terms.

* PX4 (src/lib/sensor_calibration): corrected = (raw − OFF)·SCALE on each axis of an accelerometer, in m/s², raw −
  OFF of a gyroscope, in rad/s.
* ArduPilot (AP_InertialSensor_Backend): (raw − INS_ACCOFFS)·INS_ACCSCAL in m/s², raw − INS_GYROFFS in rad/s.

With ⟨·⟩ the mean over the calibrated temperatures and over all directions of an input of magnitude r, the largest in
the calibration, least squares of the correction's equation on an offset and a scale factor per axis gives

    offset_i = ⟨offset_i⟩ + r²/3·Σ_a ⟨second_i,aa⟩,     scale_i = ⟨matrix_ii⟩ + 3/5·r²·⟨cube_i⟩,

as ⟨x²⟩ = r²/3 and ⟨x⁴⟩ = r⁴/5 for a component x on a sphere. Gyroscopes have the offset at rest, without second-order
terms, and a scale factor of one.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import product

import numpy as np
from jaxtyping import Float

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.firmware_parameters import AUTOPILOTS
from bayescal._annexes.imu.vector_correction import (
    PAIRS,
    ROUNDING,
    VectorCorrection,
    differentiate_by_terms,
)

# Means of polynomials up to the seventh degree: over a range by G. Lobatto's five points, over a sphere by V. Lebedev's
# 26 (Zh. Vychisl. Mat. Mat. Fiz. 16 (1976) 293), the directions of axes, edges and corners of a cube.
RANGE_NODES = np.array([-1.0, -((3 / 7) ** 0.5), 0.0, (3 / 7) ** 0.5, 1.0])
RANGE_WEIGHTS = np.array([9.0, 49.0, 64.0, 49.0, 9.0]) / 180
CORNERS = np.array([c for c in product((-1.0, 0.0, 1.0), repeat=3) if any(c)])
DIRECTION_WEIGHTS = np.array([1 / 21, 4 / 105, 9 / 280])[np.count_nonzero(CORNERS, axis=1) - 1]
DIRECTIONS = CORNERS / np.linalg.norm(CORNERS, axis=1)[:, None]
DIAGONAL = [3, 7, 11]  # terms of the matrix on its diagonal


def fit_offset_and_scale(
    correction: VectorCorrection, include_scale: bool
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], str]:
    """Approximate a correction by an offset and a scale factor per axis, by least squares.

    Args:
        correction: correction to approximate.
        include_scale: whether to fit scale factors; otherwise they are one, and the offset is that at rest.

    Returns:
        Offsets (unit of the outputs), scale factors, and a sentence on the omitted terms and their sizes.
    """
    (k, p), radius, order = correction.terms.shape, correction.max_input, correction.order
    temperatures, weights = np.array([correction.default_temperature]), np.ones(1)
    if correction.low is not None and correction.high is not None:
        half_range = 0.5 * (correction.high - correction.low)
        temperatures, weights = correction.low + half_range * (1 + RANGE_NODES), RANGE_WEIGHTS
    powers = correction.powers(temperatures)  # of T − T0
    columns = [0, 1, 2, *DIAGONAL]
    mean_terms = np.eye(p)[columns]  # ∂(offset, scale)/∂term at one temperature
    for i in range(3):
        if order > 1 and include_scale:
            mean_terms[i, [12 + 6 * i + PAIRS.index((a, a)) for a in range(3)]] = radius**2 / 3
        if order > 2:
            mean_terms[3 + i, 30 + i] = 0.6 * radius**2
    if not include_scale:
        mean_terms[3:] = 0.0
    projection = np.kron(weights @ powers, mean_terms)
    secondary_inputs = DIRECTIONS if correction.secondary_columns else None
    slopes = differentiate_by_terms(radius * DIRECTIONS, order, secondary_inputs)
    # ∂output/∂term at each temperature and direction, less that of the approximation.
    residual_slopes = np.einsum("tk,dip->tdikp", powers, slopes)
    residual_slopes -= (slopes[..., columns] @ projection).reshape(len(DIRECTIONS), 3, k, p)
    groups = np.full((k, p), "dependence on temperature", dtype=object)
    matrix_group = "misalignments" if include_scale else "scale factors and misalignments"
    groups[0], groups[:, 12:30], groups[:, 30:33] = matrix_group, "second order", "third order"
    if correction.secondary_columns:
        groups[:, -9:] = "secondary input (of size 1)"
    label, omissions = ws.unit_label(correction.unit), list[str]()
    for group in dict.fromkeys(groups.ravel()):
        group_slopes = residual_slopes * (groups == group)
        mean = np.einsum("tdikp,kp->tdi", group_slopes, correction.terms)
        if group == matrix_group and not include_scale:
            mean = mean - radius * DIRECTIONS
        group_slopes = group_slopes.reshape(*mean.shape, -1)
        variance = np.sum((group_slopes @ correction.covariance) * group_slopes, axis=-1)
        mean_square = mean**2 + variance
        rms = np.sqrt(np.max(np.einsum("t,d,tdi->i", weights, DIRECTION_WEIGHTS, mean_square)))
        if rms > ROUNDING * radius:
            # Posterior mean square: the uncertainty of a term counts as well.
            sizes = (ws.number(float(size), 2) for size in (rms, np.sqrt(np.max(mean_square))))
            omissions.append(f"{group}, {f' {label} rms and up to '.join(sizes)} {label}")
    scope = f"over all directions of {ws.number(radius)} {label}, {correction.calibrated_at}"
    note = f"Omitted for lack of parameters: {'; '.join(omissions)} ({scope})." * bool(omissions)
    offset, scale = (projection @ correction.terms.ravel()).reshape(2, 3)
    return offset, scale if include_scale else np.ones(3), note


# Names of offset and scale of the first sensor with outputs in a unit, with {} for the axis.
PARAMETER_NAMES = {
    "px4-params": {"m/s^2": ("CAL_ACC0_{}OFF", "CAL_ACC0_{}SCALE"), "rad/s": ("CAL_GYRO0_{}OFF",)},
    "ardupilot-params": {
        "m/s^2": ("INS_ACCOFFS_{}", "INS_ACCSCAL_{}"),
        "rad/s": ("INS_GYROFFS_{}",),
    },
}


def convert_to_parameters(
    correction: VectorCorrection, autopilot: str
) -> tuple[dict[str, float], str]:
    """Return name → parameter of a first sensor, and the terms omitted; raise InputError if it has no parameters."""
    for unit in PARAMETER_NAMES[autopilot]:
        with suppress(bc.InputError):  # of another dimension
            factor = float(ws.convert(1.0, correction.unit, unit))
            break
    else:
        raise bc.InputError(
            f"{autopilot} has parameters for accelerometers and gyroscopes only, but these outputs are in "
            f"[{correction.unit}]: choose another format"
        )
    names = PARAMETER_NAMES[autopilot][unit]
    offset, scale, note = fit_offset_and_scale(correction, len(names) > 1)
    return {
        name.format(axis): float(value)
        for name, by_axis in zip(names, (offset * factor, 1 / scale), strict=False)
        for axis, value in zip("XYZ", by_axis, strict=True)
    }, note


def describe_omissions(correction: VectorCorrection, format: str) -> str:
    """Describe in a sentence the terms that a format omits and their sizes; empty if it omits none."""
    return convert_to_parameters(correction, format)[1] if format in AUTOPILOTS else ""


def format_parameter_file(correction: VectorCorrection, autopilot: str) -> str:
    """Format a correction as a parameter file of an autopilot."""
    values, note = convert_to_parameters(correction, autopilot)
    head = f"Made by bayescal {bc.__version__}, {correction.calibrated_at}", *correction.notes
    comments = map(ws.quote_c_comment, (*head, note or "No term is omitted."))
    return AUTOPILOTS[autopilot].format_file(comments, dict(values))
