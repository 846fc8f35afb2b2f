"""Fit a model to readings by a method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.storage import load_calibration
from bayescal._core import deadline
from bayescal._core.errors import InputError, ModelError, NotConverged
from bayescal._core.lazy_jax import free_memory_maps, jax, jnp
from bayescal._core.settings import to_seed
from bayescal._data.measurements import Measurements
from bayescal._inference.laplace import NO_START
from bayescal._inference.linear_model import fill_amplitudes
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import Method
from bayescal._inference.problem import Problem
from bayescal._inference.record import AFFINE_TOLERANCE, Record, record_of
from bayescal._model.effect import READING, Effect
from bayescal._model.frame import (
    Reference,
    list_constant_names,
    name_reference,
    reference_of,
    select_origins,
)
from bayescal._model.instrument import Instrument, compute_factor
from bayescal._model.model import Model
from bayescal._model.parameters import bind
from bayescal._model.terms import ColumnSpec

ORIGIN_STEP_RANGES = 4  # output ranges, rounded to a power of two, of which origins are multiples


def fit(
    model: Model,
    readings: Measurements,
    method: Method | None = None,
    *,
    seed: int | np.random.Generator = 0,
    strict: bool = True,
    reference: Reference | None = None,
    time_limit: float | None = None,
    start: Mapping[str, float] = NO_START,
) -> Calibration:
    """Fit a model to readings.

    Args:
        model: an instrument, effects and a noise model.
        readings: measurements of that instrument.
        method: `Marginal()` if not given; or `LeastSquares()`, `NUTS()`.
        seed: seed of all random numbers, or a NumPy generator that draws it; the same seed gives the same draws.
        strict: raise if the fit did not converge (tolerance: `FTOL_NATS`); False returns it with its verdict.
        reference: constants of the basis functions, such as {"T0": 0.0}, instead of those computed from the readings.
        time_limit: seconds, after which the partial result is returned: the draws so far, or the Laplace approximation
            at the mode, which is always computed; the verdict says so. Ctrl-C does the same once the mode is found.
        start: values of shapes, noise parameters and between-group standard deviations, by name and in the units of
            `calibration.samples(name)`; the search for the mode starts from them and from draws of their priors.

    Raises:
        InputError: `reference` has a name that is not a reference constant of these readings.
        ModelError: readings lack a column, are too few for the coefficients with flat priors, or have a constant
            output; the model has an effect that is zero in every reading.
        NotConverged: the fit did not converge; its attribute is the calibration.
    """
    if not isinstance(model, Model):
        raise ModelError(
            "A model is an instrument with effects, such as mems_gyro.INSTRUMENT.baseline(); this is a "
            f"{type(model).__name__}"
        )
    free_memory_maps()
    seed = to_seed(seed)
    method = Marginal() if method is None else method
    model.require(readings)
    model = model.with_nuisances(readings)
    _refuse_constant_output(readings)
    requested, constants = reference or {}, list_constant_names(readings)
    if absent := sorted({n for n, v in requested.items() if not isinstance(v, dict)} - constants):
        raise InputError(
            f"reference: no basis has a constant {', '.join(absent)}; for these readings there are: "
            f"{', '.join(sorted(constants))}"
        )
    reference = _add_origins(model, readings, {**reference_of(readings), **requested})
    record = record_of(model.instrument, readings, reference)
    record.require_finite(model.effects)
    model = fill_amplitudes(model, readings, record)
    layout, levels = bind(model, readings, reference=reference)
    problem = Problem(layout, record)
    _refuse_lost_digits(problem, readings)

    with deadline.limit(time_limit):
        outcome = method.run(problem, seed, start)
    calibration = Calibration(
        model=model,
        readings=readings,
        joint=outcome.draws,
        verdict=outcome.verdict,
        method=method.name,
        seed=seed,
        reference=reference,
        levels=levels,
        layout=outcome.layout,
        mode=outcome.mode,
        log_evidence=outcome.log_evidence,
        start=dict(start),
    )
    if outcome.layout is layout:
        vars(calibration)["problem"] = problem
    _refuse_zero_effects(calibration)
    if strict and not calibration.verdict.ok:
        raise NotConverged(
            f"The fit of {', '.join(model.names)} to {readings.file} did not converge: "
            f"{' '.join(calibration.verdict.reasons)} (strict=False returns it nevertheless.)",
            calibration,
        )
    return calibration


def _add_origins(model: Model, readings: Measurements, reference: Reference) -> Reference:
    """Add the outputs' origins to a reference, where outputs are far from zero and the model has a constant.

    An origin is subtracted from outputs and model against cancellation in sums of squares: at 10 MHz, read to 2 mHz, a
    double has six digits of the noise, and a sum of squared outputs has none. A constant coefficient of the model
    shifts every reading equally: the origin is subtracted from outputs and coefficient, and added to reported values.
    An axis' origin is a multiple of a power of two above its outputs' last digit, so that its subtraction is exact.
    """
    stored_origins = select_origins(reference)
    plain_reference = {name: v for name, v in reference.items() if name not in stored_origins}
    far = {n: _find_nearest_origin(readings[n]) for n in model.instrument.outputs or ("output",)}
    if not any(far.values()):
        return plain_reference
    origins = {n: [*stored_origins.get(name_reference(n), {}).items()] for n in far}
    names = {e.coefficient_name(i) for e in model.effects for i in range(len(e.coefficients))}
    if all(len(o) == 1 and o[0][0] in names and o[0][1] == far[n] for n, o in origins.items()):
        return dict(reference)  # these readings' origins already, from a smaller model
    record = record_of(model.instrument, readings, plain_reference)
    constants = [_find_constant_coefficient(model, record, i) for i in range(len(far))]
    if None in constants:
        return plain_reference
    origins = {name_reference(n): {c: o} for (n, o), c in zip(far.items(), constants, strict=True)}
    return {**plain_reference, **origins}  # pyright: ignore[reportReturnType]


def _find_nearest_origin(output: Float[np.ndarray, "n"]) -> float:
    """Return the multiple of four output ranges nearest to the median output; usually zero."""
    step = 2.0 ** math.ceil(math.log2(ORIGIN_STEP_RANGES * float(np.ptp(output)) or 1.0))
    return step * round(float(np.median(output)) / step)


def _find_constant_coefficient(model: Model, record: Record, output_index: int) -> str | None:
    """Return the coefficient with the widest prior among those that shift an output one to one everywhere, or None."""
    instrument, prior_sds = model.instrument, dict[str, float]()
    for effect in model.effects:
        for i, c in enumerate(effect.coefficients):
            slot = c.slot or effect.slot
            if c.group_sd is not None or c.per == READING or effect.column_shapes:
                continue
            is_in_all = c.per is None or (record.codes[c.per] >= 0).all()
            column = record.columns(ColumnSpec.from_effect(effect), ())[:, i]
            if is_in_all and np.all(column == 1.0) and _has_unit_slope(record, slot, output_index):
                prior_sd = math.inf if c.flat else c.size * compute_factor(instrument, effect, c)
                prior_sds[effect.coefficient_name(i)] = prior_sd
    return max(prior_sds, key=prior_sds.__getitem__) if prior_sds else None


def _has_unit_slope(record: Record, slot: str, output: int) -> bool:
    """Return whether ∂output/∂slot is one, and zero for the other axes, at random values of all slots."""
    vector, rng = record.instrument.vector, np.random.default_rng(0)
    if slot not in record.slots:
        return False
    for _ in range(2):
        slots = {name: rng.standard_normal(record.size) for name in record.slots}
        if vector is None:
            jacobian = record.respond(slots, {})[1][slot][:, None]
        else:
            x = rng.standard_normal((record.size, 3))

            def evaluate(value: Any, slots=slots, x=x) -> Any:
                return vector.equation({**slots, slot: value}, record.frame)(jnp.asarray(x))

            jacobian = np.asarray(jax.jvp(evaluate, (slots[slot],), (np.ones(record.size),))[1])
        if not np.max(np.abs(jacobian - np.eye(jacobian.shape[1])[output])) <= AFFINE_TOLERANCE:
            return False
    return True


def _refuse_zero_effects(calibration: Calibration) -> None:
    """Raise ModelError if a user's effect is zero in every reading: its posterior would be its prior."""
    known, readings = calibration.model.instrument.known, calibration.readings
    effects = (e for e in calibration.model.effects if e.name not in known and not e.is_placeholder)
    for effect in effects:
        linear = calibration.linear
        indices = [i for i in range(linear.problem.size) if linear.owners[i] == effect.name]
        if indices and not np.any(linear.nuisance[:, indices]):
            raise ModelError(
                f"Effect {effect.name!r} is zero in all {len(readings)} readings of {readings.file}: its coefficients "
                "would keep their priors. Check its basis function, and the labels and columns that it uses "
                f"({', '.join(effect.columns) or 'none'}), or remove it from the model"
            )


