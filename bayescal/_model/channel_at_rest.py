"""A channel whose true input does not change: levels of runs, and a cubic over temperature; the rest is noise.

Its priors are flat: the evidence of noise laws is that of the restricted likelihood.
Source: D. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).
"""

from __future__ import annotations

from typing import Any

from bayescal._core.xp import xp
from bayescal._data.column import Column
from bayescal._model.effect import Coefficient, Effect
from bayescal._model.frame import Frame
from bayescal._model.instrument import Instrument, Slot, Slots
from bayescal._model.prior import Flat

DEGREE = 3  # of the polynomial over temperature: a sensor's own law is rarely of more in one soak


def _one(r: Frame) -> float:
    return 1.0


def _at_rest(slots: Slots, r: Frame) -> Any:
    return slots["rest"]


def _curve(r: Frame) -> Any:
    """Legendre's polynomials of the temperature's place in its range, without the constant."""
    z = 2 * r.position("temperature") - 1
    return xp.stack([z, 1.5 * z**2 - 0.5, 2.5 * z**3 - 1.5 * z], axis=-1)


LEVEL = Effect(
    "rest.level",
    "rest",
    basis=_one,
    coefficients=(Coefficient("1", Flat(), per="run"),),
    columns=("run",),
    equation="c[run]",
    source="the instrument does not move",
)
CURVE = Effect(
    "rest.temperature",
    "rest",
    basis=_curve,
    coefficients=tuple(Coefficient("1", Flat(), part=f"P{k}") for k in range(1, DEGREE + 1)),
    columns=("temperature",),
    equation="c1·P1(T) + c2·P2(T) + c3·P3(T)",
    source="Legendre's polynomials over the range of the temperature",
)
CHANNEL = Instrument(
    name="channel_at_rest",
    title="a channel at rest, its output in whatever unit it has",
    columns=(
        Column("run", None),
        Column("time", "s"),
        Column("temperature", "degC", required=False),
        Column("output", "1"),
    ),
    slots=(Slot("rest", "1", "the output at rest"),),
    response=_at_rest,
    effects=(LEVEL,),
    candidates=(CURVE,),
)
