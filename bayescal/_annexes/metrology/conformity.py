"""Limits as text, the limited quantity, and its probability of conformity.

A limit ("bias: ±0.5 °/s", "corrected reading: ±0.1 °/s over -20..60 °C") is on one of three:

- "corrected reading": corrected reading minus what acts, with the noise of one reading; "corrected mean": the same
  without, as the mean of many readings has it. The correction is made with the posterior mean, as exports make it.
- A slot, such as "bias": what all effects on it come to in use, for a run, cell or device that is new unless it is
  named, so that its deviation counts.
- An unknown, such as "bias.temperature", "bias.run.group_sd" or "noise.white", by the name that a calibration prints.

The first two are values at an operating point: covariates at the middle of their calibrated range, rates and lags
zero, the time that of the last reading, unless the limit says otherwise. Of y with limits [T_L, T_U] follow

- the probability of conformity p_c = P(T_L ≤ y ≤ T_U) (JCGM 106:2012, 7.2) and the specific risk: 1 − p_c of what is
  accepted, p_c of what is rejected (3.3.13 and 3.3.14);
- the acceptance interval [A_L, A_U] of a stated probability α of false acceptance: all estimates with which, had the
  posterior the same form about them, p_c ≥ 1 − α; the guard bands are w = T_U − A_U and A_L − T_L (8.3.2);
- the global risks (9.4 and 9.5): averages over items y ~ N(y₀, u₀²), each measured with standard uncertainty u.

A curve conforms where all of it does: each draw counts by its lowest and highest value. A quantity that scatters (a
reading) conforms with the probability of one reading at the least favourable place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

import bayescal as bc
from bayescal import workshop as ws

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = rf"(?P<low>{_NUMBER})\s*(?:\.\.|…|to\b)\s*(?P<high>{_NUMBER})"
_TOLERANCE = re.compile(
    rf"(?:(?P<centre>{_NUMBER})?\s*±\s*(?P<half>{_NUMBER})|≤\s*(?P<most>{_NUMBER})|≥\s*(?P<least>{_NUMBER})|{_RANGE})"
    r"(?P<unit>.*)"
)
_OVER = re.compile(rf"(?P<name>.*?)\s*{_RANGE}(?P<unit>.*)")
_AT = re.compile(rf"(?P<name>.+?)\s*=\s*(?P<value>{_NUMBER})(?P<unit>.*)")
_WRITTEN = {"+/-": "±", "+-": "±", "<=": "≤", ">=": "≥", "−": "-", "–": "-"}
FORM = (
    'write "bias: ±0.5 °/s", "noise.white: ≤ 0.1 °/s", "scale: -300..300 ppm" or "corrected reading: ±0.1 °/s over '
    '-20..60 °C"'
)


class LimitedRange(NamedTuple):
    """A range over which a limit holds, or one value: `low` to `high` of the column `name`, "" where it is not said."""

    name: str
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class StatedLimit:
    """A limit on a quantity, as it was written."""

    quantity: str  # "corrected reading", "corrected mean", a slot of the instrument such as "bias", or an unknown
    low: float  # low, high: the tolerance limits, in `unit`; infinite where there is none
    high: float
    unit: str  # as written; "" for a number without one
    over: tuple[LimitedRange, ...] = ()  # where it holds
    text: str = ""  # as written


def stated_limit(text: str) -> StatedLimit:
    """Parse a limit.

    A quantity, a colon, limits (±A, C ± A, ≤ B, ≥ A, A..B) and their unit; then, if need be, "over" a range of a
    column, "at" a value of one, and more of these after "and": "over temperature -20..60 °C and rate_input
    -90..90 °/s".

    Raises:
        InputError: the text is none; says what is wrong with it.
    """
    quantity, colon, terms = text.rpartition(":")
    if not (colon and quantity.strip() and terms.strip()):
        raise bc.InputError(f"limit {text!r} lacks a quantity, a colon or limits: {FORM}")
    for written, sign in _WRITTEN.items():
        terms = terms.replace(written, sign)
    interval, *places = re.split(r"\b(over|at)\b", terms)
    low, high, unit = _tolerance(interval.strip(), text)
    over: list[LimitedRange] = []
    for kind, place in zip(places[::2], places[1::2], strict=True):
        over += [_span(kind, part.strip(), text) for part in re.split(r"\band\b", place)]
    if not low < high or (math.isinf(low) and math.isinf(high)):
        why = f"limit {text!r}: the lower limit {low:g} is not below the upper {high:g}"
        raise bc.InputError(why)
    return StatedLimit(quantity.strip(), low, high, unit, tuple(over), text.strip())


def _tolerance(interval: str, text: str) -> tuple[float, float, str]:
    match = _TOLERANCE.fullmatch(interval)
    if match is None:
        raise bc.InputError(f"limit {text!r}: {interval!r} are no limits: {FORM}")
    unit = _unit(match["unit"], text)
    if match["half"]:
        centre, half = float(match["centre"] or 0.0), float(match["half"])
        return centre - half, centre + half, unit
    low, high = match["low"] or match["least"], match["high"] or match["most"]
    return float(low or -math.inf), float(high or math.inf), unit


def _span(kind: str, place: str, text: str) -> LimitedRange:
    match = (_AT if kind == "at" else _OVER).fullmatch(place)
    if match is None:
        form = "at temperature = 25 °C" if kind == "at" else "over temperature -20..60 °C"
        raise bc.InputError(f"limit {text!r}: {place!r} is no place: write {form}")
    low, high = (float(match[end]) for end in (("value",) * 2 if kind == "at" else ("low", "high")))
    if kind == "over" and not -math.inf < low < high < math.inf:
        raise bc.InputError(f"limit {text!r}: {place!r} is no range from a number to a larger one")
    return LimitedRange(match["name"], low, high, _unit(match["unit"], text))


def _unit(written: str, text: str) -> str:
    unit = written.strip().strip("[]").strip()
    if not unit:
        return ""
    try:
        ws.parse(unit)
    except bc.InputError as error:
        raise bc.InputError(f"limit {text!r}: {error}") from None
    return ws.normalise_unit(unit)


@dataclass(frozen=True)
class SpreadOfDevices:
    """Devices of one kind: mean and standard deviation of a quantity, in `unit`."""

    mean: float | None  # None for the middle of the limits, which is where a maker aims
    sd: float  # sd, unit: of the devices
    unit: str


_DEVICES = re.compile(
    rf"\s*(?:mean\s+(?P<mean>{_NUMBER})\s*,?\s*)?sd\s+(?P<sd>{_NUMBER})(?P<unit>.*)"
)


def spread_of_devices(text: str) -> SpreadOfDevices:
    """Parse a population: "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s".

    Raises:
        InputError: the text is none, or its standard deviation is not positive.
    """
    match = _DEVICES.fullmatch(text.strip().replace("−", "-"))
    if match is None:
        raise bc.InputError(f'population {text!r}: write "sd 0.2 °/s" or "mean 0.1 sd 0.2 °/s"')
    sd = float(match["sd"])
    if not 0 < sd < math.inf:
        raise bc.InputError(f"population {text!r}: a standard deviation is positive and finite")
    mean = float(match["mean"]) if match["mean"] else None
    return SpreadOfDevices(mean, sd, _unit(match["unit"], text))


# Shifts, and draws, by which the most favourable one is looked for: its p_c need only be within 1/400 of the top.
SHIFTS, SHIFT_DRAWS = 401, 400
SCORE_DRAWS = 100  # over which the distribution of one reading is
DEVIATIONS = np.sinh(np.linspace(-5.3, 5.3, 107))  # standard deviations of one reading, up to 100
BISECTIONS, EDGE_RTOL = 60, 1e-15  # each halves the bracket; of an acceptance limit
FAR_SD = 10.0  # standard deviations beyond which a normal distribution has 1e-23


def edge(holds: Callable[[float], bool], inside: float, outside: float, rtol: float) -> float:
    """Return where a condition ceases to hold, between a number at which it does and one at which it does not."""
    for _ in range(BISECTIONS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if holds(middle) else (inside, middle)
        if abs(outside - inside) <= rtol * abs(outside):
            break
    return inside


class Limits(NamedTuple):
    """A tolerance or an acceptance interval, in the unit of the quantity; infinite where there is no limit."""

    low: float
    high: float

    def hold(self, low: float, high: float) -> bool:
        """Return whether the interval [low, high] lies within the limits."""
        return self.low <= low and high <= self.high


@dataclass(frozen=True)
class DrawnQuantity:
    """Posterior draws of a limited quantity."""

    values: Float[np.ndarray, "d g"]  # in each draw at each place of the range that the limit names
    scatter: Float[np.ndarray, "g"]  # standard deviation of single readings at each place, or 0
    # normal scores of readings `DEVIATIONS` standard deviations above it, at each place; None if they are normal
    scores: Float[np.ndarray, "g m"] | None = None

    @property
    def estimate(self) -> tuple[float, float]:
        """Return the lowest and highest posterior mean over the range."""
        middle = self.values.mean(axis=0)
        return float(middle.min()), float(middle.max())

    @property
    def uncertainty(self) -> float:
        """Return the standard uncertainty; over a range, the larger of its two ends."""
        low, high = self.values.min(axis=1), self.values.max(axis=1)
        return float(max(np.std(low, ddof=1), np.std(high, ddof=1)))

    @cached_property
    def ends(self) -> DrawnQuantity:
        """Return the draws at their lowest and highest values only, where the scatter is the same at all places."""
        if np.ptp(self.scatter) > 0:
            return self
        ends = np.column_stack([self.values.min(axis=1), self.values.max(axis=1)])
        scores = None if self.scores is None else np.tile(self.scores[0], (2, 1))
        return DrawnQuantity(ends, np.tile(self.scatter[0], 2), scores)

    def probability(self, limits: Limits, shift: float = 0.0) -> float:
        """Return the probability of conformity of the posterior shifted up by `shift`."""
        values, scatter, scores = self.ends.values + shift, self.ends.scatter, self.ends.scores
        if not scatter.any():
            return float(np.mean(np.all((values >= limits.low) & (values <= limits.high), axis=1)))
        # The probability of one reading has a single top in y: where readings scatter alike its least is at an end.
        z = (limits.low - values) / scatter, (limits.high - values) / scatter
        if scores is not None:
            by_place = list(enumerate(scores))
            z = (np.transpose([np.interp(e[:, i], DEVIATIONS, s) for i, s in by_place]) for e in z)
        below, above = map(ndtr, z)
        return float(np.mean(np.min(above - below, axis=1)))

    def probability_error(self, p: float) -> float:
        """Return the Monte-Carlo standard error of a probability; an upper bound where readings scatter."""
        count = len(self.values)
        return float(np.sqrt(max(p * (1 - p), 1 / count) / count))


def acceptance(quantity: DrawnQuantity, limits: Limits, false_accept: float) -> Limits | None:
    """Return the acceptance interval of a probability α of false acceptance; None where no estimate reaches it."""
    reach = FAR_SD * float(quantity.scatter.max())
    # Below the first shift p_c is zero, as no draw is above T_L; so it is above the last.
    first = limits.low - float(quantity.values.min(axis=1).max()) - reach
    last = limits.high - float(quantity.values.max(axis=1).min()) + reach
    best = _most_favourable(quantity, limits, first, last)

    def accepts(shift: float) -> bool:
        return quantity.probability(limits, shift) >= 1.0 - false_accept

    if not accepts(best):
        return None
    ends = first, last
    down, up = (e if np.isinf(e) else edge(accepts, best, e, EDGE_RTOL) for e in ends)
    return Limits(quantity.estimate[0] + down, quantity.estimate[1] + up)


def _most_favourable(quantity: DrawnQuantity, limits: Limits, first: float, last: float) -> float:
    """Return the shift with the largest p_c."""
    if np.isinf(first) and np.isinf(last):
        return 0.0
    reach = FAR_SD * float(quantity.scatter.max())
    if np.isinf(first):  # one limit: all draws inside it
        return limits.high - float(quantity.values.max()) - reach
    if np.isinf(last):
        return limits.low - float(quantity.values.min()) + reach
    shifts = np.linspace(first, last, SHIFTS)
    quantity = replace(quantity, values=quantity.values[:: -(-len(quantity.values) // SHIFT_DRAWS)])
    # Of equally favourable ones the middle: about it p_c falls to both sides.
    p = np.array([quantity.probability(limits, s) for s in shifts])
    return float(np.median(shifts[p == p.max()]))


@dataclass(frozen=True)
class GlobalRisks:
    """Global risks of a population of items: probabilities of conformity, acceptance and wrong decisions."""

    conforming: float  # probability that an item conforms
    accepted: float  # that it is accepted
    consumer: float  # that it does not conform and is accepted
    producer: float  # that it conforms and is not accepted


def global_risks(
    mean: float, sd: float, uncertainty: float, limits: Limits, accepted: Limits
) -> GlobalRisks:
    """Compute the global risks over items N(mean, sd²), each measured with a normal error of sd `uncertainty`.

    Source: JCGM 106:2012, 9.5: item and estimate are normal together, with the covariance sd².
    """
    from scipy.stats import multivariate_normal  # half a second that only this needs

    covariance = np.full((2, 2), sd**2) + np.diag([0.0, uncertainty**2])

    def share(items: Limits, read: Limits) -> float:
        """Return the probability that an item is in `items` and its estimate in `read`."""
        ends = np.transpose([items, read])
        both = multivariate_normal(np.full(2, mean), covariance, allow_singular=True)  # pyright: ignore[reportArgumentType]
        return float(both.cdf(ends[1], lower_limit=ends[0]))

    right, conforming = share(limits, accepted), share(limits, Limits(-np.inf, np.inf))
    below, above = Limits(-np.inf, limits.low), Limits(limits.high, np.inf)
    wrongly = share(below, accepted) + share(above, accepted)
    return GlobalRisks(conforming, right + wrongly, wrongly, conforming - right)


READING, MEAN = "corrected reading", "corrected mean"
# Along each of so many ranges. Between 33 places a parabola rises by less than 1/1000 of what it rises over the range
# ((1/32)²); with two and three ranges 81 and 125 places keep the draws in memory.
PLACES = {1: 33, 2: 9, 3: 5}

FIXED_NOTE = "{} was held at its estimate, so that its uncertainty is not known: fit with --method marginal or nuts"


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedQuantity:
    """A limited quantity: an unknown of the model; or a slot, or the error of a corrected reading, at places."""

    limit: StatedLimit
    limits: Limits  # in `unit`
    unit: str  # of the quantity, fixed
    notes: tuple[str, ...] = ()  # what to know, each a sentence
    not_covered: tuple[str, ...] = ()  # clauses on what is not known; then nothing is decided
    draws: np.ndarray | None = None  # of an unknown (d,)
    chosen: bc.Compensator | None = None  # with all draws, of what is in use
    places: Mapping[str, np.ndarray] = field(default_factory=dict)  # stimulus and inputs, (g,)

    @property
    def place(self) -> dict[str, tuple[float, float, str]]:
        """Return the operating point: name → lowest value, highest value, unit; empty for an unknown."""
        if (chosen := self.chosen) is None:
            return {}
        units = {chosen.stimulus: chosen.unit}
        units |= {i.name: i.unit for i in chosen.inputs if i.kind != "lag slope"}
        names = self._acting | ({chosen.stimulus} if self.is_error else set())
        return {
            n: (float(self.places[n].min()), float(self.places[n].max()), unit)
            for n, unit in units.items()
            if n in names
        }

    @cached_property
    def _acting(self) -> set[str]:
        """Return the inputs, and the stimulus, that it depends on."""
        if (chosen := self.chosen) is None:
            return set()
        equation = chosen.equation
        if self.is_error:
            return set(equation.inputs)
        inputs = equation.graph.inputs([equation.slot_place(self.limit.quantity)])
        return {chosen.stimulus if name == ws.STIMULUS else name for name in inputs}

    @property
    def follows_time(self) -> bool:
        """Return whether it depends on the time of the record."""
        return "time" in self._acting

    @property
    def is_error(self) -> bool:
        """Return whether it is the error of a correction, whose estimate is zero for each device."""
        return self.limit.quantity in (READING, MEAN)

    def drawn(self, later: float = 0.0) -> DrawnQuantity:
        """Evaluate its posterior draws `later` s after the last reading of the calibration, in order of the draws."""
        if (chosen := self.chosen) is None:
            return DrawnQuantity(np.asarray(self.draws)[:, None], np.zeros(1))
        places = dict(self.places)
        equation, moments = chosen.equation, chosen._moments
        if "time" in places:
            places["time"] = places["time"] + later
        stimulus, slot = places[chosen.stimulus], None if self.is_error else self.limit.quantity
        values = equation.points(moments.draws, stimulus, places, slot)
        if self.is_error:  # where θ is what a draw says, and the correction is made with its mean
            values = equation.solve(moments.mean, values, places)[0] - stimulus
        if self.limit.quantity != READING:
            return DrawnQuantity(values, np.zeros(len(stimulus)))
        noise = np.sqrt(chosen.noise_variance(places))
        _, slope, _ = equation.linearised(moments.mean, stimulus, places)
        scores = _noise_scores(chosen, places, np.outer(noise, DEVIATIONS))
        return DrawnQuantity(values, noise / np.abs(slope), scores)


def _noise_scores(
    chosen: bc.Compensator, places: Mapping[str, np.ndarray], deviations: Float[np.ndarray, "n m"]
) -> Float[np.ndarray, "n m"]:
    """Return standard normal scores of the predictive probability that one reading's noise is below a deviation."""
    calibration, noise = chosen.calibration, chosen.calibration.model.noise
    tiled = {n: np.repeat(x, deviations.shape[1]) for n, x in places.items()}
    frame = chosen.equation.frame_of(tiled[chosen.stimulus], tiled)
    laws = (calibration.problem.hyper(v) for v in calibration.draws(SCORE_DRAWS).v)
    scores = [np.asarray(noise.normal_scores(deviations.ravel(), law, frame)) for law in laws]
    tails = ndtr(-np.abs(scores)).mean(axis=0).reshape(deviations.shape)  # the smaller keep digits
    return -np.sign(deviations) * ndtri(np.maximum(tails, np.finfo(float).tiny))


