"""Placeholder effects: an unknown dependence on one covariate, by name `model + "unknown(humidity)"`.

Forms: smooth, a line, a step, a kink or a peak along any covariate; a step or a periodic form in time. Each is linear
in coefficients whose prior standard deviation is an amplitude parameter, with a range estimated from the readings if
not given.

The smooth form is a Gaussian process with a squared-exponential kernel. Its columns are the eigenfunctions of the
Laplacian on an interval wider than the covariate's range, weighted with the root of the spectral density (Solin &
Särkkä, Stat. Comput. 30 (2020) 419). It can follow a step or a periodic form, but at a cost in evidence that lets
correlated noise win; hence the parametric forms, with one or two coefficients.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bayescal._core.jit import value_partial
from bayescal._core.xp import xp
from bayescal._data.measurements import Measurements
from bayescal._model.effect import OPEN, Coefficient, Effect, Kind, Shape
from bayescal._model.frame import list_covariate_columns
from bayescal._model.prior import Normal

# Along a column (False) and in time (True), where steps and periodic forms occur: number of eigenfunctions, and range
# of plausible length scales relative to the covariate's range.
RESOLUTION = {False: (12, (0.1, 0.8)), True: (36, (0.03, 0.8))}
INTERVAL_RATIO = 1.5  # interval over covariate range; at its ends and beyond the function is zero

# Plausible location of a step, kink or peak, and half widths, relative to the covariate's range.
LOCATIONS = (0.05, 0.95)
STEP_HALF_WIDTH = 0.01  # half width of a step in time: sharp, yet differentiable in its location
HALF_WIDTHS = (STEP_HALF_WIDTH, 0.2)
CYCLE_RANGE = (1.5, 15.0)  # plausible number of periods in the record
MIN_DISTINCT_VALUES = 30  # distinct values of a covariate: twice the largest number of periods

SOURCE = "ours: a generic form without a known cause; identify the cause"
FREED_SUFFIX = ".freed"  # suffix of an effect's copy with a wide prior
Form = Callable[..., Effect]
_NAME_REGEX = re.compile(r"unknown\((.+)\)", re.DOTALL)


def parse_covariate(name: str) -> str | None:
    """Parse the covariate, with its form if any, from a placeholder's canonical name; None for any other effect."""
    match = _NAME_REGEX.fullmatch(name)
    return ", ".join(filter(None, split_covariate(match[1]))) if match else None


def split_covariate(covariate: str) -> tuple[str, str]:
    """Split "humidity, line" into column and form; the form is empty if the last part is not the name of a form."""
    column, _, form = (part.strip() for part in covariate.rpartition(","))
    return (column, form) if column and form in (*FORMS, "cycle") else (covariate.strip(), "")


def make_placeholder(covariate: str, slot: str, unit: str) -> Effect:
    """Return the placeholder for a covariate with an optional form, such as "humidity, peak" or "time, cycle"."""
    column, form = split_covariate(covariate)
    if form == "cycle" and column == "time":
        return cycle(slot, *OPEN, unit)
    if form in FORMS:
        return FORMS[form](slot, *OPEN, unit, covariate=column)
    return unknown(covariate, slot, *OPEN, unit)


def freed(effect: Effect, ratio: float = 1.0) -> Effect:
    """Return a copy of an effect with prior mean 0 and `ratio` times its size, for an error of its value."""
    coefficients = tuple(replace(c, prior=Normal(0.0, ratio * c.size)) for c in effect.coefficients)
    return replace(
        effect,
        name=effect.name + FREED_SUFFIX,
        frees=effect.name,
        forms=(),
        family="",
        coefficients=coefficients,
        equation=f"{effect.equation or 'c'}, in addition to its stated value",
        source=f"ours: the stated value of {effect.name} may be wrong",
    )


def make_process_columns(position: Any, count: int) -> Any:
    """Return columns Φ (n, count) with Φ·diag(w²)·Φᵀ ≈ squared-exponential kernel, w: weights."""
    centred = xp.clip(2 * position - 1, -INTERVAL_RATIO, INTERVAL_RATIO)
    frequency = xp.arange(1, count + 1) * math.pi / (2 * INTERVAL_RATIO)
    return xp.sin(frequency * (centred[..., None] + INTERVAL_RATIO)) / math.sqrt(INTERVAL_RATIO)


def make_process_weights(count: int, length: Any, amplitude: Any = 1.0) -> Any:
    """Return the prior standard deviations w of the coefficients (`Effect.weights`); `length` in covariate ranges."""
    frequency = np.arange(1, count + 1) * math.pi / (2 * INTERVAL_RATIO)
    scale = 2 * length
    root_density = xp.sqrt(scale * math.sqrt(2 * math.pi)) * xp.exp(-((scale * frequency) ** 2) / 4)
    return amplitude * root_density


@functools.cache  # equal arguments give the identical object, so that compiled programs are reused
def unknown(
    covariate: str, slot: str, low: float, high: float, unit: str, *, name: str = ""
) -> Effect:
    """Return an unknown smooth dependence on a covariate: a Gaussian process of unknown amplitude and length scale.

    Args:
        covariate: a numeric column, "elapsed" (time within the run), or "temperature rate".
        low, high: plausible amplitudes (standard deviation over the covariate's range), `unit`; `*OPEN`: estimated.
        name: canonical name; `unknown(covariate)` if not given.
    """
    terms, lengths = RESOLUTION[covariate in ("time", "elapsed")]
    columns = list_covariate_columns(covariate)
    return Effect(
        name or f"unknown({covariate})",
        slot,
        value_partial(evaluate_process, covariate, terms),
        coefficients=make_standard_normals(unit, terms),
        shapes=(Shape("length", "1", *lengths), Shape("amplitude", unit, low, high)),
        weights=value_partial(make_process_weights, terms),
        measure="amplitude",
        columns=columns,
        varies=() if covariate == "elapsed" else columns[:1],
        equation=f"f({covariate}),  f a Gaussian process",
        source=SOURCE,
        along=covariate,
        kind="curve",
    )


