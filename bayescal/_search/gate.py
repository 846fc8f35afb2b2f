"""The gate: whether the last model is to be used. It asks everything that the fits and checks know.

Its own checks are of all steps, the last one judged.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bayescal._calibration.claim import Claim, as_claim, limit
from bayescal._calibration.judgement import (
    Subject,
    odd_thermometers,
    of_runs,
    only_between_runs,
    residual_claims,
    unexpected_groups,
)
from bayescal._calibration.leave_group_out import FEW_IN_GROUP, scheme
from bayescal._core.settings import settings
from bayescal._search.search_path import WORSE_RATIO, Gate, Step
from bayescal._search.taken_over import TakenOver, said_of_profiles, taken_over

WORSE = "step.predicts_worse"


def gate(steps: Sequence[Step]) -> Gate:
    """Return whether the last model is to be used and its probabilities believed; if not, every reason."""
    if reasons := against(steps):
        return Gate(False, " ".join(reasons), reasons)
    # Of fewer readings no correlation reaches that many standard deviations.
    if len(steps[-1].calibration.readings) < int(limit("noise.correlated", "z") ** 2) + 1:
        return Gate(True, "converged; too few readings to see whether neighbours are correlated")
    return Gate(True, "converged; neighbouring residuals are not correlated")


def against(steps: Sequence[Step]) -> tuple[Claim, ...]:
    """Return why the last model is not to be used; what was found against it earlier among it."""
    last = steps[-1]
    found = dict.fromkeys([*freed(steps), *(last.against or _claims_of_last(steps))])
    earlier = (w for w in last.calibration.verdict.against if w not in found)
    return (*dict.fromkeys(map(as_claim, earlier)), *found)


def _claims_of_last(steps: Sequence[Step]) -> list[Claim]:
    last, first = steps[-1], steps[0].calibration.model
    judged = {"check": last.check, "left_out": last.left_out, "doubts": last.doubts}
    subject = Subject(last.calibration, **judged, first=first, missing=_may_be_missing(last))
    replaced = [one.claim for one in _followed(steps) if not one.measured][:1]
    return [
        *(*last.different, *residual_claims(subject)),
        *(*undecided(steps), *equivalent(steps, "doubt")),
        *(*odd_thermometers(subject), *replaced, *worsened(steps)),
        *(*unexpected_groups(subject), *runs_unlike(steps), *contradicted(steps)),
    ]


def judged(steps: Sequence[Step]) -> tuple[tuple[Step, ...], Gate]:
    """Return steps whose last calibration knows what stands against it, wherever it is taken; and the gate."""
    last, found = steps[-1], gate(steps)
    notes = [*said_of_profiles(last.calibration)]
    if last.calibration.verdict.ok:
        hardly = (one for one in _followed(steps) if one.measured and one.confounded)
        notes += [one.claim for one in hardly]
    notes += [*sensor_or_thermometer(steps), *equivalent(steps, "note")]
    if notes := [*notes, *two_levels(steps), *in_one_order(steps)]:
        last = last.noted(notes)
    if last.calibration.verdict.ok:
        last = last.judged(found.claims)
    return (*steps[:-1], last), found


def freed(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield what stands against a model in which a coefficient is free of its stated value."""
    if free := [e.frees for e in steps[-1].calibration.model.effects if e.frees]:
        yield Claim("value.freed", *free)
        yield from (one for one in steps[0].against if not set(one.of).isdisjoint(free))


def _followed(steps: Sequence[Step]) -> list[TakenOver]:
    """Return terms of the first model, most moved first; placeholders are compared with the last model without any."""
    last, found = steps[-1].calibration, list[TakenOver]()
    unnamed = {e.name for e in last.model.effects if e.unnamed}
    plain = [s.calibration for s in steps[:-1] if unnamed.isdisjoint(s.calibration.model.names)]
    latent = steps[-1].discovery.latent if steps[-1].discovery else ()
    if plain:
        found = [one for one in taken_over(plain[0], last, latent) if not one.unnamed]
        found += [one for one in taken_over(plain[-1], last, latent) if one.unnamed]
    return sorted(found, key=lambda one: -one.moved)


def sensor_or_thermometer(steps: Sequence[Step]) -> Iterator[Claim]:
    """What the last model holds that a thermometer or a logger would make as well; no reading of the file tells.

    A thermometer that is late by τ, alike in every run, turns c·T into c·T − c·τ·dT/dt, and so does an output that is
    early; one that drifts in every run makes a warm-up, and one that drifts over the record, or is slow in one run, an
    effect in time that was not expected.
    """
    readings, model = steps[-1].calibration.readings, steps[-1].calibration.model
    warm = sorted(n for n in model.columns if readings.has(n) and readings.unit(n) == "degC")
    added = {*model.names} - {*steps[0].calibration.model.names}
    timed = [e for e in model.effects if "time" in e.columns or e.along == "elapsed"]
    in_time = [
        e.name
        for e in timed
        if e.along == "elapsed" or e.name in added or not set(warm).isdisjoint(e.columns)
    ]
    if warm and in_time:
        yield Claim("thermometer.or_sensor", *in_time, columns=tuple(warm))


def equivalent(steps: Sequence[Step], severity: str) -> list[Claim]:
    """Effects of the last model that these readings cannot tell apart."""
    said = steps[-1].discovery.equivalent if steps[-1].discovery else ()
    return [one for one in said if one.severity == severity and "cure" in one.numbers]


