"""Decisions on conformity to limits, with the rule, guard band and risks of each; recalibration intervals.

Two rules, one of which the laboratory and its customer agree on beforehand (ISO/IEC 17025:2017, 7.1.3 and 7.8.6):

- *simple*: accept where the estimate is inside the limits, whatever its uncertainty, the risk being shared (JCGM
  106:2012, 8.2);
- *guarded*: accept where the probability of a false acceptance is at most the stated one, that is, where the estimate
  is inside the limits by the guard bands; reject where the probability of a false rejection is; between them,
  undecided (8.3; ILAC-G8:09/2019 calls it a non-binary statement with guard bands).

To calibrate again is due where the probability of conformity falls below a stated one, by what changes in the model
with the time of the record: a drift. A deviation of runs lowers the probability everywhere, and sets no date. Where
nothing changes with time, the reason is said (ILAC-G24/OIML D 10:2022 leaves the method to the laboratory).
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
    DrawnQuantity,
    GlobalRisks,
    LimitedQuantity,
    Limits,
    SpreadOfDevices,
    acceptance,
    edge,
    global_risks,
    limited_quantity,
    spread_of_devices,
    stated_limit,
    with_population,
)

DAY = 86400.0  # s
YEAR = 365.25 * DAY
HORIZON = 10 * YEAR  # end of the search; beyond it only "not within 10 years" is said
FIRST_SECONDS = 60.0  # s, the first time looked at, shorter than any interval between calibrations
TIMES = 160  # looked at, evenly in the logarithm: each is 1.13 times the one before
TIME_RTOL = 1e-6  # of the time found
FAR_SPANS = 3.0  # spans of the record beyond which a drift is extrapolated so far that it is said

CANNOT = "cannot be said from these readings"
ADVICE = (
    "For a recalibration interval, calibrate in runs weeks apart, record their dates, and include a drift term such as "
    "bias.drift."
)


@dataclass(frozen=True)
class Recalibration:
    """When the probability of conformity falls below a stated one."""

    stated: float  # the probability
    after: float | None  # s after the last reading; None beyond the horizon, or not known
    date: str | None = None  # of that time, ISO 8601, where the readings have dates
    why_not: str = ""  # why there is no time; empty where there is one
    notes: tuple[str, ...] = ()  # what to know, each a sentence

    def __str__(self) -> str:
        if self.after is None:
            return self.why_not
        if self.after == 0:
            return f"the probability of conformity is below {self.stated:g} already"
        when = f"{in_words(self.after)} after the last reading" + f", {self.date}" * bool(self.date)
        return f"the probability of conformity falls below {self.stated:g} {when}"


def recalibration(
    quantity: LimitedQuantity, limits: Limits, calibration: bc.Calibration, stated: float
) -> Recalibration:
    """Compute when the probability of conformity falls below a stated one, by the drift in the model."""
    if reason := _no_answer(quantity, calibration, stated):
        return Recalibration(stated, None, why_not=reason, notes=(ADVICE,) * bool(quantity.place))

    def probability(later: float) -> float:
        return quantity.drawn(later).probability(limits)

    after = first_below(probability, stated)
    changed = quantity.drawn(HORIZON if after is None else after).values - quantity.drawn().values
    # What is less probable than a failure at the stated probability cannot decide about the date.
    if untold := ws.find_not_measured(calibration, changed, rare=1 - stated):

        def alone(later: float) -> float:
            drawn = quantity.drawn(later)  # by the likelihood alone
            values = untold.by_readings_alone(calibration, drawn.values)
            return replace(drawn, values=values).probability(limits)

        if after is not None or first_below(alone, stated) is not None:
            why = f"{CANNOT}: {untold}. {untold.cure}"
            return Recalibration(stated, None, why_not=why, notes=(ADVICE,))
    if after is None:
        why = f"not within {HORIZON / YEAR:g} years by the drift that the model holds"
        return Recalibration(stated, None, why_not=why)
    time, notes = calibration.readings["time"], list[str]()
    span = float(np.ptp(time))
    if after > FAR_SPANS * span:
        notes.append(
            f"The drift is extrapolated to {after / span:.0f} times the {in_words(span)} of the record, as if it "
            "went on as it was: calibrate again sooner to see whether it does."
        )
    since, date = calibration.readings.since, None
    if since is not None:
        begin = datetime.fromtimestamp(since, UTC)
        date = (begin + timedelta(seconds=float(time.max()) + after)).date().isoformat()
    return Recalibration(stated, after, date, notes=tuple(notes))


def first_below(probability: Callable[[float], float], stated: float) -> float | None:
    """Return the first time, s, at which a probability is below a stated one; None up to the horizon.

    A fall and rise between two times of the grid, of ratio 1.13, is not detected.
    """
    before = 0.0
    for time in (0.0, *np.geomspace(FIRST_SECONDS, HORIZON, TIMES).tolist()):
        if probability(time) < stated:
            return time and edge(lambda t: probability(t) >= stated, before, time, TIME_RTOL)
        before = time
    return None


def _no_answer(quantity: LimitedQuantity, calibration: bc.Calibration, stated: float) -> str:
    """State why the model does not predict the future; empty where it does."""
    name = quantity.limit.quantity
    if not quantity.place:
        return f"{name} is one number of the model, which holds no change of it in time"
    if not quantity.follows_time:
        return f"no interval can be derived: no term of the model lets {name} change with time"
    # A form in time that the readings drew, which ends with them.
    shares = calibration.inclusion
    for effect in calibration.model.effects:
        drawn = effect.covariate == "time" and effect.is_placeholder
        if drawn and shares[effect.name] > 1 - stated:
            return f"no interval can be derived, since {effect.name} describes the record alone, not the time after it"
    return ""


def in_words(seconds: float) -> str:
    """Format a duration in a suitable unit."""
    for size, name in ((YEAR, "years"), (DAY, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {name}"
    return f"{seconds:.3g} s"


ACCEPT, REJECT, UNDECIDED = "accept", "reject", "undecided"
NOT_RELIABLE = "the calibration is not reliable: {}"


@dataclass(frozen=True)
class Decision:
    """The decision on one limit."""

    limit: str  # as it was written
    quantity: str  # what is limited
    unit: str  # of all its numbers
    tolerance: Limits  # infinite where there is none
    estimate: tuple[float, float]  # posterior mean, lowest and highest over the range of the limit
    uncertainty: float  # standard, of the estimate; over a range, the largest of its two ends
    scatter: float  # standard deviation of single readings, the largest; zero without scatter
    probability: float  # of conformity
    probability_error: float  # its Monte-Carlo standard error
    guard_bands: tuple[float, float] | None  # below, above; None where no estimate is accepted
    accepted: Limits | None  # estimates that are accepted, by the rule
    decision: str  # "accept", "reject" or "undecided"
    why: str  # in words
    risk: float | None  # the specific risk: that the decision is wrong; None where none was made
    at: dict[str, tuple[float, float, str]]  # operating point: name → lowest, highest value, unit
    worst_at: dict[str, tuple[float, float, str]]  # where a k = 2 interval ends nearest a limit
    population: tuple[float, float] | None  # mean, sd of the devices; None if not given or a range
    global_risks: GlobalRisks | None  # over the devices of a population; None where none is given
    recalibration: Recalibration
    notes: tuple[str, ...]  # what to know, each a sentence


@dataclass(frozen=True, repr=False)
class Decisions(ws.Printed):
    """Decisions about the limits of one device."""

    rule: str  # "simple" or "guarded"
    rule_in_words: str  # as a certificate states it
    false_accept: float  # the probability of a false acceptance that is allowed
    decisions: tuple[Decision, ...]  # one of each limit, in their order
    calibration: str  # identity of the calibration
    notes: tuple[str, ...] = ()  # what to know of all of them, each a sentence

    def withheld(self, why: str) -> Decisions:
        """Return these with all decisions undecided, with the reason why the calibration is not reliable."""
        reason = NOT_RELIABLE.format(why.rstrip("."))
        open_ = (replace(d, decision=UNDECIDED, why=reason, risk=None) for d in self.decisions)
        return replace(self, decisions=tuple(open_))

    @property
    def conforms(self) -> bool:
        """Return whether every limit is met, by the rule."""
        return all(d.decision == ACCEPT for d in self.decisions)

    @property
    def doubt(self) -> str:
        """List the limits that are not met, or undecided; empty if none is."""
        open_ = [f"{d.limit} ({d.decision})" for d in self.decisions if d.decision != ACCEPT]
        return f"not shown to conform: {', '.join(open_)}" * bool(open_)

    def foreword(self, chapters: Sequence[ws.Chapter]) -> ws.Foreword:
        """Return the decisions as the foreword of a report; withheld where a chapter's verdict is negative."""
        for chapter in chapters:
            if not chapter.data["verdict"]["ok"] and self.calibration == ws.identity(chapter.used):
                return self.withheld(" ".join(chapter.data["verdict"]["reasons"])).foreword(())
        table = self.table()
        why = ws.TableColumn("why", lambda d: "\n".join((d.why, *statement_lines(d)[1:])))
        met = "Every limit is met, by the rule below."
        return ws.Foreword(
            "decisions",
            "Does it conform?",
            " ".join((f"Of the calibration {self.calibration}.", *self.notes)),
            verdict=met if self.conforms else "Not every limit is shown to be met.",
            bad=not self.conforms,
            why=f"Decision rule: {self.rule_in_words}.",
            table=("Decisions", replace(table, columns=(*table.columns, why), fold=1)),
        )

    def data(self) -> dict[str, Any]:
        """Return the decisions as JSON data."""
        return {"schema": "bayescal.decisions/1", "conforms": self.conforms} | ws.as_json(self)

    def _brief(self) -> str:
        text = ", ".join(f"{d.quantity} {d.decision}" for d in self.decisions)
        return f"{'conforms' if self.conforms else 'not shown to conform'}: {text}"

    def table(self) -> ws.ResultTable:
        """Tabulate each limit: estimate, probability of conformity, accepted estimates, decision."""

        def estimate(d: Decision) -> str:
            u = math.hypot(d.uncertainty, d.scatter)  # of what p is of
            return f"{ws.with_error(worst(d), u)} {ws.unit_label(d.unit)}".strip()

        columns = (
            ws.TableColumn("limit", lambda d: d.limit),
            ws.TableColumn("estimate ± u (k = 1)", estimate, name=""),
            ws.TableColumn("estimate", worst, None),
            ws.TableColumn("uncertainty", lambda d: d.uncertainty, None),
            ws.TableColumn("unit", lambda d: d.unit, None),
            ws.TableColumn("probability", lambda d: d.probability, None),
            ws.TableColumn(
                "p(conforms)", lambda d: percent(d.probability, d.probability_error), name=""
            ),
            ws.TableColumn("accepted from … to", _accepted, name=""),
            ws.TableColumn("decision", lambda d: d.decision),
        )
        return ws.ResultTable(columns, self.decisions)

    def _parts(self) -> list[str | ws.ResultTable]:
        parts = ["\n".join(_fill(line) for line in statement_lines(d)) for d in self.decisions]
        of_each = (note for d in self.decisions for note in (*d.recalibration.notes, *d.notes))
        parts += [_fill(note) for note in dict.fromkeys((*of_each, *self.notes))]
        rule = _fill(f"Decision rule: {self.rule_in_words}.")
        return [rule, "", self.table(), *(f"\n{part}" for part in parts)]


