"""The gate: whether the last model is to be used. It asks everything that the fits and checks know."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.guards import conflicts, without_priors
from bayescal._calibration.leave_group_out import scheme
from bayescal._calibration.settings import guarding
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._data.dataset_checks import oddities, rounding_step
from bayescal._data.record_settings import recording
from bayescal._data.unit_conversion import unit_label
from bayescal._model.unknown_effect import FORMS, FREED, JUMP, covariate_in
from bayescal._search.one_profile import said_of_profiles
from bayescal._search.search_path import Gate, Step
from bayescal._search.taken_over import IN_TIME, TakenOver, taken_over


def gate(steps: Sequence[Step]) -> Gate:
    """Whether the last model is to be used and its probabilities believed; if not, every reason."""
    return _gate(steps, against(steps))


def _gate(steps: Sequence[Step], reasons: Sequence[str]) -> Gate:
    if reasons:
        return Gate(False, " ".join(reasons))
    # Of fewer readings no correlation reaches that many standard deviations.
    if len(steps[-1].calibration.readings) < int(guarding().correlated_z ** 2) + 1:
        return Gate(True, "converged; too few readings to see whether neighbours are correlated")
    return Gate(True, "converged; neighbouring residuals are not correlated")


def against(steps: Sequence[Step]) -> list[str]:
    """Why the last model is not to be used, in words; what was found against it earlier among them."""
    last = steps[-1]
    found = last.against or [
        *last.different,
        *_of_noise(last),
        *_undecided(last),
        *_thermometers(steps),
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
    if reasons and last.calibration.verdict.ok:
        steps = (*steps[:-1], last.judged(reasons))
    return tuple(steps), _gate(steps, reasons)


def wrong_question(
    calibration: Calibration, floor: float, accepted: Collection[str]
) -> tuple[str, ...]:
    """Why nothing can be learnt from a model: readings that contradict it, or that were rounded more than they vary.

    Args:
        calibration: of the model.
        floor: noise that no model could remove, output unit.
        accepted: coefficients or effects that may contradict their priors.
    """
    free = [n.removesuffix(FREED) for n in calibration.model.names if n.endswith(FREED)]
    accepted = {*accepted, *free, *(n + FREED for n in free)}
    found = conflicts(calibration, accepted)
    found = found or [one.said for one in without_priors(calibration, accepted)]
    grid, unit = rounding_step(calibration.readings["output"]), unit_label(calibration.unit)
    if floor < recording().as_good_as_noise * grid:
        found.append(
            f"The output is rounded in steps of {grid:.3g} {unit}, which is more than its noise: nothing finer than "
            "a step can be known, and standard uncertainties are too small. Record it with more digits."
        )
    return tuple(found)


def refuse_noiseless(calibration: Calibration) -> None:
    """Readings that a model explains to their last digit: there is no noise to tell anything by, nor to check.

    Raises:
        InputError: they are, and how coarsely the output is rounded; or the fit found no finite noise at all.
    """
    output, variance = calibration.readings["output"], calibration.linear.variance
    noise, unit = math.sqrt(float(np.median(variance))), unit_label(calibration.unit)
    if noise > np.spacing(np.max(np.abs(output))):
        return
    if math.isnan(noise):
        raise InputError(
            f"{calibration.readings.file}: no fit of the model to these readings is finite: the output covers "
            f"{number(np.ptp(output))} {unit}, which the model cannot be. Check its unit, the nominal zero and scale "
            "(--unit, --nominal-zero, --nominal-scale)"
        )
    grid = rounding_step(output)
    rounded = f" It is rounded in steps of {grid:.3g} {unit}." if grid else ""
    raise InputError(
        f"{calibration.readings.file}: a model of {len(calibration.layout.blocks)} unknowns explains the output to its "
        f"last digit in all {len(output)} readings, which then show no noise and no uncertainty.{rounded} Record it "
        "with more digits"
    )


def _surprising(step: Step) -> list[str]:
    """A group that the others do not expect, although their uncertainty counts: something in it was different.

    What is missing from a model is missing in every group, and counts as their noise. There is a test for each group.
    """
    out = step.left_out
    if out is None or not np.isfinite(out.by_chance).any():
        return []
    worst = int(np.nanargmin(out.by_chance))
    # The largest of as many tests as there are groups: its p-value counts that often (C. Bonferroni).
    beyond = out.by_chance[worst] * out.count < guarding().chance
    if not (beyond and out.surprise[worst] > guarding().surprised):
        return []
    return [
        f"{out.group.capitalize()} {out.members[worst]} is not like the others: predicted from these, its errors are "
        f"{out.surprise[worst]:.1f} times what they should be ({scheme(out.group)}). Its thermometer or a setting was "
        "different, or the sensor changed: look at its columns, or leave it out."
    ]


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
    unnamed = {e.name for e in last.model.effects if e.is_placeholder}
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
        again = visits >= guarding().few_in_group
        if (
            again.any()
            and pairs[again].max(axis=1).sum() > guarding().in_order * visits[again].sum()
        ):
            found.append(
                f"Not decidable from these readings: whether {effect.name} is of the sensor, or the output is late or "
                f"smoothed: {column} goes through its values in one order. Take them in another order in one run."
            )
    return found


def _thermometers(steps: Sequence[Step]) -> list[str]:
    """What is odd in the column of a thermometer that the first model's coefficients hang on."""
    readings, model = steps[-1].calibration.readings, steps[0].calibration.model
    warm = [n for n in readings.columns if n in model.columns and readings.unit(n) == "degC"]
    every = [n for n in readings.columns if readings.unit(n) == "degC"]
    if not warm:
        return []
    found = oddities({n: readings[n] for n in readings.columns}, every, readings.output)
    return [
        f"Column {one.column!r} {one.said}: what depends on it is not measured."
        for one in found
        if one.column in warm
    ]


