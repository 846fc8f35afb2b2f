"""Three-axis correction from a calibration: Taylor expansion of the calibrated equation, for each posterior draw.

The calibrated equation h is expanded in the input: offset, 3 × 3 matrix and, where the model has them, second-order
terms and the cube of each axis, each a polynomial in T − T0. The expansion is exact for effects that are polynomials in
both; any other temperature dependence is added to the uncertainty.

Effects that are specific to the test and unknown in use are marginalised draw by draw, which increases the covariance:
a new deviation is drawn for a future run; effects of time (drift, lag) or of other columns are as at a random reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.imu.vector_correction import PAIRS, ROUNDING, VectorCorrection

POLYNOMIAL_RTOL = 1e-9  # residual to largest term, up to which a polynomial in temperature is exact
MAX_DEGREE = 3  # of the polynomials in temperature
TEMPERATURE = "temperature"  # known in use, as is the secondary input
MAX_COMMON_SCALE_RATIO = 3.0  # of a common scale error to its plausible size
MIN_NOTED_SD_RATIO = 0.1  # of a contribution's to its slot's standard deviation, to be noted
TestContributions = dict[str, dict[str, float]]  # effect → slot → standard deviation


def vector_correction(calibration: bc.Calibration) -> VectorCorrection:
    """Compute the correction of a calibrated three-axis instrument.

    It is valid for a future run: the uncertainty includes the deviation of a run, drift and other effects of the test,
    which the notes list. Mean and covariance are those of all posterior draws.

    Args:
        calibration: calibration of an instrument with `vector`. An average over structures is restricted to those
            that need no columns other than those of effects with inclusion probability above 0.5.

    Raises:
        ModelError: an instrument with one output.
    """
    instrument = calibration.model.instrument
    if (vector := instrument.vector) is None:
        message = f"instrument {instrument.name!r} has one output: use bayescal.compensator"
        raise bc.ModelError(message)
    columns = set().union(*(e.columns for e in calibration.model.effects))
    columns -= {TEMPERATURE, *vector.secondary_columns} - calibration.usual_columns
    calibration = calibration.with_columns(columns)
    model, readings = calibration.model, calibration.readings
    used_columns = set().union(*(e.columns for e in model.effects))
    names = vector.secondary_columns
    secondary_columns = names if used_columns & {*names} else ()
    has_temperature = readings.has("temperature")
    t = readings["temperature"] if has_temperature else np.zeros(1)
    low, high, reference = float(np.min(t)), float(np.max(t)), float(np.round(np.mean(t)))
    reference = float(calibration.reference.get("T0", reference))  # pyright: ignore[reportArgumentType]
    grid = np.linspace(low, high, 2 * MAX_DEGREE + 1) if high > low else np.array([low])
    taylor, contributions = _expand_draws(calibration, grid, secondary_columns)  # (draws, grid, p)
    samples = np.moveaxis(taylor, 1, 0).reshape(len(grid), -1)
    for order in range(min(MAX_DEGREE, len(grid) - 1) + 1):
        powers = np.vander(grid - reference, order + 1, increasing=True)
        coefficients = np.linalg.lstsq(powers, samples)[0]
        residuals = samples - powers @ coefficients
        if np.max(np.abs(residuals)) <= POLYNOMIAL_RTOL * np.max(np.abs(taylor)):
            residuals = np.zeros_like(residuals)
            break
    terms = np.moveaxis(coefficients.reshape(order + 1, len(taylor), -1), 1, 0)  # (draws, k, p)
    residuals = residuals.reshape(len(grid) * len(taylor), -1)
    max_powers = np.max(np.abs(powers), axis=0)[:, None]
    terms[:, np.max(np.abs(terms), axis=0) * max_powers <= ROUNDING * np.max(np.abs(taylor))] = 0.0
    # The order of each term in the input; higher orders are omitted if all their terms are zero.
    orders = np.repeat([0, 1, 2, 3, 0], [3, 9, 18, 3, 9 * bool(secondary_columns)])
    is_kept = orders <= np.max(orders * np.any(terms, axis=(0, 1)), initial=1)
    terms, residuals, orders = terms[:, :, is_kept], residuals[:, is_kept], orders[is_kept]
    flat_terms = calibration.form_factor * terms.reshape(len(terms), -1)
    covariance, mean = np.atleast_2d(np.cov(flat_terms.T)), np.mean(terms, axis=0)
    covariance[: mean.shape[1], : mean.shape[1]] += residuals.T @ residuals / len(residuals)
    scale_sd, notes = _assess_common_scale(calibration, mean[0, 3:12].reshape(3, 3))
    shift = scale_sd * (mean * orders).ravel()
    correction = VectorCorrection(
        outputs=vector.outputs,
        unit=instrument.unit,
        reference=reference,
        low=low if has_temperature else None,
        high=high if has_temperature else None,
        terms=mean,
        covariance=covariance + np.outer(shift, shift),
        noise=float(np.sqrt(np.min(calibration.linear.variance))),
        source=ws.identity(calibration),
        secondary_columns=secondary_columns,
        instrument=instrument.name,
    )
    if np.any(residuals):
        rms = np.sqrt(np.mean(residuals[:, :3] ** 2, axis=0))
        notes.append(
            f"Temperature dependence beyond degree {MAX_DEGREE} is not corrected; the uncertainty includes it "
            f"(offsets: at most {ws.number(float(rms.max()), 2)} {ws.unit_label(instrument.unit)} rms)."
        )
    reason = ws.why_not(calibration)
    notes += [f"{ws.NOT_RELIABLE}{reason}"] * bool(reason)
    notes = (*notes, *_list_notes(calibration, correction, contributions))
    max_input = _find_max_input(correction, readings)
    return replace(correction, max_input=max_input, notes=notes, reason=reason)


def _find_max_input(correction: VectorCorrection, readings: bc.Measurements) -> float:
    """Return the largest magnitude of the input in the readings; for moves, the largest mean rate."""
    if readings.has(ws.TURNED[0]):
        inputs = np.stack([readings[name] for name in ws.TURNED], axis=1)
    else:
        inputs = correction(readings).vector
    return float(np.max(np.linalg.norm(inputs, axis=1)))


def _assess_common_scale(
    calibration: bc.Calibration, matrix: Float[np.ndarray, "3 3"]
) -> tuple[float, list[str]]:
    """Return the relative uncertainty of the common scale factor, in addition to that of each axis, and notes on it.

    It is the data-sheet tolerance if the magnitude of the input is unknown, and zero if it is known.
    """
    instrument, readings = calibration.model.instrument, calibration.readings
    vector, unit = instrument.vector, ws.unit_label(instrument.unit)
    assert vector is not None
    tolerance, scale = vector.common_scale, float(np.mean(np.diag(matrix)))
    quantity, size_text = "the rates", ""
    if vector.acting is None:
        size = float(np.mean(ws.magnitude(readings)))
        quantity = f"the magnitude {instrument.column(ws.MAGNITUDE).meaning}"
        if not readings.has(ws.MAGNITUDE):
            return tolerance, [
                f"{quantity.capitalize()} is unknown, and was estimated from the outputs as {size:.4g} {unit}: scale "
                f"factors are relative to their mean. The plausible error of the common scale, "
                f"{100 * tolerance:.2g} %, is in the uncertainty of magnitudes; directions do not depend on it."
            ]
        size_text = f" ({size:.4g} {unit}; {size * scale:.3g} {unit} would fit)"
    if not tolerance or abs(scale - 1) <= MAX_COMMON_SCALE_RATIO * tolerance:
        return 0.0, []
    by_axis = ", ".join(f"{a} {s:.3g}" for a, s in zip("xyz", np.diag(matrix), strict=True))
    return 0.0, [
        f"All three scale factors differ from nominal by one factor, {scale:.3g} ({by_axis}), more than is plausible: "
        f"{quantity}{size_text} or the unit of the outputs may be stated wrongly. Their ratios do not depend on it."
    ]


def _list_notes(
    calibration: bc.Calibration, correction: VectorCorrection, contributions: TestContributions
) -> tuple[str, ...]:
    notes = []
    if calibration.readings.has(ws.TURNED[0]):
        notes.append("Axes are those of the accelerometers that measured the up direction.")
    elif not calibration.readings.has(ws.ACROSS[0]):
        notes.append(
            "Directions were unknown: the orientation of the body's axes is a convention (body z is sensor z, body y "
            "is in the plane of sensors y and z), without uncertainty."
        )
    if len(correction.terms) > 1:
        notes.append(f"Valid from {correction.low:.4g} to {correction.high:.4g} °C.")
    else:
        temperatures = f"temperatures of the calibration ({correction.calibrated_at})"
        notes.append(f"The model has no temperature dependence: use it only at the {temperatures}.")
    model = calibration.model
    for name, slot_sds in contributions.items():
        sds = ", ".join(
            f"{s} {ws.number(sd, 2)} {model.instrument.slot(s).unit}" for s, sd in slot_sds.items()
        )
        groups = {c.per for c in model.effect(name).coefficients if c.per}
        contribution = (
            f"the deviation of a new {' or '.join(groups)}"
            if groups
            else "the effect is specific to the test and not corrected; its variation during the test"
        )
        notes.append(f"{name}: {contribution} is in the uncertainty (standard deviation {sds}).")
    if len(calibration.readings.groups("run")[0]) < 2:
        notes.append(
            "One session: changes between sessions, which can exceed the stated uncertainty, are not included. "
            "Calibrate in several sessions, with a column 'run'."
        )
    return tuple(notes)


def _expand_draws(
    calibration: bc.Calibration, grid: np.ndarray, secondary_columns: tuple[str, ...]
) -> tuple[Float[np.ndarray, "s g p"], TestContributions]:
    """Return each draw's Taylor coefficients at the temperatures `grid`, and contributions as in `_sum_slots`."""
    # Without secondary input, then with one along each axis.
    size, grid = len(grid), np.tile(grid, 1 + len(secondary_columns))
    readings, vector = calibration.readings, calibration.model.instrument.vector
    assert vector is not None
    points = readings.select(np.zeros(len(grid), dtype=int))
    if readings.has("temperature"):
        points = points.with_column("temperature", grid)
    for i, name in enumerate(secondary_columns):
        points = points.with_column(name, 1.0 * (np.arange(len(grid)) // size == 1 + i))
    problem = calibration.problem_on(calibration.frame_of(points))
    slots, contributions = _sum_slots(calibration, problem)
    count = len(next(iter(slots.values())))
    series = np.asarray(_expand_equation(vector, slots, problem.record.frame))
    series, secondary = series[:, :size], series[:, size:, :3].reshape(count, -1, size, 3)
    sensitivity = np.moveaxis(secondary - series[:, None, :, :3], 1, 3).reshape(count, size, -1)
    return np.concatenate([series, sensitivity], axis=2), contributions


@ws.compile_lazily
def _expand_equation(
    vector: bc.Vector, slots: Mapping[str, Float[Array, "s g"]], frame: bc.Frame
) -> Float[Array, "s g p"]:
    """Return offset, matrix, second-order terms and cubes of each axis, for each draw of the slots at each reading."""
    zero = jnp.zeros((frame.size, 3))
    unit = jnp.eye(3)[:, None, :] * jnp.ones((frame.size, 1))

    def expand(slots: Mapping[str, Float[Array, "g"]]) -> Float[Array, "g p"]:
        h = vector.equation(slots, frame)

        def slope(f: Any) -> Any:
            return jnp.stack([jax.jvp(h, (f,), (e,))[1] for e in unit], axis=2)

        def curvature(f: Any) -> Any:  # second derivative of each output along its own axis
            return jnp.stack([jax.jvp(slope, (f,), (e,))[1][:, i, i] for i, e in enumerate(unit)])

        hessian = jnp.stack([jax.jvp(slope, (zero,), (e,))[1] for e in unit], axis=3)
        factors = [(i, j, 0.5 if i == j else 1.0) for i, j in PAIRS]
        pairs = jnp.stack([hessian[:, :, i, j] * factor for i, j, factor in factors], axis=2)
        cubes = [jax.jvp(curvature, (zero,), (e,))[1][i] / 6 for i, e in enumerate(unit)]
        terms = h(zero), slope(zero).reshape(-1, 9), pairs.reshape(-1, 18), jnp.stack(cubes, axis=1)
        return jnp.concatenate(terms, axis=1)

    return jax.vmap(expand)(slots)


def _sum_slots(
    calibration: bc.Calibration, problem: ws.Problem
) -> tuple[dict[str, Float[np.ndarray, "s g"]], TestContributions]:
    """Sum the effects in each slot for use, draw by draw; return the sums, and standard deviations of contributions.

    Deviations are drawn for new group members. An effect of columns that are unknown in use has its value at a random
    reading of the test; if it also depends on known columns (a lag, on past temperatures), its sign is random.
    """
    vector = calibration.model.instrument.vector
    assert vector is not None
    x, v = calibration.draws()
    x = x + problem.layout.x_origins
    count, known_columns = len(x), {TEMPERATURE, *vector.secondary_columns}
    rng = np.random.default_rng(0)  # for a new run, and for a reading of the test
    # Each reading equally often, and each sign, so that means do not depend on the draw.
    rows = rng.permutation(count) * len(calibration.readings) // count
    sign = np.where(rng.permutation(count) % 2, 1.0, -1.0)
    hyper = {k: np.broadcast_to(value, count) for k, value in problem.hyper(v.T).items()}
    slots = {name: np.zeros((count, problem.record.size)) for name in problem.record.slots}
    contributions: dict[str, dict[str, np.ndarray]] = {}
    for t in problem.terms:
        if t.slot not in slots or t.slot in vector.rig or t.place == "input":
            continue
        is_new = t.per is not None and t.place != "fixed"
        if is_new:
            sd = t.prior_sd if t.group_sd_name is None else hyper[t.group_sd_name]
            deviation = sd * rng.standard_normal(count)
            value = (t.mean + deviation - deviation.mean())[:, None]
        else:
            value = problem.value(t, x, hyper)
        shapes = [hyper[name] for name in t.columns.names]
        effect = t.effect
        unknown_columns = {*effect.columns} - known_columns - {c.per for c in effect.coefficients}
        record = calibration.problem.record if unknown_columns else problem.record
        column = record.columns_of_draws(t.columns, shapes, {})[..., t.index] * t.factor
        if unknown_columns:
            column = np.broadcast_to(column, (count, record.size))[np.arange(count), rows]
            column = (column * (sign if known_columns & {*effect.columns} else 1.0))[:, None]
        slots[t.slot] += value * column
        if is_new or unknown_columns:
            sums = contributions.setdefault(t.effect.name, {})
            sums[t.slot] = sums.get(t.slot, np.zeros(count)) + (value * column)[:, 0]
    sds = {n: {s: float(np.std(v)) for s, v in sums.items()} for n, sums in contributions.items()}
    min_sds = {name: MIN_NOTED_SD_RATIO * np.std(values[:, 0]) for name, values in slots.items()}
    return slots, {n: v for n, v in sds.items() if any(sd > min_sds[s] for s, sd in v.items())}
