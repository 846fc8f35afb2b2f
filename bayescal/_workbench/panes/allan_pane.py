"""Allan deviation of the residuals, beside what the noise law lets one expect."""

from __future__ import annotations

from typing import Any

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Whisker

from bayescal._calibration.noise_in_time import AllanCheck
from bayescal._data.unit_conversion import unit_label
from bayescal._report.plot_colours import RED
from bayescal._workbench.panes.pane import Pane
from bayescal._workbench.parts.pieces import column, halves, plot, words
from bayescal._workbench.parts.style import Palette, dress, new_figure

NONE = (
    "No Allan deviation: it needs a column time, and runs of 30 readings or more, evenly spaced in time "
    "within 5 %."
)


class AllanPane(Pane):
    """The curve with its confidence intervals, the law's band, the terms of data sheets."""

    def __init__(self, bench: Any) -> None:
        super().__init__(bench)
        self.told, self.terms = words(""), words("", "table")
        self.plot = pn.Column(sizing_mode="stretch_both", margin=0)
        self.view = halves(self.plot, column(self.told, self.terms, kinds=("bare", "scrolls")))

    def show(self, state: Any) -> None:
        found: AllanCheck | None = state.step.check.allan
        self.told.object = NONE if found is None else found.sentence()
        self.terms.object = "" if found is None else found.table()
        self.figures = [] if found is None else [allan_figure(found, self.bench.palette)]
        self.plot[:] = [plot(made) for made in self.figures]


def allan_figure(found: AllanCheck, palette: Palette) -> Any:
    """The curve over the averaging time, both logarithmic; 95 % intervals; the law's 95 % band in grey."""
    m = found.measured
    made = new_figure(
        "averaging time τ [s]",
        f"Allan deviation [{unit_label(m.unit) or '1'}]",
        tools="",
        x_axis_type="log",
        y_axis_type="log",
    )
    made.name = "allan deviation"
    seen = np.asarray(found.expected) > 0
    made.varea(
        m.tau[seen],
        found.low[seen],
        found.high[seen],
        color="#8a939b",
        alpha=0.3,
        legend_label="noise law",
    )
    source = ColumnDataSource(
        {"tau": m.tau, "deviation": m.deviation, "low": m.low, "high": m.high}
    )
    made.line("tau", "deviation", source=source, color=palette.blue, line_width=2)
    made.scatter(
        "tau", "deviation", source=source, size=7, color=palette.blue, legend_label="residuals"
    )
    whisker: Any = Whisker(
        base="tau", upper="high", lower="low", source=source, line_color=palette.blue
    )
    whisker.upper_head.size = whisker.lower_head.size = 6
    whisker.upper_head.line_color = whisker.lower_head.line_color = palette.blue
    made.add_layout(whisker)
    if found.apart is not None:
        k = found.apart
        made.scatter(
            [m.tau[k]], [m.deviation[k]], size=12, fill_color=None, line_color=RED, line_width=2
        )
    made.legend.orientation = "horizontal"
    made.legend.label_text_font_size = "11px"
    made.legend.location = "top_right"
    dress(made, palette)
    return made