def worst(d: Decision) -> float:
    """Return the end of the estimate that is nearer to its limit."""
    low, high = d.estimate
    return high if d.tolerance.high - high <= low - d.tolerance.low else low


def _fill(text: str) -> str:
    indent = "    " if text.startswith("  ") else "  "
    return ws.folded(text, indent)


def _accepted(d: Decision) -> str:
    if d.accepted is None:
        return "none"
    low, high = (ws.number(end, 4) for end in d.accepted)
    above, below = map(math.isinf, d.accepted)
    text = f"≤ {high}" if above else f"≥ {low}" if below else f"{low} … {high}"
    return f"{text} {ws.unit_label(d.unit)}".strip()


def statement_lines(d: Decision) -> list[str]:
    """Return lines: the decision and its risk, the operating point, the population's risks, the next calibration."""
    lines = [f"{d.limit}: {d.decision}; {d.why}."]
    if d.at:
        worst_at = _places({n: place for n, place in d.worst_at.items() if place != d.at[n]})
        worst_at = f", the least favourable at {worst_at}" * bool(worst_at)
        scatter = f"{ws.number(d.scatter)} {ws.unit_label(d.unit)}"
        of_one = f"; single readings scatter by {scatter}: u and p are of one reading"
        lines.append(f"  at {_places(d.at)}{of_one * (d.scatter > 0)}{worst_at}")
    if (g := d.global_risks) is not None:
        which = f"{ws.with_error(*d.population)} {ws.unit_label(d.unit)}" if d.population else ""
        lines.append(
            f"  of devices {which}: {percent(g.conforming)} conform, "
            f"{percent(g.accepted)} would be accepted; consumer's risk (accepted, does not conform) "
            f"{percent(g.consumer)}, producer's risk (conforms, not accepted) {percent(g.producer)}"
        )
    return [*lines, f"  next calibration: {d.recalibration}"]


