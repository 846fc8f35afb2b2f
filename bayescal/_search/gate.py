"""The gate: whether the last model is to be used. It asks everything that the fits and checks know."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayescal._calibration.judgement import CORRELATED_SD, of_noise, of_thermometers, surprising
from bayescal._calibration.leave_group_out import FEW_IN_GROUP, scheme
from bayescal._core.formatting import number
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._model.unknown_effect import FREED, JUMP
from bayescal._search.one_profile import said_of_profiles
from bayescal._search.search_path import WORSE_RATIO, Gate, Step
from bayescal._search.taken_over import IN_TIME, TakenOver, taken_over

# Probability that the model is complete, below which it is not to be used as it is.
UNLIKELY_COMPLETE = 0.05
# Times the scatter that a model expects of hold-out data, beyond which they are of something else.
EXPECTED_SCATTER_RATIO = 2.0
# Share of the steps of an input to a value that come from one value, above which it goes through its values in one
# order: of ten such steps one may be another.
IN_ORDER_SHARE = 0.9


def gate(steps: Sequence[Step]) -> Gate:
    """Whether the last model is to be used and its probabilities believed; if not, every reason."""
    return _gate(steps, against(steps))


def _gate(steps: Sequence[Step], reasons: Sequence[str]) -> Gate:
    if reasons:
        return Gate(False, " ".join(reasons))
    # Of fewer readings no correlation reaches that many standard deviations.
    if len(steps[-1].calibration.readings) < int(CORRELATED_SD**2) + 1:
        return Gate(True, "converged; too few readings to see whether neighbours are correlated")
    return Gate(True, "converged; neighbouring residuals are not correlated")


def against(steps: Sequence[Step]) -> list[str]:
    """Why the last model is not to be used, in words; what was found against it earlier among them."""
    last = steps[-1]
    found = last.against or [
        *last.different,
        *of_noise(last.calibration, last.check, last.doubts, _may_be_missing(last)),
        *_undecided(last),
        *of_thermometers(last.calibration, steps[0].calibration.model),
        *_taken_over(steps),
        *_against_the_steps_before(steps),
    ]
    found = [*_freed(steps), *found]
    return list(dict.fromkeys([*last.calibration.verdict.against, *found]))


def judged(steps: Sequence[Step]) -> tuple[tuple[Step, ...], Gate]:
    """Steps whose last calibration knows what stands against it, wherever it is taken; and the gate."""
    reasons, last = against(steps), steps[-1]
    notes = [
        *said_of_profiles(last.calibration),
        *_confounded(steps),
        *_not_decidable(steps),
        *_levels(last),
        *in_one_order(last),
    ]
    if notes:
        last = last.noted(notes)
        steps = (*steps[:-1], last)
    if last.calibration.verdict.ok:
        steps = (*steps[:-1], last.judged(reasons))
    return tuple(steps), _gate(steps, reasons)


def _freed(steps: Sequence[Step]) -> list[str]:
    """What stands against a model in which a coefficient is free of its stated value, in words."""
    free = [n for n in steps[-1].calibration.model.names if n.endswith(FREED)]
    if not free:
        return []
    concerned = [
        said for said in steps[0].against if any(n.removesuffix(FREED) in said for n in free)
    ]
    return [
        f"{', '.join(n.removesuffix(FREED) for n in free)}: the readings are explained with a value other than the "
        "stated one, and by no missing effect alone.",
        *concerned,
    ]


def _confounded(steps: Sequence[Step]) -> list[str]:
    """What the last model holds that these readings hardly tell from a term of the first, in words."""
    if not steps[-1].calibration.verdict.ok:
        return []
    return [str(one) for one in _followed(steps) if one.measured and one.confounded]


def _followed(steps: Sequence[Step]) -> list[TakenOver]:
    """Terms of the first model in the last; what has no name is compared with the last model without such."""
    last, found = steps[-1].calibration, list[TakenOver]()
    unnamed = {e.name for e in last.model.effects if e.unnamed}
    plain = [s.calibration for s in steps[:-1] if unnamed.isdisjoint(s.calibration.model.names)]
    if plain:
        found = [one for one in taken_over(plain[0], last) if not one.unnamed]
        found += [one for one in taken_over(plain[-1], last) if one.unnamed]
    return sorted(found, key=lambda one: -one.moved)


def _not_decidable(steps: Sequence[Step]) -> list[str]:
    """What the last model holds that a thermometer or a logger would make as well, in words.

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
    return [
        f"Not decidable from these readings: whether {' and '.join(in_time)} is of the sensor, or the thermometer "
        f"({', '.join(warm)}) or the output is late, slow or drifting. Predictions hold with this thermometer and this "
        "logger; compare the thermometer once with one at the sensor."
    ]


def _levels(step: Step) -> list[str]:
    """That coefficients are of the mean of two levels, where the output steps within the record, in words."""
    calibration = step.calibration
    if (name := f"unknown({JUMP})") not in calibration.model.names:
        return []
    readings, added = calibration.readings, calibration.linear.contribution(name)
    order = np.argsort(readings["time"], kind="stable")
    at = float(readings["time"][order][1 + int(np.argmax(np.abs(np.diff(added[order]))))])
    return [
        f"Not decidable from these readings: which of two levels, {number(np.ptp(added))} "
        f"{unit_label(calibration.unit)} apart, is that in use: the output steps at {number(at)} s ({name}), and the "
        "coefficients are of their mean. Look at what happened there; readings of another state belong in a file of "
        "their own."
    ]