def two_levels(steps: Sequence[Step]) -> Iterator[Claim]:
    """That coefficients are of the mean of two levels, where the output steps within the record."""
    calibration = steps[-1].calibration
    jumps = (e for e in calibration.model.effects if e.kind == "jump" and e.covariate == "time")
    if (jump := next(jumps, None)) is not None:
        time, added = calibration.readings["time"], calibration.linear.contribution(jump.name)
        order = np.argsort(time, kind="stable")
        at = float(time[order][1 + int(np.argmax(np.abs(np.diff(added[order]))))])
        told = {"apart": float(np.ptp(added)), "unit": calibration.unit, "at": at}
        yield Claim("level.which", jump.name, **told)


def in_one_order(steps: Sequence[Step]) -> Iterator[Claim]:
    """What has no name and follows an input that always comes from the same value before it.

    An output that is late or smoothed holds a part of the reading before. Where that was always at the same value of
    the input, this is a function of the input.
    """
    calibration = steps[-1].calibration
    readings, (order, since) = calibration.readings, calibration.problem.record.in_time
    share = limit("input.one_order", "share")
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
        if again.any() and pairs[again].max(axis=1).sum() > share * visits[again].sum():
            yield Claim("input.one_order", effect.name, column=column)


def _may_be_missing(step: Step) -> dict[str, str]:
    """What may be what residuals still depend on: which cure, and what it names."""
    candidates = step.discovery.candidates if step.discovery else ()
    if leads := [c for c in candidates if c.kind == "lead"]:
        named = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
        return {"cure": "lead", "named": named, "lead": leads[0].effect}
    return {"cure": "nothing"}


def undecided(steps: Sequence[Step]) -> Iterator[Claim]:
    """Something is missing, and the readings do not say what: neither an effect nor one of several."""
    found = steps[-1].discovery
    if found is None or found.nothing_missing is None or found.sets or found.unnamed:
        return
    if found.nothing_missing < limit("complete.undecided", "probability"):
        leads = [c for c in found.candidates if c.probability is not None][:3]
        told = {"named": tuple(f"{c.effect} ({c.probability:.2f})" for c in leads)}
        names = (c.effect for c in leads)
        yield Claim("complete.undecided", *names, complete=found.nothing_missing, **told)


def worsened(steps: Sequence[Step]) -> Iterator[Claim]:
    """What an added effect made worse: the error as fitted, leave-one-group-out, of the hold-out data."""
    *earlier, last = steps
    unit, out = last.calibration.unit, last.left_out
    # Under another noise law readings weigh differently, and correlated noise takes up what an effect explained: their
    # plain error may well be larger.
    noise = last.calibration.model.noise
    alike = [s for s in earlier if s.calibration.model.noise == noise and noise.independent]
    before = min((s.rmse_fitted for s in alike), default=math.inf)
    if last.added is not None and last.rmse_fitted > WORSE_RATIO * before:
        errors = {"then": before, "now": last.rmse_fitted, "unit": unit}
        yield Claim("step.raises_error", last.added, step=last.title, **errors)
    if out and (best := left_out_better(last, earlier)) and best.left_out:
        what = f"each {out.group} from the others ({scheme(out.group)})"
        errors = {"then": best.left_out.rmse, "now": out.rmse, "unit": unit}
        yield Claim(WORSE, out.group, what=what, step=best.title, **errors)
    if (best := holdout_better(last, earlier)) and best.holdout_rmse and last.holdout_rmse:
        errors = {"then": best.holdout_rmse, "now": last.holdout_rmse, "unit": unit}
        yield Claim(WORSE, what="the hold-out data", step=best.title, **errors)


def runs_unlike(steps: Sequence[Step]) -> Iterator[Claim]:
    """Runs that stand apart, each predicted from the others, all along, by what the model has no name for.

    The state in which a run begins, a noise that wanders or a step between runs takes up any such difference. A
    deviation from run to run is a name for it, with a spread that a new run is predicted with.
    """
    out, calibration = steps[-1].left_out, steps[-1].calibration
    own = (b.coefficient for b in calibration.layout.blocks)
    if out is None or out.group != "run" or not np.isfinite(out.residual).all():
        return
    means, within = of_runs(calibration, out.residual)
    named = any(c.group_sd and not c.initial for c in own)
    if not named and only_between_runs(out.residual, within):
        # A run is predicted from the mean of the others, from which it is further off than from the mean of all.
        apart = float(np.ptp(means)) * (1 - 1 / out.count)
        sizes = {"apart": apart, "within": float(np.sqrt(np.mean(within**2)))}
        yield Claim("runs.unlike", **sizes, unit=calibration.unit)


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
    # Densities are of whole groups: correlated noise makes readings of one group no separate evidence.
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


def contradicted(steps: Sequence[Step]) -> Iterator[Claim]:
    """What hold-out data say against the last model itself, whatever came before."""
    test, error = steps[-1].holdout_test, steps[-1].holdout_rmse
    if test is None or error is None:
        return
    found = test.against
    if found.p < settings().holdout_p and found.share > WORSE_RATIO:
        before = f", {found.most} before all" if found.most else ""
        told = {"error": float(error), "other": float(error / found.share), "p": found.p}
        unit = steps[-1].calibration.unit
        yield Claim("holdout.contradicts", **told, before=before, unit=unit)
    elif found.scatter > limit("holdout.scatters", "ratio"):
        yield Claim("holdout.scatters", scatter=found.scatter)
