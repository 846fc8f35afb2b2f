"""Verification data: readings of two axes at known tilts, as a separate table and as readings of the instrument.

Each row of `true_x, true_y, reading_x, reading_y` becomes two readings: of axis x at true_angle x and placement
angle y, and of axis y conversely. Both kinds of data can then be fitted by one instrument.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

import bayescal as bc
from bayescal_models.inclinometer import COLUMNS
from bayescal_models.inclinometer.geometry import ARCSEC, possible
from bayescal_models.inclinometer.model import INSTRUMENT

_MOST = np.pi / 2 + 0.01  # rad, largest tilt: rejects degrees under a [rad] header


OTHERS = ("device", "run", "temperature", "time")
TILTS = {
    "true_x": "known tilt along x",
    "true_y": "known tilt along y",
    "reading_x": "tilt that x reads",
    "reading_y": "tilt that y reads",
}


class _FileOfTilts(NamedTuple):
    """Columns of a file of verification data, with the attributes that `bayescal.read` uses of an instrument."""

    columns: tuple[bc.Column, ...]
    name: str = "inclinometer verification"
    output: str = "reading_x"
    nominal_scale: bc.NominalScale | None = None


FILE_OF_TILTS = _FileOfTilts(
    (
        *(bc.Column(n, "rad", words, low=-_MOST, high=_MOST) for n, words in TILTS.items()),
        *(c for c in COLUMNS if c.name in OTHERS),
    )
)


@dataclass(frozen=True)
class Verification:
    """Readings of both axes at known tilts, one entry per set-up, rad.

    Attributes:
        true_x, true_y: known tilts.
        reading_x, reading_y: readings of the axes.
        others: further columns (device, run, temperature, time) by name.

    Raises:
        InputError: lengths differ, or the tilts are geometrically impossible.
    """

    true_x: np.ndarray
    true_y: np.ndarray
    reading_x: np.ndarray
    reading_y: np.ndarray
    others: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        columns = {n: getattr(self, n) for n in TILTS}
        lengths = {n: np.shape(c) for n, c in {**columns, **self.others}.items()}
        if len(set(lengths.values())) != 1:
            raise bc.InputError(
                f"verification data need columns of one length, these are: {lengths}"
            )
        wrong = ~possible(self.true_x, self.true_y)
        if np.any(wrong):
            row = int(np.argmax(wrong))
            x, y = np.rad2deg([self.true_x[row], self.true_y[row]])
            raise bc.InputError(
                f"verification data, row {row + 1}: tilts of {x:.4g}° and {y:.4g}° are impossible, since "
                "sin²x + sin²y is above 1. A tilt is defined by the gravity along its axis, A = g·sin x"
            )

    def __len__(self) -> int:
        return len(self.true_x)

    @property
    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return readings of x and of y minus the truth, rad."""
        return self.reading_x - self.true_x, self.reading_y - self.true_y

    def readings(self) -> bc.Measurements:
        """Return readings of the instrument, x before y; run labels are prefixed by the axis."""
        columns: dict[str, Any] = {n: np.concatenate([c, c]) for n, c in self.others.items()}
        axis = np.repeat(["x", "y"], len(self))
        run = columns.get("run", np.full(2 * len(self), "1"))
        columns["run"] = np.array([f"{a}{label}" for a, label in zip(axis, run, strict=True)])
        return bc.Measurements.from_arrays(
            INSTRUMENT,
            **columns,
            axis=axis,
            true_angle=np.concatenate([self.true_x, self.true_y]),
            placement_angle=np.concatenate([self.true_y, self.true_x]),
            output=np.concatenate([self.reading_x, self.reading_y]) / ARCSEC,
        )


def read_verification(path_or_paths: Any, **options: Any) -> Verification:
    """Read files of `true_x, true_y, reading_x, reading_y`.

    Args:
        path_or_paths: the files.
        options: options of `bayescal.read`.

    Raises:
        InputError: invalid files, as for `bayescal.read`, or impossible tilts.
    """
    table = bc.read(path_or_paths, FILE_OF_TILTS, **options)
    others = {n: table[n] for n in OTHERS if table.has(n)}
    return Verification(*(table[n] for n in TILTS), others)
