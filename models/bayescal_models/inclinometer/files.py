"""Files of a zero test: read, with corrections negated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bayescal as bc
from bayescal_models.inclinometer.model import INSTRUMENT


def read(
    path_or_paths: str | Path | Sequence[str | Path], *, corrections: bool = False, **options: Any
) -> bc.Measurements:
    """Read zero offsets; the column may be called `output` or `zero_offset`.

    Args:
        path_or_paths: the files.
        corrections: the files hold what has to be added to a reading, as source 4's S; it is negated, because
            here a zero offset is what the instrument reads at no tilt.
        options: of `bayescal.read`.

    Raises:
        InputError: what `bayescal.read` refuses.
    """
    readings = bc.read(path_or_paths, INSTRUMENT, **options)
    return negated(readings) if corrections else readings


def negated(readings: bc.Measurements) -> bc.Measurements:
    """Negate corrections to zero offsets, or the reverse.

    Raises:
        InputError: the readings are of a verification: readings of tilts are no corrections.
    """
    if readings.has("true_angle"):
        raise bc.InputError(
            f"{readings.file} holds readings of tilts (it has the column 'true_angle'), which are no "
            "corrections: leave corrections=True out"
        )
    flag = "the outputs were taken as corrections and negated"
    turned = readings.with_column("output", -readings["output"])
    return replace(turned, flags=(*turned.flags, flag))
