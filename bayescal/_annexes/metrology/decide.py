"""Decisions on conformity to limits, with the rule, guard band and risks of each; recalibration intervals.

There are two decision rules; laboratory and customer agree on one beforehand (ISO/IEC 17025:2017, 7.1.3 and 7.8.6):

- *simple*: accept if the estimate is inside the limits, whatever its uncertainty; the risk is shared (JCGM 106:2012,
  8.2);
- *guarded*: accept if the probability of false acceptance is at most `false_accept`, that is, if the estimate is inside
  the limits by the guard bands; reject if the probability of false rejection is at most `false_accept`; otherwise
  undecided (8.3; in ILAC-G8:09/2019 a non-binary statement with guard bands).

Recalibration is due when drift, the part of the model that changes with the time of the record, lowers the probability
of conformity below `min_conformity`. Deviations of runs lower it equally at all times, and determine no date. Without a
change in time, the reason is reported (ILAC-G24/OIML D 10:2022 leaves the method to the laboratory).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any, Literal

import numpy as np

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.metrology.conformity import (
    DevicePopulation,
    DrawnQuantity,
    GlobalRisks,
    LimitedQuantity,
    Limits,
    bisect,
    compute_global_risks,
    convert_population,
    find_acceptance,
    find_quantity,
    parse_limit,
    parse_population,
)

DAY_S = 86400.0  # a day in seconds
YEAR_S = 365.25 * DAY_S
HORIZON_S = 10 * YEAR_S  # latest time searched
FIRST_TIME_S = 60.0  # earliest time searched, shorter than any calibration interval
N_TIMES = 160  # searched, on a logarithmic grid of ratio 1.13
TIME_RTOL = 1e-6  # of the time found
MAX_EXTRAPOLATION = 3.0  # of a drift, in spans of the record; beyond it a note is added

NOT_DETERMINED = "cannot be determined from these readings"
ADVICE = (
    "For a recalibration interval, calibrate in runs weeks apart, record their dates, and include a drift term such as "
    "bias.drift."
)


@dataclass(frozen=True)
class Recalibration:
    """Time at which the probability of conformity falls below a stated probability."""

    stated: float  # stated probability of conformity
    after: float | None  # time, s after the last reading; None beyond the horizon, or if not known
    date: str | None = None  # date of that time, ISO 8601, if the readings have dates
    why_not: str = ""  # reason why `after` is not known; empty if it is
    notes: tuple[str, ...] = ()  # one sentence each

    def __str__(self) -> str:
        if self.after is None:
            return self.why_not
        if self.after == 0:
            return f"the probability of conformity is already below {self.stated:g}"
        date = f", {self.date}" * bool(self.date)
        time_text = f"{format_duration(self.after)} after the last reading{date}"
        return f"{time_text}, the probability of conformity falls below {self.stated:g}"


def compute_recalibration(
    quantity: LimitedQuantity, limits: Limits, calibration: bc.Calibration, threshold: float
) -> Recalibration:
    """Compute the time at which drift lowers the probability of conformity below `threshold`."""
    if reason := _find_obstacle(quantity, calibration, threshold):
        advice = (ADVICE,) * bool(quantity.operating_point)
        return Recalibration(threshold, None, why_not=reason, notes=advice)

    def probability(delay: float) -> float:
        return quantity.draw(delay).probability(limits)

    delay = find_first_below(probability, threshold)
    change = quantity.draw(HORIZON_S if delay is None else delay).values - quantity.draw().values
    # Draws less probable than a failure at the stated probability cannot determine the date.
    if prior_dominance := ws.find_prior_dominance(calibration, change, max_inclusion=1 - threshold):

        def likelihood_probability(delay: float) -> float:
            draws = quantity.draw(delay)
            values = prior_dominance.update_by_readings(calibration, draws.values)
            return replace(draws, values=values).probability(limits)

        if delay is not None or find_first_below(likelihood_probability, threshold) is not None:
            reason = f"{NOT_DETERMINED}: {prior_dominance}. {prior_dominance.cure}"
            return Recalibration(threshold, None, why_not=reason, notes=(ADVICE,))
    if delay is None:
        reason = f"not due within {HORIZON_S / YEAR_S:g} years at the modelled drift rate"
        return Recalibration(threshold, None, why_not=reason)
    time, notes = calibration.readings["time"], list[str]()
    span = float(np.ptp(time))
    if delay > MAX_EXTRAPOLATION * span:
        notes.append(
            f"The drift is extrapolated to {delay / span:.0f} times the {format_duration(span)} of the record, at a "
            "constant drift rate: shorten the calibration interval to verify it."
        )
    start_time, date = calibration.readings.since, None
    if start_time is not None:
        start_date = datetime.fromtimestamp(start_time, UTC)
        date = (start_date + timedelta(seconds=float(time.max()) + delay)).date().isoformat()
    return Recalibration(threshold, delay, date, notes=tuple(notes))


def find_first_below(probability: Callable[[float], float], limit: float) -> float | None:
    """Find the first time, s, at which a probability is below a limit; None if beyond the horizon `HORIZON_S`.

    A temporary decrease between two successive times of the grid (ratio 1.13) is not detected.
    """
    last_time = 0.0
    for time in (0.0, *np.geomspace(FIRST_TIME_S, HORIZON_S, N_TIMES).tolist()):
        if probability(time) < limit:
            return time and bisect(lambda t: probability(t) >= limit, last_time, time, TIME_RTOL)
        last_time = time
    return None


def _find_obstacle(quantity: LimitedQuantity, calibration: bc.Calibration, threshold: float) -> str:
    """Return the reason why the model cannot predict the quantity's change in time; empty if it can."""
    name = quantity.limit.quantity
    if not quantity.operating_point:
        return f"{name} is a constant of the model, which does not change in time"
    if "time" not in quantity.dependencies:
        return f"no interval can be derived: no term of {name} changes with time"
    # A placeholder curve in time is defined within the record only.
    probabilities = calibration.inclusion
    for effect in calibration.model.effects:
        is_curve = effect.covariate == "time" and effect.is_placeholder
        if is_curve and probabilities[effect.name] > 1 - threshold:
            return f"no interval can be derived, since {effect.name} describes the record alone, not the time after it"
    return ""


