"""Noise laws that a record can distinguish, and their evidence on residuals at fixed coefficients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bayescal._core.parallel import run_on_one_thread
from bayescal._core.settings import settings
from bayescal._inference.density import Density
from bayescal._inference.laplace import fit_at_mode, select_start
from bayescal._inference.newton import HessianGuess, maximise
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.channel_at_rest import CHANNEL
from bayescal._model.effect import READING
from bayescal._model.frame import Frame
from bayescal._model.model import Model
from bayescal._model.noise_law import OFFERS, WHITE, Noise
from bayescal._model.parameters import Layout

# Fewest readings with which noise laws are compared: a fourth moment then has a standard uncertainty of one half.
MIN_READINGS = 30

# Starting coordinates of a law's parameters without an initial value.
STARTING_LEVELS = (-2.0, 0.0, 1.0)


def list_laws(model: Model, frame: Frame) -> dict[str, Noise]:
    """Return the alternative noise laws for a model, by name; {} if its law is not white or the readings are few.

    They are correlated noise, if there is a time column; sums of correlated terms, with the setting `finer_noise`;
    heavy-tailed noise; and scatter that depends on a column.
    """
    # Coefficients of single readings act as noise: with these, or with fixed noise, no other law is evaluated.
    has_reading_effects = any(c.per == READING for e in model.effects for c in e.coefficients)
    is_fixed = any(name in model.noise.parameters() for name, _ in model.fixed)
    if has_reading_effects or is_fixed or frame.size < MIN_READINGS or not model.noise.first:
        return {}
    scale = model.noise.parameters()[WHITE]
    laws = [law for offer_laws in OFFERS for law in offer_laws(scale, frame)]
    laws = [law for law in laws if not law.refines or settings().finer_noise]
    return {law.name: law for law in (*laws, *model.instrument.noise_laws)}


def log_prior(laws: Mapping[str, Noise], name: str) -> float:
    """Return the log prior odds of a law relative to the model's own law, whose prior probability is one half.

    The other half is divided equally among the other kinds of law, and within a kind among its laws.
    """
    if name not in laws:
        return 0.0
    # P(own law) = ½, P(law) = ½/(kinds·laws of its kind): their ratio.
    kinds = [law.law for law in laws.values()]
    return -math.log(len(set(kinds)) * kinds.count(laws[name].law))


class ResidualFit(NamedTuple):
    """A noise law fitted to residuals, without effects."""

    log_evidence: float
    start: dict[str, float]  # coordinates of its parameters at the maximum, by name
    covariance: np.ndarray | None = None  # covariance of the coordinates


NO_FIT = ResidualFit(-math.inf, {})


@run_on_one_thread
def fit_to_residuals(law: Noise, record: Record, previous: ResidualFit = NO_FIT) -> ResidualFit:
    """Fit a law to residuals (`Record.residual_record`) by the Laplace approximation, without effects.

    The log evidence is −∞ if all residuals are zero. The fit starts from a `previous` fit to other residuals, if given.
    """
    starts = _list_starts(law, record, previous.start)
    if not starts:
        return NO_FIT
    priors = law.parameters()
    points = [np.array([start[n] for n in priors]) for start in starts]
    problem, guess = Problem(Layout(Model(CHANNEL, (), law), ()), record), None
    if previous.covariance is not None:
        coordinates = np.array([previous.start[n] for n in priors])
        guess = HessianGuess(coordinates, np.linalg.inv(previous.covariance), True)
    density = Density(problem, problem.start, np.ones(0), guess=guess)
    # The climb stops at a hundredth of a nat: the evidence only ranks laws and the mode is a start.
    mode = fit_at_mode(density, maximise(density, select_start(density, points), math.inf), 0.0)
    coordinates_by_name = dict(zip(priors, mode.v.tolist(), strict=True))
    return ResidualFit(float(mode.log_evidence), coordinates_by_name, mode.covariance)


def _list_starts(law: Noise, record: Record, start: Mapping[str, float]) -> list[dict[str, float]]:
    """Return starting coordinates of a law's parameters, by name; [] if all residuals are zero.

    With `start`, the maximum found on other residuals: that point, and copies with one parameter at another level.
    Without: initial values of some parameters, combined with every level of the others.
    """
    priors = law.parameters()
    if start and np.any(record.y):
        is_unimodal = law.independent and law.is_gaussian
        others = () if is_unimodal else ({n: level} for n in priors for level in STARTING_LEVELS)
        return [{**start, **point} for point in ({}, *others)]
    starts = list[dict[str, float]]()
    for values in _choose_initial_values(law, record):
        fixed_levels = {n: [priors[n].coordinate(v)] for n, v in values.items()}
        levels = (fixed_levels.get(n, STARTING_LEVELS) for n in priors)
        starts += [dict(zip(priors, point, strict=True)) for point in itertools.product(*levels)]
    return starts


def _choose_initial_values(law: Noise, record: Record) -> list[dict[str, float]]:
    """Return starting values of some of a law's parameters; [] if all residuals are zero."""
    residuals = record.y
    scale = float(np.sqrt(np.mean(residuals**2)))
    if law.independent:
        # Robust standard deviation (1.5 × median absolute value), or the rms: one of both is near the maximum.
        scales = (scale, 1.5 * float(np.median(np.abs(residuals))))
        return [{next(iter(law.parameters())): s} for s in scales if s > 0]
    # Slow noise hardly changes between neighbouring readings: their differences are mainly those of the white part.
    sorted_residuals = residuals[record.time_order[0]]
    white_sd = float(np.median(np.abs(np.diff(sorted_residuals)))) or scale
    starts = law.starts(record.frame.sort_by_time(), sorted_residuals) if white_sd > 0 else []
    return [{WHITE: white_sd, **values} for values in starts]
