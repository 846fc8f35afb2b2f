"""Parse limits, evaluate the quantities that they are on, and compute probabilities of conformity.

A limit ("bias: ±0.5 °/s", "corrected reading: ±0.1 °/s over -20..60 °C") is on one of three quantities:

- "corrected reading": the error of a reading after correction with the posterior mean, including the noise of one
  reading; "corrected mean": this error without noise, as for the mean of many readings.
- A slot, such as "bias": the sum of all effects that add to it in use, including the deviation of a new run, cell or
  device, unless a member is named.
- An unknown, such as "bias.temperature", "bias.run.group_sd" or "noise.white", by its printed name.

The first two are values at an operating point: covariates at mid-range, rates and lags zero, the time of the last
reading, unless the limit states otherwise. For a quantity y with tolerance limits [T_L, T_U]:

- the probability of conformity is p_c = P(T_L ≤ y ≤ T_U) (JCGM 106:2012, 7.2); the specific risk is 1 − p_c on
  acceptance, p_c on rejection (3.3.13 and 3.3.14);
- the acceptance interval [A_L, A_U] for a probability α of false acceptance contains the estimates for which p_c ≥
  1 − α, for a posterior of the same shape; the guard bands are w = T_U − A_U and A_L − T_L (8.3.2);
- the global risks (9.4 and 9.5) are averages over items y ~ N(y₀, u₀²), each measured with standard uncertainty u.

A curve conforms if all its points do: the lowest and the highest value of each draw are tested. A quantity with scatter
(a reading) conforms with the probability of one reading at the least favourable point.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

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
# Word → pattern of what follows it, and an example.
_CLAUSES = {
    "over": (re.compile(rf"(?P<name>.*?)\s*{_RANGE}(?P<unit>.*)"), "over temperature -20..60 °C"),
    "at": (
        re.compile(rf"(?P<name>.+?)\s*=\s*(?P<low>(?P<high>{_NUMBER}))(?P<unit>.*)"),
        "at temperature = 25 °C",
    ),
}
_NOTATIONS = {"+/-": "±", "+-": "±", "<=": "≤", ">=": "≥", "−": "-", "–": "-"}
LIMIT_ADVICE = (
    'write "bias: ±0.5 °/s", "noise.white: ≤ 0.1 °/s", "scale: -300..300 ppm" or "corrected reading: ±0.1 °/s over '
    '-20..60 °C"'
)


class LimitedRange(NamedTuple):
    """A range over which a limit holds, or one value: `low` to `high` of the column `name` ("" if not stated)."""

    name: str
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class StatedLimit:
    """A limit on a quantity, parsed from its text."""

    quantity: str  # "corrected reading", "corrected mean", a slot of the instrument such as "bias", or an unknown
    low: float  # low, high: tolerance limits in `unit`; infinite for a one-sided limit
    high: float
    unit: str  # as written; "" for a number without one
    ranges: tuple[LimitedRange, ...] = ()  # over which it holds
    text: str = ""  # as written


def parse_limit(text: str) -> StatedLimit:
    """Parse the text of a limit.

    It has a quantity, a colon, limits (±A, C ± A, ≤ B, ≥ A, A..B) and their unit. Optional are "over" with a range of a
    column, "at" with a value, and more of them after "and": "over temperature -20..60 °C and rate_input -90..90 °/s".

    Raises:
        InputError: the text is not a valid limit; the message names the fault.
    """
    quantity, colon, terms = text.rpartition(":")
    if not (colon and quantity.strip() and terms.strip()):
        raise bc.InputError(f"limit {text!r} lacks a quantity, a colon or limits: {LIMIT_ADVICE}")
    for notation, sign in _NOTATIONS.items():
        terms = terms.replace(notation, sign)
    interval, *clauses = re.split(r"\b(over|at)\b", terms)
    low, high, unit = _parse_tolerance(interval.strip(), text)
    ranges: list[LimitedRange] = []
    for word, spans in zip(clauses[::2], clauses[1::2], strict=True):
        ranges += [_parse_range(word, part.strip(), text) for part in re.split(r"\band\b", spans)]
    if not low < high or (math.isinf(low) and math.isinf(high)):
        fault = f"limit {text!r}: the lower limit {low:g} is not below the upper {high:g}"
        raise bc.InputError(fault)
    return StatedLimit(quantity.strip(), low, high, unit, tuple(ranges), text.strip())


def _parse_tolerance(interval: str, text: str) -> tuple[float, float, str]:
    match = _TOLERANCE.fullmatch(interval)
    if match is None:
        raise bc.InputError(f"limit {text!r}: {interval!r} states no limits: {LIMIT_ADVICE}")
    unit = _parse_limit_unit(match["unit"], text)
    if match["half"]:
        centre, half_width = float(match["centre"] or 0.0), float(match["half"])
        return centre - half_width, centre + half_width, unit
    low, high = match["low"] or match["least"], match["high"] or match["most"]
    return float(low or -math.inf), float(high or math.inf), unit


def _parse_range(word: str, part: str, text: str) -> LimitedRange:
    pattern, example = _CLAUSES[word]
    match = pattern.fullmatch(part)
    if match is None:
        raise bc.InputError(f"limit {text!r}: {part!r} is not a range or value: write {example}")
    low, high = float(match["low"]), float(match["high"])
    if word == "over" and not -math.inf < low < high < math.inf:
        raise bc.InputError(f"limit {text!r}: {part!r} is not a range of increasing numbers")
    return LimitedRange(match["name"], low, high, _parse_limit_unit(match["unit"], text))


def _parse_limit_unit(unit_text: str, text: str) -> str:
    unit = unit_text.strip().strip("[]").strip()
    if not unit:
        return ""
    try:
        ws.parse(unit)
    except bc.InputError as error:
        raise bc.InputError(f"limit {text!r}: {error}") from None
    return ws.normalise_unit(unit)


@dataclass(frozen=True)
class DevicePopulation:
    """Population of devices of one kind: mean and standard deviation of a quantity, in `unit`."""

    mean: float | None  # None: the middle of the limits, at which a maker aims
    sd: float
    unit: str


_POPULATION = re.compile(
    rf"\s*(?:mean\s+(?P<mean>{_NUMBER})\s*,?\s*)?sd\s+(?P<sd>{_NUMBER})(?P<unit>.*)"
)


def parse_population(text: str) -> DevicePopulation:
    """Parse the text of a population of devices: "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s".

    Raises:
        InputError: the text is invalid, or its standard deviation is not positive.
    """
    match = _POPULATION.fullmatch(text.strip().replace("−", "-"))
    if match is None:
        raise bc.InputError(f'population {text!r}: write "sd 0.2 °/s" or "mean 0.1 sd 0.2 °/s"')
    sd = float(match["sd"])
    if not 0 < sd < math.inf:
        raise bc.InputError(f"population {text!r}: the standard deviation must be positive")
    mean = float(match["mean"]) if match["mean"] else None
    return DevicePopulation(mean, sd, _parse_limit_unit(match["unit"], text))


# Numbers of shifts and of draws in the search for the largest p_c, which need only be within 1/400 of the maximum.
N_SHIFTS, MAX_DRAWS = 401, 400
N_SCORE_DRAWS = 100  # posterior draws of the distribution of one reading
DEVIATIONS = np.sinh(np.linspace(-5.3, 5.3, 107))  # of one reading, standard deviations, up to 100
MAX_BISECTIONS, EDGE_RTOL = 60, 1e-15  # of an acceptance limit
TAIL_SD = 10.0  # standard deviations beyond which a normal distribution has 1e-23


def bisect(condition: Callable[[float], bool], inside: float, outside: float, rtol: float) -> float:
    """Return the number at which a condition, true at `inside` and false at `outside`, ceases to hold."""
    for _ in range(MAX_BISECTIONS):
        midpoint = 0.5 * (inside + outside)
        inside, outside = (midpoint, outside) if condition(midpoint) else (inside, midpoint)
        if abs(outside - inside) <= rtol * abs(outside):
            break
    return inside


class Limits(NamedTuple):
    """A tolerance interval or an acceptance interval, in the unit of the quantity; infinite on a side without limit."""

    low: float
    high: float


@dataclass(frozen=True)
class DrawnQuantity:
    """Posterior draws of a limited quantity."""

    values: Float[np.ndarray, "d g"]  # of each draw at each point of the limit's range
    scatter: Float[np.ndarray, "g"]  # standard deviation of single readings at each point, or 0
    # normal scores of readings `DEVIATIONS` standard deviations above a value, at each point; None if they are normal
    scores: Float[np.ndarray, "g m"] | None = None

    @property
    def estimate(self) -> tuple[float, float]:
        """Return the lowest and highest posterior mean over the range."""
        means = self.values.mean(axis=0)
        return float(means.min()), float(means.max())

    @property
    def uncertainty(self) -> float:
        """Return the standard uncertainty; over a range, the larger of those of the lowest and the highest value."""
        return float(max(np.std(values, ddof=1) for values in self.extremes))

    @cached_property
    def extremes(self) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d"]]:
        """Return the lowest and the highest value of each draw over the range."""
        return self.values.min(axis=1), self.values.max(axis=1)

    def probability(self, limits: Limits, shift: float = 0.0) -> float:
        """Return the probability of conformity of the posterior shifted by `shift`.

        Without scatter all points must conform; with scatter, one reading at the least favourable point.
        """
        if not self.scatter.any():
            lowest, highest = self.extremes
            return float(np.mean((lowest + shift >= limits.low) & (highest + shift <= limits.high)))
        z = ((limit - shift - self.values) / self.scatter for limit in limits)
        if self.scores is not None:
            pairs = list(enumerate(self.scores))
            z = (np.transpose([np.interp(e[:, i], DEVIATIONS, s) for i, s in pairs]) for e in z)
        lower_probability, upper_probability = map(ndtr, z)
        return float(np.min(np.mean(upper_probability - lower_probability, axis=0)))

    def probability_error(self, p: float) -> float:
        """Return the Monte-Carlo standard error of a probability; an upper bound for readings with scatter."""
        count = len(self.values)
        return float(np.sqrt(max(p * (1 - p), 1 / count) / count))


def find_acceptance(quantity: DrawnQuantity, limits: Limits, false_accept: float) -> Limits | None:
    """Return the acceptance interval for a probability α of false acceptance; None if no estimate is accepted."""
    margin = TAIL_SD * float(quantity.scatter.max())
    # p_c is zero below the first shift, where all draws are below T_L, and above the last.
    low = limits.low - float(quantity.values.min(axis=1).max()) - margin
    high = limits.high - float(quantity.values.max(axis=1).min()) + margin
    best_shift = _find_best_shift(quantity, limits, low, high)

    def accepts(shift: float) -> bool:
        return quantity.probability(limits, shift) >= 1.0 - false_accept

    if not accepts(best_shift):
        return None
    bounds = low, high
    lower, upper = (e if np.isinf(e) else bisect(accepts, best_shift, e, EDGE_RTOL) for e in bounds)
    return Limits(quantity.estimate[0] + lower, quantity.estimate[1] + upper)


def _find_best_shift(quantity: DrawnQuantity, limits: Limits, low: float, high: float) -> float:
    """Return the shift of the posterior that maximises the probability of conformity p_c."""
    if np.isinf(low) and np.isinf(high):
        return 0.0
    margin = TAIL_SD * float(quantity.scatter.max())
    if np.isinf(low):  # one-sided limit: all draws within it
        return limits.high - float(quantity.values.max()) - margin
    if np.isinf(high):
        return limits.low - float(quantity.values.min()) + margin
    shifts = np.linspace(low, high, N_SHIFTS)
    quantity = replace(quantity, values=quantity.values[:: -(-len(quantity.values) // MAX_DRAWS)])
    # Of several maxima the median, from which p_c decreases on both sides.
    p = np.array([quantity.probability(limits, s) for s in shifts])
    return float(np.median(shifts[p == p.max()]))


@dataclass(frozen=True)
class GlobalRisks:
    """Global risks of a population of items: probabilities of conformity, acceptance and wrong decisions."""

    conforming: float  # probability that an item conforms
    accepted: float  # probability that it is accepted
    consumer: float  # probability that it does not conform and is accepted
    producer: float  # probability that it conforms and is not accepted


def compute_global_risks(
    mean: float, sd: float, uncertainty: float, tolerance_limits: Limits, acceptance_limits: Limits
) -> GlobalRisks:
    """Compute the global risks over items N(mean, sd²), each measured with a normal error of sd `uncertainty`.

    Source: JCGM 106:2012, 9.5: item and estimate are jointly normal, with covariance sd².
    """
    from scipy.stats import multivariate_normal  # its import takes half a second

    covariance = np.full((2, 2), sd**2) + np.diag([0.0, uncertainty**2])

    def compute_probability(items: Limits, estimates: Limits) -> float:
        """Return the probability that an item's true value is within `items` and its estimate within `estimates`."""
        bounds = np.transpose([items, estimates])
        distribution = multivariate_normal(np.full(2, mean), covariance, allow_singular=True)  # pyright: ignore[reportArgumentType]
        return float(distribution.cdf(bounds[1], lower_limit=bounds[0]))

    conformity = compute_probability(tolerance_limits, Limits(-np.inf, np.inf))
    correct_acceptance = compute_probability(tolerance_limits, acceptance_limits)
    tails = Limits(-np.inf, tolerance_limits.low), Limits(tolerance_limits.high, np.inf)
    false_acceptance = sum(compute_probability(items, acceptance_limits) for items in tails)
    risks = false_acceptance, conformity - correct_acceptance
    return GlobalRisks(conformity, correct_acceptance + false_acceptance, *risks)


