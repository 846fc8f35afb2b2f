"""What no named effect describes: an unknown smooth dependence on one covariate, a Gaussian process.

Its columns are the eigenfunctions of the Laplacian on an interval somewhat wider than the covariate's range, weighted
with the root of the process's spectral density (Solin & Särkkä, Stat. Comput. 30 (2020) 419): linear in standard normal
coefficients, given its length and amplitude, which are shapes.
"""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp

from bayescal._model.coefficient import Coefficient, Shape
from bayescal._model.effect import Effect
from bayescal._model.prior import Normal

TERMS = 12  # eigenfunctions: enough for lengths down to a tenth of the range
LENGTHS = (0.1, 0.8)  # plausible lengths of the process, in parts of the range
# A dependence on a temperature is smooth; in time there are cycles and jumps.
TERMS_IN_TIME = 36
LENGTHS_IN_TIME = (0.03, 0.8)
WIDER = 1.5  # interval over range


@functools.cache  # the same dependence is the same object, so that what was compiled for it serves again
def unknown(
    covariate: str, slot: str, low: float, high: float, unit: str, *, name: str = ""
) -> Effect:
    """An unknown smooth dependence of a slot on a covariate: its amplitude and length are learned.

    Args:
        covariate: a numeric column, "elapsed" (time within the run), or "temperature rate".
        low, high: plausible amplitudes (standard deviation over the range), in `unit`.
        name: canonical; `unknown(covariate)` if not given.
    """

    in_time = covariate in ("time", "elapsed")
    terms = TERMS_IN_TIME if in_time else TERMS

    def basis(r, length, amplitude):
        # −1 … 1 over the range; at the ends of the wider interval the function is 0, and so it stays beyond
        centred = jnp.clip(2 * r.position(covariate) - 1, -WIDER, WIDER)
        order = jnp.arange(1, terms + 1) * math.pi / (2 * WIDER)
        scale = 2 * length
        root = jnp.sqrt(scale * math.sqrt(2 * math.pi)) * jnp.exp(-((scale * order) ** 2) / 4)
        waves = jnp.sin(order * (centred[:, None] + WIDER)) / math.sqrt(WIDER)
        return amplitude * root * waves

    measured = covariate.removesuffix(" rate")
    derived = covariate in ("elapsed", f"{measured} rate")
    columns = ("time",) if covariate == "elapsed" else (measured,)
    return Effect(
        name or f"unknown({covariate})",
        slot,
        basis,
        coefficients=tuple(Coefficient(unit, Normal(), part=f"{i + 1}") for i in range(terms)),
        shapes=(
            Shape("length", "1", *(LENGTHS_IN_TIME if in_time else LENGTHS)),
            Shape("amplitude", unit, low, high),
        ),
        measure="amplitude",
        columns=columns + (("time",) if derived and covariate != "elapsed" else ()),
        varies=() if covariate == "elapsed" else (measured,),
        equation=f"f({covariate}),  f a Gaussian process",
        source="ours: not in the catalogue; find out what it is, and name it",
    )
