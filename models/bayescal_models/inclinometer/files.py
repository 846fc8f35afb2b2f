"""Reader of zero-test files, which can negate corrections."""

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
        corrections: whether the files have corrections to be added to a reading, as source 4's S; they are negated,
            because here a zero offset is the reading at no tilt.
        options: options of `bayescal.read`.

    Raises:
        InputError: the files are invalid, as for `bayescal.read`.
    """
    readings = bc.read(path_or_paths, INSTRUMENT, **options)
    return negated(readings) if corrections else readings


def negated(readings: bc.Measurements) -> bc.Measurements:
    """Negate corrections to zero offsets, or the reverse.

    Raises:
        InputError: the readings are of a verification, whose tilts are no corrections.
    """
    if readings.has("true_angle"):
        raise bc.InputError(
            f"{readings.file} has readings of tilts (column 'true_angle'), which are no corrections: "
            "omit corrections=True"
        )
    flag = "the outputs were taken as corrections and negated"
    turned = readings.with_column("output", -readings["output"])
    return replace(turned, flags=(*turned.flags, flag))
