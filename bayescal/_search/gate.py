"""Acceptance checks of the last model of a search path: whether it is fit for use."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from bayescal._calibration import judgement
from bayescal._calibration.claim import Claim, as_claim, limit
from bayescal._calibration.leave_group_out import scheme
from bayescal._core.settings import settings
from bayescal._search.replaced_terms import TermComparison, find_replaced_terms, list_profile_claims
from bayescal._search.search_path import WORSE_RATIO, Gate, Step

WORSE_CODE = "step.predicts_worse"


def assess_last(steps: Sequence[Step]) -> Gate:
    """Return the outcome of the last model's acceptance checks, with all reasons if it fails, earlier ones first."""
    last = steps[-1]
    claims = dict.fromkeys([*find_freed_values(steps), *(last.failures or _claims_of_last(steps))])
    earlier_claims = (as_claim(w) for w in last.calibration.verdict.against if w not in claims)
    if all_claims := (*dict.fromkeys(earlier_claims), *claims):
        return Gate(False, " ".join(all_claims), all_claims)
    # With fewer readings no correlation reaches the limit, in standard deviations.
    if len(last.calibration.readings) < int(limit("noise.correlated", "z") ** 2) + 1:
        return Gate(True, "converged; too few readings to see whether neighbours are correlated")
    return Gate(True, "converged; neighbouring residuals are not correlated")


def _claims_of_last(steps: Sequence[Step]) -> list[Claim]:
    last = steps[-1]
    subject = judgement.Subject(
        last.calibration,
        check=last.check,
        leave_one_group_out=last.leave_one_group_out,
        mode_claims=last.multimodality,
        first_model=steps[0].calibration.model,
        remedy=_choose_remedy(last),
    )
    claims = [*last.outlying_groups, *judgement.residual_claims(subject), *find_undecided(steps)]
    claims += [*equivalent_claims(steps, "doubt"), *judgement.find_thermometer_anomalies(subject)]
    claims += [term.claim for term in _compare_terms(steps) if not term.is_measured][:1]
    claims += [*find_worsened(steps), *judgement.find_outlying_group(subject)]
    return [*claims, *find_unlike_runs(steps), *find_contradictions(steps)]


def assess_steps(steps: Sequence[Step]) -> tuple[tuple[Step, ...], Gate]:
    """Run the acceptance checks of the last step; return the steps with its verdict updated, and the outcome."""
    last_step, outcome = steps[-1], assess_last(steps)
    notes = [*list_profile_claims(last_step.calibration)]
    if last_step.calibration.verdict.ok:
        measured_terms = (term for term in _compare_terms(steps) if term.is_measured)
        notes += [term.claim for term in measured_terms if term.is_confounded]
    notes += [*find_thermometer_doubts(steps), *equivalent_claims(steps, "note")]
    notes += find_two_levels(steps)
    if notes:
        last_step = last_step.with_notes(notes)
    if last_step.calibration.verdict.ok:
        last_step = last_step.with_reasons(outcome.claims)
    return (*steps[:-1], last_step), outcome


