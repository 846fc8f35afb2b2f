"""Three axes in use: from three outputs back to what acts, with its covariance, over temperature; in others' axes.

The calibrated equation h is taken as its Taylor series in what acts: offset, 3 × 3 matrix and, where the model has
them, terms of second order and each axis' own cube, each a polynomial of T − T0. That is exact for terms that are
polynomials of both; what depends on the temperature otherwise is left to the uncertainty.

    f̂ = h⁻¹(y),    Cov f̂ = H⁻¹·(B·C·Bᵀ + S)·H⁻ᵀ,    B = ∂h/∂p,  C = Cov p,  S = σ²·1

What belongs to the test and is not known in use is integrated out, draw by draw, and widens C: the deviation of a run
is that of a new one, and what depends on time (a drift, a lag) or on a further column is as at a reading of the test
taken at random.

What acts beside it (gravity on gyroscopes) adds to the offset, linearly.

Magnetometers come into the axes of accelerometers by the dip of the field, which is the same in every pose at rest.
With û and n̂ the directions of the specific force and of the field in a pose, each in the axes of its own calibration,

    ûᵀ·R·n̂ = sin(dip)

for one rotation R and one dip (negative here where the field points down): four unknowns, by generalised least squares
over the poses of one log. Errors of both calibrations are shared by all poses and are in the covariance; the rotation's
own error is that of the correction that leaves, together with what it shares with the matrix and with the force's
correction, which a heading by both counts. Where poses scatter by more than their uncertainty (iron near by), the
rotation is that much more uncertain (R. Birge, Phys. Rev. 40 (1932) 207). An axis that points backwards and a field
that points to the other side of the level are the same to it: the dip found is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity
from bayescal._calibration.judgement import why_not
from bayescal._calibration.mixture import usual_columns, with_columns
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import number, with_error
from bayescal._core.result_table import ResultTable, TableColumn
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import ACROSS, MAGNITUDE, TURNED, magnitude
from bayescal._data.still_stretches import LoggedRun, in_common, logged_runs, per_sample
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.assembly import Assembly
from bayescal._use.compensation_program import NOT_RELIABLE

# Share of the largest term up to which a polynomial of the temperature is the model's own.
EXACT_SHARE = 1e-9
ROUNDING = 1e-13  # of it, up to which a term is none
ORDERS = 3  # of the temperature
SIZES = (12, 30, 33)  # how many terms there are up to an order in what acts
PAIRS = (
    (0, 0),
    (1, 1),
    (2, 2),
    (0, 1),
    (0, 2),
    (1, 2),
)  # of inputs, that terms of second order multiply
TEMPERATURE = "temperature"  # known in use, as is what acts beside
SHARED_SIZES = 3.0  # plausible sizes of a factor that three scale factors share, beyond which what acts is in question
MENTIONED_SHARE = 0.1  # of a standard uncertainty: what of the test is larger is said
OfTest = dict[str, dict[str, float]]  # of effects, the standard deviation of what they add to slots
STEP = 1e-6  # of a vector's length, for central differences: 1e-10 of a slope
NEWTON_STEPS = 4  # steps of the inverse: each squares the error


@dataclass(frozen=True, eq=False)
class TermSlopes:
    """What corrected vectors fall by where a term of their correction rises: `powers` times `each`.

    Attributes:
        correction: whose terms.
        powers: of T − T0 (n, k).
        each: by the terms at its temperature (n, 3, p).
    """

    correction: VectorCorrection
    powers: Float[np.ndarray, "n k"]
    each: Float[np.ndarray, "n 3 p"]

    def along(self, slope: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n q"]:
        """Of a quantity with this slope by the vector."""
        found = np.einsum("nk,nip,ni->nkp", self.powers, self.each, slope)
        return found.reshape(len(slope), -1)


@dataclass(frozen=True)
class CorrectedVector:
    """What acts, by three outputs.

    Attributes:
        vector: f̂ in the body's axes (n, 3), `unit`.
        covariance: of it (n, 3, 3), `unit` squared.
        unit: of both.
        outside: where the temperature is outside the calibrated range (n,).
        slopes: by the terms of the correction; None where no correction made it.
    """

    vector: Float[np.ndarray, "n 3"]
    covariance: Float[np.ndarray, "n 3 3"]
    unit: str
    outside: np.ndarray
    slopes: TermSlopes | None = None

    def _along(self, slope: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        return np.sqrt(np.einsum("ni,nij,nj->n", slope, self.covariance, slope))

    @property
    def magnitude(self) -> tuple[np.ndarray, np.ndarray]:
        """|f̂| and its standard uncertainty, `unit`."""
        size = np.linalg.norm(self.vector, axis=1)
        return size, self._along(self.vector / size[:, None])

    @property
    def tilt(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Roll and pitch of a body at rest by its specific force, rad, with standard uncertainties.

        Roll is atan2(f_y, f_z), pitch atan2(−f_x, √(f_y² + f_z²)). Roll is not determined where x is vertical.
        """
        x, y, z = self.vector.T
        across = np.hypot(y, z)
        square = x**2 + across**2
        with np.errstate(divide="ignore", invalid="ignore"):
            by_roll = np.stack([0 * x, z / across**2, -y / across**2], axis=1)
            by_pitch = np.stack([-across, x * y / across, x * z / across], axis=1) / square[:, None]
        return {
            "roll": (np.arctan2(y, z), self._along(by_roll)),
            "pitch": (np.arctan2(-x, across), self._along(by_pitch)),
        }

    @property
    def heading(self) -> tuple[np.ndarray, np.ndarray]:
        """Heading of a level body by the magnetic field, of x clockwise from magnetic north, rad: atan2(m_y, m_x).

        With its standard uncertainty. As of `tilt` and `heading_over`, z is up and y to the left of x.
        """
        x, y, _ = self.vector.T
        slope = np.stack([-y, x, 0 * x], axis=1) / (x**2 + y**2)[:, None]
        return np.arctan2(y, x), self._along(slope)

    def heading_over(self, force: CorrectedVector) -> tuple[np.ndarray, np.ndarray]:
        """Heading of the x axis by a magnetic field, of a body at rest in any attitude.

        Args:
            force: specific force of the same moments in the same axes, which says where up is. Where `in_frame_of` took
                the field's correction to the axes of the force's, the errors that it shares with them count as such;
                otherwise errors of force and field count as independent.

        Returns:
            Angle from magnetic north, clockwise as seen from above, rad, and its standard uncertainty; not determined
            where x is vertical.
        """

        def heading(up: np.ndarray, field: np.ndarray) -> np.ndarray:
            up = up / np.linalg.norm(up, axis=1)[:, None]
            east = np.cross(field, up)
            north = field - np.sum(field * up, axis=1)[:, None] * up
            return np.arctan2(east[:, 0], north[:, 0])

        both, slopes = (force, self), []
        for moved, one in enumerate(both):
            step = STEP * np.linalg.norm(one.vector, axis=1)[:, None]
            by_axis = []
            for axis in np.eye(3):
                ends = []
                for sign in (1, -1):
                    there = [other.vector for other in both]
                    there[moved] = one.vector + sign * step * axis
                    ends.append(heading(*there))
                turned = np.angle(np.exp(1j * (ends[0] - ends[1])))  # across ±π
                by_axis.append(turned / (2 * step[:, 0]))
            slopes.append(np.stack(by_axis, axis=1))
        variance = sum(one._along(slope) ** 2 for one, slope in zip(both, slopes, strict=True))
        own, theirs = self.slopes, force.slopes
        if own is not None and theirs is not None:
            shared = own.correction.shared_with(theirs.correction)
            if shared is not None:
                by_terms = own.along(slopes[1]) @ shared * theirs.along(slopes[0])
                variance = variance + 2 * np.sum(by_terms, axis=1)
        return heading(force.vector, self.vector), np.sqrt(np.maximum(variance, 0.0))


