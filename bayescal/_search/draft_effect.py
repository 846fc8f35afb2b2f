"""Draft a named effect from an unknown dependence: its fitted shape as a few lines of Python to edit.

The contribution of `unknown(covariate)` is compared with a few simple curves; the simplest one that explains nearly all
of its variance becomes the basis of the draft.
"""

from __future__ import annotations

import math

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._core.errors import ModelError
from bayescal._core.quoting import quote_python, quote_python_comment, to_identifier
from bayescal._model.frame import strip_rate

SIMPLE_SHARE = 0.97  # share of a free curve's variance from which a simple formula is used

MAX_POINTS = 1000  # readings to which formulas are fitted, evenly spaced
PERIODS = np.geomspace(0.06, 2.0, 300)  # periods of a sine, in parts of the range
STEP_POSITIONS = np.linspace(-0.485, 0.485, 98)  # locations of a step, in parts of the range
WIDTHS = (0.05, 0.1, 0.2, 0.4)  # length scales of an exponential, in parts of the range


def draft_effect(calibration: Calibration, name: str) -> str:
    """Return Python code of an effect drafted from an unknown dependence, to be edited and given with --effects.

    Args:
        calibration: fit of a model with the unknown dependence.
        name: name of the unknown dependence, such as "unknown(humidity)".

    Raises:
        ModelError: the model has no unknown dependence of that name.
    """
    model, effect = calibration.model, calibration.model.effect(name)
    if not effect.is_placeholder:
        raise ModelError(f"{name!r} has an equation already: name an unknown dependence")
    covariate, frame = effect.covariate, calibration.frame
    low, high = (float(frame.reference[f"{covariate}_{end}"]) for end in ("low", "high"))
    x, curve = np.asarray(frame.position(covariate)) - 0.5, calibration.linear.contribution(name)
    rows = np.argsort(x, kind="stable")[:: -(-x.size // MAX_POINTS)]
    text, basis = _find_closest_formula(x[rows], curve[rows])
    slot, word = effect.slot, to_identifier(covariate)[:40]
    known_effects = (*model.instrument.known.values(), *model.effects)
    word += "_own" if f"{slot}.{word}" in {e.name for e in known_effects} else ""
    base_column = strip_rate(covariate)
    column = quote_python(base_column)
    value = f"r[{column}]" if base_column == covariate else f"r.rate({column})"
    if covariate == "elapsed":
        value, column = "r.elapsed", '"time"'
    label, slot, unit = map(quote_python, (f"{slot}.{word}", slot, calibration.unit))
    size = float(f"{2 * max(curve.std(), 1e-300):.2g}")
    return f"""\
# {quote_python_comment(name)}: {text}
import bayescal as bc


def {word}(r):  # the instrument's columns in its units, undeclared ones in SI base units, ratios dimensionless
    x = ({value} - {0.5 * (low + high):.6g}) / {high - low:.6g}  # −½ … ½ over the fitted range
    return {basis}


effect = bc.Effect({label}, {slot}, {word}, (bc.Coefficient({unit}, bc.Normal(0.0, {size:g})),), columns=({column},))"""


def _find_closest_formula(x: np.ndarray, curve: np.ndarray) -> tuple[str, str]:
    """Return the formula closest to a curve over x (−½ to ½), in words, and its basis as Python code."""
    forms = [("a line", "x", x), ("a parabola", "x**2", x**2), ("a cubic", "x**3", x**3)]
    for w in WIDTHS:
        basis = f"bc.xp.exp(-(x + 0.5) / {w:g})"
        forms.append((f"an exponential of width {w:g} of the range", basis, np.exp(-(x + 0.5) / w)))
    for p in STEP_POSITIONS:
        basis = f"bc.xp.where(x > {p:.3g}, 0.5, -0.5)"
        forms.append((f"a step at {p + 0.5:.2g} of the range", basis, np.sign(x - p)))
    shares = [_fit_columns(curve, values)[0] for *_, values in forms]
    share, (text, basis, _) = max(shares), forms[int(np.argmax(shares))]
    # Simple forms first: a sine has a free period and resembles almost any curve.
    for period in PERIODS if share < SIMPLE_SHARE else ():
        angle = 2 * math.pi * x / period
        sine_share, (_, sine, cosine) = _fit_columns(curve, np.sin(angle), np.cos(angle))
        if sine_share > share:
            # a·sin + b·cos = √(a² + b²)·sin(· + φ), tan φ = b/a.
            phase = f"{2 * math.pi / period:.4g} * x + {math.atan2(cosine, sine):.4g}"
            text, basis = f"a sine of period {period:.2g} of the range", f"bc.xp.sin({phase})"
            share = sine_share
    return f"resembles {text} ({100 * share:.0f} % of its variance): check the physics", basis


def _fit_columns(curve: np.ndarray, *columns: np.ndarray) -> tuple[float, np.ndarray]:
    """Fit a constant and columns to a curve; return the share of its variance explained, and the coefficients."""
    matrix = np.column_stack([np.ones_like(curve), *columns])
    coefficients = np.linalg.lstsq(matrix, curve, rcond=None)[0]
    return 1 - float((curve - matrix @ coefficients).var() / max(curve.var(), 1e-300)), coefficients
