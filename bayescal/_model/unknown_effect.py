"""Placeholders: an unknown dependence on one covariate, smooth, straight, with a step, a kink or a peak; in time a
step or a periodic form.

They stand beside the instrument and not in the catalogue, because the language of models has a word for them:
`model + "unknown(humidity)"`. Each is linear in coefficients whose sizes the amplitude gives. What amplitudes are
plausible is taken from the readings that the model meets, where low and high are not given. `bayescal.effects` offers
the same functions.

The smooth one is a Gaussian process. Its columns are the eigenfunctions of the Laplacian on an interval somewhat wider
than the covariate's range, weighted with the root of the process's spectral density (Solin & Särkkä, Stat. Comput. 30
(2020) 419). It follows steps and periodic forms too, but spends most of its freedom on what is not there: a record that
steps once, or goes up and down evenly, is then more probable as correlated noise. Hence the forms of few shapes and one
or two coefficients. A line, a step, a kink or a peak along a column is a form of the smooth dependence on it: a search
weighs them in its place. Beyond the record a step stays, and a periodic form goes on.
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
from bayescal._model.frame import measured_column
from bayescal._model.prior import Normal

# Eigenfunctions and plausible lengths in parts of the range, enough of those for the shorter ones of these; in time,
# where there are periodic forms and steps, more and shorter ones.
RESOLUTION = {False: (12, (0.1, 0.8)), True: (36, (0.03, 0.8))}
WIDER_RATIO = 1.5  # interval over range: at its ends the function is 0, and so it stays beyond

PLACES = (0.05, 0.95)  # of a step, in parts of the record
SHARP = 0.01  # half width of a step in time, in parts of the record: as good as sudden, and its place has a slope
WIDTHS = (SHARP, 0.2)  # half widths along a column, in parts of its range
CYCLES = (1.5, 15.0)  # in the record
FEWEST_TIMES = 30  # different times, twice the most cycles: fewer leave a period undetermined

SOURCE = "ours: not in the catalogue; find out what it is, and name it"
FREED = ".freed"  # after the name of an effect: its own, once more, with a wide prior
Form = Callable[..., Effect]
_NAME = re.compile(r"unknown\((.+)\)", re.DOTALL)


def covariate_in(name: str) -> str | None:
    """Parse the covariate, with its form if any, from a placeholder's canonical name; None for any other effect."""
    match = _NAME.fullmatch(name)
    return ", ".join(filter(None, along_and_form(match[1]))) if match else None


def along_and_form(covariate: str) -> tuple[str, str]:
    """Split "humidity, line" into column and form; a column's own name may hold commas, and then has no form."""
    along, _, form = (part.strip() for part in covariate.rpartition(","))
    return (along, form) if along and form in (*FORMS, "cycle") else (covariate.strip(), "")


def placeholder(covariate: str, slot: str, unit: str) -> Effect:
    """Return placeholder for a covariate, and for its forms, such as "humidity, line", ", peak" or "time, cycle"."""
    along, form = along_and_form(covariate)
    if form == "cycle" and along == "time":
        return cycle(slot, *OPEN, unit)
    if form in FORMS:
        return FORMS[form](slot, *OPEN, unit, covariate=along)
    return unknown(covariate, slot, *OPEN, unit)


def freed(effect: Effect, times: float = 1.0) -> Effect:
    """Return a copy of an effect to add beside it, its prior `times` as wide: its stated value may be wrong."""
    coefficients = tuple(replace(c, prior=Normal(0.0, times * c.size)) for c in effect.coefficients)
    return replace(
        effect,
        name=effect.name + FREED,
        frees=effect.name,
        forms=(),
        family="",
        coefficients=coefficients,
        equation=f"{effect.equation or 'c'}, beside its stated value",
        source=f"ours: the stated value of {effect.name} may be wrong",
    )


def process_columns(position: Any, terms: int) -> Any:
    """Return columns Φ with Φ·diag(w²)·Φᵀ ≈ squared-exponential kernel, w by `process_weights`; positions 0 to 1."""
    centred = xp.clip(2 * position - 1, -WIDER_RATIO, WIDER_RATIO)
    order = xp.arange(1, terms + 1) * math.pi / (2 * WIDER_RATIO)
    return xp.sin(order * (centred[..., None] + WIDER_RATIO)) / math.sqrt(WIDER_RATIO)


def process_weights(length: Any, terms: int) -> Any:
    """Return standard deviations of columns' coefficients, for a process of unit amplitude and a length in ranges."""
    order = np.arange(1, terms + 1) * math.pi / (2 * WIDER_RATIO)
    scale = 2 * length
    return xp.sqrt(scale * math.sqrt(2 * math.pi)) * xp.exp(-((scale * order) ** 2) / 4)


@functools.cache  # the same dependence is the same object, so that what was compiled for it serves again
def unknown(
    covariate: str, slot: str, low: float, high: float, unit: str, *, name: str = ""
) -> Effect:
    """Return an unknown smooth dependence of a slot on a covariate: its amplitude and length are learned.

    Args:
        covariate: a numeric column, "elapsed" (time within the run), or "temperature rate".
        low, high: plausible amplitudes (standard deviation over the range), in `unit`; `*OPEN` takes them from
            the readings.
        name: canonical; `unknown(covariate)` if not given.
    """
    terms, lengths = RESOLUTION[covariate in ("time", "elapsed")]
    measured = measured_column(covariate)
    derived = covariate in ("elapsed", f"{measured} rate")
    columns = ("time",) if covariate == "elapsed" else (measured,)
    return Effect(
        name or f"unknown({covariate})",
        slot,
        value_partial(process_along, covariate, terms),
        coefficients=standard_normals(unit, terms),
        shapes=(Shape("length", "1", *lengths), Shape("amplitude", unit, low, high)),
        weights=value_partial(process_sizes, terms),
        measure="amplitude",
        columns=columns + (("time",) if derived and covariate != "elapsed" else ()),
        varies=() if covariate == "elapsed" else (measured,),
        equation=f"f({covariate}),  f a Gaussian process",
        source=SOURCE,
        along=covariate,
        kind="curve",
    )