def _taken_over(steps: Sequence[Step]) -> list[str]:
    """Terms of the first model that something else stands for in the last, the one that moved the most alone."""
    return [str(one) for one in _followed(steps) if not one.measured][:1]


def _undecided(step: Step) -> list[str]:
    """Something is missing, and the readings do not say what: neither an effect nor one of several."""
    found = step.discovery
    if found is None or found.nothing_missing is None or found.sets or found.unnamed:
        return []
    if found.nothing_missing >= guarding().unlikely:
        return []
    leads = [c for c in found.candidates if c.probability is not None][:3]
    named = ", ".join(f"{c.effect} ({c.probability:.2f})" for c in leads)
    return [
        f"The model is complete with probability {found.nothing_missing:.2g} only, and the readings do not tell what "
        f"is missing; the most probable are {named}."
    ]


def _of_noise(step: Step) -> list[str]:
    verdict = step.calibration.verdict
    if not verdict.ok:
        return ["The fit did not converge: " + " ".join(verdict.reasons)]
    if step.check.fixed is not None and step.check.fixed.wrong:
        return [
            f"The fixed coefficients leave residuals of {step.check.fixed.rms:.3g} {step.check.unit} rms, "
            f"{step.check.fixed.rms / step.check.fixed.noise:.1f} times the noise of the same model with free "
            "coefficients."
        ]
    found, evidence = [], step.calibration.log_evidence
    if evidence is not None and not math.isfinite(evidence[0]):
        found.append(
            "The log evidence is not finite: the readings have too few digits, or a prior is improper."
        )
    found += step.doubts
    found += _of_scatter(step)
    found += _left_over(step)
    found += _between_runs(step)
    coefficient, z = step.check.autocorrelation
    if abs(z) > guarding().correlated_z and abs(coefficient) > guarding().correlated:
        found.append(
            f"Noise model inadequate: neighbouring residuals are correlated ({coefficient:.2f}, z = {z:.1f}), "
            "so the probabilities of missing effects are too confident. Either the noise is correlated in "
            "time or something is missing that no candidate describes."
        )
    return found


def _left_over(step: Step) -> list[str]:
    """What the residuals still depend on; and readings too few to tell noise from unknowns."""
    free, size = len(step.calibration.layout.blocks), len(step.calibration.readings)
    if size < free + 3:
        return [
            f"{size} readings are too few for {free} unknowns: the noise cannot be told, and uncertainties hang on "
            "the priors."
        ]
    rows = [(e.log_bayes_factor, e.against) for e in step.check.entries]
    rows += [(p.log_bayes_factor, " and ".join(p.against)) for p in step.check.pairs]
    factor, against = max(rows, default=(0.0, ""))
    if factor > guarding().still_depends:
        said = f"The residuals still depend on {against} (log Bayes factor {factor:.0f}): "
        candidates = step.discovery.candidates if step.discovery else ()
        if leads := [c for c in candidates if c.kind == "lead"]:
            named = " or ".join(f"{c.effect} (probability {c.probability:.2f})" for c in leads)
            return [
                f"{said}{named} may be what is missing. Add it (--add {leads[0].effect}), or take the readings of the "
                "next experiment."
            ]
        return [
            f"{said}something is missing that no candidate describes, or readings of two devices or conditions are "
            "mixed."
        ]
    return []


