"""The correction of three axes that a calibration comes to: its equation as a series, draw by draw.

The calibrated equation h is taken as its Taylor series in what acts: offset, 3 × 3 matrix and, where the model has
them, terms of second order and each axis' own cube, each a polynomial of T − T0. That is exact for terms that are
polynomials of both; what depends on the temperature otherwise is left to the uncertainty.

What belongs to the test and is not known in use is integrated out, draw by draw, and widens C: the deviation of a run
is that of a new one, and what depends on time (a drift, a lag) or on a further column is as at a reading of the test
taken at random.
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
    UNKNOWN_DIRECTIONS,
    VectorCorrection,
)

# Share of the largest term up to which a polynomial of the temperature is the model's own.
EXACT_SHARE = 1e-9
ORDERS = 3  # of the temperature
TEMPERATURE = "temperature"  # known in use, as is what acts beside
SHARED_SIZES = 3.0  # plausible sizes of a factor that three scale factors share, beyond which what acts is in question
MENTIONED_SHARE = 0.1  # of a standard uncertainty: what of the test is larger is said
OfTest = dict[str, dict[str, float]]  # of effects, the standard deviation of what they add to slots


def vector_correction(calibration: bc.Calibration) -> VectorCorrection:
    """The correction of a calibrated instrument of three axes.

    What leaves is for a run to come: the deviation of a run, a drift and what else belongs to the test are in the
    uncertainty, and the notes say so. Mean and covariance are of all draws, as in every table.

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
    beside = vector.beside if any(set(e.columns) & {*vector.beside} for e in model.effects) else ()
    recorded = readings.has("temperature")
    warm = readings["temperature"] if recorded else np.zeros(1)
    low, high, reference = float(np.min(warm)), float(np.max(warm)), float(np.round(np.mean(warm)))
    reference = float(calibration.reference.get("T0", reference))  # pyright: ignore[reportArgumentType]
    grid = np.linspace(low, high, 2 * ORDERS + 1) if high > low else np.array([low])
    taylor, of_test = _taylor(calibration, grid, beside)  # (draws, grid, p)
    powers = (grid - reference)[:, None] ** np.arange(ORDERS + 1)
    each = np.moveaxis(taylor, 1, 0).reshape(len(grid), -1)
    for order in range(min(ORDERS, len(grid) - 1) + 1):
        own = powers[:, : order + 1]
        q, r = np.linalg.qr(own)  # least squares of all draws at once
        fitted = np.linalg.solve(r, q.T @ each)
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
        source=ws.identity(calibration),
        beside=beside,
        instrument=instrument.name,
    )
    if np.any(beyond):
        rms = np.sqrt(np.mean(beyond[:, :3] ** 2, axis=0))
        said = (
            *said,
            f"What depends on the temperature by more than its power {ORDERS} is not corrected, and is in the "
            f"uncertainty (of offsets, rms, {ws.number(float(rms.max()), 2)} {ws.unit_label(instrument.unit)} at "
            "most).",
        )
    against = ws.why_not(calibration)
    notes = (f"{ws.NOT_RELIABLE}{against}",) * bool(against)
    notes = (*said, *notes, *_notes(calibration, made, of_test))
    return replace(made, reach=_reach(made, readings), notes=notes, against=against)


def _reach(correction: VectorCorrection, readings: bc.Measurements) -> float:
    """Largest magnitude of what acted in the readings: of rates between poses, of their means."""
    if readings.has(ws.TURNED[0]):
        acted = np.stack([readings[name] for name in ws.TURNED], axis=1)
    else:
        acted = correction(readings).vector
    return float(np.max(np.linalg.norm(acted, axis=1)))


