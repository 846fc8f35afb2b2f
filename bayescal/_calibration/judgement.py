"""Whether a fit is to be used, by its own readings: what the gate asks of a last model, whatever led to it.

A model that no search judged is judged here before something is decided about it, certified or exported. What is
missing from it only a search tells; what it gets wrong shows in its residuals.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check
from bayescal._calibration.check_result import Check
from bayescal._calibration.claim import Claim
from bayescal._calibration.guards import (
    RARE_P,
    conflicts,
    doubts_of_the_mode,
    following_members,
    too_different,
    too_few,
    without_priors,
)
from bayescal._calibration.leave_group_out import LeaveOneGroupOut, leave_one_group_out, scheme
from bayescal._calibration.noise_in_time import noise_floor
from bayescal._core.formatting import number
from bayescal._core.settings import settings
from bayescal._data.dataset_checks import rounding_step
from bayescal._data.unit_conversion import unit_label
from bayescal._model.model import Model
from bayescal._model.noise_law import WHITE, Noise

# Standard deviations of the lag-1 autocorrelation, above which noise is not what its law says; one record in 30,000 by
# chance.
CORRELATED_SD = 4.0
# The autocorrelation itself, below which it changes no standard uncertainty by more than a tenth.
CORRELATED_COEFFICIENT = 0.1
# Allan deviation of correlated noise over a tenth to a half of a run, in standard deviations of a reading's own noise,
# from which it describes how the output goes, as a curve does: bias instability of sensors at rest stays below.
DESCRIBING_SD = 2.5
# Share of the squares of a step between runs, that lie within runs where it is one between them.
WITHIN_RUNS_SHARE = 0.05
SURPRISE_RATIO = 3.0  # times what the other groups expect of one, beyond which it is not like them
# Nats by which residuals may depend on a covariate, and the model still be used: twice what is very strong, since the
# largest of many covariates counts.
STILL_DEPENDS_NATS = 10.0
# Steps, from which noise makes rounding as good as noise: noise of 0.3 steps leaves a staircase of 0.05 (B. Widrow and
# I. Kollár, Quantization Noise, 2008), with the rounding's own 1/√12.
AS_GOOD_AS_NOISE_STEPS = 0.42

LOOK = {"cure": "search"}  # what is to be done where residuals still depend on something


def why_not(calibration: Calibration) -> str:
    """Why a calibration is not to be used, in words; empty where it may be. One that nobody checked is checked."""
    verdict = calibration.verdict
    if verdict.checked or not verdict.reliable:
        return verdict.why_not
    known = vars(calibration)  # kept with what else is computed of it
    if "why_not" not in known:
        said = noiseless(calibration)
        known["why_not"] = said or " ".join(map(str, _against(calibration)))
    return known["why_not"]


def _against(calibration: Calibration) -> Sequence[Claim]:
    return wrong_question(calibration, noise_floor(calibration), ()) or [
        *too_different(calibration),
        *following_members(calibration),
        *of_noise(calibration, check(calibration), doubts_of_the_mode(calibration), LOOK),
        *of_thermometers(calibration, calibration.model),
        *surprising(leave_one_group_out(calibration)),
    ]


def wrong_question(
    calibration: Calibration, floor: float, accepted: Collection[str]
) -> tuple[Claim, ...]:
    """Why nothing can be learnt from a model: readings that contradict it, or that were rounded more than they vary.

    Args:
        calibration: of the model.
        floor: noise that no model could remove, output unit.
        accepted: coefficients or effects that may contradict their priors.
    """
    free = [e for e in calibration.model.effects if e.frees]
    accepted = {*accepted, *(n for e in free for n in (e.name, e.frees))}
    found = conflicts(calibration, accepted) or without_priors(calibration, accepted)
    grid = rounding_step(calibration.readings["output"])
    if floor < AS_GOOD_AS_NOISE_STEPS * grid:
        found.append(Claim("output.rounded", grid=grid, unit=calibration.unit))
    return tuple(found)


def noiseless(calibration: Calibration) -> str:
    """Of readings that a model explains to their last digit, that they are, in words; empty for others.

    There is no noise to tell anything by, nor to check; or the fit found no finite noise at all.
    """
    output, variance = calibration.readings["output"], calibration.linear.variance
    noise, unit = math.sqrt(float(np.median(variance))), unit_label(calibration.unit)
    if noise > np.spacing(np.max(np.abs(output))):
        return ""
    if math.isnan(noise):
        return (
            f"{calibration.readings.file}: no fit of the model to these readings is finite: the output covers "
            f"{number(np.ptp(output))} {unit}, which the model cannot be. Check its unit, the nominal zero and scale "
            "(--unit, --nominal-zero, --nominal-scale)"
        )
    grid = rounding_step(output)
    rounded = f" It is rounded in steps of {grid:.3g} {unit}." if grid else ""
    return (
        f"{calibration.readings.file}: a model of {len(calibration.layout.blocks)} unknowns explains the output to its "
        f"last digit in all {len(output)} readings, which then show no noise and no uncertainty.{rounded} Record it "
        "with more digits"
    )


def surprising(out: LeaveOneGroupOut | None) -> list[Claim]:
    """A group that the others do not expect, although their uncertainty counts: something in it was different.

    What is missing from a model is missing in every group, and counts as their noise. There is a test for each group.
    """
    if out is None or not np.isfinite(out.by_chance).any():
        return []
    worst = int(np.nanargmin(out.by_chance))
    # The largest of as many tests as there are groups: its p-value counts that often (C. Bonferroni).
    beyond = out.by_chance[worst] * out.count < settings().holdout_p
    if not (beyond and out.surprise[worst] > SURPRISE_RATIO):
        return []
    which = {"group": out.group.capitalize(), "member": out.members[worst]}
    times = float(out.surprise[worst])
    return [
        Claim("group.surprising", out.group, **which, times=times, scheme=scheme(out.group)),
    ]


def of_thermometers(calibration: Calibration, model: Model) -> list[Claim]:
    """What is odd in the column of a thermometer that the coefficients of a model hang on."""
    readings = calibration.readings
    warm = [n for n in readings.columns if n in model.columns and readings.unit(n) == "degC"]
    return [
        Claim("column.odd", one.column, one.code, said=one.said)
        for one in readings.oddities
        if one.column in warm
    ]


def of_noise(
    calibration: Calibration, check: Check, doubts: Sequence[Claim], missing: Mapping[str, str]
) -> list[Claim]:
    """What a fit's own residuals say against it.

    Args:
        calibration, check: the fit, and where it fails.
        doubts: of its mode.
        missing: what may be missing where residuals still depend on something: a cure, and what it names.
    """
    verdict = calibration.verdict
    if not verdict.ok:
        return [Claim("fit.not_converged", reasons=" ".join(verdict.reasons))]
    if check.fixed is not None and check.fixed.wrong:
        rms = check.fixed.rms
        return [Claim("fixed.wrong", rms=rms, unit=check.unit, times=rms / check.fixed.noise)]
    found, evidence = [], calibration.log_evidence
    if evidence is not None and not math.isfinite(evidence[0]):
        found.append(Claim("evidence.not_finite"))
    found += doubts
    found += _describing(calibration)
    found += _of_scatter(check)
    found += _left_over(calibration, check, missing)
    found += _between_runs(calibration)
    coefficient, z = check.autocorrelation
    if abs(z) > CORRELATED_SD and abs(coefficient) > CORRELATED_COEFFICIENT:
        found.append(Claim("noise.correlated", coefficient=coefficient, z=z))
    return found


def describes(noise: Noise, values: Mapping[str, Any]) -> bool:
    """Whether correlated noise is so slow and large that it stands for something without a name."""
    return noise.lasting_deviation(values) > DESCRIBING_SD * values.get(WHITE, math.inf)


def _describing(calibration: Calibration) -> list[Claim]:
    """Noise that describes how the output goes."""
    noise, values = calibration.model.noise, calibration.problem.hyper(calibration.mode.v)
    if noise.independent or not describes(noise, values):
        return []
    size = noise.lasting_deviation(values)
    told = {"size": size, "unit": calibration.unit, "times": size / values[WHITE]}
    return [Claim("noise.describes", noise.name, words=noise.in_words, **told)]


def _left_over(calibration: Calibration, check: Check, missing: Mapping[str, str]) -> list[Claim]:
    """What the residuals still depend on; and readings too few to tell noise from unknowns."""
    if few := too_few(calibration):
        return few
    rows = [(e.log_bayes_factor, (e.against,)) for e in check.entries]
    rows += [(p.log_bayes_factor, p.against) for p in check.pairs]
    factor, against = max(rows, default=(0.0, ()))
    if factor > STILL_DEPENDS_NATS:
        return [Claim("residuals.depend", *against, factor=factor, **missing)]
    return []


def _between_runs(calibration: Calibration) -> list[Claim]:
    """A function of time that only tells runs apart: of which of them a new run would be is not known."""
    of_form = (e for e in calibration.model.effects if e.kind in ("jump", "cycle"))
    for name in (e.name for e in of_form if e.covariate == "time"):
        added = calibration.linear.contribution(name)
        means, within = of_runs(calibration, added)
        if only_between_runs(added - added.mean(), within):
            apart = float(np.ptp(means))
            return [Claim("runs.apart", name, apart=apart, unit=calibration.unit)]
    return []


def of_runs(calibration: Calibration, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of each run, and what a value of each reading is more than its run's."""
    _, codes = calibration.readings.groups("run")
    means = np.bincount(codes, values) / np.bincount(codes)
    return means, values - means[codes]


def only_between_runs(values: np.ndarray, within: np.ndarray) -> bool:
    """Whether values do nothing but tell runs apart: next to none of their squares are those within runs."""
    return bool(np.sum(within**2) < WITHIN_RUNS_SHARE * np.sum(values**2))


def _of_scatter(check: Check) -> list[Claim]:
    """What the leave-one-out tests say against the noise law."""
    along = [name for name, p in check.scatter_with.items() if p < RARE_P]
    if along:
        return [Claim("noise.scatter", *along)]
    if check.one_sided < RARE_P:
        return [Claim("noise.one_sided", p=check.one_sided)]
    if check.pit_p < RARE_P:
        outside = f", {len(check.outliers)} of them outliers" if check.outliers else ""
        return [Claim("noise.tails", p=check.pit_p, outside=outside)]
    return []