def _places(at: Mapping[str, tuple[float, float, str]]) -> str:
    """Format values or ranges by name, angles in degrees."""
    texts = dict[str, str]()
    for name, (*ends, unit) in at.items():
        ends, unit = ([*map(math.degrees, ends)], "deg") if unit == "rad" else (ends, unit)
        value = " to ".join(dict.fromkeys(ws.number(end, 4) for end in ends))
        texts[name] = f"{value} {ws.unit_label(unit)}"
    return ws.list_inputs(texts)


def percent(p: float, error: float = 0.0) -> str:
    """Format a probability in per cent, no finer than its Monte-Carlo error, nor than a hundredth of a per cent."""
    least = max(3 * error if p in (0.0, 1.0) else 0.0, 1e-4)
    if p < least:
        return f"< {100 * least:.2g} %"
    if p > 1 - least:
        return f"> {100 - 100 * least:.4g} %"
    return f"{100 * p:.2f} %" if p < 0.1 or p > 0.9 else f"{100 * p:.1f} %"


Rule = Literal["simple", "guarded"]
# As a certificate states them.
RULES = {
    "guarded": "guarded acceptance, probability of false acceptance at most {:g} %, undecided where neither acceptance "
    "nor rejection has so low a risk (JCGM 106:2012, 8.3; ILAC-G8:09/2019)",
    "simple": "simple acceptance, the estimate inside the limits, without guard bands (JCGM 106:2012, 8.2)",
}
# What a guard band of one expanded uncertainty, k = 2, comes to about (JCGM 106, 8.3.2; ILAC-G8 gives < 2.5 %).
FALSE_ACCEPT = 0.025
CONFORMITY = 0.95  # of which a recalibration interval is stated: the usual coverage of a statement


