"""One verb: fit a model to readings by a method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import jax
import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.storage import load_calibration
from bayescal._core.errors import InputError, ModelError, NotConverged
from bayescal._core.jax_setup import spare_memory_maps
from bayescal._engine.linear_model import sized
from bayescal._inference.checkpoint import fingerprint, keeping
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import Method, kept_outcome
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference, build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model
from bayescal._model.parameters import bind
from bayescal._readings.measurements import Measurements

if TYPE_CHECKING:
    from bayescal._numpyro.program_fit import ProgramFit


DIGITS = 1e6 * float(np.finfo(float).eps)  # of the largest output, by which it changes at least


@overload
def fit(
    model: Model,
    readings: Measurements,
    method: Method | None = None,
    *,
    seed: int = 0,
    strict: bool = True,
    reference: Reference | None = None,
    checkpoint: str | Path | None = None,
) -> Calibration: ...


@overload
def fit(
    model: Callable[..., Any],
    readings: Any,
    method: Method | None = None,
    *,
    seed: int = 0,
    strict: bool = True,
) -> ProgramFit: ...


def fit(
    model: Model | Callable[..., Any],
    readings: Any,
    method: Method | None = None,
    *,
    seed: int = 0,
    strict: bool = True,
    reference: Reference | None = None,
    checkpoint: str | Path | None = None,
) -> Calibration | ProgramFit:
    """Fit a model to readings.

    A NumPyro program is fitted as it is: its Gaussian sites are integrated out where, given all others, every location
    is affine in them, and the verdict says which. Where none is, NumPyro's NUTS runs.

    Args:
        model: an instrument, effects, a noise law; or a NumPyro program.
        readings: measurements of that instrument; for a program its arguments, as a dict by name, a tuple or list
            in order, or anything else as the only one.
        method: `Marginal()` if not given; or `LeastSquares()` (own models only), `NUTS()`. For a program,
            `Marginal(promote=…)` names sites to sample rather than integrate out.
        seed: of every random number; the same seed gives the same draws on the same machine.
        strict: raise if the fit did not converge; False returns it with its verdict.
        reference: constants of the bases, such as {"T0": 0.0}, in place of the data's own. Own models only.
        checkpoint: a file, …nc, for finished pieces of the fit. A fit that was stopped, killed even, goes on from
            there to the same draws, bit for bit; one that had ended does not sample again. Own models only.

    Raises:
        InputError: `reference` names what is no constant of these readings; the checkpoint is none, or one of another
            model, readings, method, seed or version.
        ModelError: readings lack a column, have too few rows for the flat coefficients, or an output that never
            changes; or a program observes nothing, has discrete unknowns, or does not take these readings.
        NotConverged: the verdict is not good; carries the calibration.
    """
    if not isinstance(model, Model):
        return _fit_program(model, readings, method, seed, strict, reference, checkpoint)
    spare_memory_maps()
    method = Marginal() if method is None else method
    model.require(readings)
    _refuse_stuck(readings)
    reference = _reference(readings, reference)
    frame = build_frame(readings, reference)
    model = sized(model, readings, frame)
    layout, levels = bind(model, readings)
    with keeping(checkpoint, lambda: fingerprint(model, readings, method, seed, reference)):
        outcome = kept_outcome(layout, lambda: method.run(layout, frame, frame["output"], seed))
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
        mode=jax.tree.map(np.asarray, outcome.mode),
        log_evidence=outcome.log_evidence,
    )
    return _converged(calibration) if strict else calibration


def _converged(calibration: Calibration) -> Calibration:
    if not calibration.verdict.ok:
        raise NotConverged(
            f"The fit of {', '.join(calibration.model.names)} to {calibration.readings.file} did not converge: "
            f"{' '.join(calibration.verdict.reasons)} (strict=False returns it all the same.)",
            calibration,
        )
    return calibration


def _reference(readings: Measurements, asked: Reference | None) -> Reference:
    """Constants of the bases: the readings' own, but for those that are asked for."""
    own = reference_of(readings)
    strange = sorted(set(asked or {}) - set(own))
    if strange:
        raise InputError(
            f"reference: no basis has a constant {', '.join(strange)}; for these readings there are: {', '.join(own)}"
        )
    return {**own, **(asked or {})}


def _refuse_stuck(readings: Measurements) -> None:
    """An output that never changes is none; nor is one that changes in its last digits alone.

    Raises:
        ModelError: it reads the same in every one of three or more readings, or nearly so.
    """
    output = readings["output"]
    if len(output) > 2 and np.ptp(output) == 0:
        raise ModelError(
            f"{readings.file}: the output reads {output[0]:g} in all {len(output)} readings. Noise alone would change "
            "it: the sensor or the logger is stuck, or the column is not the output"
        )
    largest = float(np.max(np.abs(output)))
    if len(output) > 2 and np.ptp(output) < DIGITS * largest:
        raise ModelError(
            f"{readings.file}: the output is {largest:.3g} and changes by {np.ptp(output):.3g} only: too few of its "
            "digits are left to calculate with. Subtract a constant from it, or give the nominal zero"
        )


def _fit_program(model, readings, method, seed, strict, reference, checkpoint) -> ProgramFit:
    if not callable(model):
        raise ModelError(
            f"A model is an instrument with effects, such as mems_gyro.INSTRUMENT.baseline(), or a NumPyro program; "
            f"this is a {type(model).__name__}"
        )
    if reference is not None or checkpoint is not None:
        name = "reference" if reference is not None else "checkpoint"
        raise ModelError(
            f"{name} is for bayescal's own models, and this is a program: leave it out"
        )
    # here, because it loads NumPyro, which the default fit does without
    from bayescal._numpyro.fit_program import fit_program

    return fit_program(model, readings, method, seed=seed, strict=strict)


def load(
    path: str | Path, *, effects: Sequence[Effect] = (), instruments: Sequence[Instrument] = ()
) -> Calibration:
    """Read a saved calibration.

    Its instrument and effects are resolved by name against what is installed, `instruments` and `effects`; nothing in
    the file is evaluated.

    Raises:
        InputError: not a calibration, another version, or an effect that is not installed.
    """
    found, tree = load_calibration(Path(path), effects, instruments)
    calibration = Calibration(**found)
    vars(calibration)["tree"] = tree  # as it was saved, not made again
    return calibration
