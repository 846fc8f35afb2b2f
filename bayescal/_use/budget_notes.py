"""What a reader of an uncertainty budget has to know beside its numbers."""

from __future__ import annotations

from collections.abc import Mapping

from bayescal._use.compensator import Compensator
from bayescal._use.operating_equation import OperatingEquation
from bayescal._use.provenance import bias_only

SHARED = (
    "Not in it: errors that all readings share and no prior states, such as that of a reference or of the thermometer. "
    "Add their variances."
)
FEW = 10  # groups, below which a spread between them is not known well enough for a normal distribution


def learned_group_sds(equation: OperatingEquation) -> set[str]:
    """Coefficients of which a new member is drawn in use, from a spread that the readings told."""
    given, fixed = dict(equation.members), dict(equation.layout.model.fixed)
    return {
        b.name
        for b in equation.blocks
        if b.coefficient.group_sd is not None
        and b.coefficient.per not in given
        and b.group_sd_name not in fixed
    }


def notes_on(chosen: Compensator, point: Mapping[str, float]) -> tuple[str, ...]:
    """Where the operating point is outside the calibrated range, which coverage is short, and what is not counted.

    Args:
        chosen: whose budget it is.
        point: the operating point, fixed units.
    """
    ranges = {
        i.name: (i.low, i.high, i.unit) for i in chosen.inputs if i.kind in ("column", "elapsed")
    }
    if chosen.stimulus_range is not None:
        ranges[chosen.stimulus] = (*chosen.stimulus_range, chosen.unit)
    notes = [
        f"{name} = {point[name]:.6g} is outside its calibrated range, {low:.6g} to {high:.6g} {unit}: an "
        "extrapolation, whose uncertainty does not say by how much the equation itself may fail."
        for name, (low, high, unit) in ranges.items()
        if not low <= point[name] <= high
    ]
    assert chosen.calibration is not None and chosen.equation is not None
    learned = learned_group_sds(chosen.equation)
    for block in chosen.equation.blocks:
        per = block.coefficient.per
        if per is not None and block.name in learned:
            count = len(chosen.calibration.levels.get(per, ()))
            if count < FEW:
                notes.append(
                    f"{block.name} of a new {per} is known from {count} of them: an expanded uncertainty covers less "
                    "than that of a normal distribution."
                )
    if not chosen.equation.slope_calibrated(chosen.calibration):
        notes.append(bias_only(chosen.stimulus))
    return (*dict.fromkeys(notes), SHARED)
