"""What an export says of itself: where it comes from, what it needs, what to know."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._compensation.firmware import About, Input
from bayescal._compensation.operating_equation import InUse
from bayescal._model.frame import RATE_WINDOW
from bayescal._readings.measurements import Measurements


def input_of(calibration: Calibration, equation: InUse, name: str, values: np.ndarray) -> Input:
    """One input of the equation, as people and firmware are told of it; `values` are those of the fit."""
    span = float(values.min()), float(values.max())
    for lag in equation.lags:
        if lag.name == name:
            meaning = (
                f"lag of {lag.column} behind the thermometer, L, 0 at the start; dt after the last "
                f"reading, x = dt/{lag.tau!r} s: L = exp(-x)*L + expm1(-x)/x*(change of {lag.column})"
            )
            return Input(name, "delta_degC", meaning, "lag", lag.column, *span, lag.tau)
    column = name.removesuffix("_rate")
    if name not in equation.known:
        meaning = (
            f"rate of {column}: least-squares slope over the last {RATE_WINDOW:g} s (or the last two "
            "readings, if these are further apart), 0 at the start"
        )
        return Input(name, "degC/s", meaning, "rate", column, *span)
    if name == "elapsed":
        return Input(
            name, "s", "time since the start (of the run, of power)", "elapsed", "time", *span
        )
    own = {c.name: c.meaning for c in calibration.model.instrument.columns}
    meaning = "of the same origin as in the calibration" if name == "time" else own.get(name, "")
    return Input(name, calibration.readings.unit(name) or "1", meaning, "column", name, *span)


def about_of(
    calibration: Calibration, equation: InUse, stimulus_range: tuple[float, float] | None
) -> About:
    """What an export says of itself."""
    from bayescal._core.version import __version__

    instrument, use = calibration.model.instrument, equation.use
    acting = dict.fromkeys(b.effect for b in equation.blocks)
    scale = instrument.nominal_scale
    sources = tuple((s.file, s.sha256) for s in calibration.readings.sources)
    reference = {
        k: float(v)
        for k, v in calibration.reference.items()
        if not isinstance(v, dict) and not k.endswith(("_low", "_high"))
    }
    return About(
        instrument.name,
        instrument.title,
        use.stimulus,
        use.unit,
        calibration.unit,
        tuple((e.name, e.equation) for e in acting),
        reference,
        sources or (("arrays", _digest(calibration.readings)),),
        (scale.unit, scale.gain, scale.offset) if scale else None,
        tuple(_notes(calibration, equation, stimulus_range)),
        f"bayescal {__version__}",
    )


def _notes(
    calibration: Calibration, equation: InUse, stimulus_range: tuple[float, float] | None
) -> list[str]:
    notes = []
    entries = equation.entries()
    new = [e.name for e in entries if e.kind == "new"]
    if new:
        notes.append(
            f"Taken as new in use, with the spread that the calibration found: {', '.join(new)}."
        )
    for lag in equation.lags:
        if lag.shape:
            notes.append(
                f"{lag.name} is the lag for {lag.shape} = {lag.tau:.6g} s; the uncertainty of this time is "
                "not counted through the lag."
            )
    if stimulus_range is None:
        notes.append(f"The range of {equation.use.stimulus} in the calibration is not stated.")
    if not calibration.verdict.ok:
        notes.append(f"THE FIT DID NOT CONVERGE: {' '.join(calibration.verdict.reasons)}")
    return notes


def _digest(readings: Measurements) -> str:
    digest: Any = hashlib.sha256()
    for name in readings.columns:
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(readings[name]).tobytes())
    return digest.hexdigest()
