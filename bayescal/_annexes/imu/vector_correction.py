"""Three-axis correction: conversion of three outputs and a temperature to the input vector with its covariance.

    y = h(f̂),    Cov f̂ = H⁻¹·(B·C·Bᵀ + S)·H⁻ᵀ,    B = ∂h/∂p,  C = Cov p,  S = σ²·1

with outputs y, input vector f, H = ∂h/∂f, and h an offset, a matrix and terms of higher order in f, polynomials in T −
T0 with coefficients p (from `vector_series.py`). A secondary input (gravity on gyroscopes) adds to the offset linearly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.still_stretches import LoggedRun

ROUNDING = 1e-13  # relative to the largest term, below which a term is zero
TERM_COUNTS = (12, 30, 33)  # number of terms up to first, second and third order in the input
# axes of the two factors of each second-order term
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # fmt: skip
FIRST_AXES, SECOND_AXES = np.array(PAIRS).T
JSON_KEYS = {"max_input": "reach", "reason": "against", "secondary_columns": "beside"}
NEWTON_STEPS = 4  # iterations of the inverse: each squares the error
ValueAndSd = tuple[np.ndarray, np.ndarray]  # a quantity and its standard uncertainty, (n,) each


@dataclass(frozen=True)
class CorrectedVector:
    """Input vectors estimated from three outputs; for tilt, body z is up and body y to the left of body x.

    Attributes:
        vector: f̂ in the body's axes (n, 3), `unit`.
        covariance: covariance of f̂ (n, 3, 3), `unit` squared.
        unit: unit of the input.
        outside: mask (n,) of temperatures outside the calibrated range.
    """

    vector: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    unit: str
    outside: np.ndarray

    @property
    def magnitude(self) -> ValueAndSd:
        """Return |f̂| and its standard uncertainty, `unit`."""
        length = np.linalg.norm(self.vector, axis=1)
        return length, self._propagate(self.vector.T / length)

    @property
    def tilt(self) -> dict[str, ValueAndSd]:
        """Return roll and pitch of a body at rest from its specific force, rad, with standard uncertainties.

        Roll is atan2(f_y, f_z), pitch atan2(−f_x, √(f_y² + f_z²)). Roll is not determined where x is vertical.
        """
        x, y, z = self.vector.T
        roll, r = np.arctan2(y, z), np.hypot(y, z)
        roll_sd = self._propagate(np.array([0 * x, np.cos(roll), -np.sin(roll)]))
        pitch_slope = np.array([-r, x * np.sin(roll), x * np.cos(roll)]) / (x**2 + r**2)
        roll_sd = np.divide(roll_sd, r, np.full_like(r, np.inf), where=r > 0)
        return {"roll": (roll, roll_sd), "pitch": (np.arctan2(-x, r), self._propagate(pitch_slope))}

    def _propagate(self, gradient: Float[np.ndarray, "3 n"]) -> np.ndarray:
        """Return the standard uncertainty of a quantity, given its gradient with respect to f̂."""
        return np.sqrt(np.abs(np.einsum("in,nij,jn->n", gradient, self.covariance, gradient)))


@ws.renamed(assumed="default_temperature", data="to_json_data")
@ws.renamed(reach="max_input", against="reason", beside="secondary_columns")
@dataclass(frozen=True, eq=False)
class VectorCorrection:
    """Correction of three outputs, at a temperature, to the input vector with its covariance; call it with outputs.

        correct = bc.vector_correction(calibration)
        corrected = correct([[0.01, 0.02, 0.99]], temperature=25.0)
        corrected.vector, corrected.covariance, corrected.magnitude, corrected.tilt

    Attributes:
        outputs: names of the three outputs.
        unit: unit of the outputs and of the input.
        reference: reference temperature T0, °C.
        low, high: calibrated temperature range, °C; None if not recorded.
        terms: (k, p), a row per power of T − T0: offset (3), matrix by rows (9); if any, second order by rows (18),
            cubes of each axis (3), secondary input by rows (9).
        covariance: covariance of the flattened `terms` (k·p, k·p).
        noise: smallest standard deviation of a calibration reading about its expected output, `unit`.
        notes: notes on use, one sentence each.
        source: identity of the calibration (SHA-256).
        secondary_columns: names of the secondary input's columns; empty if there is no secondary input.
        instrument: name of the instrument.
        max_input: largest magnitude of the input in the calibration, `unit`.
        reason: reason why the result must not be used (also in `notes`); empty if it may be used.
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
    secondary_columns: tuple[str, ...] = ()
    instrument: str = "triad"
    max_input: float = 1.0
    reason: str = ""

    @property
    def order(self) -> int:
        """Return the order of the equation in the input, 1, 2 or 3."""
        return 1 + TERM_COUNTS.index(self.terms.shape[1] - 9 * bool(self.secondary_columns))

    def powers(self, temperature: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n k"]:
        """Return the powers of T − T0 for temperatures in °C."""
        return (temperature - self.reference)[:, None] ** np.arange(len(self.terms))

    @property
    def why_not(self) -> str:
        """Return the reason why the result must not be used; empty if it may be used."""
        return self.reason

    def to_json_data(self) -> dict[str, Any]:
        """Return the correction as JSON data."""
        equation = (
            "outputs = offset + matrix·f (+ higher orders) (+ beside·g), each a polynomial of T − reference, °C; "
            "terms: offset x y z; matrix by rows; second order xx yy zz xy xz yz by rows; cubes; beside by rows"
        )
        data = {"made_by": f"bayescal {bc.__version__}", "equation": equation} | ws.as_json(self)
        return {(JSON_KEYS.get(name) or name): value for name, value in data.items()}

    @property
    def range(self) -> tuple[float, float]:
        """Return the lowest and highest calibrated temperature, °C; infinite if not recorded."""
        if self.low is None or self.high is None:
            return -np.inf, np.inf
        return self.low, self.high

    @property
    def calibrated_at(self) -> str:
        """Describe the calibrated temperature range in words."""
        if self.low is None:
            return "temperature not recorded"
        ends = dict.fromkeys(f"{end:.4g}" for end in self.range)
        return f"calibrated at {' to '.join(ends)} °C"

    @property
    def default_temperature(self) -> float:
        """Return the default temperature, °C: T0 clamped to the calibrated range."""
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
        """Return the standard uncertainties of `terms` (k, p)."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.terms.shape)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> VectorCorrection:
        """Return the correction with the data of `to_json_data`; unknown entries are ignored."""
        data = {**data, **{name: data[key] for name, key in JSON_KEYS.items()}}
        data |= {name: np.array(data[name]) for name in ("terms", "covariance")}
        return cls(**{f.name: data[f.name] for f in fields(cls)})

    def tabulate_uncertainty(self) -> tuple[str, ws.ResultTable]:
        """Tabulate the uncertainty of each component of a corrected input along an axis; return caption and table.

        The input has the magnitude `max_input`, at the default temperature without secondary input. The uncertainties
        are the largest of its six directions: of the correction alone, and with the noise of one reading.
        """
        inputs = self.max_input * np.concatenate([np.eye(3), -np.eye(3)])
        t, g = self.default_temperature, np.zeros_like(inputs) if self.secondary_columns else None
        slopes = differentiate_by_terms(inputs, self.order, g)
        y = slopes @ (self.powers(np.array([t])) @ self.terms)[0]
        covariances = [self(y, t, noise=n, secondary_input=g).covariance for n in (0, self.noise)]
        u, total_u = np.sqrt(np.max(np.diagonal(covariances, axis1=2, axis2=3), axis=1))
        titles = ("component", "standard uncertainty u", "U (k = 2)", "U (k = 2) with noise")
        rows = [("xyz"[i], *map(ws.number, (u[i], 2 * u[i], 2 * total_u[i]))) for i in range(3)]
        columns = (ws.TableColumn(title, lambda row, i=i: row[i]) for i, title in enumerate(titles))
        unit = ws.unit_label(self.unit)
        caption = f"Compensated vector of {ws.number(self.max_input)} {unit}, any axis, {t:g} °C; noise: of one reading"
        return caption, ws.ResultTable(tuple(columns), rows)

    @property
    def rows(self) -> list[TermRow]:
        """Return the non-zero terms with their standard uncertainties."""
        return list_terms(self.terms, self.uncertainty, self.unit, self.secondary_columns)

    def __str__(self) -> str:
        """Format the offset, the matrix and the other terms, as in exports."""
        return str(tabulate_terms(self.rows))

    def _repr_html_(self) -> str:
        return tabulate_terms(self.rows).html()

    @ws.renamed(beside="secondary_input")
    def __call__(
        self,
        outputs: bc.Measurements | ArrayLike,
        /,
        temperature: ArrayLike | None = None,
        *,
        noise: float | None = None,
        secondary_input: ArrayLike | None = None,
    ) -> CorrectedVector:
        """Correct three outputs to the input vector.

        Args:
            outputs: readings of the instrument, or (n, 3) in `unit`.
            temperature: °C, one per reading or one for all; default: that of the readings. Required if the
                correction depends on temperature.
            noise: standard deviation of each output, `unit`; default: the attribute `noise`; 0: without noise.
            secondary_input: (n, 3) or (3,), in the unit of its columns, if the correction depends on it.

        Raises:
            InputError: not three outputs, or a temperature or secondary input that the correction needs is missing.
        """
        vector, inverse, slope, temperatures = self._invert(outputs, temperature, secondary_input)
        powers, blocks = self.powers(temperatures), self.covariance.reshape(2 * self.terms.shape)
        cov = np.einsum("nk,kplq,nl->npq", powers, blocks, powers)
        sd = self.noise if noise is None else noise
        covariance = slope @ cov @ slope.mT + sd**2 * inverse @ inverse.mT
        low, high = self.range
        is_outside = (temperatures < low) | (temperatures > high)
        return CorrectedVector(vector, covariance, self.unit, is_outside)

    def correct_poses(
        self, run: LoggedRun, windows: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3n q"], Float[np.ndarray, "3n 3n"]]:
        """Correct the mean outputs of several poses, which share the calibration's errors.

        Args:
            run: run of a log of the three outputs.
            windows: start and end time of each pose, s.

        Returns:
            f̂; its negative partial derivatives G with respect to the terms, so that G·covariance·Gᵀ is the covariance
            that the poses share; and the covariance of independent errors.

        Raises:
            InputError: no temperature was logged, and the correction depends on it.
        """
        temperatures = None
        if run.temperature is not None:
            temperatures = [np.mean(run.temperature[run.find_rows(*w)]) for w in windows]
        outputs = run.average_outputs(windows)
        vector, inverse, slope, temperatures = self._invert(outputs, temperatures, None)
        slopes = np.einsum("nk,nip->nikp", self.powers(temperatures), slope)
        # Scatter of the calibration's poses in excess of their means' noise (creep, hysteresis, model error) is added.
        variance = run.segments.one_second_sd**2 / (windows[:, 1] - windows[:, 0])
        variance = variance + max(0.0, self.noise**2 - float(np.min(variance)))
        pose_covs = variance[:, None, None] * inverse @ inverse.mT
        return vector, slopes.reshape(3 * len(vector), -1), np.asarray(block_diag(*pose_covs))

    def _invert(
        self,
        outputs: bc.Measurements | ArrayLike,
        temperature: ArrayLike | None,
        secondary_input: ArrayLike | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return input vectors f̂ (n, 3), inverse Jacobians (n, 3, 3), −∂f̂/∂terms (n, 3, p) and temperatures (n,)."""
        names = self.secondary_columns
        if isinstance(outputs, bc.Measurements):
            readings = outputs
            if names and secondary_input is None and readings.has(names[0]):
                secondary_input = np.stack([readings[name] for name in names], axis=1)
            if temperature is None and readings.has("temperature"):
                temperature = readings["temperature"]
            outputs = np.stack([readings[name] for name in self.outputs], axis=1)
        y = np.atleast_2d(np.asarray(outputs, dtype=float))
        if y.ndim != 2 or y.shape[1] != 3:
            raise bc.InputError(f"expected three outputs per reading, (n, 3), not shape {y.shape}")
        if temperature is None and len(self.terms) > 1:
            raise bc.InputError("the correction depends on temperature: give temperature=… in °C")
        temperature = self.default_temperature if temperature is None else temperature
        temperatures = np.broadcast_to(np.asarray(temperature, float), len(y))
        if names and secondary_input is None:
            message = f"the correction depends on {', '.join(names)}: give secondary_input=… (n, 3), in their unit"
            raise bc.InputError(message)
        g = np.broadcast_to(np.asarray(secondary_input, float), y.shape) if names else None
        terms = self.powers(temperatures) @ self.terms

        def linearise(f: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
            expected = differentiate_by_terms(f, self.order, g) @ terms[..., None]
            slopes = _differentiate_by_input(terms, f, self.order)
            return expected[..., 0], lambda r: np.linalg.solve(slopes, r[..., None])[..., 0]

        f = ws.iterate_newton(linearise, y, y, NEWTON_STEPS)
        inverse = np.linalg.inv(_differentiate_by_input(terms, f, self.order))
        return f, inverse, inverse @ differentiate_by_terms(f, self.order, g), temperatures


class TermRow(NamedTuple):
    """One term of a correction, for tables."""

    name: str  # of the term, with its power of T − T0
    value: float
    uncertainty: float
    unit: str
    order: int  # in the inputs; 1 for terms in other columns


def tabulate_terms(rows: Sequence[TermRow]) -> ws.ResultTable:
    """Tabulate the terms of a correction, without those of higher order that are within half their u of zero."""
    rows = [r for r in rows if r.order < 2 or abs(r.value) > 0.5 * r.uncertainty]
    columns = (
        ws.TableColumn("outputs = offset + matrix · inputs + higher orders", lambda r: r.name),
        ws.TableColumn("value ± standard uncertainty", lambda r: ws.format_value(*r[1:3])),
        ws.TableColumn("unit", lambda r: ws.unit_label(r.unit)),
    )
    return ws.ResultTable(columns, rows)


# Power of T − T0, in the name of a term → in its unit.
POWERS = {"": "", " by T − T0": "/degC", " by (T − T0)²": "/degC^2", " by (T − T0)³": "/degC^3"}


def list_terms(
    terms: ArrayLike, uncertainty: ArrayLike, unit: str, secondary_columns: Sequence[str]
) -> list[TermRow]:
    """Return a row for each non-zero term; `terms` and their `uncertainty` are (k, p), as in `VectorCorrection`."""
    axes, terms, base = "xyz", np.asarray(terms, float), f"({unit})" if "/" in unit else unit
    names = [(f"offset {a}", unit, 0) for a in axes]
    names += [(f"matrix {a}{b}", "1", 1) for a in axes for b in axes]
    size = terms.shape[1] - 9 * bool(secondary_columns)
    if size > 12:
        pairs = [f"{axes[i]}·{axes[j]}" for i, j in PAIRS]
        names += [(f"second order of {a}: {p}", f"1/{base}", 2) for a in axes for p in pairs]
    if size > 30:
        names += [(f"third order of {a}: {a}³", f"1/{base}^2", 3) for a in axes]
    names += [(f"{g} on {a}", unit, 1) for a in axes for g in secondary_columns]
    rows = zip(POWERS.items(), terms, np.asarray(uncertainty, float), strict=False)
    return [
        TermRow(name + power, float(value), float(sd), term_unit + per_power, order)
        for (power, per_power), values, sds in rows
        for (name, term_unit, order), value, sd in zip(names, values, sds, strict=True)
        if value or sd
    ]


def differentiate_by_terms(
    stimulus: Float[np.ndarray, "n 3"], order: int, secondary_input: Float[np.ndarray, "n 3"] | None
) -> Float[np.ndarray, "n 3 p"]:
    """Return the Jacobian of the three outputs with respect to a correction's terms up to an order in the input."""

    def expand(values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n 3 m3"]:
        """Return the Jacobian of matrix · values with respect to the matrix's entries, row by row."""
        return np.einsum("ij,nm->nijm", np.eye(3), values).reshape(len(values), 3, -1)

    blocks = [np.broadcast_to(np.eye(3), (len(stimulus), 3, 3)), expand(stimulus)]
    blocks += [expand(stimulus[:, FIRST_AXES] * stimulus[:, SECOND_AXES])] if order > 1 else []
    blocks += [stimulus[:, :, None] ** 3 * np.eye(3)] if order > 2 else []
    blocks += [] if secondary_input is None else [expand(secondary_input)]
    return np.concatenate(blocks, axis=2)


def _differentiate_by_input(
    terms: Float[np.ndarray, "n p"], stimulus: Float[np.ndarray, "n 3"], order: int
) -> Float[np.ndarray, "n 3 3"]:
    """Return H, the Jacobian of the three outputs with respect to the input vector."""
    slopes = terms[:, 3:12].reshape(-1, 3, 3)
    if order > 1:
        quadratic = terms[:, 12:30].reshape(-1, 3, 6)
        slopes = slopes + quadratic * stimulus[:, None, SECOND_AXES] @ np.eye(3)[FIRST_AXES]
        slopes = slopes + quadratic * stimulus[:, None, FIRST_AXES] @ np.eye(3)[SECOND_AXES]
    if order > 2:
        slopes = slopes + (3 * terms[:, 30:33] * stimulus**2)[:, :, None] * np.eye(3)
    return slopes
