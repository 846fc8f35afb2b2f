"""The customary estimators: four or more positions cell by cell, and fixed-point heating.

    made = classical_estimates(readings)
    made.bias, made.scale              K0 in µg and κ in ppm, cell by cell
    made.bias_tempco, made.scale_tempco

They take the tilt as set, the input axis as lying in the face, and the base as level. What that costs stands in the
datasheet of `model.py`. Source: source 0, equations 9, 12, 14 and sections 4.1 and 4.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

import bayescal as bc

Array = NDArray[np.float64]

G = 1e6  # µg
QUARTERS = np.array([0.0, 0.5, 1.0, 1.5]) * np.pi
SAME = 1e-6  # rad, within which positions are one


@dataclass(frozen=True)
class Tempco:
    """A slope over temperature and the half-width of its 95 % confidence interval (Student's t), same unit."""

    value: float
    half_width: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ± {self.half_width:.2g}"


@dataclass(frozen=True)
class ClassicalEstimates:
    """What the customary estimator makes of each cell, and of the cells over temperature.

    Attributes:
        positions: how many it used.
        cells: names.
        temperature: mean of each cell, °C.
        bias: K0, µg.
        scale: K1 − 1, ppm.
        bias_tempco: µg/°C.
        scale_tempco: ppm/°C.
    """

    positions: int
    cells: tuple[str, ...]
    temperature: Array
    bias: Array
    scale: Array
    bias_tempco: Tempco
    scale_tempco: Tempco


def classical_estimates(
    readings: bc.Measurements, positions: int | None = None
) -> ClassicalEstimates:
    """Estimate bias and scale factor of every cell, and their slopes over temperature, by least squares.

    With four positions K0 = (E0 + E2)/2 and K1 = (E1 − E3)/(2·g·sin γ); with n positions equally spaced over a turn,
    K0 is the mean and K1 the first harmonic, 2/n·Σ E·sin θ/(g·sin γ).

    Args:
        readings: of an instrument with the columns `position_angle`, `tilt` and `output`, in µg.
        positions: 4, to use those at 0, 90, 180 and 270° alone; None for all that there are.

    Raises:
        ValueError: another number than 4, readings without cells, a cell with several tilts, or positions that
            are not equally spaced.
    """
    if positions not in (None, 4):
        raise ValueError(f"classical_estimates(positions={positions}): give 4, or None for all")
    names, cell = readings.groups("cell")
    if not names:
        raise ValueError(
            f"classical_estimates: {readings.file} has no cells; it needs the column 'temperature_point'"
        )
    turned = np.mod(readings["position_angle"], 2 * np.pi)
    turned[turned > 2 * np.pi - SAME] = 0.0
    cells = []
    for k, name in enumerate(names):
        at = cell == k
        if positions == 4:
            at &= (np.abs(turned[:, None] - QUARTERS) < SAME).any(axis=1)
        cells.append(_cell(name, turned[at], readings["tilt"][at], readings["output"][at]))
    bias, scale, used = (np.array(values) for values in zip(*cells, strict=True))
    temperature = np.array([readings["temperature"][cell == k].mean() for k in range(len(names))])
    return ClassicalEstimates(
        int(used[0]),
        names,
        temperature,
        bias=bias,
        scale=scale,
        bias_tempco=_slope(temperature, bias),
        scale_tempco=_slope(temperature, scale),
    )


def _cell(name: str, angle: Array, tilt: Array, output: Array) -> tuple[float, float, int]:
    """Return K0, µg, κ, ppm, and the number of positions of one cell."""
    if not tilt.size or np.ptp(tilt) > SAME:
        raise ValueError(
            f"classical_estimates: cell {name!r} has {'several tilts' if tilt.size else 'no such position'}; "
            "choose readings of one tilt and of all positions"
        )
    places = np.unique(np.round(angle / SAME)) * SAME
    spread = 2 * np.pi * np.arange(places.size) / places.size
    if places.size < 4 or not np.allclose(places, spread, atol=10 * SAME):
        raise ValueError(
            f"classical_estimates: cell {name!r} has positions {np.degrees(places).round(3).tolist()}°; at least 4, "
            "equally spaced over a turn from 0°, are needed. For readings at a fixed position use fixed_point_tempcos"
        )
    mean = np.array([output[np.abs(angle - place) < 20 * SAME].mean() for place in spread])
    full = G * np.sin(tilt[0])
    if places.size == 4:
        return (mean[0] + mean[2]) / 2, 1e6 * ((mean[1] - mean[3]) / (2 * full) - 1), 4
    first = 2 / places.size * mean @ np.sin(spread)
    return float(mean.mean()), 1e6 * (first / full - 1), places.size


def _slope(temperature: Array, values: Array) -> Tempco:
    """Fit a straight line by least squares."""
    line: Any = stats.linregress(temperature, values)
    freedom = temperature.size - 2
    quantile = stats.t.ppf(0.975, freedom) if freedom > 0 else np.nan
    return Tempco(float(line.slope), float(quantile * line.stderr))


@dataclass(frozen=True)
class FixedPointTempcos:
    """Scale-factor tempcos of fixed-point heating at (near +, near −) full scale, ppm/°C, in three ways.

    Attributes:
        zero_subtracted: the output of the zero position subtracted, as source 0 prescribes.
        bias_subtracted: the true bias subtracted; None if its tempco was not given.
        nothing_subtracted: the slope of the output alone.
        bias_tempco: slope at the zero position, µg/°C.
    """

    zero_subtracted: tuple[float, float]
    bias_subtracted: tuple[float, float] | None
    nothing_subtracted: tuple[float, float]
    bias_tempco: float


def fixed_point_tempcos(
    readings: bc.Measurements, bias_tempco: float | None = None
) -> FixedPointTempcos:
    """Estimate temperature coefficients by fixed-point heating: readings at zero input and near both ends.

    Args:
        readings: with positions at 0 (or zero tilt), and with sin γ·sin θ of both signs.
        bias_tempco: the true one, µg/°C, if it is known from elsewhere.

    Raises:
        ValueError: one of the three positions is missing.
    """
    nominal = G * np.sin(readings["tilt"]) * np.sin(readings["position_angle"])
    end = np.abs(nominal).max()
    slopes, inputs = {}, {}
    for name, chosen in (
        ("zero", np.abs(nominal) < 1e-3 * end),
        ("plus", nominal > 0.9 * end),
        ("minus", nominal < -0.9 * end),
    ):
        if chosen.sum() < 2:
            raise ValueError(
                f"fixed_point_tempcos: {readings.file} has no readings at the {name} position; zero input and both "
                "ends are needed"
            )
        line: Any = stats.linregress(readings["temperature"][chosen], readings["output"][chosen])
        slopes[name] = line.slope
        inputs[name] = nominal[chosen].mean()

    def relative(reference: float) -> tuple[float, float]:
        plus, minus = (1e6 * (slopes[p] - reference) / inputs[p] for p in ("plus", "minus"))
        return float(plus), float(minus)

    return FixedPointTempcos(
        relative(slopes["zero"]),
        None if bias_tempco is None else relative(bias_tempco),
        relative(0.0),
        float(slopes["zero"]),
    )
