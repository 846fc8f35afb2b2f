"""Does it conform? Decisions about limits, with the rule, the guard band and the risks of each.

Three rules, one of which the laboratory and its customer agree on beforehand (ISO/IEC 17025:2017, 7.1.3 and 7.8.6):

- *simple*: accept where the estimate is inside the limits, whatever its uncertainty (JCGM 106:2012, 8.2);
- *shared-risk*: the same, agreed on because the uncertainty is small: where the capability index
  (7.6), the tolerance over two expanded uncertainties, k = 2, is below a stated one, nothing is decided;
- *guarded*: accept where the probability of a false acceptance is at most the stated one, that is, where the estimate
  is inside the limits by the guard bands; reject where the probability of a false rejection is; between them,
  undecided (8.3; ILAC-G8:09/2019 calls it a non-binary statement with guard bands).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, Protocol, get_args

import numpy as np
import pandas as pd

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.description import identity
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._data.unit_parsing import STANDARD_GRAVITY
from bayescal._use.conformity import (
    DrawnQuantity,
    GlobalRisks,
    Limits,
    acceptance,
    global_risks,
    risks_of_curves,
)
from bayescal._use.decision import ACCEPT, REJECT, UNDECIDED, Decision, Decisions, percent
from bayescal._use.limit import SpreadOfDevices, StatedLimit, spread_of_devices, stated_limit
from bayescal._use.limited_quantity import LimitedQuantity, limited_quantity, with_population
from bayescal._use.provenance import averaged_over
from bayescal._use.recalibration import recalibration

Rule = Literal["simple", "guarded", "shared-risk"]
# What a guard band of one expanded uncertainty, k = 2, comes to about (JCGM 106, 8.3.2; ILAC-G8 gives < 2.5 %).
FALSE_ACCEPT = 0.025
# Where U, k = 2, is at most a third of the maximum permissible error, as OIML R 111-1 asks of weights (JCGM 106, 8.2).
CAPABILITY = 3.0
# Drawn anew where risks over a range are counted: a risk of 2.5 % has then a standard error of 0.05 percentage points.
DEVICES = 100_000
CONFORMITY = 0.95  # of which a recalibration interval is stated: the usual coverage of a statement


class HasTable(Protocol):
    """A population of devices, as fleets learn one: rows with coefficient, mean, mean_sd and group_sd."""

    @property
    def table(self) -> pd.DataFrame: ...


Population = str | SpreadOfDevices | HasTable | Sequence[str | SpreadOfDevices]


def decide(
    calibration: Calibration,
    limits: str | StatedLimit | Sequence[str | StatedLimit],
    *,
    rule: Rule = "guarded",
    false_accept: float = FALSE_ACCEPT,
    population: Population | None = None,
    capability: float = CAPABILITY,
    conformity: float = CONFORMITY,
    members: Mapping[str, str] | None = None,
    local_gravity: float = STANDARD_GRAVITY,
) -> Decisions:
    """Decide whether a calibrated device conforms, limit by limit.

    Args:
        calibration: a fit, or an average over structures, which puts what is not known of the structure into every
            probability.
        limits: such as "bias: ±0.5 °/s" or "corrected reading: ±0.1 °/s over -20..60 °C" (see `limit.py`).
        rule: "guarded", "simple" or "shared-risk".
        false_accept: probability of a false acceptance (and, of a false rejection) that "guarded" allows.
        population: devices of this kind, for global risks: "sd 0.2 °/s", "mean 0.1 sd 0.2 °/s", one for a limit by name
            ("bias: sd 0.2 °/s"), or the population of a fleet.
        capability: least ratio of the tolerance to 2U, k = 2, with which "shared-risk" decides.
        conformity: probability of which the recalibration interval is stated.
        members: which member of a group is used, such as {"device": "A17"}; every other counts as new.
        local_gravity: m/s², for limits in m/s² on accelerations in g.

    Raises:
        InputError: a limit, population, rule or probability that is none; says which and what to write.
        ModelError: the instrument does not say what it measures, and a limit is on something in use.
    """
    _refuse(rule, false_accept, capability, conformity)
    stated = [limits] if isinstance(limits, str | StatedLimit) else list(limits)
    if not stated:
        raise InputError('nothing to decide: give a limit, such as "bias: ±0.5 °/s"')
    devices, about_devices = _devices(population)
    how = _How(rule, false_accept, capability, conformity)
    found, used = [], set[int]()
    for one in stated:
        limit = stated_limit(one) if isinstance(one, str) else one
        quantity = limited_quantity(
            calibration, limit, members=members, local_gravity=local_gravity
        )
        spread = None
        for i, given in enumerate(devices):
            if (spread := with_population(quantity, given)) is not None or quantity.is_error:
                used.add(i)
                break
        tables = (given for given in devices if not isinstance(given, SpreadOfDevices))
        found.append(_decision(calibration, quantity, how, spread, next(tables, {}), bool(devices)))
    for i, given in enumerate(devices):
        if i not in used and isinstance(given, SpreadOfDevices):
            raise InputError(
                f"population {given.text!r} is of no limit that is given: global risks are stated for a slot or an "
                "unknown at one point, in its unit, with a mean where there is one limit only"
            )
    return Decisions(
        rule=rule,
        rule_in_words=_rule_in_words(how),
        false_accept=false_accept,
        decisions=tuple(found),
        calibration=identity(calibration),
        notes=(*averaged_over(calibration), *about_devices),
    )


class _How(NamedTuple):
    rule: Rule
    false_accept: float
    capability: float
    conformity: float


def _refuse(rule: str, false_accept: float, capability: float, conformity: float) -> None:
    if rule not in get_args(Rule):
        raise InputError(f"rule {rule!r} is none: choose {', '.join(get_args(Rule))}")
    if not 0 < false_accept < 0.5:
        raise InputError(
            f"false_accept = {false_accept:g}: a probability above 0 and below 0.5 was expected, such as 0.025"
        )
    if not 0.5 <= conformity < 1:
        raise InputError(
            f"conformity = {conformity:g}: a probability from 0.5 and below 1 was expected, such as 0.95"
        )
    if not 0 < capability < math.inf:
        raise InputError(f"capability = {capability:g}: a positive ratio was expected, such as 3")


def _devices(
    given: Population | None,
) -> tuple[list[SpreadOfDevices | dict[str, tuple[float, float]]], list[str]]:
    """Populations as they are used, and what to know of them."""
    if given is None:
        return [], []
    if not isinstance(given, str | SpreadOfDevices | Sequence):
        table = given.table
        table = table.rename(columns={"spread": "group_sd"})  # as it was called; goes in 0.3.0
        if "group_sd" not in table:
            raise InputError(
                "this fleet has no population: fit it with population=True, or give the devices as text, such as "
                '"sd 0.2 °/s"'
            )
        # Of a device drawn anew: between the devices, and what is not known of their mean.
        sd = np.hypot(table["group_sd"], table["mean_sd"])
        rows = zip(table["coefficient"], table["mean"], sd, strict=True)
        unreliable = getattr(given, "ok", True) is False
        return [{str(n): (float(m), float(s)) for n, m, s in rows}], [
            "The population's own result is not reliable, and so are the global risks."
        ] * unreliable
    several = [given] if isinstance(given, str | SpreadOfDevices) else list(given)
    return [spread_of_devices(one) if isinstance(one, str) else one for one in several], []


def _decision(
    calibration: Calibration,
    quantity: LimitedQuantity,
    how: _How,
    devices: tuple[float, float] | None,
    table: Mapping[str, tuple[float, float]],
    asked: bool,
) -> Decision:
    drawn, limits = quantity.drawn(), quantity.limits
    p = drawn.probability(limits)
    guarded = acceptance(drawn, limits, how.false_accept)
    accepted = guarded if how.rule == "guarded" else limits
    decision, why = _decided(calibration, quantity, drawn, p, how)
    uncertainty = float(max(np.std(drawn.low), np.std(drawn.high)))
    notes = list(quantity.notes)
    within = accepted or Limits(math.inf, math.inf)  # where no estimate is accepted
    risks = None
    if devices is not None:
        risks = global_risks(*devices, uncertainty, limits, within)
    elif asked and quantity.is_error:
        # Each device is corrected by what was found of it: its error is estimated as zero, and the decision the same.
        took = decision == ACCEPT
        risks = GlobalRisks(p, float(took), (1 - p) * took, p * (not took))
    elif (curves := quantity.curves(table, DEVICES)) is not None:
        risks = risks_of_curves(*curves, limits, within, calibration.seed)
    elif asked:
        notes.append(
            "No global risk is stated: the population is of another quantity, or the limit holds over a range and no "
            "fleet says how the coefficients differ between devices."
        )
    return Decision(
        limit=quantity.limit.text,
        quantity=quantity.limit.quantity,
        unit=quantity.unit,
        tolerance=limits,
        estimate=drawn.estimate,
        uncertainty=uncertainty,
        scatter=drawn.scatter,
        probability=p,
        probability_error=drawn.probability_error(p),
        guard_bands=None
        if guarded is None
        else (guarded.low - limits.low, limits.high - guarded.high),
        accepted=accepted,
        decision=decision,
        why=why,
        risk={ACCEPT: 1 - p, REJECT: p}.get(decision),
        at=quantity.place,
        population=devices,
        global_risks=risks,
        recalibration=recalibration(quantity, limits, calibration, how.conformity),
        notes=tuple(notes),
    )


def _decided(
    calibration: Calibration, quantity: LimitedQuantity, drawn: DrawnQuantity, p: float, how: _How
) -> tuple[str, str]:
    """The decision, and why."""
    limits, error = quantity.limits, drawn.probability_error(p)
    if why_not := calibration.verdict.why_not:
        return UNDECIDED, f"the calibration is not reliable: {why_not.rstrip('.')}"
    if quantity.not_covered:
        return UNDECIDED, "; ".join(quantity.not_covered)
    conforms, fails = percent(p, error), percent(1 - p, error)
    if how.rule == "guarded":
        if p >= 1 - how.false_accept:
            return ACCEPT, f"specific risk of false acceptance {fails}"
        if p <= how.false_accept:
            return REJECT, f"specific risk of false rejection {conforms}"
        return UNDECIDED, (
            f"it conforms with probability {conforms}: to accept or to reject it, "
            f"{100 * (1 - how.false_accept):g} % are needed"
        )
    if how.rule == "shared-risk":
        index = capability_index(drawn, limits)
        if index is None:
            return (
                UNDECIDED,
                "a capability index needs two limits, and there is one: agree on another rule",
            )
        if index < how.capability:
            return UNDECIDED, (
                f"the capability index T/(4u) = {number(index)} is below {how.capability:g}, on which the risk is "
                "shared"
            )
    if limits.hold(*drawn.estimate):
        return (
            ACCEPT,
            f"the estimate is inside the limits; specific risk of false acceptance {fails}",
        )
    return (
        REJECT,
        f"the estimate is outside the limits; specific risk of false rejection {conforms}",
    )


def capability_index(drawn: DrawnQuantity, limits: Limits) -> float | None:
    """Width of the tolerance over 4u (JCGM 106, 7.6); None with a single limit."""
    width = limits.high - limits.low
    u = math.hypot(max(np.std(drawn.low), np.std(drawn.high)), drawn.scatter)
    if math.isinf(width):
        return None
    return width / (4 * u) if u > 0 else math.inf


def _rule_in_words(how: _How) -> str:
    if how.rule == "guarded":
        return (
            f"guarded acceptance, probability of false acceptance at most {100 * how.false_accept:g} %, undecided "
            "where neither acceptance nor rejection is as safe (JCGM 106:2012, 8.3; ILAC-G8:09/2019)"
        )
    if how.rule == "simple":
        return "simple acceptance, the estimate inside the limits, without guard bands (JCGM 106:2012, 8.2)"
    return (
        f"shared risk, simple acceptance agreed on with a capability index T/(4u) of at least {how.capability:g} "
        "(JCGM 106:2012, 7.6 and 8.2)"
    )
