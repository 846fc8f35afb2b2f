"""The reference problem of zero offsets over placement angles; what one is for stands in `bayescal_models`."""

from dataclasses import replace

from bayescal_models.inclinometer.campaign import VERIFICATION, Campaign
from bayescal_models.inclinometer.model import INSTRUMENT
from bayescal_models.simulated import reference_problem

# ±45° by 15°, forward and backward, two mountings of each axis: 56 rows.
CAMPAIGN = Campaign(angles=tuple(float(a) for a in range(-45, 46, 15)))
ON_TILT = ("zero.electrical_tilt", "zero.exact_placement", "scale.constant")


def _fuller(effects) -> Campaign:
    """Choose a zero test; a verification where effects are on tilt."""
    return replace(VERIFICATION, runs=2) if {*effects} & {*ON_TILT} else Campaign()


model, readings, hidden = reference_problem(INSTRUMENT, CAMPAIGN, _fuller)