def find_freed_values(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield claims on coefficients that the last model estimates although their values were stated."""
    if freed_names := [e.frees for e in steps[-1].calibration.model.effects if e.frees]:
        yield Claim("value.freed", *freed_names)
        yield from (c for c in steps[0].failures if not set(c.subjects).isdisjoint(freed_names))


def _compare_terms(steps: Sequence[Step]) -> list[TermComparison]:
    """Compare the last model's terms with those of the first model and of the last model without unnamed effects."""
    last, terms = steps[-1].calibration, list[TermComparison]()
    names = {e.name for e in last.model.effects if e.unnamed}
    fits = [s.calibration for s in steps[:-1] if names.isdisjoint(s.calibration.model.names)]
    latent_names = steps[-1].discovery.latent if steps[-1].discovery else ()
    if fits:
        terms = [t for t in find_replaced_terms(fits[0], last, latent_names) if not t.is_unnamed]
        terms += [t for t in find_replaced_terms(fits[-1], last, latent_names) if t.is_unnamed]
    return sorted(terms, key=lambda term: -term.shift)


def find_thermometer_doubts(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim if the last model's thermal terms may be errors of the thermometer or the data logger.

    A thermometer delay τ makes c·T appear as c·T + c·τ·dT/dt of the recorded T, as does an output time-stamped too
    early by τ; a drifting thermometer resembles a warm-up or another effect in time.
    """
    readings, model = steps[-1].calibration.readings, steps[-1].calibration.model
    columns = sorted(n for n in model.columns if readings.has(n) and readings.unit(n) == "degC")
    added_names = {*model.names} - {*steps[0].calibration.model.names}
    time_effects = [e for e in model.effects if "time" in e.columns or e.along == "elapsed"]
    warm_up = {e.name for e in time_effects if e.along == "elapsed" or {*columns} & {*e.columns}}
    time_names = [e.name for e in time_effects if e.name in warm_up | added_names]
    if columns and time_names:
        yield Claim("thermometer.or_sensor", *time_names, columns=tuple(columns))


def equivalent_claims(steps: Sequence[Step], severity: str) -> list[Claim]:
    """Return claims of one severity on equivalent effects of the last model, which the readings cannot separate."""
    claims = steps[-1].discovery.equivalent if steps[-1].discovery else ()
    return [claim for claim in claims if claim.severity == severity and "cure" in claim.numbers]


def find_two_levels(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim if the output has a step within the record: coefficients are then means over two levels."""
    calibration = steps[-1].calibration
    jumps = (e for e in calibration.model.effects if e.kind == "jump" and e.covariate == "time")
    if (jump := next(jumps, None)) is not None:
        time, added = calibration.readings["time"], calibration.linear.contribution(jump.name)
        order = np.argsort(time, kind="stable")
        step_time = float(time[order][1 + int(np.argmax(np.abs(np.diff(added[order]))))])
        details = {"apart": float(np.ptp(added)), "unit": calibration.unit, "at": step_time}
        yield Claim("level.which", jump.name, **details)


def _choose_remedy(step: Step) -> dict[str, str]:
    """Return the claim fields of the remedy for structured residuals: test the leads; none without leads."""
    candidates = step.discovery.candidates if step.discovery else ()
    if leads := [c for c in candidates if c.kind == "lead"]:
        lead_names = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
        return {"cure": "lead", "named": lead_names, "lead": leads[0].effect}
    return {"cure": "nothing"}


def find_undecided(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim if the model is probably incomplete, but no finding states which effect is missing."""
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


def find_worsened(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield claims on rms errors that the last effect increased: as fitted, leave-one-group-out, hold-out."""
    *previous, last = steps
    unit, left_out = last.calibration.unit, last.leave_one_group_out
    # Under another noise law readings have other weights, and an effect's part may be noise: the error may be larger.
    noise = last.calibration.model.noise
    comparable = [s for s in previous if s.calibration.model.noise == noise and noise.independent]
    lowest_rms = min((s.rmse_fitted for s in comparable), default=math.inf)
    if last.added is not None and last.rmse_fitted > WORSE_RATIO * lowest_rms:
        errors = {"then": lowest_rms, "now": last.rmse_fitted, "unit": unit}
        yield Claim("step.raises_error", last.added, step=last.title, **errors)
    if left_out and (best := find_better_left_out(last, previous)) and best.leave_one_group_out:
        prediction = f"each {left_out.group} from the others ({scheme(left_out.group)})"
        errors = {"then": best.leave_one_group_out.rmse, "now": left_out.rmse, "unit": unit}
        yield Claim(WORSE_CODE, left_out.group, what=prediction, step=best.title, **errors)
    if (best := find_better_holdout(last, previous)) and best.holdout_rmse and last.holdout_rmse:
        errors = {"then": best.holdout_rmse, "now": last.holdout_rmse, "unit": unit}
        yield Claim(WORSE_CODE, what="the hold-out data", step=best.title, **errors)


def find_unlike_runs(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim if left-out runs differ by offsets that no term of the model describes.

    Initial states, random-walk noise and steps between runs absorb such offsets in the fit but do not predict them; a
    random effect between runs does, by its estimated standard deviation.
    """
    left_out, calibration = steps[-1].leave_one_group_out, steps[-1].calibration
    coefficients = (b.coefficient for b in calibration.layout.blocks)
    if left_out is None or left_out.group != "run" or not np.isfinite(left_out.residual).all():
        return
    means, deviations = judgement.split_by_run(calibration, left_out.residual)
    has_run_effect = any(c.group_sd and not c.initial for c in coefficients)
    if not has_run_effect and judgement.is_between_runs_only(left_out.residual, deviations):
        # Prediction from the mean of the n − 1 other runs has n/(n − 1) times the distance from the mean of all.
        mean_range = float(np.ptp(means)) * (1 - 1 / left_out.count)
        sizes = {"apart": mean_range, "within": float(np.sqrt(np.mean(deviations**2)))}
        yield Claim("runs.unlike", **sizes, unit=calibration.unit)


def find_better_left_out(last: Step, previous: Sequence[Step]) -> Step | None:
    """Return the step with the smallest leave-one-group-out error, if significantly better than the last; else None.

    Two criteria must hold. The error, with the weights of the last model, is smaller by more than a twentieth. The
    predictive density of all groups is higher beyond chance: if the last model is right, another model's density is k
    times as high with probability 1/k at most (Markov's inequality; the ratio's mean is one).
    """
    if (left_out := last.leave_one_group_out) is None:
        return None
    pairs = ((s.leave_one_group_out, s) for s in previous)
    scored_steps = [(o.error(left_out.variance), s) for o, s in pairs if o]
    error, best = min(scored_steps, key=lambda pair: pair[0], default=(math.inf, last))
    if left_out.error(left_out.variance) <= WORSE_RATIO * error or best.leave_one_group_out is None:
        return None
    # Joint densities of whole groups: under correlated noise the readings of a group are not independent evidence.
    ratio = float(np.sum(best.leave_one_group_out.log_score - left_out.log_score))
    return None if ratio <= -math.log(settings().holdout_p) else best


def find_better_holdout(last: Step, previous: Sequence[Step]) -> Step | None:
    """Return the earlier step with the smallest hold-out error, if the last is significantly worse in a paired test."""
    scored_steps = [(s.holdout_rmse, s) for s in previous if s.holdout_rmse is not None]
    if last.holdout_rmse is None or not scored_steps:
        return None
    error, best = min(scored_steps, key=lambda pair: pair[0])
    if last.holdout_rmse <= WORSE_RATIO * error:
        return None
    # Without a test of both steps the error alone decides.
    if last.holdout_test is None or best.holdout_test is None:
        return best
    return best if last.holdout_test.paired_test(best.holdout_test) < settings().holdout_p else None


def find_contradictions(steps: Sequence[Step]) -> Iterator[Claim]:
    """Yield a claim if hold-out data contradict the last model."""
    test, error = steps[-1].holdout_test, steps[-1].holdout_rmse
    if test is None or error is None:
        return
    result = test.contradiction
    if result.p < settings().holdout_p and result.ratio > WORSE_RATIO:
        coefficient = f", {result.coefficient} before all" if result.coefficient else ""
        details = {"error": float(error), "other": float(error / result.ratio), "p": result.p}
        unit = steps[-1].calibration.unit
        yield Claim("holdout.contradicts", **details, before=coefficient, unit=unit)
    elif result.scatter > limit("holdout.scatters", "ratio"):
        yield Claim("holdout.scatters", scatter=result.scatter)