READING, MEAN = "corrected reading", "corrected mean"
# Number of ranges → grid points along each. Between 33 points a parabola changes by (1/32)² < 1/1000 of its change over
# the range; with two and three ranges, 81 and 125 points limit the memory for draws.
GRID_SIZES = {1: 33, 2: 9, 3: 5}

FIXED_NOTE = "{} was fixed at its estimate, so its uncertainty is unknown: fit with --method marginal or nuts"


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitedQuantity:
    """The quantity that a limit is on: an unknown of the model; or a slot or a correction error at operating points."""

    limit: StatedLimit
    limits: Limits  # in `unit`
    unit: str  # unit of the quantity
    notes: tuple[str, ...] = ()  # one sentence each
    undecided_reasons: tuple[str, ...] = ()  # reasons why the limit is undecided
    draws: np.ndarray | None = None  # of an unknown (d,)
    compensator: bc.Compensator | None = None  # for a slot or an error, with all draws
    points: Mapping[str, np.ndarray] = field(default_factory=dict)  # stimulus and inputs, (g,)
    dependencies: frozenset[str] = frozenset()  # stimulus and inputs that it depends on

    @property
    def operating_point(self) -> dict[str, tuple[float, float, str]]:
        """Return the operating point: name → lowest value, highest value, unit; empty for an unknown."""
        units = {} if self.compensator is None else _list_input_units(self.compensator)
        ends = {n: (float(v.min()), float(v.max())) for n, v in self.points.items()}
        return {n: (*ends[n], unit) for n, unit in units.items() if n in self.dependencies}

    @property
    def is_error(self) -> bool:
        """Return whether the quantity is a correction error, whose estimate is zero for each device."""
        return self.limit.quantity in (READING, MEAN)

    def draw(self, delay: float = 0.0) -> DrawnQuantity:
        """Return the quantity's posterior draws, in their order, at a time `delay` s after the last reading."""
        if (compensator := self.compensator) is None:
            return DrawnQuantity(np.asarray(self.draws)[:, None], np.zeros(1))
        points, slot = dict(self.points), None if self.is_error else self.limit.quantity
        equation, moments = compensator.equation, compensator._moments
        if "time" in points:
            points["time"] = points["time"] + delay
        stimulus = points[compensator.stimulus]
        values = equation.evaluate_draws(moments.draws, stimulus, points, slot)
        if self.is_error:  # outputs at the draw's θ, corrected with the mean θ
            values = equation.solve(moments.mean, values, points)[0] - stimulus
        if self.limit.quantity != READING:
            return DrawnQuantity(values, np.zeros(len(stimulus)))
        noise = np.sqrt(compensator.in_use.noise_variance(stimulus, points))
        _, slope, _ = equation.linearise(moments.mean, stimulus, points)
        scores = _compute_noise_scores(compensator, points, np.outer(noise, DEVIATIONS))
        return DrawnQuantity(values, noise / np.abs(slope), scores)


