"""The gate: whether the last model is to be used. It asks everything that the fits and checks know."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayescal._calibration.claim import Claim, as_kept, distinct
from bayescal._calibration.judgement import (
    CORRELATED_SD,
    of_noise,
    of_runs,
    of_thermometers,
    only_between_runs,
    surprising,
)
from bayescal._calibration.leave_group_out import FEW_IN_GROUP, scheme
from bayescal._core.settings import settings
from bayescal._search.search_path import WORSE_RATIO, Gate, Step
from bayescal._search.taken_over import TakenOver, said_of_profiles, taken_over

# Probability that the model is complete, below which it is not to be used as it is.
UNLIKELY_COMPLETE = 0.05
# Times the scatter that a model expects of hold-out data, beyond which they are of something else.
EXPECTED_SCATTER_RATIO = 2.0
# Share of the steps of an input to a value that come from one value, above which it goes through its values in one
# order: of ten such steps one may be another.
IN_ORDER_SHARE = 0.9


WORSE = "step.predicts_worse"


def gate(steps: Sequence[Step]) -> Gate:
    """Whether the last model is to be used and its probabilities believed; if not, every reason."""
    return _gate(steps, against(steps))


def _gate(steps: Sequence[Step], reasons: Sequence[Claim]) -> Gate:
    if reasons:
        return Gate(False, " ".join(map(str, reasons)), tuple(reasons))
    # Of fewer readings no correlation reaches that many standard deviations.
    if len(steps[-1].calibration.readings) < int(CORRELATED_SD**2) + 1:
        return Gate(True, "converged; too few readings to see whether neighbours are correlated")
    return Gate(True, "converged; neighbouring residuals are not correlated")


def against(steps: Sequence[Step]) -> tuple[Claim, ...]:
    """Why the last model is not to be used; what was found against it earlier among it."""
    last = steps[-1]
    found = last.against or [
        *last.different,
        *of_noise(last.calibration, last.check, last.doubts, _may_be_missing(last)),
        *_undecided(last),
        *_equivalent(last, "doubt"),
        *of_thermometers(last.calibration, steps[0].calibration.model),
        *_taken_over(steps),
        *_against_the_steps_before(steps),
    ]
    earlier = map(as_kept, last.calibration.verdict.against)
    found = distinct([*_freed(steps), *found])
    said = {*map(str, found)}
    return (*(one for one in distinct(earlier) if str(one) not in said), *found)


def judged(steps: Sequence[Step]) -> tuple[tuple[Step, ...], Gate]:
    """Steps whose last calibration knows what stands against it, wherever it is taken; and the gate."""
    reasons, last = against(steps), steps[-1]
    notes = [
        *said_of_profiles(last.calibration),
        *_confounded(steps),
        *_not_decidable(steps),
        *_equivalent(last, "note"),
        *_levels(last),
        *in_one_order(last),
    ]
    if notes:
        last = last.noted(notes)
        steps = (*steps[:-1], last)
    if last.calibration.verdict.ok:
        steps = (*steps[:-1], last.judged(reasons))
    return tuple(steps), _gate(steps, reasons)


def _freed(steps: Sequence[Step]) -> list[Claim]:
    """What stands against a model in which a coefficient is free of its stated value."""
    free = [e.frees for e in steps[-1].calibration.model.effects if e.frees]
    concerned = [one for one in steps[0].against if not set(one.of).isdisjoint(free)]
    return [Claim("value.freed", *free), *concerned] if free else []


def _confounded(steps: Sequence[Step]) -> list[Claim]:
    """What the last model holds that these readings hardly tell from a term of the first."""
    if not steps[-1].calibration.verdict.ok:
        return []
    return [one.claim for one in _followed(steps) if one.measured and one.confounded]


def _followed(steps: Sequence[Step]) -> list[TakenOver]:
    """Terms of the first model in the last; what has no name is compared with the last model without such."""
    last, found = steps[-1].calibration, list[TakenOver]()
    unnamed = {e.name for e in last.model.effects if e.unnamed}
    plain = [s.calibration for s in steps[:-1] if unnamed.isdisjoint(s.calibration.model.names)]
    latent = steps[-1].discovery.latent if steps[-1].discovery else ()
    if plain:
        found = [one for one in taken_over(plain[0], last, latent) if not one.unnamed]
        found += [one for one in taken_over(plain[-1], last, latent) if one.unnamed]
    return sorted(found, key=lambda one: -one.moved)


def _not_decidable(steps: Sequence[Step]) -> list[Claim]:
    """What the last model holds that a thermometer or a logger would make as well.

    A thermometer that is late by τ, alike in every run, turns c·T into c·T − c·τ·dT/dt, and so does an output that is
    early; one that drifts in every run makes a warm-up, and one that drifts over the record, or is slow in one run, an
    effect in time that was not expected. Which of them it is no reading of the file tells.
    """
    readings, model = steps[-1].calibration.readings, steps[-1].calibration.model
    warm = sorted(n for n in model.columns if readings.has(n) and readings.unit(n) == "degC")
    had = {e.name for e in steps[0].calibration.model.effects}
    in_time = [
        e.name
        for e in model.effects
        if e.along == "elapsed"
        or ("time" in e.columns and (e.name not in had or not set(warm).isdisjoint(e.columns)))
    ]
    if not (warm and in_time):
        return []
    return [Claim("thermometer.or_sensor", *in_time, columns=tuple(warm))]


def _equivalent(step: Step, severity: str) -> list[Claim]:
    """Effects of the last model that these readings cannot tell apart."""
    said = step.discovery.equivalent if step.discovery else ()
    return [one for one in said if one.severity == severity and "cure" in one.numbers]


def _levels(step: Step) -> list[Claim]:
    """That coefficients are of the mean of two levels, where the output steps within the record."""
    calibration = step.calibration
    jumps = (e for e in calibration.model.effects if e.kind == "jump" and e.covariate == "time")
    if (jump := next(jumps, None)) is None:
        return []
    name = jump.name
    readings, added = calibration.readings, calibration.linear.contribution(name)
    order = np.argsort(readings["time"], kind="stable")
    at = float(readings["time"][order][1 + int(np.argmax(np.abs(np.diff(added[order]))))])
    apart = float(np.ptp(added))
    return [Claim("level.which", name, apart=apart, unit=calibration.unit, at=at)]


def in_one_order(step: Step) -> list[Claim]:
    """What has no name and follows an input that always comes from the same value before it.

    An output that is late or smoothed holds a part of the reading before. Where that was always at the same value of
    the input, this is a function of the input.
    """
    calibration = step.calibration
    readings, (order, since) = calibration.readings, calibration.problem.record.in_time
    found = []
    for effect in (e for e in calibration.model.effects if e.is_placeholder):
        column = effect.along or ""
        if not readings.has(column) or readings.unit(column) == "degC" or column == "time":
            continue
        _, level = np.unique(readings[column], return_inverse=True)
        here, before = level[order][1:][since[1:] >= 0], level[order][:-1][since[1:] >= 0]
        moved = here != before
        pairs = np.zeros(2 * (int(level.max()) + 1,))
        np.add.at(pairs, (here[moved], before[moved]), 1)
        visits = pairs.sum(axis=1)
        again = visits >= FEW_IN_GROUP
        if again.any() and pairs[again].max(axis=1).sum() > IN_ORDER_SHARE * visits[again].sum():
            found.append(Claim("input.one_order", effect.name, column=column))
    return found


def _taken_over(steps: Sequence[Step]) -> list[Claim]:
    """Terms of the first model that something else stands for in the last, the one that moved the most alone."""
    return [one.claim for one in _followed(steps) if not one.measured][:1]


def _may_be_missing(step: Step) -> dict[str, str]:
    """What may be what residuals still depend on: which cure, and what it names."""
    candidates = step.discovery.candidates if step.discovery else ()
    if leads := [c for c in candidates if c.kind == "lead"]:
        named = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
        return {"cure": "lead", "named": named, "lead": leads[0].effect}
    return {"cure": "nothing"}


def _undecided(step: Step) -> list[Claim]:
    """Something is missing, and the readings do not say what: neither an effect nor one of several."""
    found = step.discovery
    if found is None or found.nothing_missing is None or found.sets or found.unnamed:
        return []
    if found.nothing_missing >= UNLIKELY_COMPLETE:
        return []
    leads = [c for c in found.candidates if c.probability is not None][:3]
    named = tuple(f"{c.effect} ({c.probability:.2f})" for c in leads)
    told = {"complete": found.nothing_missing, "named": named}
    return [Claim("complete.undecided", *(c.effect for c in leads), **told)]


def _against_the_steps_before(steps: Sequence[Step]) -> list[Claim]:
    """What an added effect made worse: the error as fitted, leave-one-group-out, of the hold-out data."""
    reasons, unit = [], steps[-1].calibration.unit
    *earlier, last = steps
    # Under another noise law readings weigh differently, and correlated noise takes up what an effect explained: their
    # plain error may well be larger.
    noise = last.calibration.model.noise
    alike = [s for s in earlier if s.calibration.model.noise == noise and noise.independent]
    before = min((s.rmse_fitted for s in alike), default=math.inf)
    if last.added is not None and last.rmse_fitted > WORSE_RATIO * before:
        errors = {"then": before, "now": last.rmse_fitted, "unit": unit}
        reasons.append(Claim("step.raises_error", last.added, step=last.title, **errors))
    if last.left_out and (best := left_out_better(last, earlier)) and best.left_out:
        group = last.left_out.group
        what = f"each {group} from the others ({scheme(group)})"
        errors = {"then": best.left_out.rmse, "now": last.left_out.rmse, "unit": unit}
        reasons.append(Claim(WORSE, group, what=what, step=best.title, **errors))
    if (best := holdout_better(last, earlier)) and best.holdout_rmse and last.holdout_rmse:
        errors = {"then": best.holdout_rmse, "now": last.holdout_rmse, "unit": unit}
        reasons.append(Claim(WORSE, what="the hold-out data", step=best.title, **errors))
    return [*reasons, *surprising(last.left_out), *_runs_apart(last), *_contradicted(last)]


def _runs_apart(step: Step) -> list[Claim]:
    """Runs that stand apart, each predicted from the others, all along, by what the model has no name for.

    The state in which a run begins, a noise that wanders or a step between runs takes up any such difference. A
    deviation from run to run is a name for it, with a spread that a new run is predicted with.
    """
    out, calibration = step.left_out, step.calibration
    if out is None or out.group != "run" or not np.isfinite(out.residual).all():
        return []
    own = (b.coefficient for b in calibration.layout.blocks)
    if any(c.group_sd and not c.initial for c in own):
        return []
    means, within = of_runs(calibration, out.residual)
    if not only_between_runs(out.residual, within):
        return []
    # A run is predicted from the mean of the others, from which it is further off than from the mean of all.
    apart = float(np.ptp(means)) * (1 - 1 / out.count)
    sizes = {"apart": apart, "within": float(np.sqrt(np.mean(within**2)))}
    return [Claim("runs.unlike", **sizes, unit=calibration.unit)]


def left_out_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """The one of some steps that predicted groups from the others best, if better than the last beyond chance.

    By the error, of which a twentieth is no rise, readings weighted as the last model expects them; and by the joint
    predictive density of the groups: if the last model is right, another's is k times as high with probability 1/k at
    most (Markov's inequality; the ratio's mean is one).
    """
    if (out := last.left_out) is None:
        return None
    known = [(s.left_out.error(out.variance), s) for s in earlier if s.left_out]
    error, best = min(known, key=lambda one: one[0], default=(math.inf, last))
    if out.error(out.variance) <= WORSE_RATIO * error or best.left_out is None:
        return None
    # Of densities of whole groups, joint over their readings: correlated noise makes readings of one group no
    # separate evidence.
    ratio = float(np.sum(best.left_out.log_score - out.log_score))
    return None if ratio <= -math.log(settings().holdout_p) else best


def holdout_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """The same of the hold-out data, by a paired test against what the last model expects of its errors there."""
    known = [(s.holdout_rmse, s) for s in earlier if s.holdout_rmse is not None]
    if last.holdout_rmse is None or not known:
        return None
    error, best = min(known, key=lambda one: one[0])
    if last.holdout_rmse <= WORSE_RATIO * error:
        return None
    # Of steps without a test the error alone decides.
    if last.holdout_test is None or best.holdout_test is None:
        return best
    return best if last.holdout_test.worse_than(best.holdout_test) < settings().holdout_p else None


def _contradicted(step: Step) -> list[Claim]:
    """What hold-out data say against the last model itself, whatever came before."""
    error = step.holdout_rmse
    if step.holdout_test is None or error is None:
        return []
    found = step.holdout_test.against
    if found.p < settings().holdout_p and found.share > WORSE_RATIO:
        before = f", {found.most} before all" if found.most else ""
        told = {"error": float(error), "other": float(error / found.share), "p": found.p}
        told |= {"before": before, "unit": step.calibration.unit}
        return [Claim("holdout.contradicts", **told)]
    if found.scatter > EXPECTED_SCATTER_RATIO:
        return [Claim("holdout.scatters", scatter=found.scatter)]
    return []