def format_duration(seconds: float) -> str:
    """Format a duration in a suitable unit."""
    for size, name in ((YEAR_S, "years"), (DAY_S, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s"


ACCEPT, REJECT, UNDECIDED = "accept", "reject", "undecided"
NOT_RELIABLE = "the calibration is not reliable: {}"


@dataclass(frozen=True)
class Decision:
    """The decision on one limit."""

    limit: str  # text of the limit
    quantity: str  # name of the limited quantity
    unit: str  # of all numbers
    tolerance: Limits  # tolerance interval; infinite on a side without limit
    estimate: tuple[float, float]  # posterior mean, lowest and highest over the range of the limit
    uncertainty: float  # standard uncertainty; over a range, the larger of lowest and highest value
    scatter: float  # standard deviation of single readings, the largest; zero without scatter
    worst_uncertainty: float  # standard uncertainty at the least favourable point, with scatter
    probability: float  # of conformity
    probability_error: float  # its Monte-Carlo standard error
    guard_bands: tuple[float, float] | None  # lower, upper; None if no estimate is accepted
    accepted: Limits | None  # acceptance interval of the rule
    decision: str  # "accept", "reject" or "undecided"
    why: str  # reason for the decision
    risk: float | None  # specific risk, that the decision is wrong; None if undecided
    at: dict[str, tuple[float, float, str]]  # operating point: name → lowest, highest value, unit
    worst_at: dict[str, tuple[float, float, str]]  # least favourable point, by k = 2 intervals
    population: tuple[float, float] | None  # mean, sd of the devices; None if not given or a range
    global_risks: GlobalRisks | None  # over the population; None if not given
    recalibration: Recalibration
    notes: tuple[str, ...]  # one sentence each


@ws.renamed(doubt="warning", withheld="withhold")
@dataclass(frozen=True, repr=False)
class Decisions(ws.Printed):
    """Decisions about the limits of one device."""

    rule: str  # "simple" or "guarded"
    rule_in_words: str  # description of the rule, for a certificate
    false_accept: float  # maximum probability of false acceptance
    decisions: tuple[Decision, ...]  # one per limit, in input order
    calibration: str  # identity of the calibration
    notes: tuple[str, ...] = ()  # on all decisions, one sentence each

    def withhold(self, reason: str) -> Decisions:
        """Return a copy with all decisions undecided, because the calibration is unreliable for the given reason."""
        reason = NOT_RELIABLE.format(reason.rstrip("."))
        decisions = (replace(d, decision=UNDECIDED, why=reason, risk=None) for d in self.decisions)
        return replace(self, decisions=tuple(decisions))

    @property
    def conforms(self) -> bool:
        """Return whether every limit is met, by the rule."""
        return all(d.decision == ACCEPT for d in self.decisions)

    @property
    def warning(self) -> str:
        """Return a warning that names the limits that are not met or undecided; empty if all are met."""
        unmet_limits = [f"{d.limit} ({d.decision})" for d in self.decisions if d.decision != ACCEPT]
        return f"not shown to conform: {', '.join(unmet_limits)}" * bool(unmet_limits)

    def foreword(self, chapters: Sequence[ws.Chapter]) -> ws.Foreword:
        """Build a report's foreword with the decisions; they are withheld if a chapter's verdict is negative."""
        for chapter in chapters:
            if not chapter.data["verdict"]["ok"] and self.calibration == ws.identity(chapter.used):
                return self.withhold(" ".join(chapter.data["verdict"]["reasons"])).foreword(())
        table = self.table()
        why = ws.TableColumn("why", lambda d: "\n".join((d.why, *format_statement(d)[1:])))
        conclusion = "Every limit is met, by the rule below."
        return ws.Foreword(
            "decisions",
            "Does it conform?",
            " ".join((f"Of the calibration {self.calibration}.", *self.notes)),
            verdict=conclusion if self.conforms else "Not every limit is shown to be met.",
            is_negative=not self.conforms,
            reason=f"Decision rule: {self.rule_in_words}.",
            table=("Decisions", replace(table, columns=(*table.columns, why), width=1)),
        )

    def to_json_data(self) -> dict[str, Any]:
        """Return the decisions as JSON data."""
        return {"schema": "bayescal.decisions/1", "conforms": self.conforms} | ws.as_json(self)

    def _format_summary(self) -> str:
        text = ", ".join(f"{d.quantity} {d.decision}" for d in self.decisions)
        return f"{'conforms' if self.conforms else 'not shown to conform'}: {text}"

    def table(self) -> ws.ResultTable:
        """Tabulate each limit: estimate, probability of conformity, accepted estimates, decision."""

        def format_estimate(d: Decision) -> str:
            text = ws.format_value(find_worst_end(d), d.worst_uncertainty)
            return f"{text} {ws.unit_label(d.unit)}".strip()

        columns = (
            ws.TableColumn("limit", lambda d: d.limit),
            ws.TableColumn("estimate ± u (k = 1)", format_estimate, name=""),
            ws.TableColumn("estimate", find_worst_end, None),
            ws.TableColumn("uncertainty", lambda d: d.uncertainty, None),
            ws.TableColumn("unit", lambda d: d.unit, None),
            ws.TableColumn("probability", lambda d: d.probability, None),
            ws.TableColumn(
                "p(conforms)", lambda d: format_percent(d.probability, d.probability_error), name=""
            ),
            ws.TableColumn("accepted from … to", _format_acceptance, name=""),
            ws.TableColumn("decision", lambda d: d.decision),
        )
        return ws.ResultTable(columns, self.decisions)

    def _list_parts(self) -> list[str | ws.ResultTable]:
        parts = ["\n".join(_fold(line) for line in format_statement(d)) for d in self.decisions]
        notes = [note for d in self.decisions for note in (*d.recalibration.notes, *d.notes)]
        parts += [_fold(note) for note in dict.fromkeys([*notes, *self.notes])]
        rule = _fold(f"Decision rule: {self.rule_in_words}.")
        return [rule, "", self.table(), *(f"\n{part}" for part in parts)]


def find_worst_end(decision: Decision) -> float:
    """Return the end of the estimate's range that is nearer to its limit."""
    low, high = decision.estimate
    return high if decision.tolerance.high - high <= low - decision.tolerance.low else low


def _fold(text: str) -> str:
    indent = "    " if text.startswith("  ") else "  "
    return ws.wrap(text, indent)


def _format_acceptance(d: Decision) -> str:
    if d.accepted is None:
        return "none"
    low, high = (ws.number(end, 6) for end in d.accepted)
    if d.accepted != d.tolerance:  # rounded inward, to a tenth of the uncertainty or less
        places = max(0, 1 - math.floor(math.log10(d.worst_uncertainty or 1.0)))
        ends = np.ceil(d.accepted.low * 10**places), np.floor(d.accepted.high * 10**places)
        low, high = (f"{end / 10**places:.{places}f}" for end in ends)
    is_upper, is_lower = map(math.isinf, d.accepted)
    text = f"≤ {high}" if is_upper else f"≥ {low}" if is_lower else f"{low} … {high}"
    return f"{text} {ws.unit_label(d.unit)}".strip()


def format_statement(d: Decision) -> list[str]:
    """Format a decision as lines: decision and risk, operating point, global risks, next calibration."""
    lines, worst_point = [f"{d.limit}: {d.decision}; {d.why}."], ""
    unit, u = ws.unit_label(d.unit), d.worst_uncertainty
    if d.at:
        worst_point = _format_point({n: p for n, p in d.worst_at.items() if p != d.at[n]})
        worst_point = f", least favourable at {worst_point}" * bool(worst_point)
        scatter = f"{ws.number(d.scatter)} {unit}"
        scatter_note = f"; single readings scatter by {scatter}: u and p apply to one reading"
        lines.append(f"  at {_format_point(d.at)}{scatter_note * (d.scatter > 0)}{worst_point}")
    bands = [w for w in d.guard_bands or () if math.isfinite(w) and u > 0]
    if bands and d.accepted != d.tolerance:
        n = max(0, 1 - math.floor(math.log10(u)))  # decimals; rounded up
        numbers = (f"{math.ceil(w * 10**n) / 10**n:.{n}f} {unit} = {w / u:.2f}·u" for w in bands)
        texts = [*dict.fromkeys(numbers)]
        texts[-1] += f", rounded up; u = {u:#.3g} {unit}" + " there" * bool(worst_point)
        head = "  guard bands (lower, upper)" if len(texts) > 1 else "  guard band"
        lines.append(f"{head} w = {' and '.join(texts)}")
    if (g := d.global_risks) is not None:
        moments = f"{ws.format_value(*d.population)} {unit}" if d.population else ""
        lines.append(
            f"  of devices {moments}: {format_percent(g.conforming)} conform, "
            f"{format_percent(g.accepted)} would be accepted; consumer's risk (accepted, does not conform) "
            f"{format_percent(g.consumer)}, producer's risk (conforms, not accepted) {format_percent(g.producer)}"
        )
    return [*lines, f"  next calibration: {d.recalibration}"]


def _format_point(at: Mapping[str, tuple[float, float, str]]) -> str:
    """Format an operating point: values or ranges by name, angles in degrees."""
    texts = dict[str, str]()
    for name, (*ends, unit) in at.items():
        ends, unit = ([*map(math.degrees, ends)], "deg") if unit == "rad" else (ends, unit)
        value = " to ".join(dict.fromkeys(ws.number(end, 4) for end in ends))
        texts[name] = f"{value} {ws.unit_label(unit)}"
    return ws.format_inputs(texts, {name: unit for name, (*_, unit) in at.items()})


def format_percent(p: float, error: float = 0.0) -> str:
    """Format a probability in per cent, with a resolution of its Monte-Carlo error and of 0.01 %."""
    resolution = max(3 * error if p in (0.0, 1.0) else 0.0, 1e-4)
    if p < resolution:
        return f"< {100 * resolution:.2g} %"
    if p > 1 - resolution:
        return f"> {100 - 100 * resolution:.4g} %"
    return f"{100 * p:.2f} %" if p < 0.1 or p > 0.9 else f"{100 * p:.1f} %"


Rule = Literal["simple", "guarded"]
# Decision rules, as worded in a certificate; {} is the probability in %.
RULES = {
    "guarded": "guarded acceptance, probability of false acceptance at most {:g} %, undecided where neither acceptance "
    "nor rejection has so low a risk (JCGM 106:2012, 8.3; ILAC-G8:09/2019)",
    "simple": "simple acceptance, the estimate inside the limits, without guard bands (JCGM 106:2012, 8.2)",
}
# Risk of a guard band of one expanded uncertainty, k = 2, approximately (JCGM 106, 8.3.2; ILAC-G8 gives < 2.5 %).
FALSE_ACCEPT = 0.025
MIN_CONFORMITY = 0.95  # probability of conformity for a recalibration interval: the usual coverage


@ws.renamed(conformity="min_conformity")
def decide(
    calibration: bc.Calibration,
    limits: str | Sequence[str],
    *,
    rule: Rule = "guarded",
    false_accept: float = FALSE_ACCEPT,
    population: str | None = None,
    min_conformity: float = MIN_CONFORMITY,
    members: Mapping[str, str] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> Decisions:
    """Decide for each limit whether a calibrated device conforms to it.

    Args:
        calibration: a fit, or an average over structures.
        limits: such as "bias: ±0.5 °/s" or "corrected reading: ±0.1 °/s over -20..60 °C" (see `parse_limit`).
        rule: "guarded" or "simple".
        false_accept: maximum probability of false acceptance, and of false rejection, for "guarded".
        population: devices of this kind, for global risks of limits in its unit: "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s".
        min_conformity: probability of conformity below which recalibration is due.
        members: the member of a group in use, such as {"device": "A17"}; members of other groups are new.
        local_gravity: m/s², for limits in m/s² on accelerations in g.

    Raises:
        InputError: a limit, the population, the rule or a probability is invalid; the message states what to write.
        ModelError: a limit is on a slot or corrected reading, but the instrument has no stimulus (`Instrument.use`).
    """
    if rule not in RULES:
        raise bc.InputError(f"rule {rule!r} is unknown: choose {', '.join(RULES)}")
    if not 0 < false_accept < 0.5:
        text = f"{false_accept:g} (--false-accept, false_accept=)"
        raise bc.InputError(f"{text}: expected a probability above 0, below 0.5, such as 0.025")
    if not 0.5 <= min_conformity < 1:
        text = f"the conformity probability {min_conformity:g} is out of range"
        raise bc.InputError(f"{text}: expected one from 0.5 and below 1, such as 0.95")
    texts = [limits] if isinstance(limits, str) else list(limits)
    if not texts:
        raise bc.InputError('no limit is given: give one, such as "bias: ±0.5 °/s"')
    devices = None if population is None else parse_population(population)
    options: dict[str, Any] = {"members": members, "local_gravity": local_gravity}
    decisions = []
    for text in texts:
        quantity = find_quantity(calibration, parse_limit(text), **options)
        decisions.append(
            _build_decision(calibration, quantity, rule, false_accept, min_conformity, devices)
        )
    if devices is not None and all(d.global_risks is None for d in decisions):
        raise bc.InputError(
            f"population {population!r} applies to none of the limits: global risks need a slot or an unknown at one "
            "point, in the population's unit, and for a one-sided limit the population's mean"
        )
    return Decisions(
        rule=rule,
        rule_in_words=RULES[rule].format(100 * false_accept),
        false_accept=false_accept,
        decisions=tuple(decisions),
        calibration=ws.identity(calibration),
        notes=tuple(ws.list_average_claims(calibration)),
    )


def _build_decision(
    calibration: bc.Calibration,
    quantity: LimitedQuantity,
    rule: str,
    false_accept: float,
    min_conformity: float,
    devices: DevicePopulation | None,
) -> Decision:
    draws, limits = quantity.draw(), quantity.limits
    p = draws.probability(limits)
    guarded = find_acceptance(draws, limits, false_accept)
    acceptance_interval = guarded if rule == "guarded" else limits
    decision, why = _decide_limit(calibration, quantity, draws, p, rule, false_accept)
    uncertainty, notes = draws.uncertainty, list(quantity.notes)
    mean, u = draws.values.mean(axis=0), np.hypot(draws.values.std(axis=0), draws.scatter)
    i = int(np.argmin(np.minimum(limits.high - mean, mean - limits.low) - 2 * u))
    worst_points = {name: values[i : i + 1] for name, values in quantity.points.items()}
    interval = acceptance_interval or Limits(math.inf, math.inf)  # empty if no estimate is accepted
    moments = None if devices is None else convert_population(quantity, devices)
    if devices is not None and moments is None:
        notes.append(
            "No global risk is stated: the population is of another quantity, or the limit is on a correction or over "
            "a range, which one standard deviation does not describe."
        )
    return Decision(
        limit=quantity.limit.text,
        quantity=quantity.limit.quantity,
        unit=quantity.unit,
        tolerance=limits,
        estimate=draws.estimate,
        uncertainty=uncertainty,
        scatter=float(draws.scatter.max()),
        worst_uncertainty=float(u[i]),
        probability=p,
        probability_error=draws.probability_error(p),
        guard_bands=guarded and (guarded.low - limits.low, limits.high - guarded.high),
        accepted=acceptance_interval,
        decision=decision,
        why=why,
        risk={ACCEPT: 1 - p, REJECT: p}.get(decision),
        at=quantity.operating_point,
        worst_at=replace(quantity, points=worst_points).operating_point,
        population=moments,
        global_risks=moments and compute_global_risks(*moments, uncertainty, limits, interval),
        recalibration=compute_recalibration(quantity, limits, calibration, min_conformity),
        notes=tuple(notes),
    )


def _decide_limit(
    calibration: bc.Calibration,
    quantity: LimitedQuantity,
    draws: DrawnQuantity,
    p: float,
    rule: str,
    false_accept: float,
) -> tuple[str, str]:
    """Return the decision on a limit, and its reason."""
    limits, error = quantity.limits, draws.probability_error(p)
    if reason := ws.why_not(calibration):
        return UNDECIDED, NOT_RELIABLE.format(reason.rstrip("."))
    if quantity.undecided_reasons:
        return UNDECIDED, "; ".join(quantity.undecided_reasons)
    options = {"name": quantity.limit.quantity, "sd": draws.scatter, "max_inclusion": false_accept}
    if prior_dominance := ws.find_prior_dominance(calibration, draws.values, **options):
        values, risk = prior_dominance.update_by_readings(calibration, draws.values), false_accept
        q = replace(draws, values=values).probability(limits)  # with the likelihood alone
        is_same = (p >= 1 - risk) == (q >= 1 - risk) and (p <= risk) == (q <= risk)
        if prior_dominance.hyperparameter or not (is_same and abs(p - q) <= risk):
            return UNDECIDED, f"{NOT_DETERMINED}: {prior_dominance}. {prior_dominance.cure}"
    count = f" (none of {len(draws.values)} posterior draws)" * (p in (0.0, 1.0))
    p_text, q_text = (format_percent(q, error) + count for q in (p, 1 - p))
    if rule == "guarded":
        if p >= 1 - false_accept:
            return ACCEPT, f"specific consumer's risk {q_text}"
        if p <= false_accept:
            return REJECT, f"specific producer's risk {p_text}"
        return UNDECIDED, (
            f"probability of conformity {p_text}: acceptance needs {100 * (1 - false_accept):g} %, rejection "
            f"{100 * false_accept:g} %"
        )
    low, high = draws.estimate
    if limits.low <= low and high <= limits.high:
        position, decision, risk = "inside", ACCEPT, f"consumer's risk {q_text}"
    else:
        position, decision, risk = "outside", REJECT, f"producer's risk {p_text}"
    return decision, f"the estimate is {position} the limits; specific {risk}"
