"""Noise laws that a record can tell, and what each is expected to gain on residuals, coefficients held."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bayescal._core.parallel import on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.laplace import best_start, fit_at_mode
from bayescal._inference.newton import Nearby, climb
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.channel_at_rest import CHANNEL
from bayescal._model.effect import READING
from bayescal._model.frame import Frame
from bayescal._model.model import Model
from bayescal._model.noise_law import OFFERS, WHITE, Noise
from bayescal._model.parameters import Layout

# Readings from which a noise law can be told at all: a fourth moment is then known to a half.
FEWEST_FOR_NOISE = 30

# Coordinates of a law's further parameters, at which a maximum is looked for first.
LEVELS = (-2.0, 0.0, 1.0)


def laws_over(model: Model, frame: Frame) -> dict[str, Noise]:
    """Return further noise laws of a model, by name; none where its own is not white or readings are few.

    Correlated, where there is time, and sums of such terms if asked for; heavy tails; scatter that follows a column.
    """
    # Coefficients of single readings are noise by another name: beside them, or with the noise held, none is weighed.
    together = any(c.per == READING for e in model.effects for c in e.coefficients)
    fixed = any(name in model.noise.parameters() for name, _ in model.fixed)
    if together or fixed or frame.size < FEWEST_FOR_NOISE or not model.noise.first:
        return {}
    scale = model.noise.parameters()[WHITE]
    laws = [law for offer in OFFERS for law in offer(scale, frame)]
    laws = [law for law in laws if not law.refines or settings().finer_noise]
    return {law.name: law for law in (*laws, *model.instrument.noise_laws)}


def log_prior(laws: Mapping[str, Noise], name: str) -> float:
    """Return a law's log prior odds against the model's own, which has probability one half.

    The other kinds share the other half, columns that the scatter may follow one of these shares.
    """
    if name not in laws:
        return 0.0
    # P(own law) = ½, P(law) = ½/(kinds·laws of its kind): their ratio.
    kinds = [law.law for law in laws.values()]
    return -math.log(len(set(kinds)) * kinds.count(laws[name].law))


class OnResiduals(NamedTuple):
    """Log evidence of a noise law alone; coordinates of its parameters at the maximum, by name; their covariance."""

    log_evidence: float
    hint: dict[str, float]
    covariance: np.ndarray | None = None


NO_FIT = OnResiduals(-math.inf, {})


@on_one_thread
def on_residuals(law: Noise, record: Record, near: OnResiduals = NO_FIT) -> OnResiduals:
    """Fit a law to residuals (`Record.of_noise`) by Laplace, without effects.

    There is no evidence where nothing is left. Its maximum on other residuals may be `near`.
    """
    starts = _starts(law, record, near.hint)
    if not starts:
        return NO_FIT
    priors = law.parameters()
    at = [np.array([start[n] for n in priors]) for start in starts]
    alone = Problem(Layout(Model(CHANNEL, (), law), ()), record)
    like = None
    if near.covariance is not None:
        coordinates = np.array([near.hint[n] for n in priors])
        like = Nearby(coordinates, np.linalg.inv(near.covariance), True)
    density = Density(alone, alone.start, np.ones(0), like=like)
    # What is only a hint is found to a hundredth of a nat.
    mode = fit_at_mode(density, climb(density, best_start(density, at), math.inf), 0.0)
    hint = dict(zip(priors, mode.v.tolist(), strict=True))
    return OnResiduals(float(mode.log_evidence), hint, mode.covariance)


def _starts(law: Noise, record: Record, near: Mapping[str, float]) -> list[dict[str, float]]:
    """Return starting coordinates of a law's parameters, by name; none where all residuals are zero.

    What is known of some, beside every combination of levels of the others; where a maximum was on other residuals,
    that, and it with one parameter at another level.
    """
    priors = law.parameters()
    if near and np.any(record.y):
        one_hill = law.independent and law.gaussian
        others = () if one_hill else ({n: level} for n in priors for level in LEVELS)
        return [{**near, **point} for point in ({}, *others)]
    stated = [{n: priors[n].coordinate(v) for n, v in s.items()} for s in _stated(law, record)]
    return [
        dict(zip(priors, point, strict=True))
        for some in stated
        for point in itertools.product(*([some[n]] if n in some else LEVELS for n in priors))
    ]


def _stated(law: Noise, record: Record) -> list[dict[str, float]]:
    """Return starting values of some of a law's parameters; none where all residuals are zero."""
    residuals = record.y
    scale = float(np.sqrt(np.mean(residuals**2)))
    if law.independent:
        # 1.5 times the median absolute value is the standard deviation that outliers have not widened; the rms is
        # that of the law without outliers. One of them is near the maximum.
        scales = (scale, 1.5 * float(np.median(np.abs(residuals))))
        return [{next(iter(law.parameters())): s} for s in scales if s > 0]
    # Slow noise hardly moves from one reading to the next: differences of neighbours are about the white part's.
    in_time = residuals[record.in_time[0]]
    narrow = float(np.median(np.abs(np.diff(in_time)))) or scale
    starts = law.starts(record.frame.in_time(), in_time) if narrow > 0 else []
    return [{WHITE: narrow, **some} for some in starts]
