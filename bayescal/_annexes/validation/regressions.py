"""Fits of certified examples by the public functions: regressions whose equations are given as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from types import CodeType
from typing import Any

import numpy as np

import bayescal as bc

FUNCTIONS: dict[str, Any] = {
    name: getattr(bc.xp, name) for name in ("arctan", "cos", "exp", "log", "sin")
}
FUNCTIONS |= {"__builtins__": {}, "pi": math.pi}
LINE = "line"  # the sum of all columns, each times its coefficient


@cache
def _compile(text: str) -> CodeType:
    return compile(text.replace("[", "(").replace("]", ")"), text, "eval")


def evaluate(text: str, values: Mapping[str, Any]) -> Any:
    """Evaluate an equation of this package's own data, such as "b1*(1-exp[-b2*x])"."""
    return eval(_compile(text), FUNCTIONS, dict(values))


def fit(
    y: Any,
    columns: Mapping[str, Any],
    start: Sequence[float] = (),
    expected: str = LINE,
    *,
    u: Any = None,
    prior: Any = None,
    value: str = LINE,
    stimulus: str = "value",
    further_effects: Sequence[bc.Effect] = (),
    method: Any = None,
) -> bc.Calibration:
    """Fit y by columns (n,) times the coefficients of the effect "line.b", or by an equation in b1, b2, ….

    Args:
        y, columns, u: response, regressors, standard uncertainties of y (None: one is estimated from the residuals).
        start, expected: starting values of b1, b2, …, and the equation of the response.
        prior: prior of the coefficients of columns; flat if not given.
        value, stimulus: equation of the compensated quantity; its name, or a column, for which the response is solved.
        further_effects, method: additional effects; method of the fit, least squares if not given.
    """
    starts = {f"b{i}": float(b) for i, b in enumerate(start, 1)} or {LINE: 0.0}

    def coefficient(size: float = 1.0, part: str = "") -> bc.Coefficient:
        return bc.Coefficient("1", prior or bc.Flat(size), part=part)

    if len(start):
        sizes = {slot: (coefficient(abs(b) or 1.0),) for slot, b in starts.items()}
        effects = [
            bc.Effect(f"{s}.constant", s, lambda r: 1.0, c, source="ours") for s, c in sizes.items()
        ]
    else:
        coefficients = tuple(coefficient(part=name) for name in columns)
        stack = lambda r: bc.xp.stack([r[name] for name in columns], axis=1)  # noqa: E731
        effects = [
            bc.Effect("line.b", LINE, stack, coefficients, columns=tuple(columns), source="ours")
        ]

    def compute(text: str, slots: Any, r: Any) -> Any:
        columns_used = {name: r[name] for name in columns if name in _compile(text).co_names}
        return evaluate(text, columns_used | {slot: slots[slot] + b for slot, b in starts.items()})

    equation = None if stimulus in columns else lambda v, slots, r: v - compute(value, slots, r)
    instrument = bc.Instrument(
        "regression",
        "a regression",
        columns=tuple(bc.Column(name, "1") for name in (*columns, "output")),
        slots=tuple(bc.Slot(slot, "1") for slot in starts),
        response=lambda slots, r: compute(expected, slots, r),
        effects=(*effects, *further_effects),
        noise=bc.White(bc.Flat()),
        use=bc.Use(stimulus, "1", equation=equation),
    )
    model, data = instrument.baseline(), dict(columns)
    if u is not None:
        data["output_uncertainty"] = np.broadcast_to(np.asarray(u, float), np.shape(y))
        model = model.fix({"noise.white": 0.0})
    readings = bc.Measurements.from_arrays(instrument, output=np.asarray(y, float), **data)
    return bc.fit(model, readings, method or bc.LeastSquares(), strict=False, seed=1)
