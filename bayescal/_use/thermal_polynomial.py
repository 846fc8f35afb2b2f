"""A calibration as the cubic over temperature that firmware evaluates, and what that leaves out.

The posterior mean of the reading at rest, b(T, rate, lag, …), is projected by least squares, over the
readings of the calibration, on

    p(T) = c0 + c1·d + c2·d² + c3·d³,   d = T − T_ref.

Where b is a cubic of the temperature alone, p is b to rounding; else b − p is the cost of firmware
that knows no more than the temperature.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayescal._core.errors import InputError
from bayescal._data.unit_conversion import convert, unit_label
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._use.compensation_program import STIMULUS
from bayescal._use.compensator import Compensator
from bayescal._use.inputs import inputs_at_fit

ORDER = 3


@dataclass(frozen=True)
class AtRest:
    """Readings of a calibration as its posterior mean says they would be at rest.

    Attributes:
        temperature: °C, (n,).
        offset: of the reading, in `unit`, (n,).
        unit: "rad/s" or "m/s^2".
        noise: standard deviation of one reading, in `unit`.
        uncertainty: root mean square over the readings of the standard uncertainty of `offset`, in `unit`.
    """

    temperature: np.ndarray
    offset: np.ndarray
    unit: str
    noise: float
    uncertainty: float

    @property
    def low(self) -> float:
        return float(self.temperature.min())

    @property
    def high(self) -> float:
        return float(self.temperature.max())


def at_rest(
    chosen: Compensator, unit: str, name: str, local_gravity: float = STANDARD_GRAVITY
) -> AtRest:
    """What a calibrated instrument reads at rest, over the readings of its calibration.

    Args:
        chosen: the instrument in use.
        unit: wanted, "rad/s" or "m/s^2".
        name: of the axis, for messages.
        local_gravity: m/s², that the calibration's local g stands for.

    Raises:
        InputError: the output is no such quantity, or the calibration has no temperature.
        ModelError: an effect cannot be evaluated outside Python.
    """
    if chosen.calibration is None or chosen.equation is None:
        raise InputError(
            f"{name}: an export has no readings to project on a polynomial: give the saved calibration (.nc)"
        )
    calibration = chosen.calibration
    inputs = inputs_at_fit(calibration, chosen.equation)
    if "temperature" not in inputs:
        raise InputError(
            f"{name}: the calibration has no column 'temperature', over which firmware corrects: calibrate "
            "with one"
        )
    program, rest = chosen.program, np.zeros(len(calibration.readings))
    (expected,) = program.graph.evaluate((program.expected,), {**inputs, STIMULUS: rest})
    expected = np.broadcast_to(expected, rest.shape)
    _, own, slope = program.run(expected, inputs)
    own = own / np.where(slope > 0, slope, 1.0)  # of the reading, not of the stimulus

    def converted(values: np.ndarray) -> np.ndarray:
        try:
            return convert(values, calibration.unit, unit, local_gravity=local_gravity)
        except InputError:
            raise InputError(
                f"{name}: the calibration's output is in {unit_label(calibration.unit)}, firmware's "
                f"parameter for {name} is in {unit_label(unit)}: give the calibration of such a sensor"
            ) from None

    return AtRest(
        temperature=np.asarray(inputs["temperature"], float),
        offset=converted(expected),
        unit=unit,
        noise=float(converted(np.array([chosen.noise]))[0]),
        uncertainty=float(converted(np.array([np.sqrt(np.mean(own**2))]))[0]),
    )


@dataclass(frozen=True)
class ThermalPolynomial:
    """One axis as firmware has it; single precision, as firmware stores it.

    Attributes:
        coefficients: c0 … c3, in `unit`/°C^k.
        reference: T_ref, °C.
        low, high: the temperatures between which it holds; firmware stops there, °C.
        rms, largest: of what it leaves out of the calibration, over its readings in that range, in `unit`.
        of: what it was projected from.
    """

    coefficients: tuple[float, float, float, float]
    reference: float
    low: float
    high: float
    rms: float
    largest: float
    of: AtRest

    @property
    def unit(self) -> str:
        return self.of.unit

    @property
    def expected_error(self) -> float:
        """Root mean square to expect of a corrected reading like those of the calibration, in `unit`."""
        return float(np.sqrt(self.of.noise**2 + self.of.uncertainty**2 + self.rms**2))

    def __call__(self, temperature: np.ndarray) -> np.ndarray:
        """The offset at these temperatures, °C, held at its ends beyond the range."""
        d = np.clip(temperature, self.low, self.high) - self.reference
        c0, c1, c2, c3 = self.coefficients
        return c0 + d * (c1 + d * (c2 + d * c3))


def project(of: AtRest, reference: float, low: float, high: float) -> ThermalPolynomial:
    """The cubic nearest to a calibration between two temperatures.

    Args:
        of: the calibration's readings at rest.
        reference: T_ref, °C.
        low, high: °C; readings outside count for nothing.

    Raises:
        InputError: the readings in that range are all at one temperature.
    """
    inside = (of.temperature >= low) & (of.temperature <= high)
    temperature, offset = of.temperature[inside], of.offset[inside]
    distinct = len(np.unique(temperature))
    if distinct < 2:
        raise InputError(
            f"between {low:.4g} and {high:.4g} °C the calibration has {distinct} temperature"
            f"{'s' * (distinct != 1)}, and a polynomial needs several: calibrate over a range"
        )
    fitted = np.polynomial.Polynomial.fit(
        temperature - reference, offset, min(ORDER, distinct - 1)
    ).convert()
    rounded = np.zeros(ORDER + 1, np.float32)
    rounded[: len(fitted.coef)] = fitted.coef
    c0, c1, c2, c3 = map(float, rounded)
    made = ThermalPolynomial((c0, c1, c2, c3), reference, low, high, 0.0, 0.0, of)
    left = offset - made(temperature)
    rms, largest = float(np.sqrt(np.mean(left**2))), float(np.abs(left).max())
    return replace(made, rms=rms, largest=largest)
