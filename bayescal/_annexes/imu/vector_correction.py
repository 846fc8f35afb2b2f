"""The correction of three axes in use: from three outputs to the input vector, with its covariance, over temperature.

    y = h(f̂),    Cov f̂ = H⁻¹·(B·C·Bᵀ + S)·H⁻ᵀ,    B = ∂h/∂p,  C = Cov p,  S = σ²·1

with h an offset, a matrix and terms of higher order of what acts, f, each a polynomial of T − T0 (`vector_series.py`
makes them of a calibration). What acts beside it (gravity on gyroscopes) adds to the offset, linearly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.still_stretches import LoggedRun

ROUNDING = 1e-13  # of the largest term, up to which a term is none
SIZES = (12, 30, 33)  # how many terms there are up to an order in what acts
# of inputs, that terms of second order multiply
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # fmt: skip
FIRST, SECOND = np.array(PAIRS).T
RELATIVE_STEP = 1e-6  # of a vector's length, for central differences: 1e-10 of a slope
NEWTON_STEPS = 4  # steps of the inverse: each squares the error
Uncertain = tuple[np.ndarray, np.ndarray]  # a quantity and its standard uncertainty, (n,) each


@dataclass(frozen=True)
class CorrectedVector:
    """Input vectors estimated from three outputs. Of tilt z is up and y to the left of x.

    Attributes:
        vector: f̂ in the body's axes (n, 3), `unit`.
        covariance: of it (n, 3, 3), `unit` squared.
        unit: of both.
        outside: where the temperature is outside the calibrated range (n,).
    """

    vector: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    unit: str
    outside: np.ndarray

    @property
    def magnitude(self) -> Uncertain:
        """Return |f̂| and its standard uncertainty, `unit`."""
        length = np.linalg.norm(self.vector, axis=1)
        unit = self.vector / length[:, None]
        return length, np.sqrt(np.einsum("ni,nij,nj->n", unit, self.covariance, unit))

    @property
    def tilt(self) -> dict[str, Uncertain]:
        """Return roll and pitch of a body at rest by its specific force, rad, with standard uncertainties.

        Roll is atan2(f_y, f_z), pitch atan2(−f_x, √(f_y² + f_z²)). Roll is not determined where x is vertical.
        """
        return {
            "roll": self._propagate(lambda v: np.arctan2(v[:, 1], v[:, 2])),
            "pitch": self._propagate(lambda v: np.arctan2(-v[:, 0], np.hypot(v[:, 1], v[:, 2]))),
        }

    def _propagate(self, quantity: Callable[[np.ndarray], np.ndarray]) -> Uncertain:
        """Propagate the covariance to an angle, by its slopes."""
        step, by_axis = RELATIVE_STEP * np.linalg.norm(self.vector, axis=1), []
        for axis in np.eye(3):
            change = step[:, None] * axis
            difference = quantity(self.vector + change) - quantity(self.vector - change)
            # The difference of angles across ±π.
            by_axis.append(np.angle(np.exp(1j * difference)) / (2 * step))
        slope = np.stack(by_axis, axis=1)
        variance = np.einsum("ni,nij,nj->n", slope, self.covariance, slope)
        return quantity(self.vector), np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True, eq=False)
class VectorCorrection(ws.CorrectionInUse):
    """Offset, matrix and terms of higher order over temperature, with their covariance: call it with outputs.

        correct = bc.vector_correction(calibration)
        found = correct([[0.01, 0.02, 0.99]], temperature=25.0)
        found.vector, found.covariance, found.magnitude, found.tilt

    Attributes:
        outputs: names of the three outputs.
        unit: of the outputs and of what acts.
        reference: T0, °C.
        low, high: temperatures of the calibration, °C; None where none was recorded.
        terms: for each power of T − T0, offset (3), matrix by rows (9), then second order by rows (18) or none, then
            each axis' own cube (3) or none, then what acts beside, by rows (9) or none (k, p).
        covariance: of `terms`, raveled (k·p, k·p).
        noise: standard deviation of an output as it was calibrated, of the best reading, `unit`.
        notes: what to know, each a sentence.
        source: identity of the calibration.
        beside: columns of what acts beside; empty for none.
        instrument: its name.
        reach: largest magnitude of what acted in the calibration, `unit`.
        against: why the result is not to be used, which is among the notes too; empty where it may be.
    """

    outputs: tuple[str, ...]
    unit: str
    reference: float
    low: float | None
    high: float | None
    terms: Float[np.ndarray, "k p"]
    covariance: Float[np.ndarray, "q q"]
    noise: float
    notes: tuple[str, ...] = ()
    source: str = ""
    beside: tuple[str, ...] = ()
    instrument: str = "triad"
    reach: float = 1.0
    against: str = ""

    @property
    def order(self) -> int:
        """Return the order of the equation in the input, 1, 2 or 3."""
        return 1 + SIZES.index(self.terms.shape[1] - 9 * bool(self.beside))

    def powers(self, temperature: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n k"]:
        """Return the powers of T − T0 for temperatures in °C."""
        return (temperature - self.reference)[:, None] ** np.arange(len(self.terms))

    def about_it(self) -> tuple[str, tuple[str, ...], str]:
        return self.instrument, self.notes, self.against

    def data(self) -> dict[str, Any]:
        equation = (
            "outputs = offset + matrix·f (+ higher orders) (+ beside·g), each a polynomial of T − reference, °C; "
            "terms: offset x y z; matrix by rows; second order xx yy zz xy xz yz by rows; cubes; beside by rows"
        )
        return {"made_by": f"bayescal {bc.__version__}", "equation": equation} | ws.as_json(self)

    @property
    def range(self) -> tuple[float, float]:
        """Return the calibrated temperatures, lowest and highest, °C; infinite where none was recorded."""
        if self.low is None or self.high is None:
            return -np.inf, np.inf
        return self.low, self.high

    @property
    def calibrated_at(self) -> str:
        """State the temperatures of the calibration in words."""
        if self.low is None:
            return "temperature not recorded"
        ends = dict.fromkeys(f"{end:.4g}" for end in self.range)
        return f"calibrated at {' to '.join(ends)} °C"

    @property
    def assumed(self) -> float:
        """Return the temperature where none is given, °C: T0 clamped to the calibrated range."""
        return float(np.clip(self.reference, *self.range))

    @cached_property
    def offset(self) -> np.ndarray:
        """Return the offset at T0 (3,)."""
        return self.terms[0, :3]

    @cached_property
    def matrix(self) -> np.ndarray:
        """Return the matrix at T0 (3, 3): outputs = matrix·f + offset."""
        return self.terms[0, 3:12].reshape(3, 3)

    @property
    def uncertainty(self) -> np.ndarray:
        """Return the standard uncertainty of each term, as `terms` (k, p)."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.terms.shape)

    @property
    def rows(self) -> list[TermRow]:
        """Return the non-zero terms with their standard uncertainties."""
        return term_rows(self.terms, self.uncertainty, self.unit, self.beside)

    def __str__(self) -> str:
        """Format offset, matrix and the other terms, as exports have them."""
        return str(terms_table(self.rows))

    def _repr_html_(self) -> str:
        return terms_table(self.rows).html()

    def __call__(
        self,
        outputs: bc.Measurements | ArrayLike,
        /,
        temperature: ArrayLike | None = None,
        *,
        noise: float | None = None,
        beside: ArrayLike | None = None,
    ) -> CorrectedVector:
        """Correct three outputs to the input vector.

        Args:
            outputs: readings of the instrument, or (n, 3) in `unit`.
            temperature: °C, one each or one for all; T0 if not given.
            noise: standard deviation of each output, `unit`; that of the calibration's poses if not given, 0 for the
                uncertainty of the calibration alone.
            beside: what acts beside, (n, 3) or (3,), in the unit of its columns, where the model has it.

        Raises:
            InputError: not three outputs, or a temperature or what acts beside is missing where the model needs it.
        """
        force, inverse, slope, temperatures = self._invert(outputs, temperature, beside)
        powers, blocks = self.powers(temperatures), self.covariance.reshape(2 * self.terms.shape)
        cov = np.einsum("nk,kplq,nl->npq", powers, blocks, powers)
        sd = self.noise if noise is None else noise
        covariance = slope @ cov @ slope.mT + sd**2 * inverse @ inverse.mT
        low, high = self.range
        outside = (temperatures < low) | (temperatures > high)
        return CorrectedVector(force, covariance, self.unit, outside)

    def in_poses(
        self, run: LoggedRun, windows: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3n q"], Float[np.ndarray, "3n 3n"]]:
        """Correct the mean outputs of several poses, which share the calibration's errors.

        Args:
            run: of a log of the three outputs.
            windows: begin and end of each pose, s.

        Returns:
            f̂; its negative derivatives by the terms, so that slopes·covariance·slopesᵀ is the covariance that poses
            share; and the covariance of independent errors.

        Raises:
            InputError: no temperature was logged, and the correction depends on it.
        """
        temperatures = None
        if run.temperature is not None:
            temperatures = np.array([np.mean(run.temperature[run.inside(*w)]) for w in windows])
        force, inverse, slope, temperatures = self._invert(run.means(windows), temperatures, None)
        shared = np.einsum("nk,nip->nikp", self.powers(temperatures), slope)
        # What poses of the calibration scatter by beyond their means' noise (creep, hysteresis, a model not exact) each
        # pose of a log has too.
        noise = run.at_rest.of_second**2 / (windows[:, 1] - windows[:, 0])
        noise = noise + max(0.0, self.noise**2 - float(np.min(noise)))
        pose_covs = noise[:, None, None] * inverse @ inverse.mT
        return force, shared.reshape(3 * len(force), -1), np.asarray(block_diag(*pose_covs))

    def _invert(
        self,
        outputs: bc.Measurements | ArrayLike,
        temperature: ArrayLike | None,
        secondary: ArrayLike | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return f̂ (n, 3), H⁻¹ (n, 3, 3), slopes of f̂ by the terms at its temperature (n, 3, p), temperatures (n,)."""
        if isinstance(outputs, bc.Measurements):
            readings = outputs
            if self.beside and secondary is None and readings.has(self.beside[0]):
                secondary = np.stack([readings[name] for name in self.beside], axis=1)
            if temperature is None and readings.has("temperature"):
                temperature = readings["temperature"]
            outputs = np.stack([readings[name] for name in self.outputs], axis=1)
        y = np.atleast_2d(np.asarray(outputs, dtype=float))
        if y.ndim != 2 or y.shape[1] != 3:
            raise bc.InputError(
                f"three outputs a reading are needed, (n, 3); these have the shape {y.shape}"
            )
        if temperature is None and len(self.terms) > 1:
            raise bc.InputError(
                "the correction depends on the temperature: give temperature=… in °C"
            )
        degrees = self.assumed if temperature is None else np.asarray(temperature, float)
        warm = np.broadcast_to(degrees, len(y))
        if self.beside and secondary is None:
            raise bc.InputError(
                f"the correction depends on {', '.join(self.beside)}: give beside=… (n, 3), as calibrated"
            )
        acts = np.broadcast_to(np.asarray(secondary, float), y.shape) if self.beside else None
        terms = self.powers(warm) @ self.terms

        def equation(force: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
            predicted = slopes_by_terms(force, self.order, acts) @ terms[..., None]
            slopes = _slopes_by_force(terms, force, self.order)
            return predicted[..., 0], lambda miss: np.linalg.solve(slopes, miss[..., None])[..., 0]

        force = ws.stepped(equation, y, y, NEWTON_STEPS)
        inverse = np.linalg.inv(_slopes_by_force(terms, force, self.order))
        return force, inverse, inverse @ slopes_by_terms(force, self.order, acts), warm


class TermRow(NamedTuple):
    """A term of a correction."""

    name: str  # with the power of T − T0 that it multiplies
    value: float
    uncertainty: float
    unit: str


def terms_table(rows: Sequence[TermRow]) -> ws.ResultTable:
    """Tabulate the terms of a correction with their standard uncertainties."""
    columns = (
        ws.TableColumn("correction", lambda r: r.name),
        ws.TableColumn(
            "value ± standard uncertainty", lambda r: ws.with_error(r.value, r.uncertainty)
        ),
        ws.TableColumn("unit", lambda r: ws.unit_label(r.unit)),
    )
    return ws.ResultTable(columns, rows)


# Of T − T0, in the name and in the unit of a term.
POWERS = {
    "": "",
    " by T − T0": "/degC",
    " by (T − T0)²": "/degC^2",
    " by (T − T0)³": "/degC^3",
}


def term_rows(
    terms: ArrayLike, uncertainty: ArrayLike, unit: str, secondary: Sequence[str]
) -> list[TermRow]:
    """Return the non-zero terms of a correction as rows."""
    axes, terms, per = "xyz", np.asarray(terms, float), f"({unit})" if "/" in unit else unit
    names = [(f"offset {a}", unit) for a in axes]
    names += [(f"matrix {a}{b}", "1") for a in axes for b in axes]
    size = terms.shape[1] - 9 * bool(secondary)
    if size > 12:
        pairs = [axes[i] + axes[j] for i, j in PAIRS]
        names += [(f"second order {a}·{p}", f"1/{per}") for a in axes for p in pairs]
    if size > 30:
        names += [(f"cube {a}", f"1/{per}^2") for a in axes]
    names += [(f"{g} on {a}", unit) for a in axes for g in secondary]
    rows = zip(POWERS.items(), terms, np.asarray(uncertainty, float), strict=False)
    return [
        TermRow(name + power, float(value), float(sd), its + per_power)
        for (power, per_power), values, sds in rows
        for (name, its), value, sd in zip(names, values, sds, strict=True)
        if value or sd
    ]


def slopes_by_terms(
    force: Float[np.ndarray, "n 3"], order: int, secondary: Float[np.ndarray, "n 3"] | None
) -> Float[np.ndarray, "n 3 p"]:
    """Return the slopes of the three outputs with respect to the terms of a correction up to an order in the input."""

    def by_rows(values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n 3 m3"]:
        """Return the slopes with respect to a matrix's entries, row by row, that multiply these values."""
        return np.einsum("ij,nm->nijm", np.eye(3), values).reshape(len(values), 3, -1)

    blocks = [np.broadcast_to(np.eye(3), (len(force), 3, 3)), by_rows(force)]
    blocks += [by_rows(force[:, FIRST] * force[:, SECOND])] if order > 1 else []
    blocks += [force[:, :, None] ** 3 * np.eye(3)] if order > 2 else []
    blocks += [] if secondary is None else [by_rows(secondary)]
    return np.concatenate(blocks, axis=2)


def _slopes_by_force(
    terms: Float[np.ndarray, "n p"], force: Float[np.ndarray, "n 3"], order: int
) -> Float[np.ndarray, "n 3 3"]:
    """Return H, the slopes of the three outputs with respect to the input vector."""
    slopes = terms[:, 3:12].reshape(-1, 3, 3)
    if order > 1:
        second = terms[:, 12:30].reshape(-1, 3, 6)
        slopes = slopes + second * force[:, None, SECOND] @ np.eye(3)[FIRST]
        slopes = slopes + second * force[:, None, FIRST] @ np.eye(3)[SECOND]
    if order > 2:
        slopes = slopes + (3 * terms[:, 30:33] * force**2)[:, :, None] * np.eye(3)
    return slopes
