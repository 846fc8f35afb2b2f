"""Real laws depart a little from any catalogue's form: each named effect may carry a smooth departure, tied to it.

With enough readings a free curve would imitate such a law better than its formula does, and be found in its place. A
departure is a hundredth to a third of what the effect contributes beyond what the rest of the model can take up: too
small to stand in for another effect. An effect has one or not with the same prior probability, and
none where it could be a candidate of another covariate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from bayescal._calibration.settings import searching
from bayescal._core.formatting import number
from bayescal._core.parallel import on_one_thread
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.linear_model import LinearModel, taken_up
from bayescal._inference.record import Record
from bayescal._inference.terms import ColumnsOf
from bayescal._model.departure import Departure, Rows, curves_along, departure, rounded
from bayescal._model.effect import Effect
from bayescal._model.unknown_effect import LENGTHS, process_weights

SEEN = 1e-10  # of the curves' largest square, below which a direction of them is rounding
LEAST_LEFT = 1e-4  # of a curve's squares, below which nothing of it could be seen
LEVELS = ndtri([1 / 6, 1 / 2, 5 / 6])  # of its amplitude and length, at which a departure is scored
_MIDDLE = math.sqrt(LENGTHS[0] * LENGTHS[1])  # of a process's plausible lengths


class Form(NamedTuple):
    """How the departure of a named effect runs on a record: see `Departure`.

    Attributes:
        effect: the named one.
        at, shares: of the departure.
        left: of its squares, what the base model does not take up.
    """

    effect: Effect
    at: tuple[tuple[str, float], ...]
    shares: Rows
    left: float

    def departure(self, unit: str, contribution: float) -> Departure:
        """For a contribution of this size, in the slot's unit."""
        size = contribution / math.sqrt(max(self.left, LEAST_LEFT))
        return departure(self.effect, unit, size, self.at, self.shares)


class ScoredDeparture(NamedTuple):
    """A departure, the log Bayes factor expected of it, and where its refit may begin."""

    effect: Departure
    gain: float
    hint: dict[str, float]


def may_depart(effect: Effect, record: Record, correlated: bool) -> bool:
    """Whether an effect has a covariate that these readings vary; beside correlated noise, time is none."""
    along, reference = effect.departs_along, record.frame.reference
    if not along or (correlated and along == "time") or f"{along}_low" not in reference:
        return False
    return float(reference[f"{along}_high"]) > float(reference[f"{along}_low"])


@on_one_thread
def form_of(base: LinearModel, effect: Effect) -> Form | None:
    """How an effect's departure runs beside a base model; None where this takes up the effect itself."""
    at = _usual_shapes(effect)
    white, curves = _white_columns(base, effect), _white_curves(base, effect)
    taken, of_curves = base.projected(white), base.projected(curves)
    # (I − P)-products as below, of the effect's own columns and of the curves: regression of the curves on the
    # columns, which is taken off them. So the departure explains nothing that the effect or the base model could.
    inner = white.T @ white - taken.T @ taken
    cross = white.T @ curves - taken.T @ of_curves
    if not np.all(np.diag(inner) > LEAST_LEFT**2 * np.sum(white**2, axis=0)):
        return None
    shares = np.linalg.lstsq(inner, cross, rcond=None)[0]
    # Of the prior variance of the curves, at the middle of the plausible lengths, the share that was not taken off.
    weight = process_weights(_MIDDLE, curves.shape[1]) ** 2
    left = np.sum(curves**2, axis=0) - np.sum(of_curves**2, axis=0) - np.sum(shares * cross, axis=0)
    kept = tuple(tuple(rounded(float(v)) for v in row) for row in shares)
    return Form(effect, at, kept, float(weight @ left / (weight @ np.sum(curves**2, axis=0))))


@on_one_thread
def could_be_another(base: LinearModel, effect: Effect, others: Iterable[Effect]) -> bool:
    """Whether a departure could stand for an effect of another covariate, of which it is a function in this record.

    Where every run has one temperature profile, all that is thermal is a function of the time within a run.
    """
    curves = _white_curves(base, effect)
    of_curves = base.projected(curves)
    # (I − P)-products, P the projection on the base model's columns: G of the curves, g of these with a column c.
    gram = np.linalg.pinv(curves.T @ curves - of_curves.T @ of_curves, SEEN, hermitian=True)
    for other in others:
        if other.is_placeholder or other.coefficients[0].per is not None:
            continue
        if other.departs_along == effect.departs_along:
            continue
        column = _white_columns(base, other)[:, :1]
        taken = base.projected(column)
        squares = float(np.sum(column**2) - np.sum(taken**2))
        cross = curves.T @ column - of_curves.T @ taken
        # gᵀG⁻¹g is the squared length of c's projection on the curves: their cosine, squared, times c's.
        visible = squares > LEAST_LEFT * np.sum(column**2)
        if visible and (cross.T @ gram @ cross).item() > searching().alike ** 2 * squares:
            return True
    return False


