"""From an unknown dependence to an effect with a name: the shape that was found, as a few lines of Python to edit.

The posterior mean of `unknown(covariate)` is compared with a few simple curves; the simplest one that has nearly all of
its variance becomes the basis of a first draft.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.settings import searching
from bayescal._core.errors import ModelError
from bayescal._core.quoting import identifier, python_string, python_words
from bayescal._model.frame import derived
from bayescal._model.unknown_effect import FORMS

POINTS = 101
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
    inside = name[name.index("(") + 1 : -1]
    covariate = inside.split(",")[0] if inside in FORMS else inside
    low, high = (calibration.reference[f"{covariate}_{end}"] for end in ("low", "high"))
    assert isinstance(low, float) and isinstance(high, float)
    coefficients = np.stack(
        [calibration.samples(effect.coefficient_name(i)) for i in range(len(effect.coefficients))],
        axis=1,
    )
    shapes = {s.name: calibration.samples(effect.shape_name(s)) for s in effect.column_shapes}
    # Two hundred draws, spread over all: mean and scatter of a curve to a fourteenth of its scatter.
    step = max(1, len(coefficients) // 200)
    draws = []
    waves = _Ramp(jnp.linspace(0.0, 1.0, POINTS))
    for i in range(0, len(coefficients), step):
        columns = np.asarray(effect.basis(waves, **{s: v[i] for s, v in shapes.items()}))
        draws.append(columns.reshape(POINTS, -1) @ coefficients[i])
    curves = np.array(draws)
    curves -= curves.mean(axis=1, keepdims=True)  # a constant belongs to the bias
    mean = curves.mean(axis=0)
    at = np.linspace(low, high, POINTS)
    own = np.interp(derived(calibration.readings, every=True)[covariate], at, mean)
    output = calibration.readings["output"]
    size = float(own.std())
    return DraftShape(
        name,
        covariate,
        at,
        mean,
        curves.std(axis=0),
        size,
        size**2 / max(float(output.var()), 1e-300),
    )


@dataclass(frozen=True)
class _Ramp:
    """In place of readings: a covariate that goes through its range."""

    places: object

    def position(self, covariate: str):
        return self.places


def draft_effect(calibration: Calibration, name: str) -> str:
    """A user's own effect, drafted from the shape that was found; to be edited and given with --effects.

    Args, Raises: as `shape_of`.
    """
    shape = shape_of(calibration, name)
    words, basis, middle = _closest(shape)
    slot, instrument = calibration.model.effect(name).slot, calibration.model.instrument
    unit = calibration.unit
    word = identifier(shape.covariate)[:40]
    taken = {
        e.name for e in (*instrument.effects, *instrument.candidates, *calibration.model.effects)
    }
    word += "_own" if f"{slot}.{word}" in taken else ""
    column = shape.covariate.removesuffix(" rate")
    value = (
        f"r.rate({python_string(column)})"
        if shape.covariate.endswith(" rate")
        else f"r[{python_string(column)}]"
    )
    value = "r.elapsed" if shape.covariate == "elapsed" else value
    columns = '("time",)' if shape.covariate == "elapsed" else f"({python_string(column)},)"
    size = float(f"{2 * max(shape.size, 1e-300):.2g}")
    return "\n".join(
        [
            f"# {python_words(name)}: {words}",
            "import bayescal as bc",
            "import jax.numpy as jnp",
            "",
            "",
            f"def {word}(r):  # columns in the units of the instrument, others in base units, ratios as plain numbers",
            f"    x = ({value} - {middle:.6g}) / {float(np.ptp(shape.at)):.6g}  # −½ … ½ over the range seen",
            f"    return {basis}",
            "",
            "",
            f"effect = bc.Effect({python_string(f'{slot}.{word}')}, {python_string(slot)}, {word}, "
            f"(bc.Coefficient({python_string(unit)}, bc.Normal(0.0, {size:g})),), columns={columns})",
        ]
    )


def _closest(shape: DraftShape) -> tuple[str, str, float]:
    """(what it resembles, in words; the basis as Python; the middle of the range)."""
    x = np.linspace(-0.5, 0.5, POINTS)
    forms = [("a line", "x", x), ("a parabola", "x**2", x**2), ("a cubic", "x**3", x**3)]
    forms += [
        (
            f"an exponential of width {w:g} of the range",
            f"jnp.exp(-(x + 0.5) / {w:g})",
            np.exp(-(x + 0.5) / w),
        )
        for w in WIDTHS
    ]
    forms += [
        (
            f"a step at {p + 0.5:.2g} of the range",
            f"jnp.where(x > {p:.3g}, 0.5, -0.5)",
            0.5 * np.sign(x - p),
        )
        for p in PLACES
    ]
    best = max(forms, key=lambda form: _share(shape.mean, [form[2]]))
    share = _share(shape.mean, [best[2]])
    words, basis = best[0], best[1]
    # Simple forms first: a sine has a free period and resembles almost any curve.
    if share < searching().simple:
        period = max(PERIODS, key=lambda p: _share(shape.mean, _waves(x, p)))
        waves = _share(shape.mean, _waves(x, period))
        if waves > share:
            phase = _phase(shape.mean, x, period)
            angle = f"{2 * math.pi / period:.4g} * x + {phase:.4g}"
            words, basis = f"a sine of period {period:.2g} of the range", f"jnp.sin({angle})"
            share = waves
    middle = float(0.5 * (shape.at[0] + shape.at[-1]))
    return (
        f"resembles {words} ({100 * share:.0f} % of its variance); is that the physics?",
        basis,
        middle,
    )


def _share(curve: np.ndarray, columns: list[np.ndarray]) -> float:
    """Share of a curve's variance that columns and a constant have."""
    matrix = np.column_stack([np.ones_like(curve), *columns])
    rest = curve - matrix @ np.linalg.lstsq(matrix, curve, rcond=None)[0]
    return 1 - float(rest.var() / max(curve.var(), 1e-300))


def _waves(x: np.ndarray, period: float) -> list[np.ndarray]:
    angle = 2 * math.pi * x / period
    return [np.sin(angle), np.cos(angle)]


def _phase(curve: np.ndarray, x: np.ndarray, period: float) -> float:
    matrix = np.column_stack([np.ones_like(x), *_waves(x, period)])
    # a·sin + b·cos = √(a² + b²)·sin(· + φ), tan φ = b/a.
    _, sine, cosine = np.linalg.lstsq(matrix, curve, rcond=None)[0]
    return math.atan2(cosine, sine)