def _list_input_units(compensator: bc.Compensator) -> dict[str, str]:
    """Return the units of the stimulus and the inputs that a limit may state, by name."""
    inputs = {i.name: i.unit for i in compensator.inputs if i.kind != "lag slope"}
    return {compensator.stimulus: compensator.unit, **inputs}


def _compute_noise_scores(
    compensator: bc.Compensator, points: Mapping[str, np.ndarray], deviations: np.ndarray
) -> Float[np.ndarray, "n m"]:
    """Return normal scores (n, m) of the predictive probability that one reading's noise is below each deviation."""
    calibration, noise = compensator.calibration, compensator.calibration.model.noise
    columns = {n: np.repeat(x, deviations.shape[1]) for n, x in points.items()}
    frame = compensator.equation.build_frame_in_use(columns[compensator.stimulus], columns)
    draws = (calibration.problem.hyper(v) for v in calibration.draws(N_SCORE_DRAWS).v)
    scores = [np.asarray(noise.normal_scores(deviations.ravel(), hyper, frame)) for hyper in draws]
    tails = ndtr(-np.abs(scores)).mean(axis=0).reshape(deviations.shape)  # small tails keep digits
    return -np.sign(deviations) * ndtri(np.maximum(tails, np.finfo(float).tiny))


def find_quantity(
    calibration: bc.Calibration,
    limit: StatedLimit,
    *,
    members: Mapping[str, str] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> LimitedQuantity:
    """Return the quantity that a limit applies to; `members` and `local_gravity` as in `decide`.

    Raises:
        InputError: the quantity or a column is unknown, or a unit has another dimension.
        ModelError: the limit is on a slot or corrected reading, but the instrument has no stimulus (`Instrument.use`).
    """
    instrument = calibration.model.instrument
    slots = {s.name: s.unit for s in instrument.slots}
    if limit.quantity not in (READING, MEAN, *slots):
        return _find_unknown(calibration, limit, local_gravity)
    # Averaged over all structures, also those whose inputs firmware omits.
    equation = ws.equation_in_use(calibration, members)
    compensator = bc.Compensator(calibration, equation, ws.ALL_DRAWS)
    if limit.quantity in slots and limit.quantity not in {b.slot for b in equation.blocks}:
        raise bc.InputError(
            f"limit {limit.text!r}: no effect of the model acts on {limit.quantity!r} in use, so that its value is "
            "unknown"
        )
    unit = slots.get(limit.quantity, compensator.unit)
    operating_point = compensator.middle
    spans, undecided_reasons, notes = [], [], []
    for span in limit.ranges:
        name, low, high = _resolve_range(compensator, span, limit, local_gravity)
        undecided_reasons += _check_range(compensator, name, low, high)
        if name not in operating_point:
            notes.append(f"{limit.quantity} does not depend on {name}.")
        spans.append((name, low, high))
    n_varied = sum(high > low and name in operating_point for name, low, high in spans)
    if n_varied > max(GRID_SIZES):
        raise bc.InputError(f"limit {limit.text!r}: state at most {max(GRID_SIZES)} ranges")
    axes = {n: np.array([value]) for n, value in operating_point.items()}
    for name, low, high in spans:
        if name in operating_point:
            axes[name] = np.linspace(low, high, GRID_SIZES[n_varied] if high > low else 1)
    grid = np.meshgrid(*axes.values(), indexing="ij")
    points = {n: values.ravel() for n, values in zip(axes, grid, strict=True)}
    if limit.quantity in slots:
        inputs = equation.graph.inputs([equation.nodes.slots[limit.quantity]])
        dependencies = {compensator.stimulus if name == ws.STIMULUS else name for name in inputs}
    else:
        dependencies = {*equation.inputs, compensator.stimulus}
    # `undecided_reasons` has the notes on ranges outside the calibration.
    notes += ws.list_budget_claims(compensator, is_correction=limit.quantity not in slots)
    if limit.quantity == MEAN and not calibration.model.noise.independent:
        notes.append(
            f"{MEAN!r} excludes correlated noise, which averaging readings close in time does not remove."
        )
    return LimitedQuantity(
        limit=limit,
        limits=_convert_limits(limit, unit, local_gravity),
        unit=unit,
        notes=tuple(notes),
        undecided_reasons=tuple(undecided_reasons),
        compensator=compensator,
        points=points,
        dependencies=frozenset(dependencies),
    )


def _convert_limits(limit: StatedLimit, unit: str, local_gravity: float) -> Limits:
    """Return the tolerance limits in the quantity's unit; raise InputError if theirs is missing or incompatible."""
    if not limit.unit and ws.unit_label(unit):
        raise bc.InputError(
            f"limit {limit.text!r} has no unit: {limit.quantity} is in {ws.unit_label(unit)}"
        )
    options = {"local_gravity": local_gravity, "difference": True}
    return Limits(*_convert_ends(limit, limit.quantity, limit, unit, **options))


def _convert_ends(
    limit: StatedLimit, name: str, span: StatedLimit | LimitedRange, unit: str, **options: Any
) -> list[float]:
    """Return the ends of a span of `name` in a unit; raise InputError if the span is of another dimension."""
    units = span.unit or "1", unit or "1"
    if not ws.same_dimension(*units):
        stated_unit, expected = (ws.unit_label(u) or "plain numbers" for u in units)
        raise bc.InputError(f"limit {limit.text!r}: {name} is in {expected}, not in {stated_unit}")
    return ws.convert(np.array([span.low, span.high]), *units, **options).tolist()


def _find_unknown(
    calibration: bc.Calibration, limit: StatedLimit, local_gravity: float
) -> LimitedQuantity:
    unknowns = calibration.unknowns
    if limit.quantity not in unknowns.index:
        slots = ", ".join(s.name for s in calibration.model.instrument.slots)
        raise bc.InputError(
            f"limit {limit.text!r}: unknown quantity {limit.quantity!r}: give {READING!r}, {MEAN!r}, a slot ({slots}) "
            f"or an unknown of the calibration: {', '.join(unknowns.names)}"
        )
    if limit.ranges:
        raise bc.InputError(
            f"limit {limit.text!r}: {limit.quantity} is a single number: leave the range out, or limit a slot or a "
            "corrected reading"
        )
    values = calibration.samples(limit.quantity)
    unit = unknowns.rows[unknowns.index[limit.quantity]].unit
    undecided_reasons = () if np.ptp(values) > 0 else (FIXED_NOTE.format(limit.quantity),)
    limits = _convert_limits(limit, unit, local_gravity)
    return LimitedQuantity(
        limit=limit, limits=limits, unit=unit, undecided_reasons=undecided_reasons, draws=values
    )


def _resolve_range(
    compensator: bc.Compensator, span: LimitedRange, limit: StatedLimit, local_gravity: float
) -> tuple[str, float, float]:
    """Return a range's column, and its ends in that column's unit; raise InputError if it is unknown or ambiguous."""
    readings, inputs = compensator.calibration.readings, _list_input_units(compensator)
    units = inputs | {n: u for n in readings.columns if (u := readings.unit(n)) and n not in inputs}
    units.pop("output", None)
    if span.name and span.name not in units:
        raise bc.InputError(
            f"limit {limit.text!r}: {span.name!r} is not a column of this calibration (it has: {', '.join(units)})"
        )
    past_inputs = {i.name for i in compensator.inputs if i.kind in ws.HISTORY_KINDS}
    matches = {n for n, u in units.items() if ws.same_dimension(u, span.unit or "1")}
    candidates = [n for n in inputs if n in matches - past_inputs] or sorted(matches)
    names = [span.name] if span.name else candidates
    if len(names) != 1:
        ambiguity = f"several columns match: {', '.join(names)}"
        raise bc.InputError(
            f"limit {limit.text!r}: the column of the range in {ws.unit_label(span.unit) or 'plain numbers'} is not "
            f"named, and {ambiguity if names else 'no column is in that unit'}. Write: over temperature -20..60 °C"
        )
    (name,) = names
    low, high = _convert_ends(limit, name, span, units[name], local_gravity=local_gravity)
    return name, low, high


def _check_range(compensator: bc.Compensator, name: str, low: float, high: float) -> list[str]:
    """Return why a range is not covered by the calibration, as a list of one sentence; empty if it is covered."""
    readings = compensator.calibration.readings
    if name in compensator.calibrated:
        span = compensator.calibrated[name]
    elif name == compensator.stimulus:
        return [f"{name} was not varied in the calibration"] if high > low else []
    else:
        values, unit = readings[name], readings.unit(name) or "1"
        span = (float(values.min()), float(values.max()), unit)
    first, last = ws.add_margin(span[:2])
    constants = {i.name for i in compensator.inputs if i.settled}
    if first <= low and (high <= last or name in constants):
        return []
    range_text = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
    return [
        f"the calibration covers {name} from {span[0]:.6g} to {span[1]:.6g} {ws.unit_label(span[2])}, not {range_text}"
    ]


def convert_population(
    quantity: LimitedQuantity, devices: DevicePopulation
) -> tuple[float, float] | None:
    """Return a population's mean and sd in the quantity's unit; None for errors, ranges, no mean, other dimensions."""
    unit, target_unit = devices.unit or "1", quantity.unit or "1"
    is_over_range = any(r.high > r.low for r in quantity.limit.ranges)
    if quantity.is_error or is_over_range or not ws.same_dimension(unit, target_unit):
        return None
    sd = float(ws.convert(devices.sd, unit, target_unit, difference=True))
    if devices.mean is not None:
        return float(ws.convert(devices.mean, unit, target_unit, difference=True)), sd
    low, high = quantity.limits
    ends = [end for end in (low, high) if np.isfinite(end)]
    return (float(np.mean(ends)), sd) if len(ends) == 2 else None