def _common_scale(
    calibration: bc.Calibration, matrix: Float[np.ndarray, "3 3"]
) -> tuple[float, tuple[str, ...]]:
    """Relative uncertainty of what all three scale factors share, beyond that of each, and what is to be said of it.

    It is that of data sheets where the magnitude of what acts is not known, and none where it is.
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


def _notes(calibration: bc.Calibration, made: VectorCorrection, of_test: OfTest) -> tuple[str, ...]:
    notes, at = [], made.calibrated_at
    if calibration.readings.has(ws.TURNED[0]):
        notes.append("Axes are those of the accelerometers that the moves were closed by.")
    elif not calibration.readings.has(ws.ACROSS[0]):
        notes.append(UNKNOWN_DIRECTIONS)
    if len(made.terms) > 1:
        notes.append(f"Valid from {made.low:.4g} to {made.high:.4g} °C.")
    else:
        notes.append(
            f"No dependence on temperature is in the model ({at}): valid where it was calibrated."
        )
    model = calibration.model
    for name, moved in of_test.items():
        each = (
            f"{s} {ws.number(sd, 2)} {model.instrument.slot(s).unit}" for s, sd in moved.items()
        )
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
    calibration: bc.Calibration, grid: np.ndarray, beside: tuple[str, ...]
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
    problem = calibration.problem_on(calibration.frame_of(like))
    slots, of_test = _slots(calibration, problem)
    count = len(next(iter(slots.values())))

    found = np.asarray(_series(vector, slots, problem.record.frame))
    none, others = found[:, :each], found[:, each:, :3].reshape(count, len(beside), each, 3)
    further = np.moveaxis(others - none[:, None, :, :3], 1, 3).reshape(count, each, -1)
    return np.concatenate([none, further], axis=2), of_test


@ws.compiled
def _series(
    vector: bc.Vector, slots: Mapping[str, Float[Array, "s g"]], frame: bc.Frame
) -> Float[Array, "s g p"]:
    """Offset, matrix, second order and own cubes of the equation, for draws of its slots at each reading of a frame."""
    zero = jnp.zeros((frame.size, 3))
    unit = jnp.eye(3)[:, None, :] * jnp.ones((frame.size, 1))

    def terms(slots: Mapping[str, Float[Array, "g"]]) -> Float[Array, "g p"]:
        h = vector.equation(slots, frame)

        def slope(at: Any) -> Any:
            return jnp.stack([jax.jvp(h, (at,), (e,))[1] for e in unit], axis=2)

        def bend(at: Any) -> Any:  # of each output along its own axis
            return jnp.stack([jax.jvp(slope, (at,), (e,))[1][:, i, i] for i, e in enumerate(unit)])

        second = jnp.stack([jax.jvp(slope, (zero,), (e,))[1] for e in unit], axis=3)
        own = jnp.stack([second[:, :, i, j] * (0.5 if i == j else 1.0) for i, j in PAIRS], axis=2)
        cubes = [jax.jvp(bend, (zero,), (e,))[1][i] / 6 for i, e in enumerate(unit)]
        parts = h(zero), slope(zero).reshape(-1, 9), own.reshape(-1, 18), jnp.stack(cubes, axis=1)
        return jnp.concatenate(parts, axis=1)

    return jax.vmap(terms)(slots)


def _slots(
    calibration: bc.Calibration, at: ws.Problem
) -> tuple[dict[str, Float[np.ndarray, "s g"]], OfTest]:
    """What the effects come to in use, of draws, and what those of the test have in it.

    A member of a group is a new one. An effect of columns that are not known in use acts as at a reading of the test
    taken at random; where it depends on what is known too (a lag, on the temperature's past), its sign is random:
    how the known one went in the test says nothing of how it goes in use.
    """
    vector = calibration.model.instrument.vector
    assert vector is not None
    x, v = calibration.draws()
    x = x + at.layout.origin_of_x
    count, known = len(x), {TEMPERATURE, *vector.beside}
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
        unknown = {*effect.columns} - known - {c.per for c in effect.coefficients}
        record = calibration.problem.record if unknown else at.record
        column = record.columns_of_draws(t.columns, shapes, {})[..., t.index] * t.factor
        if unknown:
            column = np.broadcast_to(column, (count, record.size))[np.arange(count), picked]
            column = (column * (sign if known & {*effect.columns} else 1.0))[:, None]
        slots[t.slot] += value * column
        if new or unknown:
            sums = of_test.setdefault(t.effect.name, {})
            sums[t.slot] = sums.get(t.slot, np.zeros(count)) + (value * column)[:, 0]
    sds = {name: {s: float(np.std(v)) for s, v in sums.items()} for name, sums in of_test.items()}
    whole = {name: MENTIONED_SHARE * np.std(values[:, 0]) for name, values in slots.items()}
    return slots, {
        n: each for n, each in sds.items() if any(sd > whole[s] for s, sd in each.items())
    }
