"""What a search names: effects of its last model, and those that it could not tell from one that it added."""

from __future__ import annotations

from itertools import pairwise

import bayescal as bc


def named(trail: bc.Trail) -> set[str]:
    """Effects of the last model, and the other members of the sets from which one was added."""
    rivals = {
        rival
        for step, following in pairwise(trail.steps)
        if step.discovery is not None
        for found in step.discovery.sets
        if following.added in found.effects
        for rival in found.effects
    }
    return {*trail.final.calibration.model.names, *rivals}
