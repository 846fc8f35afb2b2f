"""The gate: whether the last model is to be used, by all that fits and checks of its steps know."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from bayescal._calibration.claim import Claim, as_claim, limit
from bayescal._calibration.judgement import (
    Subject,
    only_between_runs,
    outlying_groups,
    residual_claims,
    split_by_run,
    thermometer_anomalies,
)
from bayescal._calibration.leave_group_out import scheme
from bayescal._core.settings import settings
from bayescal._search.search_path import WORSE_RATIO, Gate, Step
from bayescal._search.taken_over import TakenOver, claims_of_profiles, taken_over

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
    claims = dict.fromkeys([*freed_value_claims(steps), *(last.failures or _claims_of_last(steps))])
    earlier = (w for w in last.calibration.verdict.against if w not in claims)
    return (*dict.fromkeys(map(as_claim, earlier)), *claims)


def _claims_of_last(steps: Sequence[Step]) -> list[Claim]:
    last, first = steps[-1], steps[0].calibration.model
    judged: dict[str, Any] = {"check": last.check, "left_out": last.leave_one_group_out}
    judged |= {"mode_claims": last.multimodality, "remedy": _may_be_missing(last)}
    subject = Subject(last.calibration, **judged, first_model=first)
    replaced = [term.claim for term in _followed_terms(steps) if not term.measured][:1]
    return [
        *(*last.outlying_groups, *residual_claims(subject)),
        *(*undecided(steps), *equivalent(steps, "doubt")),
        *(*thermometer_anomalies(subject), *replaced, *worsened(steps)),
        *(*outlying_groups(subject), *runs_unlike(steps), *contradicted(steps)),
    ]


def judged(steps: Sequence[Step]) -> tuple[tuple[Step, ...], Gate]:
    """Return steps whose last calibration knows what stands against it, wherever it is taken; and the gate."""
    last, outcome = steps[-1], gate(steps)
    notes = [*claims_of_profiles(last.calibration)]
    if last.calibration.verdict.ok:
        hardly = (term for term in _followed_terms(steps) if term.measured and term.confounded)
        notes += [term.claim for term in hardly]
    notes += [*sensor_or_thermometer(steps), *equivalent(steps, "note"), *two_levels(steps)]
    if notes:
        last = last.noted(notes)
    if last.calibration.verdict.ok:
        last = last.judged(outcome.claims)
    return (*steps[:-1], last), outcome


def freed_value_claims(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield what stands against a model in which a coefficient is free of its stated value."""
    if free := [e.frees for e in steps[-1].calibration.model.effects if e.frees]:
        yield Claim("value.freed", *free)
        yield from (c for c in steps[0].failures if not set(c.subjects).isdisjoint(free))


def _followed_terms(steps: Sequence[Step]) -> list[TakenOver]:
    """Return terms of the first model, most moved first; placeholders are compared with the last model without any."""
    last, terms = steps[-1].calibration, list[TakenOver]()
    unnamed = {e.name for e in last.model.effects if e.unnamed}
    plain = [s.calibration for s in steps[:-1] if unnamed.isdisjoint(s.calibration.model.names)]
    latent = steps[-1].discovery.latent if steps[-1].discovery else ()
    if plain:
        terms = [term for term in taken_over(plain[0], last, latent) if not term.unnamed]
        terms += [term for term in taken_over(plain[-1], last, latent) if term.unnamed]
    return sorted(terms, key=lambda term: -term.moved)