def decide(
    calibration: bc.Calibration,
    limits: str | Sequence[str],
    *,
    rule: Rule = "guarded",
    false_accept: float = FALSE_ACCEPT,
    population: str | None = None,
    conformity: float = CONFORMITY,
    members: Mapping[str, str] | None = None,
    local_gravity: float = ws.STANDARD_GRAVITY,
) -> Decisions:
    """Decide whether a calibrated device conforms, limit by limit.

    Args:
        calibration: a fit, or an average over structures.
        limits: such as "bias: ±0.5 °/s" or "corrected reading: ±0.1 °/s over -20..60 °C" (see `stated_limit`).
        rule: "guarded" or "simple".
        false_accept: probability of a false acceptance (and, of a false rejection) that "guarded" allows.
        population: devices of this kind, for global risks of the limits in its unit: "sd 0.2 °/s", "mean 0.1 sd 0.2
            °/s".
        conformity: probability of which the recalibration interval is stated.
        members: which member of a group is used, such as {"device": "A17"}; every other counts as new.
        local_gravity: m/s², for limits in m/s² on accelerations in g.

    Raises:
        InputError: a limit, population, rule or probability that is none; says which and what to write.
        ModelError: the instrument does not say what it measures, and a limit is on something in use.
    """
    if rule not in RULES:
        raise bc.InputError(f"rule {rule!r} is none: choose {', '.join(RULES)}")
    if not 0 < false_accept < 0.5:
        raise bc.InputError(
            f"false_accept = {false_accept:g}: expected a probability above 0 and below 0.5, such as 0.025"
        )
    if not 0.5 <= conformity < 1:
        raise bc.InputError(
            f"conformity = {conformity:g}: expected a probability from 0.5 and below 1, such as 0.95"
        )
    stated = [limits] if isinstance(limits, str) else list(limits)
    if not stated:
        raise bc.InputError('nothing to decide: give a limit, such as "bias: ±0.5 °/s"')
    devices = None if population is None else spread_of_devices(population)
    where: dict[str, Any] = {"members": members, "local_gravity": local_gravity}
    decisions = []
    for text in stated:
        quantity = limited_quantity(calibration, stated_limit(text), **where)
        decisions.append(
            _decision_on(calibration, quantity, rule, false_accept, conformity, devices)
        )
    if devices is not None and all(d.global_risks is None for d in decisions):
        raise bc.InputError(
            f"population {population!r} is of no limit that is given: global risks are stated for a slot or an unknown "
            "at one point, in its unit, with a mean where there is one limit only"
        )
    return Decisions(
        rule=rule,
        rule_in_words=RULES[rule].format(100 * false_accept),
        false_accept=false_accept,
        decisions=tuple(decisions),
        calibration=ws.identity(calibration),
        notes=tuple(ws.averaged_over(calibration)),
    )