def in_one_order(step: Step) -> list[str]:
    """What has no name and follows an input that always comes from the same value before it, in words.

    An output that is late or smoothed holds a part of the reading before. Where that was always at the same value of
    the input, this is a function of the input.
    """
    calibration = step.calibration
    readings, (order, since) = calibration.readings, calibration.assembly.record.in_time
    found = []
    for effect in (e for e in calibration.model.effects if e.is_placeholder):
        column = effect.along or ""
        if not readings.has(column) or readings.unit(column) == "degC" or column in IN_TIME:
            continue
        _, level = np.unique(readings[column], return_inverse=True)
        here, before = level[order][1:][since[1:] >= 0], level[order][:-1][since[1:] >= 0]
        moved = here != before
        pairs = np.zeros(2 * (int(level.max()) + 1,))
        np.add.at(pairs, (here[moved], before[moved]), 1)
        visits = pairs.sum(axis=1)
        again = visits >= FEW_IN_GROUP
        if again.any() and pairs[again].max(axis=1).sum() > IN_ORDER_SHARE * visits[again].sum():
            found.append(
                f"Not decidable from these readings: whether {effect.name} is of the sensor, or the output is late or "
                f"smoothed: {column} goes through its values in one order. Take them in another order in one run."
            )
    return found


def _taken_over(steps: Sequence[Step]) -> list[str]:
    """Terms of the first model that something else stands for in the last, the one that moved the most alone."""
    return [str(one) for one in _followed(steps) if not one.measured][:1]


def _may_be_missing(step: Step) -> str:
    """What may be what residuals still depend on, in words."""
    candidates = step.discovery.candidates if step.discovery else ()
    if leads := [c for c in candidates if c.kind == "lead"]:
        named = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
        return (
            f"{named} may be what is missing. Add it (--add {leads[0].effect}), or take the readings of the next "
            "experiment."
        )
    return "something is missing that no candidate describes, or readings of two devices or conditions are mixed."


def _undecided(step: Step) -> list[str]:
    """Something is missing, and the readings do not say what: neither an effect nor one of several."""
    found = step.discovery
    if found is None or found.nothing_missing is None or found.sets or found.unnamed:
        return []
    if found.nothing_missing >= UNLIKELY_COMPLETE:
        return []
    leads = [c for c in found.candidates if c.probability is not None][:3]
    named = ", ".join(f"{c.effect} ({c.probability:.2f})" for c in leads)
    return [
        f"The model is complete with probability {found.nothing_missing:.2g} only, and the readings do not tell what "
        f"is missing; the most probable are {named}."
    ]


def _against_the_steps_before(steps: Sequence[Step]) -> list[str]:
    """What an added effect made worse: the error as fitted, leave-one-group-out, of the hold-out data."""
    reasons, unit = [], unit_label(steps[-1].calibration.unit)
    *earlier, last = steps
    # Under another noise law readings weigh differently, and correlated noise takes up what an effect explained: their
    # plain error may well be larger.
    noise = last.calibration.model.noise
    alike = [s for s in earlier if s.calibration.model.noise == noise and noise.independent]
    before = min((s.rmse_fitted for s in alike), default=math.inf)
    if last.added is not None and last.rmse_fitted > WORSE_RATIO * before:
        reasons.append(
            f"Step {last.title!r} raises the error as fitted, {before:.3g} → {last.rmse_fitted:.3g} {unit}: do not use "
            "it."
        )
    if last.left_out and (best := left_out_better(last, earlier)) and best.left_out:
        what = f"each {last.left_out.group} from the others ({scheme(last.left_out.group)})"
        reasons.append(_worse(what, best, best.left_out.rmse, last.left_out.rmse, unit))
    if (best := holdout_better(last, earlier)) and best.holdout_rmse and last.holdout_rmse:
        reasons.append(
            _worse("the hold-out data", best, best.holdout_rmse, last.holdout_rmse, unit)
        )
    return [*reasons, *surprising(last.left_out), *_contradicted(last)]


def left_out_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """The one of some steps that predicted groups from the others best, if better than the last beyond chance.

    By the error, of which a twentieth is no rise, and by the joint predictive density of the groups: if the last model
    is right, another's is k times as high with probability 1/k at most (Markov's inequality; the ratio's mean is one).
    """
    known = [(s.left_out.rmse, s) for s in earlier if s.left_out]
    if last.left_out is None or not known:
        return None
    error, best = min(known, key=lambda one: one[0])
    if last.left_out.rmse <= WORSE_RATIO * error or best.left_out is None:
        return None
    # Of densities of whole groups, joint over their readings: correlated noise makes readings of one group no
    # separate evidence.
    ratio = float(np.sum(best.left_out.log_score - last.left_out.log_score))
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


def _contradicted(step: Step) -> list[str]:
    """What hold-out data say against the last model itself, whatever came before."""
    error = step.holdout_rmse
    if step.holdout_test is None or error is None:
        return []
    found, unit = step.holdout_test.against, unit_label(step.calibration.unit)
    other = "They are of another device or condition, or the model is wrong."
    if found.p < settings().holdout_p and found.share > WORSE_RATIO:
        of = f", {found.most} before all" if found.most else ""
        return [
            f"The hold-out data contradict the last model: its error there, {number(error)} {unit}, would be "
            f"{number(error / found.share)} with other coefficients{of}, and a right model is so far off with "
            f"probability {found.p:.2g}. {other}"
        ]
    if found.scatter > EXPECTED_SCATTER_RATIO:
        return [
            "The last model predicts the hold-out data worse than it claims: they scatter "
            f"{found.scatter:.1f} times as much as expected. {other}"
        ]
    return []


def _worse(what: str, best: Step, then: float, now: float, unit: str) -> str:
    return (
        f"The last model predicts {what} worse than step {best.title!r}, {then:.3g} → {now:.3g} {unit}: "
        "what was changed since holds for these readings alone."
    )
