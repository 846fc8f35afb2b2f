"""The terms of an Allan curve, white noise N, bias instability B and random walk K, as data sheets give them.

Names and units: IEEE Std 952 (gyroscopes), IEEE Std 1293 (accelerometers). Which terms a curve shows, and how large
they are: σ²(τ) = N²/τ + (2·ln 2/π)·B² + K²·τ/3, IEEE Std 952, Annex C: its slopes say which of these there are, and
least squares of their sum how large.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular
from scipy.special import chdtrc

from bayescal._core.formatting import with_error
from bayescal._data.record_settings import recording
from bayescal._data.unit_conversion import unit_label
from bayescal._data.unit_parsing import parse

SYMBOLS = "NBK"
SLOPES = {"N": -0.5, "B": 0.0, "K": 0.5}  # of log σ over log τ
FLAT = 2 * np.log(2) / np.pi  # σ² of flicker noise over B²; its root is the 0.664 of data sheets
FREQUENCIES = 4096  # of an integral over a spectrum; twice as many change no digit that is printed
ROUNDS = 5  # of weighting anew; more change nothing to three digits


class Habit(NamedTuple):
    """How the terms of one kind of output are called and given on data sheets: N, B, K; `rounded` is the unit of Q."""

    names: tuple[str, str, str]
    units: tuple[str, str, str]
    rounded: str


@dataclass(frozen=True)
class AllanTerm:
    """One term of an Allan curve.

    Attributes:
        symbol: N, B or K.
        name: as IEEE 952 and 1293 call it.
        unit: of data sheets.
        value: None where the curve of this record has no such slope.
        uncertainty: standard uncertainty of the value.
    """

    symbol: str
    name: str
    unit: str
    value: float | None = None
    uncertainty: float | None = None

    def __str__(self) -> str:
        if self.value is None or self.uncertainty is None:
            return "not seen in this record"
        return f"{with_error(self.value, self.uncertainty)} {unit_label(self.unit)}".strip()


def habit(unit: str) -> Habit:
    """Names and units of the terms for an output in `unit`.

    Noise densities are of the spectrum on both sides of zero frequency, as in IEEE 952, so that N per √Hz is N·√s;
    a data sheet with a one-sided spectrum prints √2 times as much.
    """
    powers = dict(parse(unit or "1").powers)
    if powers == {"rad": 1, "s": -1}:
        names = ("angle random walk", "bias instability", "rate random walk")
        return Habit(names, ("deg/h^0.5", "deg/h", "deg/h/h^0.5"), "arcsec")
    walks = ("velocity random walk", "bias instability", "acceleration random walk")
    if powers == {"ug": 1}:
        return Habit(walks, ("ug/Hz^0.5", "ug", "ug/h^0.5"), "ug*s")
    if powers == {"m": 1, "s": -2}:
        return Habit(walks, ("m/s/h^0.5", "m/s^2", "m/s^2/h^0.5"), "m/s")
    own = unit or "1"
    names = ("white noise", "bias instability", "random walk")
    return Habit(names, (f"{own}/Hz^0.5", own, f"{own}/s^0.5"), f"{own}*s")


def term(symbol: str, unit: str, value: float | None, uncertainty: float | None) -> AllanTerm:
    """A term in its data-sheet unit.

    Args:
        symbol: N, B or K.
        unit: of the output.
        value, uncertainty: in that unit times √s (N), as it is (B), or per √s (K); None where not seen.
    """
    i, names = SYMBOLS.index(symbol), habit(unit)
    if value is None or uncertainty is None:
        return AllanTerm(symbol, names.names[i], names.units[i])
    # Both in base units, of which the second is one and the hertz its inverse.
    factor = parse(unit or "1").factor / parse(names.units[i]).factor
    return AllanTerm(symbol, names.names[i], names.units[i], value * factor, uncertainty * factor)


class Curve(NamedTuple):
    """An Allan curve.

    Attributes:
        factors: readings averaged, each twice the one before.
        step: between readings, s.
        readings: of the longest run.
        variance: Allan variances, output unit squared.
        edf: their equivalent degrees of freedom.
    """

    factors: Float[np.ndarray, "k"]
    step: float
    readings: int
    variance: Float[np.ndarray, "k"]
    edf: Float[np.ndarray, "k"]

    def column(self, symbol: str) -> Float[np.ndarray, "k"]:
        """The Allan variance of a term of size one; of a random walk, as readings taken at moments see it."""
        if symbol == "N":
            return 1 / (self.step * self.factors)
        if symbol == "B":
            return np.full(len(self.factors), FLAT)
        return self.step * self.factors / 3 * (1 + 0.5 / self.factors**2)

    @property
    def frequencies(self) -> Float[np.ndarray, "f"]:
        """From that of the longest run to half of one per reading, by equal factors."""
        return np.geomspace(0.25 / self.readings, 0.5, FREQUENCIES)

    def spectrum(self, symbol: str) -> Float[np.ndarray, "f"]:
        """The spectral density of a term of size one, per reading."""
        f = self.frequencies
        if symbol == "N":
            return np.full(len(f), 1 / self.step)
        return 1 / (2 * np.pi * f) if symbol == "B" else self.step / (2 * np.sin(np.pi * f)) ** 2

    @property
    def responses(self) -> Float[np.ndarray, "k f"]:
        """How much of each frequency is in each Allan variance, but for a factor: of its square, that of its band."""
        f, m = self.frequencies, self.factors[:, None]
        return np.sqrt(f) * np.sin(np.pi * f * m) ** 4 / (m * np.sin(np.pi * f)) ** 2


def terms_of(curve: Curve, unit: str) -> tuple[AllanTerm, ...]:
    """N, B and K of a curve, each only where the curve has its slope.

    Args:
        curve: in octaves.
        unit: of the output.
    """
    shown = _sizes(_stretches(curve), curve)
    return tuple(term(s, unit, *shown.get(s, (None, None))) for s in SYMBOLS)


class _Stretch(NamedTuple):
    first: int
    last: int
    uncertainty: float  # of its slope


def _stretches(curve: Curve) -> dict[str, _Stretch]:
    """Where the curve has the slope of each term, if anywhere."""
    octaves, height = np.log2(curve.factors), 0.5 * np.log2(curve.variance)
    error = 1 / (np.log(2) * np.sqrt(2 * curve.edf))
    lowest = int(np.argmin(height))
    found: dict[str, _Stretch] = {}
    for symbol in ("K", "B", "N"):
        fitting = [
            s
            for i, j in combinations(range(len(octaves)), 2)
            if (s := _sloping(SLOPES[symbol], i, j, octaves, height, error)) is not None
            # The flat part is the lowest; and what falls again after a rise is no white noise of single readings.
            and (symbol != "B" or i <= lowest <= j)
            and (symbol != "N" or "K" not in found or i < found["K"].first)
        ]
        if fitting:
            found[symbol] = min(fitting, key=lambda s: s.uncertainty)
    return found


def _sloping(
    slope: float, first: int, last: int, octaves: np.ndarray, height: np.ndarray, error: np.ndarray
) -> _Stretch | None:
    """The stretch, if it is straight, and its slope with its uncertainty nearer to this than to another noise's."""
    x, y, e = (a[first : last + 1] for a in (octaves, height, error))
    centred = x - np.average(x, weights=e**-2)
    uncertainty = float(np.sum((centred / e) ** 2)) ** -0.5
    found = float(np.sum(centred * y / e**2)) * uncertainty**2
    bend = y - np.average(y, weights=e**-2) - found * centred
    straight = _described(float(np.sum((bend / e) ** 2)), last - first - 1)
    if (
        straight
        and abs(found - slope) + recording().allan_coverage * uncertainty < recording().allan_slope
    ):
        return _Stretch(first, last, uncertainty)
    return None