def _decision_on(
    calibration: bc.Calibration,
    quantity: LimitedQuantity,
    rule: str,
    false_accept: float,
    conformity: float,
    devices: SpreadOfDevices | None,
) -> Decision:
    drawn, limits = quantity.drawn(), quantity.limits
    p = drawn.probability(limits)
    guarded = acceptance(drawn, limits, false_accept)
    accepted = guarded if rule == "guarded" else limits
    decision, why = _decide_limit(calibration, quantity, drawn, p, rule, false_accept)
    uncertainty, notes = drawn.uncertainty, list(quantity.notes)
    mean, u = drawn.values.mean(axis=0), np.hypot(drawn.values.std(axis=0), drawn.scatter)
    i = int(np.argmin(np.minimum(limits.high - mean, mean - limits.low) - 2 * u))
    worst_places = {name: values[i : i + 1] for name, values in quantity.places.items()}
    within = accepted or Limits(math.inf, math.inf)  # where no estimate is accepted
    spread = None if devices is None else with_population(quantity, devices)
    if devices is not None and spread is None:
        notes.append(
            "No global risk is stated: the population is of another quantity, or the limit is on a correction, or over "
            "a range, of which one standard deviation says nothing."
        )
    return Decision(
        limit=quantity.limit.text,
        quantity=quantity.limit.quantity,
        unit=quantity.unit,
        tolerance=limits,
        estimate=drawn.estimate,
        uncertainty=uncertainty,
        scatter=float(drawn.scatter.max()),
        probability=p,
        probability_error=drawn.probability_error(p),
        guard_bands=guarded and (guarded.low - limits.low, limits.high - guarded.high),
        accepted=accepted,
        decision=decision,
        why=why,
        risk={ACCEPT: 1 - p, REJECT: p}.get(decision),
        at=quantity.place,
        worst_at=replace(quantity, places=worst_places).place,
        population=spread,
        global_risks=None if spread is None else global_risks(*spread, uncertainty, limits, within),
        recalibration=recalibration(quantity, limits, calibration, conformity),
        notes=tuple(notes),
    )


def _decide_limit(
    calibration: bc.Calibration,
    quantity: LimitedQuantity,
    drawn: DrawnQuantity,
    p: float,
    rule: str,
    false_accept: float,
) -> tuple[str, str]:
    """Return the decision on a limit, and the reason in words."""
    limits, error = quantity.limits, drawn.probability_error(p)
    if reason := ws.why_not(calibration):
        return UNDECIDED, NOT_RELIABLE.format(reason.rstrip("."))
    if quantity.not_covered:
        return UNDECIDED, "; ".join(quantity.not_covered)
    options = {"of": quantity.limit.quantity, "scatter": drawn.scatter, "rare": false_accept}
    if untold := ws.find_not_measured(calibration, drawn.values, **options):
        values, risk = untold.by_readings_alone(calibration, drawn.values), false_accept
        alone = replace(drawn, values=values).probability(limits)
        same = (p >= 1 - risk) == (alone >= 1 - risk) and (p <= risk) == (alone <= risk)
        if untold.hyperparameter or not (same and abs(p - alone) <= risk):
            return UNDECIDED, f"{CANNOT}: {untold}. {untold.cure}"
    conforms, fails = percent(p, error), percent(1 - p, error)
    if rule == "guarded":
        if p >= 1 - false_accept:
            return ACCEPT, f"specific risk of false acceptance {fails}"
        if p <= false_accept:
            return REJECT, f"specific risk of false rejection {conforms}"
        return UNDECIDED, (
            f"it conforms with probability {conforms}: to accept or to reject it, "
            f"{100 * (1 - false_accept):g} % are needed"
        )
    if limits.hold(*drawn.estimate):
        where, decided, risk = "inside", ACCEPT, f"acceptance {fails}"
    else:
        where, decided, risk = "outside", REJECT, f"rejection {conforms}"
    return decided, f"the estimate is {where} the limits; specific risk of false {risk}"
