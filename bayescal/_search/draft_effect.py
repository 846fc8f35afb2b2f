"""From an unknown dependence to an effect with a name: the shape that was found, as a few lines of Python to edit.

The posterior mean of `unknown(covariate)` is compared with a few simple curves; the simplest one that has nearly all of
its variance becomes the basis of a first draft.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.summary import range_of
from bayescal._core.errors import ModelError
from bayescal._core.quoting import identifier, python_string, python_words
from bayescal._model.effect import Effect
from bayescal._model.frame import derived, measured_column

SIMPLE_SHARE = 0.97  # share of a free curve's variance, from which a simple formula will do for it

POINTS = 101  # of the curve that formulas are tried on: the narrowest width spans five
PERIODS = np.geomspace(0.06, 2.0, 1000)  # of a sine, in parts of the range
PLACES = np.linspace(-0.485, 0.485, 98)  # of a step, in parts of the range
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of an exponential, in parts of the range


def draft_effect(calibration: Calibration, name: str) -> str:
    """Return a user's own effect, drafted from an unknown dependence; to be edited and given with --effects.

    Args:
        calibration: of a model that holds it.
        name: such as "unknown(humidity)".

    Raises:
        ModelError: the model has no unknown dependence of that name.
    """
    model, effect = calibration.model, calibration.model.effect(name)
    if not effect.is_placeholder:
        raise ModelError(
            f"{name!r} is a named effect, not an unknown dependence: it has a form of its own"
        )
    covariate, (low, high) = effect.covariate, range_of(calibration, effect.covariate)
    curve = _mean_curve(calibration, effect)
    words, basis = _closest(curve)
    own = derived(calibration.readings, every=True)[covariate]
    size = float(np.interp(own, np.linspace(low, high, POINTS), curve).std())
    slot, word = effect.slot, identifier(covariate)[:40]
    known = (*model.instrument.known.values(), *model.effects)
    word += "_own" if f"{slot}.{word}" in {e.name for e in known} else ""
    measured = measured_column(covariate)
    column = python_string(measured)
    value = f"r[{column}]" if measured == covariate else f"r.rate({column})"
    if covariate == "elapsed":
        value, column = "r.elapsed", '"time"'
    return DRAFT.format(
        **{"looks": f"{python_words(name)}: {words}", "word": word, "value": value},
        **{"basis": basis, "columns": f"({column},)", "unit": python_string(calibration.unit)},
        **{"name": python_string(f"{slot}.{word}"), "slot": python_string(slot)},
        middle=float(0.5 * (low + high)),
        span=float(high - low),
        size=float(f"{2 * max(size, 1e-300):.2g}"),
    )


def _mean_curve(calibration: Calibration, effect: Effect) -> Float[np.ndarray, "points"]:
    """Posterior mean of an unknown dependence over the range of its covariate, in the slot's unit."""
    names = [effect.coefficient_name(i) for i in range(len(effect.coefficients))]
    coefficients = np.stack([calibration.samples(n) for n in names], axis=1)
    shapes = {s.name: calibration.samples(effect.shape_name(s)) for s in effect.column_shapes}
    # In place of readings: a covariate that goes through its range.
    places = np.linspace(0.0, 1.0, POINTS)
    ramp: Any = SimpleNamespace(position=lambda covariate: places)
    step, curves = max(1, len(coefficients) // 200), []
    for i in range(0, len(coefficients), step):
        columns = np.asarray(effect.basis(ramp, **{s: v[i] for s, v in shapes.items()}))
        curves.append(columns.reshape(POINTS, -1) @ coefficients[i])
    centred = np.array(curves) - np.mean(curves, axis=1, keepdims=True)  # a constant is of the bias
    return centred.mean(axis=0)


DRAFT = """\
# {looks}
import bayescal as bc


def {word}(r):  # columns in the units of the instrument, others in base units, ratios as plain numbers
    x = ({value} - {middle:.6g}) / {span:.6g}  # −½ … ½ over the range seen
    return {basis}


effect = bc.Effect({name}, {slot}, {word}, (bc.Coefficient({unit}, bc.Normal(0.0, {size:g})),), columns={columns})"""


def _closest(curve: np.ndarray) -> tuple[str, str]:
    """What a curve resembles, in words, and the basis as Python."""
    x = np.linspace(-0.5, 0.5, POINTS)
    forms = [
        ("a line", "x", x),
        ("a parabola", "x**2", x**2),
        ("a cubic", "x**3", x**3),
        *(
            (f"an exponential of width {w:g} of the range", f"bc.xp.exp(-(x + 0.5) / {w:g})", y)
            for w, y in ((w, np.exp(-(x + 0.5) / w)) for w in WIDTHS)
        ),
        *(
            (f"a step at {p + 0.5:.2g} of the range", f"bc.xp.where(x > {p:.3g}, 0.5, -0.5)", y)
            for p, y in ((p, 0.5 * np.sign(x - p)) for p in PLACES)
        ),
    ]
    shares = [_fitted(curve, [form])[0] for *_, form in forms]
    share, (words, basis, _) = max(shares), forms[int(np.argmax(shares))]
    # Simple forms first: a sine has a free period and resembles almost any curve.
    if share < SIMPLE_SHARE:
        angles = [2 * math.pi * x / p for p in PERIODS]
        waves = [_fitted(curve, [np.sin(a), np.cos(a)]) for a in angles]
        best = int(np.argmax([one for one, _ in waves]))
        period, (wave, (_, sine, cosine)) = PERIODS[best], waves[best]
        if wave > share:
            # a·sin + b·cos = √(a² + b²)·sin(· + φ), tan φ = b/a.
            angle = f"{2 * math.pi / period:.4g} * x + {math.atan2(cosine, sine):.4g}"
            words, basis = f"a sine of period {period:.2g} of the range", f"bc.xp.sin({angle})"
            share = wave
    return f"resembles {words} ({100 * share:.0f} % of its variance); is that the physics?", basis


def _fitted(curve: np.ndarray, columns: list[np.ndarray]) -> tuple[float, np.ndarray]:
    """Share of a curve's variance that a constant and columns have, and their coefficients."""
    matrix = np.column_stack([np.ones_like(curve), *columns])
    found = np.linalg.lstsq(matrix, curve, rcond=None)[0]
    rest = curve - matrix @ found
    return 1 - float(rest.var() / max(curve.var(), 1e-300)), found