def sensor_or_thermometer(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim where the last model's thermal terms may be of the thermometer or the logger.

    A thermometer that is late by τ turns c·T into c·T − c·τ·dT/dt, as an output that is early does; one that drifts
    makes a warm-up, or an effect in time.
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
    """Return claims of one severity on effects of the last model that these readings cannot tell apart."""
    claims = steps[-1].discovery.equivalent if steps[-1].discovery else ()
    return [claim for claim in claims if claim.severity == severity and "cure" in claim.numbers]


def two_levels(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim where the output steps within the record: coefficients are means over two levels."""
    calibration = steps[-1].calibration
    jumps = (e for e in calibration.model.effects if e.kind == "jump" and e.covariate == "time")
    if (jump := next(jumps, None)) is not None:
        time, added = calibration.readings["time"], calibration.linear.contribution(jump.name)
        order = np.argsort(time, kind="stable")
        at = float(time[order][1 + int(np.argmax(np.abs(np.diff(added[order]))))])
        details = {"apart": float(np.ptp(added)), "unit": calibration.unit, "at": at}
        yield Claim("level.which", jump.name, **details)


def _may_be_missing(step: Step) -> dict[str, str]:
    """Return the cure of what residuals still depend on: leads, or none."""
    candidates = step.discovery.candidates if step.discovery else ()
    if leads := [c for c in candidates if c.kind == "lead"]:
        named = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
        return {"cure": "lead", "named": named, "lead": leads[0].effect}
    return {"cure": "nothing"}


def undecided(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim where something is missing that no effect, nor a set of them, is found to be."""
    discovery = steps[-1].discovery
    if discovery is None or discovery.nothing_missing is None:
        return
    if discovery.findings or discovery.unnamed:
        return
    if discovery.nothing_missing < limit("complete.undecided", "probability"):
        leads = [c for c in discovery.candidates if c.probability is not None][:3]
        details = {"named": tuple(f"{c.effect} ({c.probability:.2f})" for c in leads)}
        names = (c.effect for c in leads)
        yield Claim("complete.undecided", *names, complete=discovery.nothing_missing, **details)


def worsened(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield claims on errors that the last effect raised: as fitted, leave-one-group-out, hold-out."""
    *earlier, last = steps
    unit, out = last.calibration.unit, last.leave_one_group_out
    # Under another noise law readings weigh differently, and correlated noise takes up what an effect explained: their
    # plain error may well be larger.
    noise = last.calibration.model.noise
    comparable = [s for s in earlier if s.calibration.model.noise == noise and noise.independent]
    before = min((s.rmse_fitted for s in comparable), default=math.inf)
    if last.added is not None and last.rmse_fitted > WORSE_RATIO * before:
        errors = {"then": before, "now": last.rmse_fitted, "unit": unit}
        yield Claim("step.raises_error", last.added, step=last.title, **errors)
    if out and (best := left_out_better(last, earlier)) and best.leave_one_group_out:
        what = f"each {out.group} from the others ({scheme(out.group)})"
        errors = {"then": best.leave_one_group_out.rmse, "now": out.rmse, "unit": unit}
        yield Claim(WORSE, out.group, what=what, step=best.title, **errors)
    if (best := holdout_better(last, earlier)) and best.holdout_rmse and last.holdout_rmse:
        errors = {"then": best.holdout_rmse, "now": last.holdout_rmse, "unit": unit}
        yield Claim(WORSE, what="the hold-out data", step=best.title, **errors)


def runs_unlike(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim where left-out runs differ by offsets that no term of the model describes.

    The state in which a run begins, a noise that wanders or a step between runs takes up any such difference. A
    deviation from run to run is a name for it, with a spread that a new run is predicted with.
    """
    out, calibration = steps[-1].leave_one_group_out, steps[-1].calibration
    coefficients = (b.coefficient for b in calibration.layout.blocks)
    if out is None or out.group != "run" or not np.isfinite(out.residual).all():
        return
    means, within = split_by_run(calibration, out.residual)
    named = any(c.group_sd and not c.initial for c in coefficients)
    if not named and only_between_runs(out.residual, within):
        # A run is predicted from the mean of the others, from which it is further off than from the mean of all.
        distance = float(np.ptp(means)) * (1 - 1 / out.count)
        sizes = {"apart": distance, "within": float(np.sqrt(np.mean(within**2)))}
        yield Claim("runs.unlike", **sizes, unit=calibration.unit)


def left_out_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """Return the step of least leave-one-group-out error, if better than the last beyond chance.

    By the error, of which a twentieth is no rise, readings weighted as the last model expects them; and by the joint
    predictive density of the groups: if the last model is right, another's is k times as high with probability 1/k at
    most (Markov's inequality; the ratio's mean is one).
    """
    if (out := last.leave_one_group_out) is None:
        return None
    pairs = ((s.leave_one_group_out, s) for s in earlier)
    scored_steps = [(before.error(out.variance), s) for before, s in pairs if before]
    error, best = min(scored_steps, key=lambda pair: pair[0], default=(math.inf, last))
    if out.error(out.variance) <= WORSE_RATIO * error or best.leave_one_group_out is None:
        return None
    # Densities are of whole groups: correlated noise makes readings of one group no separate evidence.
    ratio = float(np.sum(best.leave_one_group_out.log_score - out.log_score))
    return None if ratio <= -math.log(settings().holdout_p) else best


def holdout_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """Return the step of least hold-out error, if the last is significantly worse in a paired test."""
    scored_steps = [(s.holdout_rmse, s) for s in earlier if s.holdout_rmse is not None]
    if last.holdout_rmse is None or not scored_steps:
        return None
    error, best = min(scored_steps, key=lambda pair: pair[0])
    if last.holdout_rmse <= WORSE_RATIO * error:
        return None
    # Of steps without a test the error alone decides.
    if last.holdout_test is None or best.holdout_test is None:
        return best
    return best if last.holdout_test.paired_test(best.holdout_test) < settings().holdout_p else None


def contradicted(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim where hold-out data contradict the last model."""
    test, error = steps[-1].holdout_test, steps[-1].holdout_rmse
    if test is None or error is None:
        return
    departure = test.contradiction
    if departure.p < settings().holdout_p and departure.ratio > WORSE_RATIO:
        before = f", {departure.coefficient} before all" if departure.coefficient else ""
        details = {"error": float(error), "other": float(error / departure.ratio), "p": departure.p}
        unit = steps[-1].calibration.unit
        yield Claim("holdout.contradicts", **details, before=before, unit=unit)
    elif departure.scatter > limit("holdout.scatters", "ratio"):
        yield Claim("holdout.scatters", scatter=departure.scatter)
