"""From an unknown dependence to an effect with a name: the shape that was found, as a few lines of Python to edit.

The posterior mean of `unknown(covariate)` is compared with a few simple curves; the simplest one that has nearly all of
its variance becomes the basis of a first draft.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.summary import range_of
from bayescal._core.errors import ModelError
from bayescal._core.quoting import identifier, python_string, python_words
from bayescal._model.frame import derived, measured_column

SIMPLE_SHARE = 0.97  # share of a free curve's variance, from which a simple formula will do for it

POINTS = 101  # of the curve that formulas are tried on: the narrowest width spans five
PERIODS = np.geomspace(0.06, 2.0, 1000)  # of a sine, in parts of the range
PLACES = np.linspace(-0.485, 0.485, 98)  # of a step, in parts of the range
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # of an exponential, in parts of the range


@dataclass(frozen=True)
class DraftShape:
    """The shape of an unknown dependence over the range of its covariate.

    Attributes:
        effect, covariate: names.
        at: points of the covariate, in its fixed unit, (POINTS,).
        mean, sd: of the dependence there, in the slot's unit.
        size: standard deviation of the contribution over the readings, in the slot's unit.
        share: of the variance of the output (group deviations at zero) that it explains.
    """

    effect: str
    covariate: str
    at: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    size: float
    share: float


def shape_of(calibration: Calibration, name: str) -> DraftShape:
    """The shape of an `unknown(…)` of a fitted model.

    Args:
        calibration: of a model that holds it.
        name: such as "unknown(humidity)".

    Raises:
        ModelError: the model has no unknown dependence of that name.
    """
    effect = calibration.model.effect(name)
    if not effect.is_placeholder:
        raise ModelError(
            f"{name!r} is a named effect, not an unknown dependence: it has a form of its own"
        )
    covariate = effect.covariate
    low, high = range_of(calibration, covariate)
    names = [effect.coefficient_name(i) for i in range(len(effect.coefficients))]
    coefficients = np.stack([calibration.samples(n) for n in names], axis=1)
    shapes = {s.name: calibration.samples(effect.shape_name(s)) for s in effect.column_shapes}
    # In place of readings: a covariate that goes through its range.
    places = jnp.linspace(0.0, 1.0, POINTS)
    ramp: Any = SimpleNamespace(position=lambda covariate: places)
    # Two hundred draws, spread over all: mean and scatter of a curve to a fourteenth of its scatter.
    step, draws = max(1, len(coefficients) // 200), []
    for i in range(0, len(coefficients), step):
        columns = np.asarray(effect.basis(ramp, **{s: v[i] for s, v in shapes.items()}))
        draws.append(columns.reshape(POINTS, -1) @ coefficients[i])
    curves = np.array(draws)
    curves -= curves.mean(axis=1, keepdims=True)  # a constant belongs to the bias
    mean, at = curves.mean(axis=0), np.linspace(low, high, POINTS)
    own = np.interp(derived(calibration.readings, every=True)[covariate], at, mean)
    size, output = float(own.std()), float(calibration.readings["output"].var())
    share = size**2 / max(output, 1e-300)
    return DraftShape(name, covariate, at, mean, curves.std(axis=0), size, share)


def draft_effect(calibration: Calibration, name: str) -> str:
    """A user's own effect, drafted from the shape that was found; to be edited and given with --effects.

    Args, Raises: as `shape_of`.
    """
    shape, model = shape_of(calibration, name), calibration.model
    words, basis = _closest(shape)
    slot, word = model.effect(name).slot, identifier(shape.covariate)[:40]
    known = (*model.instrument.known.values(), *model.effects)
    word += "_own" if f"{slot}.{word}" in {e.name for e in known} else ""
    measured = measured_column(shape.covariate)
    column = python_string(measured)
    value = f"r[{column}]" if measured == shape.covariate else f"r.rate({column})"
    if shape.covariate == "elapsed":
        value, column = "r.elapsed", '"time"'
    return DRAFT.format(
        **{"looks": f"{python_words(name)}: {words}", "word": word, "value": value},
        **{"basis": basis, "columns": f"({column},)", "unit": python_string(calibration.unit)},
        **{"name": python_string(f"{slot}.{word}"), "slot": python_string(slot)},
        middle=float(0.5 * (shape.at[0] + shape.at[-1])),
        span=float(np.ptp(shape.at)),
        size=float(f"{2 * max(shape.size, 1e-300):.2g}"),
    )


DRAFT = """\
# {looks}
import bayescal as bc
import jax.numpy as jnp


def {word}(r):  # columns in the units of the instrument, others in base units, ratios as plain numbers
    x = ({value} - {middle:.6g}) / {span:.6g}  # −½ … ½ over the range seen
    return {basis}


effect = bc.Effect({name}, {slot}, {word}, (bc.Coefficient({unit}, bc.Normal(0.0, {size:g})),), columns={columns})"""


def _closest(shape: DraftShape) -> tuple[str, str]:
    """What it resembles, in words, and the basis as Python."""
    x = np.linspace(-0.5, 0.5, POINTS)
    forms = [("a line", "x"), ("a parabola", "x**2"), ("a cubic", "x**3")]
    forms += [
        (f"an exponential of width {w:g} of the range", f"jnp.exp(-(x + 0.5) / {w:g})")
        for w in WIDTHS
    ]
    forms += [
        (f"a step at {p + 0.5:.2g} of the range", f"jnp.where(x > {p:.3g}, 0.5, -0.5)")
        for p in PLACES
    ]
    curves = [x, x**2, x**3, *(np.exp(-(x + 0.5) / w) for w in WIDTHS)]
    curves += [0.5 * np.sign(x - p) for p in PLACES]
    shares = [_fitted(shape.mean, [curve])[0] for curve in curves]
    share, (words, basis) = max(shares), forms[int(np.argmax(shares))]
    # Simple forms first: a sine has a free period and resembles almost any curve.
    if share < SIMPLE_SHARE:
        angles = [2 * math.pi * x / p for p in PERIODS]
        waves = [_fitted(shape.mean, [np.sin(a), np.cos(a)]) for a in angles]
        best = int(np.argmax([one for one, _ in waves]))
        period, (wave, (_, sine, cosine)) = PERIODS[best], waves[best]
        if wave > share:
            # a·sin + b·cos = √(a² + b²)·sin(· + φ), tan φ = b/a.
            angle = f"{2 * math.pi / period:.4g} * x + {math.atan2(cosine, sine):.4g}"
            words, basis = f"a sine of period {period:.2g} of the range", f"jnp.sin({angle})"
            share = wave
    return f"resembles {words} ({100 * share:.0f} % of its variance); is that the physics?", basis


def _fitted(curve: np.ndarray, columns: list[np.ndarray]) -> tuple[float, np.ndarray]:
    """Share of a curve's variance that a constant and columns have, and their coefficients."""
    matrix = np.column_stack([np.ones_like(curve), *columns])
    found = np.linalg.lstsq(matrix, curve, rcond=None)[0]
    rest = curve - matrix @ found
    return 1 - float(rest.var() / max(curve.var(), 1e-300)), found