def _refuse_constant_output(readings: Measurements) -> None:
    """Raise ModelError if the output is constant."""
    output = readings["output"]
    if len(output) >= 3 and np.ptp(output) == 0:
        raise ModelError(
            f"{readings.file}: the output reads {output[0]:g} in all {len(output)} readings. Noise alone would change "
            "it: the sensor or the logger is stuck, or the column is not the output"
        )


def _refuse_lost_digits(problem: Problem, readings: Measurements) -> None:
    """Raise ModelError if a constant is so far from its prior mean that squared residuals lose all precision."""
    for b in problem.layout.x_blocks:
        sd = problem.sizes.fixed_sd[b.x_slice] * problem.weight_of_x[b.x_slice]
        if not (b.origin and np.all(sd > 0)):
            continue
        ratio = float(np.max(np.abs(b.mean) / sd))
        if ratio > np.finfo(float).eps ** -0.5:
            raise ModelError(
                f"{readings.file}: the output differs from the prior mean of {b.name} by {ratio:.2g} prior standard "
                "deviations, so that rounding errors are too large. Subtract a constant from the output, give the "
                "nominal zero, or check the unit"
            )


def load(
    path: str | Path, *, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> Calibration:
    """Read a saved calibration.

    Instrument and effects are looked up by name among the installed ones, `instruments` and `effects`, the noise model
    among the loaded classes. No code in the file is run.

    Raises:
        InputError: not a calibration of this version; or its instrument, an effect or its noise model is not found.
    """
    return Calibration(**load_calibration(Path(path), effects, instruments))