@dataclass(frozen=True, eq=False)
class VectorCorrection:
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
        axes_of: identity of the calibration whose axes `in_frame_of` took it to; empty for its own.
        shared: covariance of `terms` with those of that correction, both raveled (k·p, q); None for its own axes.
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
    axes_of: str = ""
    shared: Float[np.ndarray, "q r"] | None = None

    def shared_with(self, other: VectorCorrection) -> Float[np.ndarray, "q r"] | None:
        """Covariance of the terms with those of the correction whose axes these are; None of another."""
        known = self.axes_of != "" and self.axes_of == other.source
        return self.shared if known else None

    @property
    def order(self) -> int:
        """Of the equation in what acts, 1, 2 or 3."""
        return 1 + SIZES.index(self.terms.shape[1] - 9 * bool(self.beside))

    def at(self, temperature: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Terms (n, p) at temperatures in °C, and their covariance (n, p, p)."""
        k, p = self.terms.shape
        powers = self.powers(np.atleast_1d(np.asarray(temperature, float)))
        blocks = self.covariance.reshape(k, p, k, p)
        return powers @ self.terms, np.einsum("nk,kplq,nl->npq", powers, blocks, powers)

    def powers(self, temperature: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n k"]:
        """Of T − T0, of temperatures in °C."""
        return (temperature - self.reference)[:, None] ** np.arange(len(self.terms))

    @property
    def why_not(self) -> str:
        """Why the result is not to be used, in words; empty where it may be."""
        told = (note for note in self.notes if note.startswith(NOT_RELIABLE))
        return next(told, "").removeprefix(NOT_RELIABLE)

    @property
    def calibrated_at(self) -> str:
        """The temperatures of the calibration, in words."""
        if self.low is None or self.high is None:
            return "temperature not recorded"
        several = f"{self.low:.4g} to " if self.high > self.low else ""
        return f"calibrated at {several}{self.high:.4g} °C"

    @property
    def assumed(self) -> float:
        """Temperature where none is given, °C: T0, which is rounded and may be none of the calibration's."""
        if self.low is None or self.high is None:
            return self.reference
        return min(max(self.reference, self.low), self.high)

    def is_outside(self, temperature: Float[np.ndarray, "n"]) -> np.ndarray:
        """Where a temperature, °C, is none of the calibration; nowhere where none was recorded."""
        if self.low is None or self.high is None:
            return np.zeros(len(temperature), bool)
        return (temperature < self.low) | (temperature > self.high)

    @cached_property
    def offset(self) -> np.ndarray:
        """At T0 (3,)."""
        return self.terms[0, :3]

    @cached_property
    def matrix(self) -> np.ndarray:
        """At T0 (3, 3): outputs = matrix·f + offset."""
        return self.terms[0, 3:12].reshape(3, 3)

    @property
    def uncertainty(self) -> np.ndarray:
        """Standard uncertainty of each term, as `terms` (k, p)."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.terms.shape)

    @property
    def rows(self) -> list[TermRow]:
        """Every term that is not nothing, with its standard uncertainty."""
        return term_rows(self.terms, self.uncertainty, self.unit, self.beside)

    def __str__(self) -> str:
        """Offset, matrix and what else there is, as exports have them."""
        return str(terms_table(self.rows))

    def __call__(
        self,
        outputs: Measurements | ArrayLike,
        /,
        temperature: ArrayLike | None = None,
        *,
        noise: float | None = None,
        beside: ArrayLike | None = None,
    ) -> CorrectedVector:
        """What acts, by three outputs.

        Args:
            outputs: readings of the instrument, or (n, 3) in `unit`.
            temperature: °C, one each or one for all; T0 if not given.
            noise: standard deviation of each output, `unit`; that of the calibration's poses if not given, 0 for the
                uncertainty of the calibration alone.
            beside: what acts beside, (n, 3) or (3,), in the unit of its columns, where the model has it.

        Raises:
            InputError: not three outputs, or a temperature or what acts beside is missing where the model needs it.
        """
        force, inverse, slope, warm = self._solved(outputs, temperature, beside)
        own = self.at(warm)[1]
        sd = self.noise if noise is None else noise
        covariance = slope @ own @ slope.transpose(0, 2, 1) + sd**2 * inverse @ inverse.transpose(
            0, 2, 1
        )
        slopes = TermSlopes(self, self.powers(warm), slope)
        return CorrectedVector(force, covariance, self.unit, self.is_outside(warm), slopes)

    def in_poses(
        self, run: LoggedRun, windows: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "3n q"], Float[np.ndarray, "3n 3n"]]:
        """What acts in several poses, which share the calibration's errors.

        Args:
            run: of a log of the three outputs.
            windows: begin and end of each pose, s.

        Returns:
            f̂; what it falls by where a term rises, so that slopes·covariance·slopesᵀ is what poses share; and its
            covariance by what each has of its own.

        Raises:
            InputError: no temperature was logged, and the correction depends on it.
        """
        warm = None
        if run.temperature is not None:
            warm = np.array([np.mean(run.temperature[run.inside(*w)]) for w in windows])
        force, inverse, slope, warm = self._solved(run.means(windows), warm, None)
        shared = np.einsum("nk,nip->nikp", self.powers(warm), slope)
        # What poses of the calibration scatter by beyond their means' noise (creep, hysteresis, a model not exact) each
        # pose of a log has too.
        noise = run.still.of_second**2 / (windows[:, 1] - windows[:, 0])
        noise = noise + max(0.0, self.noise**2 - float(np.min(noise)))
        own = noise[:, None, None] * inverse @ inverse.transpose(0, 2, 1)
        return force, shared.reshape(3 * len(force), -1), np.asarray(block_diag(*own))

    def _solved(
        self,
        outputs: Measurements | ArrayLike,
        temperature: ArrayLike | None,
        beside: ArrayLike | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """f̂ (n, 3), H⁻¹ (n, 3, 3), slopes of f̂ by the terms at its temperature (n, 3, p), temperatures (n,)."""
        if isinstance(outputs, Measurements):
            if self.beside and beside is None and outputs.has(self.beside[0]):
                beside = np.stack([outputs[name] for name in self.beside], axis=1)
            temperature = (
                outputs["temperature"]
                if temperature is None and outputs.has("temperature")
                else temperature
            )
            outputs = np.stack([outputs[name] for name in self.outputs], axis=1)
        y = np.atleast_2d(np.asarray(outputs, dtype=float))
        if y.ndim != 2 or y.shape[1] != 3:
            raise InputError(
                f"three outputs a reading are needed, (n, 3); these have the shape {y.shape}"
            )
        if temperature is None and len(self.terms) > 1:
            raise InputError("the correction depends on the temperature: give temperature=… in °C")
        warm = np.broadcast_to(
            self.assumed if temperature is None else np.asarray(temperature, float), len(y)
        )
        if self.beside and beside is None:
            raise InputError(
                f"the correction depends on {', '.join(self.beside)}: give beside=… (n, 3), as calibrated"
            )
        terms = self.powers(warm) @ self.terms
        acts = None
        if self.beside:
            acts = np.broadcast_to(np.asarray(beside, float), y.shape)
            terms, last = terms[:, :-9].copy(), terms[:, -9:]
            terms[:, :3] += (_by_rows(acts) @ last[..., None])[..., 0]
        force = y.copy()
        for _ in range(NEWTON_STEPS):
            there, slopes = _outputs(terms, force)
            force = force - np.linalg.solve(slopes, (there - y)[..., None])[..., 0]
        inverse = np.linalg.inv(_outputs(terms, force)[1])
        return force, inverse, inverse @ slopes_by_terms(force, self.order, acts), warm


class TermRow(NamedTuple):
    """A term of a correction: its name, the power of T − T0 that it multiplies, its value and unit."""

    name: str
    power: int
    value: float
    uncertainty: float
    unit: str

    def __str__(self) -> str:
        return self.name + ("", " by T − T0", " by (T − T0)²", " by (T − T0)³")[self.power]


def terms_table(rows: Sequence[TermRow]) -> ResultTable:
    """Terms of a correction with their standard uncertainties."""
    columns = (
        TableColumn("correction", str),
        TableColumn("value ± standard uncertainty", lambda r: with_error(r.value, r.uncertainty)),
        TableColumn("unit", lambda r: unit_label(r.unit)),
    )
    return ResultTable(columns, rows)


def term_rows(
    terms: ArrayLike, uncertainty: ArrayLike, unit: str, beside: Sequence[str]
) -> list[TermRow]:
    """The terms that are not nothing.

    Args:
        terms, uncertainty: as a correction holds them (k, p).
        unit: of the outputs.
        beside: columns of what acts beside, whose terms are for a unit of each.
    """
    axes, terms = "xyz", np.asarray(terms, float)
    names = [(f"offset {a}", unit) for a in axes] + [
        (f"matrix {a}{b}", "1") for a in axes for b in axes
    ]
    own = terms.shape[1] - 9 * bool(beside)
    if own > 12:
        pairs = [axes[i] + axes[j] for i, j in PAIRS]
        names += [(f"second order {a}·{p}", f"1/({unit})") for a in axes for p in pairs]
    if own > 30:
        names += [(f"cube {a}", f"1/({unit})^2") for a in axes]
    names += [(f"{g} on {a}", unit) for a in axes for g in beside]
    found = []
    for power, (values, sds) in enumerate(zip(terms, np.asarray(uncertainty, float), strict=True)):
        per = ("", "/degC", "/degC^2", "/degC^3")[power]
        found += [
            TermRow(name, power, float(value), float(sd), f"{own_unit}{per}")
            for (name, own_unit), value, sd in zip(names, values, sds, strict=True)
            if value or sd
        ]
    return found


def slopes_by_terms(
    force: Float[np.ndarray, "n 3"], order: int, beside: Float[np.ndarray, "n 3"] | None
) -> Float[np.ndarray, "n 3 p"]:
    """Slopes of the three outputs by the terms of a correction up to an order in what acts."""
    found = [np.broadcast_to(np.eye(3), (len(force), 3, 3)), _by_rows(force)]
    found += [_by_rows(_products(force))] if order > 1 else []
    found += [force[:, :, None] ** 3 * np.eye(3)] if order > 2 else []
    found += [] if beside is None else [_by_rows(beside)]
    return np.concatenate(found, axis=2)


def _products(force: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6"]:
    return np.stack([force[:, i] * force[:, j] for i, j in PAIRS], axis=1)


def _by_rows(values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n 3 m3"]:
    """Slopes of three outputs by a matrix's entries, row by row, that multiply these values."""
    return np.einsum("ij,nm->nijm", np.eye(3), values).reshape(len(values), 3, -1)


def _outputs(
    terms: Float[np.ndarray, "n p"], force: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """h and H, by the terms of each reading."""
    matrix = terms[:, 3:12].reshape(-1, 3, 3)
    there, slopes = terms[:, :3] + np.einsum("nij,nj->ni", matrix, force), matrix
    if terms.shape[1] > 12:
        second = terms[:, 12:30].reshape(-1, 3, 6)
        there = there + np.einsum("nim,nm->ni", second, _products(force))
        slopes = slopes + np.stack(
            [
                sum(
                    second[:, :, m] * ((i == a) * force[:, [j]] + (j == a) * force[:, [i]])
                    for m, (i, j) in enumerate(PAIRS)
                )
                for a in range(3)
            ],
            axis=2,
        )
    if terms.shape[1] > 30:
        cube = terms[:, 30:]
        there = there + cube * force**3
        slopes = slopes + (3 * cube * force**2)[:, :, None] * np.eye(3)
    return there, slopes


def vector_correction(
    calibration: Calibration, *, draws: int | None = None, seed: int = 0
) -> VectorCorrection:
    """The correction of a calibrated instrument of three axes.

    What leaves is for a run to come: the deviation of a run, a drift and what else belongs to the test are in the
    uncertainty, and the notes say so.

    Args:
        calibration: of an instrument with `vector`, or an average over structures: over those that need no further
            input than the likely ones.
        draws: of the posterior, at most, that mean and covariance are of; all if not given, as in every table.
        seed: of what is drawn of a new run and of a moment of the test.

    Raises:
        ModelError: an instrument of one output.
    """
    instrument = calibration.model.instrument
    if (vector := instrument.vector) is None:
        raise ModelError(
            f"instrument {instrument.name!r} has one output: bayescal.compensator corrects it"
        )
    effects = calibration.model.effects
    further = {TEMPERATURE, *vector.beside} - usual_columns(calibration)
    calibration = with_columns(calibration, set().union(*(e.columns for e in effects)) - further)
    model, readings = calibration.model, calibration.readings
    beside = vector.beside if any(set(e.columns) & {*vector.beside} for e in model.effects) else ()
    recorded = readings.has("temperature")
    warm = readings["temperature"] if recorded else np.zeros(1)
    low, high, reference = float(np.min(warm)), float(np.max(warm)), float(np.round(np.mean(warm)))
    reference = float(calibration.reference.get("T0", reference))  # pyright: ignore[reportArgumentType]
    grid = np.linspace(low, high, 2 * ORDERS + 1) if high > low else np.array([low])
    taylor, of_test = _taylor(calibration, grid, beside, draws, seed)  # (draws, grid, p)
    powers = (grid - reference)[:, None] ** np.arange(ORDERS + 1)
    each = np.moveaxis(taylor, 1, 0).reshape(len(grid), -1)
    for order in range(min(ORDERS, len(grid) - 1) + 1):
        own = powers[:, : order + 1]
        fitted = np.linalg.lstsq(own, each, rcond=None)[0]
        beyond = each - own @ fitted  # what no polynomial of this order holds
        if np.max(np.abs(beyond)) <= EXACT_SHARE * np.max(np.abs(taylor)):
            beyond = np.zeros_like(beyond)
            break
    terms = np.moveaxis(fitted.reshape(order + 1, len(taylor), -1), 1, 0)  # (draws, k, p)
    beyond = beyond.reshape(len(grid) * len(taylor), -1)
    reach = np.max(np.abs(powers[:, : order + 1]), axis=0)[:, None]
    terms[:, np.max(np.abs(terms), axis=0) * reach <= ROUNDING * np.max(np.abs(taylor))] = 0.0
    if not np.any(terms[:, :, 30:33]):
        terms, beyond = (np.delete(a, slice(30, 33), axis=-1) for a in (terms, beyond))
        if not np.any(terms[:, :, 12:30]):
            terms, beyond = (np.delete(a, slice(12, 30), axis=-1) for a in (terms, beyond))
    spread = terms.reshape(len(terms), -1)
    covariance, mean = np.atleast_2d(np.cov(spread.T)), np.mean(terms, axis=0)
    covariance[: mean.shape[1], : mean.shape[1]] += beyond.T @ beyond / len(beyond)
    relative, said = _common_scale(calibration, mean[0, 3:12].reshape(3, 3))
    size = mean.shape[1] - 9 * bool(beside)
    powers = np.zeros(mean.shape[1])  # of what acts, in each term
    powers[:size] = np.repeat(range(4), [3, 9, 18, 3])[:size]
    moved = relative * (mean * powers).ravel()
    made = VectorCorrection(
        outputs=vector.outputs,
        unit=instrument.unit,
        reference=reference,
        low=low if recorded else None,
        high=high if recorded else None,
        terms=mean,
        covariance=covariance + np.outer(moved, moved),
        noise=float(np.sqrt(np.min(calibration.linear.variance))),
        source=identity(calibration),
        beside=beside,
        instrument=instrument.name,
    )
    if np.any(beyond):
        rms = np.sqrt(np.mean(beyond[:, :3] ** 2, axis=0))
        said = (
            *said,
            f"What depends on the temperature by more than its power {ORDERS} is not corrected, and is in the "
            f"uncertainty (of offsets, rms, {number(float(rms.max()), 2)} {unit_label(instrument.unit)} at most).",
        )
    notes = (*said, *_notes(calibration, made, of_test))
    return replace(made, reach=_reach(made, readings), notes=notes)


def _reach(correction: VectorCorrection, readings: Measurements) -> float:
    """Largest magnitude of what acted in the readings: of rates between poses, of their means."""
    if readings.has(TURNED[0]):
        acted = np.stack([readings[name] for name in TURNED], axis=1)
    else:
        acted = correction(readings).vector
    return float(np.max(np.linalg.norm(acted, axis=1)))


def _common_scale(
    calibration: Calibration, matrix: Float[np.ndarray, "3 3"]
) -> tuple[float, tuple[str, ...]]:
    """Relative uncertainty of what all three scale factors share, beyond that of each, and what is to be said of it.

    It is that of data sheets where the magnitude of what acts is not known, and none where it is.
    """
    instrument, readings = calibration.model.instrument, calibration.readings
    vector, unit = instrument.vector, unit_label(instrument.unit)
    assert vector is not None
    plausible, common = vector.common_scale, float(np.mean(np.diag(matrix)))
    what, stated = "the rates", ""
    if vector.acting is None:
        size = float(np.mean(magnitude(readings)))
        what = f"the magnitude {instrument.column(MAGNITUDE).meaning}"
        if not readings.has(MAGNITUDE):
            return plausible, (
                f"{what.capitalize()} is not known and taken as the outputs read it, {size:.4g} {unit}: scale factors "
                f"are ratios to their mean. The absolute scale is unknown, plausibly by {100 * plausible:.2g} %, which "
                "is in the uncertainty of magnitudes and in that of no direction.",
            )
        stated = f" ({size:.4g} {unit}; {size * common:.3g} {unit} would fit)"
    if not plausible or abs(common - 1) <= SHARED_SIZES * plausible:
        return 0.0, ()
    three = ", ".join(f"{a} {s:.3g}" for a, s in zip("xyz", np.diag(matrix), strict=True))
    return 0.0, (
        f"All three scale factors differ from nominal by one factor, {common:.3g} ({three}), more than is plausible: "
        f"{what}{stated} or the unit of the outputs may be stated wrongly. Their ratios do not depend on it.",
    )


def _notes(calibration: Calibration, made: VectorCorrection, of_test: OfTest) -> tuple[str, ...]:
    notes, at = [], made.calibrated_at
    if against := why_not(calibration):
        notes.append(f"{NOT_RELIABLE}{against}")
    if calibration.readings.has(TURNED[0]):
        notes.append("Axes are those of the accelerometers that the moves were closed by.")
    elif not calibration.readings.has(ACROSS[0]):
        notes.append(
            "Directions were unknown: a rotation of the triad is a convention (body z is sensor z, body y in the plane "
            "of sensors y and z), and its uncertainty is none."
        )
    if len(made.terms) > 1:
        notes.append(f"Valid from {made.low:.4g} to {made.high:.4g} °C.")
    else:
        notes.append(
            f"No dependence on temperature is in the model ({at}): valid where it was calibrated."
        )
    model = calibration.model
    for name, moved in of_test.items():
        each = (f"{s} {number(sd, 2)} {model.instrument.slot(s).unit}" for s, sd in moved.items())
        of = {c.per for c in model.effect(name).coefficients if c.per}
        what = (
            f"a new {' or '.join(of)} has a deviation of its own, which"
            if of
            else "it belongs to the test and is not corrected; what it moves from one moment of the test to another"
        )
        notes.append(
            f"{name}: {what} is in the uncertainty (standard deviation of {', '.join(each)})."
        )
    if len(calibration.readings.groups("run")[0]) < 2:
        notes.append(
            "One session: what changes between sessions (often ten times the stated uncertainty) is not in it. "
            "Calibrate in several, with a column 'run'."
        )
    return tuple(notes)


def _taylor(
    calibration: Calibration,
    grid: np.ndarray,
    beside: tuple[str, ...],
    draws: int | None,
    seed: int,
) -> tuple[Float[np.ndarray, "s g p"], OfTest]:
    """Offset, matrix, second order and what acts beside at temperatures, of draws; and what of it is of the test."""
    each, grid = len(grid), np.tile(grid, 1 + len(beside))  # at none, then at one of each
    readings, vector = calibration.readings, calibration.model.instrument.vector
    assert vector is not None
    like = readings.select(np.zeros(len(grid), dtype=int))
    if readings.has("temperature"):
        like = like.with_column("temperature", grid)
    for i, name in enumerate(beside):
        like = like.with_column(name, 1.0 * (np.arange(len(grid)) // each == 1 + i))
    assembly = calibration.assembly_on(calibration.frame_of(like))
    slots, of_test = _slots(calibration, assembly, draws, seed)
    count = len(next(iter(slots.values())))

    def terms(slots: dict[str, Any]) -> Any:
        h = vector.equation(slots, assembly.record.frame)
        zero, unit = jnp.zeros((len(grid), 3)), jnp.eye(3)[:, None, :] * jnp.ones((len(grid), 1))

        def slope(at: Any) -> Any:
            return jnp.stack([jax.jvp(h, (at,), (e,))[1] for e in unit], axis=2)

        second = jnp.stack([jax.jvp(slope, (zero,), (e,))[1] for e in unit], axis=3)
        own = jnp.stack([second[:, :, i, j] * (0.5 if i == j else 1.0) for i, j in PAIRS], axis=2)

        def bend(at: Any) -> Any:  # of each output along its own axis
            return jnp.stack([jax.jvp(slope, (at,), (e,))[1][:, i, i] for i, e in enumerate(unit)])

        cubes = [jax.jvp(bend, (zero,), (e,))[1][i] / 6 for i, e in enumerate(unit)]
        parts = h(zero), slope(zero).reshape(len(grid), 9), own.reshape(len(grid), 18)
        parts = (*parts, jnp.stack(cubes, axis=1))
        return jnp.concatenate(parts, axis=1)

    found = np.asarray(jax.jit(jax.vmap(terms))({n: jnp.asarray(s) for n, s in slots.items()}))
    none, others = found[:, :each], found[:, each:, :3].reshape(count, len(beside), each, 3)
    further = np.moveaxis(others - none[:, None, :, :3], 1, 3).reshape(count, each, -1)
    return np.concatenate([none, further], axis=2), of_test


def _slots(
    calibration: Calibration, at: Assembly, draws: int | None, seed: int
) -> tuple[dict[str, Float[np.ndarray, "s g"]], OfTest]:
    """What the effects come to in use, of draws, and what those of the test have in it.

    A member of a group is a new one. An effect of columns that are not known in use acts as at a reading of the test
    taken at random; where it depends on what is known too (a lag, on the temperature's past), its sign is random:
    how the known one went in the test says nothing of how it goes in use.
    """
    vector = calibration.model.instrument.vector
    assert vector is not None
    x, _, v = calibration.draws(draws)
    x = x + at.layout.origin_of_x
    count, known = len(x), {TEMPERATURE, *vector.beside}
    random = np.random.default_rng(seed)
    # In even shares, so that no mean moves by the chance of a draw.
    picked = random.permutation(count) * len(calibration.readings) // count
    sign = np.where(random.permutation(count) % 2, 1.0, -1.0)
    hyper = {k: np.broadcast_to(value, count) for k, value in at.hyper(v.T).items()}
    slots = {name: np.zeros((count, at.record.size)) for name in at.record.slots}
    of_test: dict[str, dict[str, np.ndarray]] = {}
    for t in at.terms:
        if t.slot not in slots or t.slot in vector.rig or t.place == "row":
            continue
        new = t.known.per is not None and t.place != "fixed"
        if new:
            spread = t.prior_sd if t.group_sd_name is None else hyper[t.group_sd_name]
            away = spread * random.standard_normal(count)
            value = (t.known.mean + away - away.mean())[:, None]
        else:
            value = at.value(t, x, hyper)
        shapes = [hyper[name] for name in t.known.shape_names]
        effect = t.known.effect
        unknown = {*effect.columns} - known - {c.per for c in effect.coefficients}
        record = calibration.assembly.record if unknown else at.record
        column = record.columns_of_draws(t.known.columns, shapes, {})[..., t.index] * t.factor
        if unknown:
            column = np.broadcast_to(column, (count, record.size))[np.arange(count), picked]
            column = (column * (sign if known & {*effect.columns} else 1.0))[:, None]
        slots[t.slot] += value * column
        if new or unknown:
            sums = of_test.setdefault(t.known.of, {})
            sums[t.slot] = sums.get(t.slot, np.zeros(count)) + (value * column)[:, 0]
    sds = {name: {s: float(np.std(v)) for s, v in sums.items()} for name, sums in of_test.items()}
    whole = {name: MENTIONED_SHARE * np.std(values[:, 0]) for name, values in slots.items()}
    return slots, {
        n: each for n, each in sds.items() if any(sd > whole[s] for s, sd in each.items())
    }


SWEEPS = 20  # of Gauss–Newton
SETTLED_RADIANS = 1e-10  # rad, by which the last may move
UNKNOWNS = 4  # the rotation and the dip
TURNS = Rotation.create_group("O").as_matrix()  # the 24 that take axes to axes
SCATTER = 0.2  # of sin(dip) between poses, from which on the axes do not fit or the field is none


def in_frame_of(
    field: VectorCorrection,
    field_log: Measurements,
    force: VectorCorrection,
    force_log: Measurements,
    *,
    shortest: float | None = None,
) -> VectorCorrection:
    """The correction of magnetometers in the axes of the accelerometers of the same unit.

    Args:
        field: correction of the magnetometers, of first order in the field.
        field_log: samples of theirs, with a column `time`, in one run.
        force: correction of the accelerometers.
        force_log: samples of theirs on the same clock.
        shortest: of a pose, s.

    Raises:
        InputError: fewer than five poses in common, poses that do not determine the rotation, axes of unlike
            handedness or a field that differs from pose to pose, or a correction of higher order.
    """
    if field.order > 1:
        raise InputError(
            "the correction of the magnetometers has terms of higher order, which are not turned into other axes: fit "
            "the model without them"
        )
    runs = [
        logged_runs(per_sample(log), correction.outputs, shortest)
        for log, correction in ((force_log, force), (field_log, field))
    ]
    label = next(iter(runs[0]))
    pull, drawn = runs[0][label], runs[1].get(label)
    windows = np.zeros((0, 2)) if drawn is None else in_common(pull.ends(), drawn.ends())
    if drawn is None or len(windows) <= UNKNOWNS:
        raise InputError(
            f"{field_log.file}: {len(windows)} poses in common with {force_log.file}, and five or more are needed: log "
            "both together, at rest for some seconds in each of many poses"
        )
    f, f_slopes, f_own = force.in_poses(pull, windows)
    m, m_slopes, m_own = field.in_poses(drawn, windows)
    f_all = f_slopes @ force.covariance @ f_slopes.T + f_own
    up, f_size = _split(f)
    along, m_size = _split(m)
    starts = [np.std(np.sum(up * (along @ r.T), axis=1)) for r in TURNS]
    turn = TURNS[int(np.argmin(starts))]
    dip = float(np.mean(np.sum(up * (along @ turn.T), axis=1)))
    terms = field.covariance

    def linear(turn: np.ndarray, dip: float) -> tuple[np.ndarray, ...]:
        """What is left, its weight, the estimate's gain; what terms of both move it by; covariance beside."""
        turned = along @ turn.T
        cosine = np.sum(up * turned, axis=1)
        by_force = _blocks((turned - cosine[:, None] * up) / f_size)
        by_field = _blocks((up @ turn - cosine[:, None] * along) / m_size)
        beside = by_force @ f_all @ by_force.T + by_field @ m_own @ by_field.T
        shared = by_field @ m_slopes
        weight = np.linalg.inv(beside + shared @ terms @ shared.T)
        slopes = np.column_stack([np.cross(turned, up), -np.ones(len(up))])
        information = slopes.T @ weight @ slopes
        if np.linalg.cond(information) > 1 / np.finfo(float).eps:
            raise InputError(
                f"{field_log.file}: these poses do not determine how magnetometers and accelerometers stand to each "
                "other: turn the unit about all three axes"
            )
        gain = np.linalg.solve(information, slopes.T @ weight)
        return cosine - dip, weight, gain, shared, by_force @ f_slopes, beside

    left, weight, gain, shared, of_force, beside = linear(turn, dip)
    for _ in range(SWEEPS):
        step = -gain @ left
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ turn
        dip += float(step[3])
        left, weight, gain, shared, of_force, beside = linear(turn, dip)
        if np.max(np.abs(step)) < SETTLED_RADIANS:
            break
    if not np.std(left) < SCATTER:
        raise InputError(
            f"{field_log.file}: the angle between field and gravity differs by {np.std(left):.2g} rad from pose to "
            "pose, and one field has one dip. Is iron or a current near, or are two columns exchanged?"
        )
    ratio = max(1.0, float(left @ weight @ left) / (len(left) - UNKNOWNS))
    gain = gain[:3]
    made, by_turn = _rotated(field, turn, gain @ shared, ratio * gain @ beside @ gain.T)
    with_force = by_turn @ gain @ of_force @ force.covariance
    down = np.rad2deg(np.arcsin(np.clip(-dip, -1.0, 1.0)))
    said = (
        f"Axes are those of the accelerometers, by a field {abs(down):.1f}° {'below' if down >= 0 else 'above'} the "
        "level. If it points to the other side where you are, an axis of the magnetometers points backwards."
    )
    return replace(made, notes=(said, *made.notes), axes_of=force.source, shared=with_force)


def _rotated(
    field: VectorCorrection,
    turn: Float[np.ndarray, "3 3"],
    by_terms: Float[np.ndarray, "3 q"],
    beside: Float[np.ndarray, "3 3"],
) -> tuple[VectorCorrection, Float[np.ndarray, "q 3"]]:
    """In other axes, and what a turn of these moves its terms by.

    Args:
        field: in its own axes.
        turn: from these to the others.
        by_terms: what error of a term turns them by.
        beside: covariance of what other errors turn them by, rad².
    """
    k, p = field.terms.shape
    rotate = np.eye(p)
    rotate[3:12, 3:12] = np.kron(np.eye(3), turn)
    terms = field.terms @ rotate.T
    matrix = terms[:, 3:12].reshape(k, 3, 3)
    by_turn = np.zeros((k, p, 3))
    # (1 + [ρ×])ᵀ on the right of a row is ρ × row.
    by_turn[:, 3:12] = np.stack([np.cross(e, matrix) for e in np.eye(3)], axis=3).reshape(k, 9, 3)
    by_turn = by_turn.reshape(k * p, 3)
    moved = np.kron(np.eye(k), rotate) + by_turn @ by_terms
    covariance = moved @ field.covariance @ moved.T + by_turn @ beside @ by_turn.T
    notes = [note for note in field.notes if not note.startswith("Directions were unknown")]
    made = replace(field, terms=terms, covariance=covariance, notes=tuple(notes))
    return made, by_turn


def _split(vectors: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) and lengths (n, 1)."""
    size = np.linalg.norm(vectors, axis=1)[:, None]
    return vectors / size, size


def _blocks(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3n"]:
    """Each row on the three columns of its own pose."""
    return (np.eye(len(rows))[:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