def process_along(covariate: str, terms: int, r: Any) -> Any:
    """Evaluate `process_columns` along a covariate, as a basis: same for any amplitude, so that one program serves."""
    return process_columns(r.position(covariate), terms)


def process_sizes(terms: int, length: Any, amplitude: Any) -> Any:
    """Return the `weights` of an effect whose columns are a process's, of learned length and amplitude."""
    return amplitude * process_weights(length, terms)


def _form(kind: Kind, words: str, basis: Callable[..., Any], says: str) -> Form:
    """Return a factory of a form along a column; the last of its shapes is the amplitude of its coefficients."""

    @functools.cache
    def make_form(
        slot: str, low: float, high: float, unit: str, *, covariate: str = "time", name: str = ""
    ) -> Effect:
        in_time = covariate == "time"
        sides = ("before one moment", "after") if in_time else (f"below one {covariate}", "above")
        return Effect(
            name or f"unknown({covariate}, {kind})",
            slot,
            value_partial(basis, covariate),
            coefficients=standard_normals(unit, 2 if kind == "cycle" else 1),
            shapes=(*_shapes(kind, in_time), Shape("amplitude", unit, low, high)),
            weights=_even,
            measure="amplitude",
            columns=(covariate,),
            varies=(covariate,),
            untestable=functools.partial(_too_few, covariate),
            equation=words.format(*sides, covariate=covariate),
            source=SOURCE,
            along="" if in_time else covariate,
            family="" if in_time else f"unknown({covariate})",
            kind=kind,
        )

    make_form.__name__ = make_form.__qualname__ = kind
    make_form.__doc__ = f"""{says}

    Args:
        slot: that it adds to.
        low, high: plausible amplitudes a, in `unit`; `*OPEN` takes them from the readings.
        unit: of the slot.
        covariate: the column along which it goes.
        name: canonical; `unknown(humidity, {kind})` if not given, with the column's name.
    """
    return make_form


def _shapes(kind: Kind, in_time: bool) -> tuple[Shape, ...]:
    """Return shapes: place and half width of a step, a kink or a peak, in parts of the range; or number of cycles."""
    if kind == "cycle":
        return (Shape("cycles", "1", *CYCLES, ragged=True),)
    if kind == "line":
        return ()
    # A moment is the same in all channels of a unit, and sudden. A kink's evidence is smooth in its place.
    sudden = kind == "jump" and in_time
    place = Shape("place", "1", *PLACES, scale="linear", ragged=kind != "kink", shared=sudden)
    return (place,) if sudden else (place, Shape("width", "1", *WIDTHS))


def _step(covariate, r, place, width=SHARP):
    return 0.5 * xp.tanh((r.position(covariate) - place) / width)


def _straight(covariate, r):
    return r.position(covariate) - 0.5


def _hinge(covariate, r, place, width):
    beyond = r.position(covariate) - place
    return 0.5 * (beyond + xp.sqrt(beyond**2 + width**2))


def _lorentzian(covariate, r, place, width):
    return 1 / (1 + ((r.position(covariate) - place) / width) ** 2)


def _waves(covariate, r, cycles):
    angle = 2 * math.pi * cycles * r.position(covariate)
    return xp.stack([xp.sin(angle), xp.cos(angle)], axis=-1)


def _even(amplitude):
    return amplitude


def standard_normals(unit: str, count: int) -> tuple[Coefficient, ...]:
    """Return coefficients with standard normal priors, whose sizes an amplitude gives."""
    return tuple(Coefficient(unit, Normal(), part=f"{i + 1}") for i in range(count))


def _too_few(covariate: str, readings: Measurements) -> str | None:
    count = np.unique(readings[covariate]).size
    what = "times" if covariate == "time" else f"values of {covariate}"
    enough = count >= FEWEST_TIMES
    return None if enough else f"needs {FEWEST_TIMES} different {what}; there are {count}"


_X = "x the position in the range of {covariate}"
_LINES = "A slot's value is proportional to a column."
_STEPS = "A slot's value steps by a at one moment, or about one value of a column, and stays."
_BENDS = "A slot's slope along a column changes about one value of it, by a over its range."
_PEAKS = "A slot's value has a peak of height a at one value of a column, as of a resonance."
_TURNS = "A slot's value goes up and down evenly in time."
line: Form = _form("line", f"a·(x − ½),  {_X}", _straight, _LINES)
jump: Form = _form("jump", "−a/2 {}, a/2 {} it", _step, _STEPS)
kink: Form = _form("kink", f"a·max(0, x − p),  {_X}", _hinge, _BENDS)
peak: Form = _form("peak", f"a/(1 + ((x − p)/w)²),  {_X}", _lorentzian, _PEAKS)
cycle: Form = _form("cycle", "a·sin(2π·cycles·t + φ)", _waves, _TURNS)

IN_TIME = ("time, jump", "time, cycle")
FORMS = {"line": line, "jump": jump, "kink": kink, "peak": peak}  # along a column