def limited_quantity(
    calibration: bc.Calibration,
    limit: StatedLimit,
    *,
    members: Mapping[str, str] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> LimitedQuantity:
    """Resolve the quantity of a limit in a calibration; members and gravity as in `decide`.

    Raises:
        InputError: nothing is called so, the unit is of another dimension, or a range is of no column.
        ModelError: the instrument does not say what it measures, and the limit is on something in use.
    """
    instrument = calibration.model.instrument
    slots = {s.name: s.unit for s in instrument.slots}
    if limit.quantity not in (READING, MEAN, *slots):
        return _unknown(calibration, limit, local_gravity)
    # All structures: what the less probable ones need is no reason to leave them out, as it is for firmware.
    equation = ws.equation_in_use(calibration, members)
    chosen = bc.Compensator(calibration, equation, ws.ALL_DRAWS)
    if limit.quantity in slots and limit.quantity not in {b.slot for b in equation.blocks}:
        raise bc.InputError(
            f"limit {limit.text!r}: no effect of the model acts on {limit.quantity!r} in use, so that nothing is known "
            "of it"
        )
    unit = slots.get(limit.quantity, chosen.unit)
    point = chosen.middle
    spans, not_covered, notes = [], [], []
    for span in limit.over:
        name, low, high = _resolve_range(chosen, span, limit, local_gravity)
        not_covered += _uncalibrated(chosen, name, low, high)
        if name not in point:
            notes.append(f"{limit.quantity} does not depend on {name}.")
        spans.append((name, low, high))
    ranges = [(n, low, high) for n, low, high in spans if high > low and n in point]
    if len(ranges) > max(PLACES):
        why = f"limit {limit.text!r}: at most {max(PLACES)} ranges, it has {len(ranges)}"
        raise bc.InputError(why)
    point |= {n: low for n, low, high in spans if high == low and n in point}
    grid = np.meshgrid(
        *(np.linspace(low, high, PLACES[len(ranges)]) for _, low, high in ranges), indexing="ij"
    )
    size = grid[0].size if grid else 1
    places = {n: np.full(size, v) for n, v in point.items()}
    places |= {n: g.ravel() for (n, _, _), g in zip(ranges, grid, strict=True)}
    # Where a range leaves what was calibrated is said by `not_covered`, in its own words.
    notes += ws.notes_on(chosen, of_correction=limit.quantity not in slots)
    if limit.quantity == MEAN and not calibration.model.noise.independent:
        notes.append(
            f"{MEAN!r} is without the correlated noise, which readings close in time share: a mean keeps it."
        )
    return LimitedQuantity(
        limit=limit,
        limits=_limits(limit, unit, local_gravity),
        unit=unit,
        notes=tuple(notes),
        not_covered=tuple(not_covered),
        chosen=chosen,
        places=places,
    )


def _limits(limit: StatedLimit, unit: str, local_gravity: float) -> Limits:
    """Return the tolerance limits in the unit of the quantity."""
    if not limit.unit and ws.unit_label(unit):
        raise bc.InputError(
            f"limit {limit.text!r} has no unit: {limit.quantity} is in {ws.unit_label(unit)}"
        )
    if not ws.same_dimension(limit.unit or "1", unit or "1"):
        raise bc.InputError(
            f"limit {limit.text!r}: {limit.quantity} is in {ws.unit_label(unit) or 'plain numbers'}, not in "
            f"{ws.unit_label(limit.unit) or 'plain numbers'}"
        )
    ends, to = np.array([limit.low, limit.high]), unit or "1"
    values = ws.convert(ends, limit.unit or "1", to, local_gravity=local_gravity, difference=True)
    return Limits(*values.tolist())


def _unknown(
    calibration: bc.Calibration, limit: StatedLimit, local_gravity: float
) -> LimitedQuantity:
    unknowns = calibration.unknowns
    if limit.quantity not in unknowns.index:
        slots = ", ".join(s.name for s in calibration.model.instrument.slots)
        raise bc.InputError(
            f"limit {limit.text!r}: nothing is called {limit.quantity!r}. A limit is on {READING!r}, {MEAN!r}, what "
            f"acts ({slots}), or an unknown of the calibration: {', '.join(unknowns.names)}"
        )
    if limit.over:
        raise bc.InputError(
            f"limit {limit.text!r}: {limit.quantity} is one number, the same everywhere; leave the range out, or limit "
            "what acts"
        )
    values = calibration.samples(limit.quantity)
    unit = unknowns.rows[unknowns.index[limit.quantity]].unit
    not_covered = () if np.ptp(values) > 0 else (FIXED_NOTE.format(limit.quantity),)
    limits = _limits(limit, unit, local_gravity)
    return LimitedQuantity(
        limit=limit, limits=limits, unit=unit, not_covered=not_covered, draws=values
    )


def _resolve_range(
    chosen: bc.Compensator, span: LimitedRange, limit: StatedLimit, local_gravity: float
) -> tuple[str, float, float]:
    """Return the column of a range, and its ends in that column's unit."""
    readings = chosen.calibration.readings
    inputs = {i.name: i.unit for i in chosen.inputs if i.kind != "lag slope"}
    acting = {chosen.stimulus: chosen.unit, **inputs}
    units = acting | {n: u for n in readings.columns if (u := readings.unit(n)) and n not in acting}
    units.pop("output", None)
    if span.name and span.name not in units:
        raise bc.InputError(
            f"limit {limit.text!r}: {span.name!r} is no column of this calibration; there is: {', '.join(units)}"
        )
    past = {i.name for i in chosen.inputs if i.kind in ws.PAST}
    fits = {n for n, u in units.items() if ws.same_dimension(u, span.unit or "1")}
    meant = [span.name] if span.name else [n for n in acting if n in fits - past] or sorted(fits)
    if len(meant) != 1:
        several = f"several could be meant: {', '.join(meant)}"
        raise bc.InputError(
            f"limit {limit.text!r}: of which column is the range in {ws.unit_label(span.unit) or 'plain numbers'}? "
            f"{several if meant else 'no column is in that unit'}. Name it: over temperature -20..60 °C"
        )
    (name,) = meant
    unit = units[name]
    if not ws.same_dimension(span.unit or "1", unit):
        raise bc.InputError(
            f"limit {limit.text!r}: {name} is in {ws.unit_label(unit)}, not in "
            f"{ws.unit_label(span.unit) or 'plain numbers'}"
        )
    ends = np.array([span.low, span.high])
    low, high = ws.convert(ends, span.unit or "1", unit, local_gravity=local_gravity).tolist()
    return name, low, high


def _uncalibrated(chosen: bc.Compensator, name: str, low: float, high: float) -> list[str]:
    """State the part of a range outside the calibration, in words; empty if there is none."""
    readings = chosen.calibration.readings
    if name in chosen.calibrated:
        span = chosen.calibrated[name]
    elif name == chosen.stimulus:
        return [f"{name} was not varied in the calibration"] if high > low else []
    else:
        values, unit = readings[name], readings.unit(name) or "1"
        span = (float(values.min()), float(values.max()), unit)
    first, last = ws.limits(span[:2])
    settled = {i.name for i in chosen.inputs if i.settled}
    if first <= low and (high <= last or name in settled):
        return []
    request = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return [
        f"{name} was calibrated from {span[0]:.6g} to {span[1]:.6g} {ws.unit_label(span[2])}, not at {request}"
    ]


def with_population(
    quantity: LimitedQuantity, devices: SpreadOfDevices
) -> tuple[float, float] | None:
    """Return mean and standard deviation of the quantity over devices, in its unit; None for another population."""
    unit, target = devices.unit or "1", quantity.unit or "1"
    over_range = any(r.high > r.low for r in quantity.limit.over)
    if quantity.is_error or over_range or not ws.same_dimension(unit, target):
        return None
    sd = float(ws.convert(devices.sd, unit, target, difference=True))
    if devices.mean is not None:
        return float(ws.convert(devices.mean, unit, target, difference=True)), sd
    low, high = quantity.limits
    ends = [end for end in (low, high) if np.isfinite(end)]
    return (float(np.mean(ends)), sd) if len(ends) == 2 else None