def _described(misfit: float, spare: int) -> bool:
    """Whether a sum of squares is no rarer than one in a thousand for a χ² of so many degrees of freedom."""
    return spare == 0 or bool(chdtrc(spare, misfit) > recording().allan_straight)


def _sizes(found: dict[str, _Stretch], curve: Curve) -> dict[str, tuple[float, float]]:
    """Terms, and their standard uncertainties, whose sum is the curve from the first of their slopes to the last.

    Where the sum does not describe the curve, as beside noise of a correlation time, the term of the longest times
    goes out; so does one that is not above zero.
    """
    left = dict(found)
    while left:
        part = slice(min(s.first for s in left.values()), max(s.last for s in left.values()) + 1)
        squares, error, misfit = _least_squares(list(left), curve, part)
        faint = int(np.argmin(squares / error))
        spare = part.stop - part.start - len(left)
        if len(left) > 1 and not _described(misfit, spare):
            left.pop(max(left, key=lambda s: left[s].last))
        elif squares[faint] <= recording().allan_coverage * error[faint]:
            left.pop(list(left)[faint])
        else:
            sizes = np.sqrt(squares)
            errors = error / 2 / sizes
            return {s: (float(sizes[i]), float(errors[i])) for i, s in enumerate(left)}
    return {}


def _least_squares(
    symbols: list[str], curve: Curve, part: slice
) -> tuple[Float[np.ndarray, "t"], Float[np.ndarray, "t"], float]:
    """Squared sizes, their standard uncertainties and the sum of squares: generalised, the weights those of the sum."""
    responses, measured = curve.responses[part], curve.variance[part]
    design = np.stack([curve.column(s)[part] for s in symbols], axis=1)
    spectra = np.stack([curve.spectrum(s) for s in symbols])
    expected, squares = measured, np.ones(len(symbols))
    for _ in range(ROUNDS):
        root = _root(responses * (squares @ spectra), expected, curve.edf[part])
        white = solve_triangular(root, np.column_stack([design, measured]), lower=True)
        squares = np.maximum(np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0], 0.0)
        if not np.any(squares > 0):
            break
        expected = design @ squares
    error = np.sqrt(np.diag(np.linalg.pinv(white[:, :-1].T @ white[:, :-1])))
    return squares, error, float(np.sum((white[:, -1] - white[:, :-1] @ squares) ** 2))


def _root(
    passed: Float[np.ndarray, "k f"], expected: Float[np.ndarray, "k"], edf: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k k"]:
    """L with L·Lᵀ the covariance of estimated Allan variances.

    An estimate of v with e degrees of freedom has the variance 2·v²/e. Two are correlated as far as the same
    frequencies pass through both: as the integral of the product of the spectra that do.
    """
    shared = passed @ passed.T
    size = np.sqrt(np.diag(shared))
    deviation = expected * np.sqrt(2 / edf)
    return cholesky(shared / np.outer(size, size) * np.outer(deviation, deviation), lower=True)