def _usual_shapes(effect: Effect) -> tuple[tuple[str, float], ...]:
    """Medians of the shapes that an effect's columns have."""
    return tuple((s.name, rounded(float(s.prior.value(0.0)))) for s in effect.column_shapes)


def _white_columns(base: LinearModel, effect: Effect) -> np.ndarray:
    """An effect's columns at its usual shapes, whitened (n, terms)."""
    values = tuple(v for _, v in _usual_shapes(effect))
    columns = base.assembly.record.columns(ColumnsOf.of(effect), values)
    return base.whiten(base.slopes[effect.slot][:, None] * columns)


def _white_curves(base: LinearModel, effect: Effect) -> np.ndarray:
    """The process along an effect's covariate, whitened (n, p)."""
    curves = base.assembly.record.columns(ColumnsOf(curves_along(effect), (), ()), ())
    return base.whiten(base.slopes[effect.slot][:, None] * curves)


@on_one_thread
def scored(line: LinearModel, form: Form) -> ScoredDeparture | None:
    """The departure of one effect of a fitted structure; None where this contributes nothing."""
    effect, record = form.effect, line.assembly.record
    slope = line.slopes[effect.slot]
    steep = float(np.sqrt(np.mean(slope**2)))
    size = contribution(line, effect.name) / steep if steep > 0 else 0.0
    if not size > 0:
        return None
    made = form.departure(record.instrument.slot(effect.slot).unit, size)
    columns = line.whiten(slope[:, None] * record.columns(ColumnsOf.of(made), ()))
    inside = line.projected(columns)
    information = columns.T @ columns - inside.T @ inside
    u = columns.T @ line.white_residual
    best, shapes, gains = ScoredDeparture(made, -math.inf, {}), made.shapes, []
    # The score's mean over amplitude and length, at the middles of thirds of either prior.
    for at in np.stack(np.meshgrid(*[LEVELS] * len(shapes)), axis=-1).reshape(-1, len(shapes)):
        values = {s.name: float(s.prior.value(v)) for s, v in zip(shapes, at, strict=True)}
        sd = made.weights(**values)  # pyright: ignore[reportOptionalCall]
        gains.append(_gain(line, sd * u, sd[:, None] * information * sd))
        if gains[-1] > best.gain:
            named = {made.shape_name(s): float(v) for s, v in zip(shapes, at, strict=True)}
            best = best._replace(gain=gains[-1], hint=named)
    return best._replace(gain=float(np.logaddexp.reduce(gains)) - math.log(len(gains)))


def _gain(line: LinearModel, u: np.ndarray, information: np.ndarray) -> float:
    """Log Bayes factor of columns of standard normal coefficients, the noise as large as it then likely is."""
    volume, taken = taken_up(u, information)
    return -volume - 0.5 * line.size * math.log(max(1 - taken / line.rest, 1e-12))


def contribution(line: LinearModel, name: str) -> float:
    """What an effect contributes that the rest of the model does not take up, rms over the readings, output unit."""
    plain, white, left = _beyond_the_rest(line, name)
    # Of the effect's own squares the share that the rest of the model leaves: an alias of the rest contributes
    # nothing, and a departure tied to it has no size.
    length = float(white @ white)
    share = max(float(white @ left) / length, 0.0) if length > 0 else 0.0
    return float(np.sqrt(np.mean(plain**2) * share))


def _beyond_the_rest(line: LinearModel, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An effect's contribution, output unit; whitened; and what the rest of the model leaves of this."""
    own, plain = np.array([owner == name for owner in line.owners]), line.contribution(name)
    white = line.whiten(plain[:, None])[:, 0]
    return plain, white, line.beyond(white, ~own)


@dataclass(frozen=True)
class Departed:
    """How far a real law departs from the form of a named effect.

    Attributes:
        effect: its name.
        along: the covariate.
        share: of what the effect contributes beyond the rest of the model, rms over rms.
        at: where it departs the most, in the covariate's `unit`.
    """

    effect: str
    along: str
    share: float
    at: float
    unit: str

    def __str__(self) -> str:
        where = f"{number(self.at)} {unit_label(self.unit)}".rstrip()
        return f"{self.effect} departs from its form by {self.share:.1%} of it, the most at {self.along} {where}"


def departed(line: LinearModel, departure: Departure) -> Departed:
    """A departure of a fitted structure, in numbers."""
    name = departure.of
    frame, along = line.assembly.record.frame, departure.along or ""
    # Where it is largest of what only the departure explains: elsewhere the effect itself would have followed.
    left = _beyond_the_rest(line, departure.name)[2]
    worst = int(np.argmax(np.abs(left)))
    share = contribution(line, departure.name) / contribution(line, name)
    if along in frame.columns:
        units = {c.name: c.unit for c in line.assembly.record.instrument.columns}
        at, unit = float(frame.columns[along][worst]), units.get(along) or ""
    else:
        at, unit = 60 * float(frame.rates[along.removesuffix(" rate")][worst]), "degC/min"
    return Departed(name, along, share, at, unit)