def evaluate_process(covariate: str, count: int, frame: Any) -> Any:
    """Return a Gaussian process's basis columns (`make_process_columns`) at the positions of a covariate (n, terms)."""
    return make_process_columns(frame.position(covariate), count)


def _make_factory(kind: Kind, equation: str, basis: Callable[..., Any], summary: str) -> Form:
    """Return a function that returns a placeholder effect of one form; its last shape is the amplitude."""

    @functools.cache
    def make_form(
        slot: str, low: float, high: float, unit: str, *, covariate: str = "time", name: str = ""
    ) -> Effect:
        is_time = covariate == "time"
        sides = ("before one moment", "after") if is_time else (f"below one {covariate}", "above")
        return Effect(
            name or f"unknown({covariate}, {kind})",
            slot,
            value_partial(basis, covariate),
            coefficients=make_standard_normals(unit, 2 if kind == "cycle" else 1),
            shapes=(*_make_form_shapes(kind, is_time), Shape("amplitude", unit, low, high)),
            weights=_evaluate_constant_weights,
            measure="amplitude",
            columns=(covariate,),
            varies=(covariate,),
            untestable=functools.partial(_explain_untestable, covariate),
            equation=equation.format(*sides, covariate=covariate),
            source=SOURCE,
            along="" if is_time else covariate,
            family="" if is_time else f"unknown({covariate})",
            kind=kind,
        )

    make_form.__name__ = make_form.__qualname__ = kind
    make_form.__doc__ = f"""{summary}

    Args:
        slot: slot that the effect adds to.
        low, high: plausible amplitudes a, in `unit`; `*OPEN` estimates them from the readings.
        unit: unit of the slot.
        covariate: column that the slot depends on.
        name: canonical name; `unknown(humidity, {kind})` if not given, with the column's name.
    """
    return make_form


def _make_form_shapes(kind: Kind, is_time: bool) -> tuple[Shape, ...]:
    """Return the shapes of a form: location and half width, relative to the range; or the number of cycles."""
    if kind == "cycle":
        return (Shape("cycles", "1", *CYCLE_RANGE, ragged=True),)
    if kind == "line":
        return ()
    # The time of a step is common to all channels of a device. The evidence of a kink is unimodal in its location.
    is_step = kind == "jump" and is_time
    place = Shape("place", "1", *LOCATIONS, scale="linear", ragged=kind != "kink", shared=is_step)
    return (place,) if is_step else (place, Shape("width", "1", *HALF_WIDTHS))


def _evaluate_step_basis(covariate, frame, place, width=STEP_HALF_WIDTH):
    return 0.5 * xp.tanh((frame.position(covariate) - place) / width)


def _evaluate_line_basis(covariate, frame):
    return frame.position(covariate) - 0.5


def _evaluate_kink_basis(covariate, frame, place, width):
    distance = frame.position(covariate) - place
    return 0.5 * (distance + xp.sqrt(distance**2 + width**2))


def _evaluate_peak_basis(covariate, frame, place, width):
    return 1 / (1 + ((frame.position(covariate) - place) / width) ** 2)


def _evaluate_cycle_basis(covariate, frame, cycles):
    phase = 2 * math.pi * cycles * frame.position(covariate)
    return xp.stack([xp.sin(phase), xp.cos(phase)], axis=-1)


def _evaluate_constant_weights(amplitude):
    return amplitude


def make_standard_normals(unit: str, count: int) -> tuple[Coefficient, ...]:
    """Return coefficients with standard normal priors, which an amplitude parameter scales."""
    return tuple(Coefficient(unit, Normal(), part=f"{i + 1}") for i in range(count))


def _explain_untestable(covariate: str, readings: Measurements) -> str | None:
    count = np.unique(readings[covariate]).size
    noun = "times" if covariate == "time" else f"values of {covariate}"
    is_enough = count >= MIN_DISTINCT_VALUES
    return None if is_enough else f"needs {MIN_DISTINCT_VALUES} different {noun}; there are {count}"


_X = "x the position in the range of {covariate}"
_LINE_DOC = "Return an effect linear in a column."
_STEP_DOC = "Return an effect that steps by a at one time, or near one value of a column."
_KINK_DOC = "Return an effect whose slope along a column changes by a near one value of it."
_PEAK_DOC = "Return an effect with a peak of height a at one value of a column, as of a resonance."
_CYCLE_DOC = "Return an effect that is sinusoidal in time."
line: Form = _make_factory("line", f"a·(x − ½),  {_X}", _evaluate_line_basis, _LINE_DOC)
jump: Form = _make_factory("jump", "−a/2 {}, a/2 {} it", _evaluate_step_basis, _STEP_DOC)
kink: Form = _make_factory("kink", f"a·max(0, x − p),  {_X}", _evaluate_kink_basis, _KINK_DOC)
peak: Form = _make_factory("peak", f"a/(1 + ((x − p)/w)²),  {_X}", _evaluate_peak_basis, _PEAK_DOC)
cycle: Form = _make_factory("cycle", "a·sin(2π·cycles·t + φ)", _evaluate_cycle_basis, _CYCLE_DOC)

TIME_FORMS = ("time, jump", "time, cycle")
FORMS = {"line": line, "jump": jump, "kink": kink, "peak": peak}  # along a column
