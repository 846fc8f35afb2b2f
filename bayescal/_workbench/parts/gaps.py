"""A time axis that leaves out the long gaps between runs: what is left out, and how the rest is labelled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import CustomJSTickFormatter, Span

# A step is a gap if it is longer than so many usual ones (their median), and than this share of the time in all shorter
# steps: a pause within a run stays, and so do evenly spaced runs of one reading.
STEPS, SHARE = 10.0, 0.1
WASTED = 0.25  # of the axis that is left, about, which gaps may take up together

LABEL = """
let k = 0;
while (k + 1 < starts.length && starts[k + 1] <= tick) k += 1;
return tick > ends[k] ? "" : String(Number((tick + taken[k]).toPrecision(10)));
"""


@dataclass(frozen=True)
class CutAxis:
    """Stretches of a column, one after the other.

    Attributes:
        starts, ends: values at which each begins and ends, (k,), rising.
        taken: what is left out of the axis before each, (k,), a round number each.
    """

    starts: np.ndarray
    ends: np.ndarray
    taken: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> CutAxis:
        """Of values (n,) in any order; a single stretch where no gap is long."""
        at = np.unique(values)
        steps = np.diff(at)
        rising = np.sort(steps)
        usual, shorter = np.append(rising, 0.0)[rising.size // 2], np.cumsum(rising) - rising
        long = (rising > STEPS * usual) & (rising > SHARE * shorter)
        gaps = np.flatnonzero(steps >= rising[np.argmax(long)]) if long.any() else np.array([], int)
        unit = _round(WASTED * np.delete(steps, gaps).sum() / gaps.size) if gaps.size else np.inf
        taken = np.floor(steps[gaps] / unit - 1 / 3) * unit
        gaps, taken = gaps[taken > 0], taken[taken > 0]
        edges = np.r_[0, gaps + 1]
        ends = np.r_[gaps, at.size - 1]
        return cls(at[edges], at[ends], np.r_[0.0, np.cumsum(taken)])

    def place(self, values: np.ndarray) -> np.ndarray:
        """Where values stand on the axis."""
        k = np.searchsorted(self.starts, values, side="right") - 1
        return np.asarray(values, float) - self.taken[np.maximum(k, 0)]

    def label(self, figure: Any, colour: str) -> None:
        """Label a figure's axis with the values themselves, and draw where something is left out."""
        if self.starts.size == 1:
            return
        starts, ends = self.place(self.starts), self.place(self.ends)
        args = {"starts": starts.tolist(), "ends": ends.tolist(), "taken": self.taken.tolist()}
        figure.xaxis.formatter = CustomJSTickFormatter(args=args, code=LABEL)
        for middle in 0.5 * (ends[:-1] + starts[1:]):
            cut: dict[str, Any] = {
                "dimension": "height",
                "line_dash": "dotted",
                "line_color": colour,
            }
            figure.add_layout(Span(location=float(middle), line_width=2, **cut))


def _round(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(power * m for m in (1, 2, 5) if power * m <= value * (1 + 1e-12)))