def _between_runs(step: Step) -> list[str]:
    """A function of time that only tells runs apart: of which of them a new run would be is not known."""
    calibration = step.calibration
    _, codes = calibration.readings.groups("run")
    for name in calibration.model.names:
        if covariate_in(name) not in FORMS:
            continue
        added = calibration.linear.contribution(name)
        means = np.bincount(codes, added) / np.bincount(codes)
        # Squares about the runs' means against all squares: next to none within runs means that the function does
        # nothing but tell runs apart.
        if np.sum((added - means[codes]) ** 2) < guarding().within * np.sum(
            (added - added.mean()) ** 2
        ):
            return [
                f"Runs stand {np.ptp(means):.3g} {unit_label(calibration.unit)} apart ({name} steps where none goes "
                "on): they are of two devices or conditions, or the sensor was restarted, and which of them a new run "
                "will be like is not known."
            ]
    return []


def _of_scatter(step: Step) -> list[str]:
    """What the leave-one-out tests say against the noise law."""
    check = step.check
    along = [name for name, p in check.scatter_with.items() if p < guarding().rare]
    if along:
        return [
            f"Noise model inadequate: the scatter changes with {' and '.join(along)}, so standard uncertainties hold "
            "for no part of the record. Give the readings their own uncertainties (column output_uncertainty)."
        ]
    if check.one_sided < guarding().rare:
        return [
            "Noise model inadequate: the readings far from the model stand on one side "
            f"(p = {check.one_sided:.1g}), outliers that draw it there. Find what makes them, and leave them out."
        ]
    if check.pit_p < guarding().rare:
        outside = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        return [
            "Noise model inadequate: readings do not scatter about the model as normal noise does (leave-one-out "
            f"probabilities uniform: p = {check.pit_p:.1g}{outside}). Look at the readings; a model with noise "
            "bc.StudentT() bears outliers on both sides."
        ]
    return []


def _against_the_steps_before(steps: Sequence[Step]) -> list[str]:
    """What an added effect made worse: the error as fitted, leave-one-group-out, of the hold-out data."""
    reasons, unit = [], unit_label(steps[-1].calibration.unit)
    *earlier, last = steps
    # Under another noise law readings weigh differently, and correlated noise takes up what an effect explained: their
    # plain error may well be larger.
    noise = last.calibration.model.noise
    alike = [s for s in earlier if s.calibration.model.noise == noise and noise.independent]
    before = min((s.rmse_fitted for s in alike), default=math.inf)
    if last.added is not None and last.rmse_fitted > guarding().worse * before:
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
    return [*reasons, *_surprising(last), *_contradicted(last)]


def left_out_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """The one of some steps that predicted groups from the others best, if better than the last beyond chance.

    By the error, of which a twentieth is no rise, and by the joint predictive density of the groups: if the last model
    is right, another's is k times as high with probability 1/k at most (Markov's inequality; the ratio's mean is one).
    """
    known = [(s.left_out.rmse, s) for s in earlier if s.left_out]
    if last.left_out is None or not known:
        return None
    error, best = min(known, key=lambda one: one[0])
    if last.left_out.rmse <= guarding().worse * error or best.left_out is None:
        return None
    # Of densities of whole groups, joint over their readings: correlated noise makes readings of one group no
    # separate evidence.
    ratio = float(np.sum(best.left_out.log_score - last.left_out.log_score))
    return None if ratio <= -math.log(guarding().chance) else best


def holdout_better(last: Step, earlier: Sequence[Step]) -> Step | None:
    """The same of the hold-out data, by a paired test against what the last model expects of its errors there."""
    known = [(s.holdout_rmse, s) for s in earlier if s.holdout_rmse is not None]
    if last.holdout_rmse is None or not known:
        return None
    error, best = min(known, key=lambda one: one[0])
    if last.holdout_rmse <= guarding().worse * error:
        return None
    # Of steps without a test the error alone decides.
    if last.holdout_test is None or best.holdout_test is None:
        return best
    return best if last.holdout_test.worse_than(best.holdout_test) < guarding().chance else None


def _contradicted(step: Step) -> list[str]:
    """What hold-out data say against the last model itself, whatever came before."""
    error = step.holdout_rmse
    if step.holdout_test is None or error is None:
        return []
    found, unit = step.holdout_test.against, unit_label(step.calibration.unit)
    other = "They are of another device or condition, or the model is wrong."
    if found.p < guarding().chance and found.share > guarding().worse:
        of = f", {found.most} before all" if found.most else ""
        return [
            f"The hold-out data contradict the last model: its error there, {number(error)} {unit}, would be "
            f"{number(error / found.share)} with other coefficients{of}, and a right model is so far off with "
            f"probability {found.p:.2g}. {other}"
        ]
    if found.scatter > guarding().expected:
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
