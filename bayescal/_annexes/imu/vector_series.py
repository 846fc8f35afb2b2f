"""The correction of three axes from a calibration: its equation as a Taylor series, draw by draw.

The calibrated equation h is expanded in the input: offset, 3 × 3 matrix and, where the model has them, terms of second
order and each axis' own cube, each a polynomial of T − T0. That is exact for terms that are polynomials of both; other
dependence on the temperature is added to the uncertainty.

Effects that are specific to the test and unknown in use are integrated out, draw by draw, and widen C: a run deviates
as a new one, and effects of time (a drift, a lag) or of a further column are as at a random reading of the test.
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
from bayescal._annexes.imu.vector_correction import (
    PAIRS,
    ROUNDING,
    VectorCorrection,
)

# Share of the largest term up to which a polynomial of the temperature is the model's own.
EXACT_SHARE = 1e-9
ORDERS = 3  # of the temperature
TEMPERATURE = "temperature"  # known in use, as is the secondary input
SHARED_SIZES = 3.0  # plausible sizes of a common scale factor, above which input is doubtful
MENTIONED_SHARE = 0.1  # of a standard uncertainty: larger effects of the test are noted
OfTest = dict[str, dict[str, float]]  # effect → slot → standard deviation of its contribution


def vector_correction(calibration: bc.Calibration) -> VectorCorrection:
    """Compute the correction of a calibrated instrument of three axes.

    It is for a run to come: the deviation of a run, a drift and other effects of the test are in the uncertainty, and
    the notes say so. Mean and covariance are of all draws, as in every table.

    Args:
        calibration: of an instrument with `vector`, or an average over structures: over those that need no further
            input than the likely ones.

    Raises:
        ModelError: an instrument of one output.
    """
    instrument = calibration.model.instrument
    if (vector := instrument.vector) is None:
        raise bc.ModelError(
            f"instrument {instrument.name!r} has one output: bayescal.compensator corrects it"
        )
    effects = calibration.model.effects
    further = {TEMPERATURE, *vector.beside} - calibration.usual_columns
    calibration = calibration.with_columns(set().union(*(e.columns for e in effects)) - further)
    model, readings = calibration.model, calibration.readings
    gravity = vector.beside if any(set(e.columns) & {*vector.beside} for e in model.effects) else ()
    recorded = readings.has("temperature")
    warm = readings["temperature"] if recorded else np.zeros(1)
    low, high, reference = float(np.min(warm)), float(np.max(warm)), float(np.round(np.mean(warm)))
    reference = float(calibration.reference.get("T0", reference))  # pyright: ignore[reportArgumentType]
    grid = np.linspace(low, high, 2 * ORDERS + 1) if high > low else np.array([low])
    taylor, of_test = _taylor(calibration, grid, gravity)  # (draws, grid, p)
    samples = np.moveaxis(taylor, 1, 0).reshape(len(grid), -1)
    for order in range(min(ORDERS, len(grid) - 1) + 1):
        powers = np.vander(grid - reference, order + 1, increasing=True)
        fitted = np.linalg.lstsq(powers, samples)[0]  # of all draws at once
        beyond = samples - powers @ fitted  # what no polynomial of this order holds
        if np.max(np.abs(beyond)) <= EXACT_SHARE * np.max(np.abs(taylor)):
            beyond = np.zeros_like(beyond)
            break
    terms = np.moveaxis(fitted.reshape(order + 1, len(taylor), -1), 1, 0)  # (draws, k, p)
    beyond = beyond.reshape(len(grid) * len(taylor), -1)
    reach = np.max(np.abs(powers), axis=0)[:, None]
    terms[:, np.max(np.abs(terms), axis=0) * reach <= ROUNDING * np.max(np.abs(taylor))] = 0.0
    if not np.any(terms[:, :, 30:33]):
        terms, beyond = (np.delete(a, slice(30, 33), axis=-1) for a in (terms, beyond))
        if not np.any(terms[:, :, 12:30]):
            terms, beyond = (np.delete(a, slice(12, 30), axis=-1) for a in (terms, beyond))
    spread = terms.reshape(len(terms), -1)
    covariance, mean = np.atleast_2d(np.cov(spread.T)), np.mean(terms, axis=0)
    covariance[: mean.shape[1], : mean.shape[1]] += beyond.T @ beyond / len(beyond)
    relative, notes = _common_scale(calibration, mean[0, 3:12].reshape(3, 3))
    size = mean.shape[1] - 9 * bool(gravity)
    orders = np.zeros(mean.shape[1])  # in what acts, of each term
    orders[:size] = np.repeat(range(4), [3, 9, 18, 3])[:size]
    shift = relative * (mean * orders).ravel()
    correction = VectorCorrection(
        outputs=vector.outputs,
        unit=instrument.unit,
        reference=reference,
        low=low if recorded else None,
        high=high if recorded else None,
        terms=mean,
        covariance=covariance + np.outer(shift, shift),
        noise=float(np.sqrt(np.min(calibration.linear.variance))),
        source=ws.identity(calibration),
        beside=gravity,
        instrument=instrument.name,
    )
    if np.any(beyond):
        rms = np.sqrt(np.mean(beyond[:, :3] ** 2, axis=0))
        notes.append(
            f"What depends on the temperature by more than its power {ORDERS} is not corrected, and is in the "
            f"uncertainty (of offsets, rms, {ws.number(float(rms.max()), 2)} {ws.unit_label(instrument.unit)} at most)."
        )
    against = ws.why_not(calibration)
    notes += [f"{ws.NOT_RELIABLE}{against}"] * bool(against)
    notes = (*notes, *_notes(calibration, correction, of_test))
    return replace(correction, reach=_reach(correction, readings), notes=notes, against=against)


def _reach(correction: VectorCorrection, readings: bc.Measurements) -> float:
    """Return the largest magnitude of the input in the readings; for moves, of mean rates."""
    if readings.has(ws.TURNED[0]):
        acted = np.stack([readings[name] for name in ws.TURNED], axis=1)
    else:
        acted = correction(readings).vector
    return float(np.max(np.linalg.norm(acted, axis=1)))


def _common_scale(
    calibration: bc.Calibration, matrix: Float[np.ndarray, "3 3"]
) -> tuple[float, list[str]]:
    """Return the relative uncertainty of the common scale factor in excess of that of each, and notes on it.

    It is that of data sheets where the magnitude of the input is unknown, and zero where it is known.
    """
    instrument, readings = calibration.model.instrument, calibration.readings
    vector, unit = instrument.vector, ws.unit_label(instrument.unit)
    assert vector is not None
    plausible, common = vector.common_scale, float(np.mean(np.diag(matrix)))
    what, stated = "the rates", ""
    if vector.acting is None:
        size = float(np.mean(ws.magnitude(readings)))
        what = f"the magnitude {instrument.column(ws.MAGNITUDE).meaning}"
        if not readings.has(ws.MAGNITUDE):
            return plausible, [
                f"{what.capitalize()} is not known and taken as the outputs read it, {size:.4g} {unit}: scale factors "
                f"are ratios to their mean. The absolute scale is unknown, plausibly by {100 * plausible:.2g} %, which "
                "is in the uncertainty of magnitudes and in that of no direction."
            ]
        stated = f" ({size:.4g} {unit}; {size * common:.3g} {unit} would fit)"
    if not plausible or abs(common - 1) <= SHARED_SIZES * plausible:
        return 0.0, []
    three = ", ".join(f"{a} {s:.3g}" for a, s in zip("xyz", np.diag(matrix), strict=True))
    return 0.0, [
        f"All three scale factors differ from nominal by one factor, {common:.3g} ({three}), more than is plausible: "
        f"{what}{stated} or the unit of the outputs may be stated wrongly. Their ratios do not depend on it."
    ]


def _notes(
    calibration: bc.Calibration, result: VectorCorrection, of_test: OfTest
) -> tuple[str, ...]:
    notes, at = [], result.calibrated_at
    if calibration.readings.has(ws.TURNED[0]):
        notes.append("Axes are those of the accelerometers that the moves were closed by.")
    elif not calibration.readings.has(ws.ACROSS[0]):
        notes.append(
            "Directions were unknown: a rotation of the triad is a convention (body z is sensor z, body y in the plane "
            "of sensors y and z), without an uncertainty."
        )
    if len(result.terms) > 1:
        notes.append(f"Valid from {result.low:.4g} to {result.high:.4g} °C.")
    else:
        notes.append(
            f"No dependence on temperature is in the model ({at}): valid where it was calibrated."
        )
    model = calibration.model
    for name, slot_sds in of_test.items():
        deviations = (
            f"{s} {ws.number(sd, 2)} {model.instrument.slot(s).unit}" for s, sd in slot_sds.items()
        )
        of = {c.per for c in model.effect(name).coefficients if c.per}
        what = (
            f"a new {' or '.join(of)} has a deviation of its own, which"
            if of
            else "it belongs to the test and is not corrected; what it moves from one moment of the test to another"
        )
        notes.append(
            f"{name}: {what} is in the uncertainty (standard deviation of {', '.join(deviations)})."
        )
    if len(calibration.readings.groups("run")[0]) < 2:
        notes.append(
            "One session: what changes between sessions (often ten times the stated uncertainty) is not in it. "
            "Calibrate in several, with a column 'run'."
        )
    return tuple(notes)


def _taylor(
    calibration: bc.Calibration, grid: np.ndarray, gravity: tuple[str, ...]
) -> tuple[Float[np.ndarray, "s g p"], OfTest]:
    """Return the series of each draw at temperatures, secondary input included; and the contributions of the test."""
    size, grid = len(grid), np.tile(grid, 1 + len(gravity))  # at none, then at one of each
    readings, vector = calibration.readings, calibration.model.instrument.vector
    assert vector is not None
    like = readings.select(np.zeros(len(grid), dtype=int))
    if readings.has("temperature"):
        like = like.with_column("temperature", grid)
    for i, name in enumerate(gravity):
        like = like.with_column(name, 1.0 * (np.arange(len(grid)) // size == 1 + i))
    problem = calibration.problem_on(calibration.frame_of(like))
    slots, of_test = _slots(calibration, problem)
    count = len(next(iter(slots.values())))

    series = np.asarray(_series(vector, slots, problem.record.frame))
    zero, others = series[:, :size], series[:, size:, :3].reshape(count, len(gravity), size, 3)
    further = np.moveaxis(others - zero[:, None, :, :3], 1, 3).reshape(count, size, -1)
    return np.concatenate([zero, further], axis=2), of_test


@ws.compiled
def _series(
    vector: bc.Vector, slots: Mapping[str, Float[Array, "s g"]], frame: bc.Frame
) -> Float[Array, "s g p"]:
    """Expand the equation: offset, matrix, second order and own cubes, for draws of its slots at each reading."""
    zero = jnp.zeros((frame.size, 3))
    unit = jnp.eye(3)[:, None, :] * jnp.ones((frame.size, 1))

    def terms(slots: Mapping[str, Float[Array, "g"]]) -> Float[Array, "g p"]:
        h = vector.equation(slots, frame)

        def slope(at: Any) -> Any:
            return jnp.stack([jax.jvp(h, (at,), (e,))[1] for e in unit], axis=2)

        def bend(at: Any) -> Any:  # of each output along its own axis
            return jnp.stack([jax.jvp(slope, (at,), (e,))[1][:, i, i] for i, e in enumerate(unit)])

        second = jnp.stack([jax.jvp(slope, (zero,), (e,))[1] for e in unit], axis=3)
        pairs = jnp.stack([second[:, :, i, j] * (0.5 if i == j else 1.0) for i, j in PAIRS], axis=2)
        cubes = [jax.jvp(bend, (zero,), (e,))[1][i] / 6 for i, e in enumerate(unit)]
        parts = h(zero), slope(zero).reshape(-1, 9), pairs.reshape(-1, 18), jnp.stack(cubes, axis=1)
        return jnp.concatenate(parts, axis=1)

    return jax.vmap(terms)(slots)


def _slots(
    calibration: bc.Calibration, at: ws.Problem
) -> tuple[dict[str, Float[np.ndarray, "s g"]], OfTest]:
    """Sum the effects in each slot as in use, draw by draw; return them and the contributions of the test.

    A member of a group is a new one. An effect of columns that are unknown in use acts as at a random reading of the
    test; where it depends on known columns too (a lag, on the temperature's past), its sign is random.
    """
    vector = calibration.model.instrument.vector
    assert vector is not None
    x, v = calibration.draws()
    x = x + at.layout.x_origins
    count, known_columns = len(x), {TEMPERATURE, *vector.beside}
    random = np.random.default_rng(0)  # of a new run, and of a moment of the test
    # In even shares, so that no mean moves by the chance of a draw.
    picked = random.permutation(count) * len(calibration.readings) // count
    sign = np.where(random.permutation(count) % 2, 1.0, -1.0)
    hyper = {k: np.broadcast_to(value, count) for k, value in at.hyper(v.T).items()}
    slots = {name: np.zeros((count, at.record.size)) for name in at.record.slots}
    of_test: dict[str, dict[str, np.ndarray]] = {}
    for t in at.terms:
        if t.slot not in slots or t.slot in vector.rig or t.place == "input":
            continue
        new = t.per is not None and t.place != "fixed"
        if new:
            spread = t.prior_sd if t.group_sd_name is None else hyper[t.group_sd_name]
            away = spread * random.standard_normal(count)
            value = (t.mean + away - away.mean())[:, None]
        else:
            value = at.value(t, x, hyper)
        shapes = [hyper[name] for name in t.shape_names]
        effect = t.effect
        unknown = {*effect.columns} - known_columns - {c.per for c in effect.coefficients}
        record = calibration.problem.record if unknown else at.record
        column = record.columns_of_draws(t.columns, shapes, {})[..., t.index] * t.factor
        if unknown:
            column = np.broadcast_to(column, (count, record.size))[np.arange(count), picked]
            column = (column * (sign if known_columns & {*effect.columns} else 1.0))[:, None]
        slots[t.slot] += value * column
        if new or unknown:
            sums = of_test.setdefault(t.effect.name, {})
            sums[t.slot] = sums.get(t.slot, np.zeros(count)) + (value * column)[:, 0]
    sds = {name: {s: float(np.std(v)) for s, v in sums.items()} for name, sums in of_test.items()}
    whole = {name: MENTIONED_SHARE * np.std(values[:, 0]) for name, values in slots.items()}
    return slots, {
        n: sizes for n, sizes in sds.items() if any(sd > whole[s] for s, sd in sizes.items())
    }
