"""An unexplained pattern in selected readings: in words, by which covariate it runs, and the draft of an effect."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._core.errors import InputError, ModelError
from bayescal._core.formatting import number
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._model.frame import derived
from bayescal._search.calibrate import QUICK
from bayescal._search.draft_effect import DraftShape, draft_effect, shape_of
from bayescal._search.preview import Preview, Previews

# Share of a covariate's range, below which a selection of readings is said to lie at part of it.
NARROW_SHARE = 0.8
# Share of what the best dependence explains in a selection, that another must explain to stand for it.
STANDS_FOR_SHARE = 0.5


@dataclass(frozen=True)
class Draft:
    """What selected readings show.

    Attributes:
        sentence: where they lie, how far the model is off there, and what explains it.
        effect: the unknown dependence that describes it, such as "unknown(humidity)"; empty where none does.
        size, unit: standard deviation of its contribution over all readings.
        code: a first draft of an effect in its place, to edit and load; empty where none describes it.
        shape: its shape along the covariate.
        preview: what adding it would do.
    """

    sentence: str
    effect: str = ""
    size: float = 0.0
    unit: str = ""
    code: str = ""
    shape: DraftShape | None = None
    preview: Preview | None = None

    def __str__(self) -> str:
        return self.sentence


def describe(
    calibration: Calibration,
    rows: Sequence[int] | Int[np.ndarray, "k"],
    against: str = "",
    *,
    previews: Previews | None = None,
) -> Draft:
    """What some readings show that the model does not have, with the draft of an effect.

    Args:
        calibration: the model.
        rows: numbers of the selected readings, from 0.
        previews: over this calibration, where there are some.
        against: name of the covariate that the region was selected along; empty: whichever explains it best.

    Raises:
        InputError: no reading is selected, or one that is not there.
    """
    rows = np.unique(np.asarray(rows, dtype=np.intp))
    previews = previews or Previews(calibration)
    if not rows.size or rows[0] < 0 or rows[-1] >= len(calibration.readings):
        count = len(calibration.readings)
        raise InputError(f"select readings to describe, of rows 0 to {count - 1}")
    said, unit = _where_and_how_far(calibration, rows), unit_label(calibration.unit)
    best = _explaining(calibration, rows, previews, against)
    if best is None:
        return Draft(f"{said} No dependence on a single column explains it.")
    model = calibration.model + previews.effects[best.effect]
    how: dict[str, Any] = {"seed": calibration.seed, "reference": calibration.reference}
    made = fit(model, calibration.readings, QUICK, strict=False, **how)
    shape, code = shape_of(made, best.effect), draft_effect(made, best.effect)
    looks = code.splitlines()[0].partition(": ")[2]
    said += (
        f" A dependence on {shape.covariate} explains it (log Bayes factor {best.log_bayes_factor:.1f}): over all "
        f"readings it contributes {number(shape.size)} {unit} rms and {looks}"
    )
    return Draft(said, best.effect, shape.size, calibration.unit, code, shape, best)


def _where_and_how_far(calibration: Calibration, rows: Int[np.ndarray, "k"]) -> str:
    residual = calibration.linear.settled
    chosen = np.zeros((len(residual), 1))
    chosen[rows] = 1.0
    # The mean over the selection is that of a column which is one there, after the model has been fitted to it too:
    # its score over its information, and the square root of the latter for z.
    (pull,), ((weight,),) = calibration.linear.along(chosen)
    mean, z = (pull / weight, pull / np.sqrt(weight)) if weight > 0 else (0.0, 0.0)
    unit, readings = unit_label(calibration.unit), calibration.readings
    places = []
    for name, values in derived(readings).items():
        low, high, span = values[rows].min(), values[rows].max(), float(np.ptp(values))
        if span > 0 and high - low < NARROW_SHARE * span:
            measured = unit_label(readings.unit(name) or "") if readings.has(name) else ""
            places.append(f"{name} {number(low, 4)} to {number(high, 4)} {measured}".rstrip())
    levels, codes = readings.groups("run")
    inside = sorted({int(c) for c in codes[rows] if c >= 0})
    if len(levels) > 1 and len(inside) < len(levels):
        places.append(f"run {', '.join(levels[c] for c in inside)}")
    where = f" ({'; '.join(places)})" if places else ""
    which = f"the {rows.size} selected readings" if rows.size > 1 else f"row {rows[0] + 1}"
    rms = number(float(np.sqrt(np.mean(residual[rows] ** 2))))
    return f"In {which}{where} the residuals have the mean {mean:+.3g} {unit} (z = {z:+.1f}) and {rms} {unit} rms."


def _explaining(
    calibration: Calibration, rows: Int[np.ndarray, "k"], previews: Previews, against: str
) -> Preview | None:
    """The unknown dependence with the most evidence, of those that explain the selection about as well as any."""
    found: list[tuple[float, Preview]] = []
    residual = calibration.linear.settled[rows]
    for name, effect in previews.effects.items():
        if (
            not effect.is_placeholder
            or name in calibration.model.names
            or (against and effect.covariate != against)
        ):
            continue
        with suppress(ModelError):  # not beside this noise law
            one = previews.of(name)
            explained = float(np.sum(residual**2) - np.sum((residual - one.curve[rows]) ** 2))
            if (one.log_bayes_factor or 0.0) > settings().strong_evidence and explained > 0:
                found.append((explained, one))
    # What explains the selection best by squares may be a curve that bends after it: of those nearly as good, the one
    # with the most evidence over all readings.
    most = STANDS_FOR_SHARE * max((explained for explained, _ in found), default=0.0)
    near = [one for explained, one in found if explained >= most]
    return max(near, key=lambda one: one.log_bayes_factor or 0.0, default=None)
