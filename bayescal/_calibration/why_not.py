"""Why a calibration is not to be used: as a search judged it, or by the acceptance checks of its own readings."""

from __future__ import annotations

from collections.abc import Sequence

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check
from bayescal._calibration.claim import Claim
from bayescal._calibration.judgement import (
    GROUPS,
    LEFT_OUT,
    THERMOMETERS,
    Subject,
    claims,
    doubts_of_the_mode,
    noiseless,
    residual_claims,
    wrong_question,
)
from bayescal._calibration.leave_group_out import leave_one_group_out
from bayescal._calibration.noise_in_time import noise_floor


def why_not(calibration: Calibration) -> str:
    """Return why a calibration is not to be used; empty where it may be. One that nobody checked is checked."""
    verdict = calibration.verdict
    if verdict.checked or not verdict.reliable:
        return verdict.why_not
    known = vars(calibration)  # kept with what else is computed of it
    if "why_not" not in known:
        known["why_not"] = noiseless(calibration) or " ".join(_against(calibration))
    return known["why_not"]


def _against(calibration: Calibration) -> Sequence[Claim]:
    if wrong := wrong_question(calibration, noise_floor(calibration)):
        return wrong
    doubts, left_out = tuple(doubts_of_the_mode(calibration)), leave_one_group_out(calibration)
    subject = Subject(calibration, check=check(calibration), left_out=left_out, doubts=doubts)
    residuals = residual_claims(subject)
    return [*claims(GROUPS, subject), *residuals, *claims((*THERMOMETERS, *LEFT_OUT), subject)]
