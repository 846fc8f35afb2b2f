"""Picture of the noise of a sensor at rest: its Allan deviation, and the noise law's."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bayescal._calibration.sensor_noise import SensorNoise
from bayescal._core.formatting import number
from bayescal._data.unit_conversion import unit_label
from bayescal._report.plot_colours import BLUE, GREY, ORANGE
from bayescal._report.plot_style import axis_label, new_figure, open_sides


def noise(found: SensorNoise) -> Figure:
    """Allan deviation of the record with its 95 % intervals; the law's posterior band, and that of such records.

    Args:
        found: what `bc.noise` returned.
    """
    figure = new_figure(5.2, 3.6)
    ax, m = figure.subplots(), found.measured
    ax.fill_between(
        m.tau,
        found.estimate_low,
        found.estimate_high,
        color=GREY,
        alpha=0.2,
        lw=0,
        label="95 % of such records",
    )
    ax.fill_between(m.tau, found.low, found.high, color=ORANGE, alpha=0.4, lw=0, label="law, 95 %")
    ax.plot(m.tau, found.expected, "--", color=ORANGE, lw=1.2, label=found.law)
    error = np.array([m.deviation - m.low, m.high - m.deviation])
    ax.errorbar(
        m.tau, m.deviation, yerr=error, fmt="o", ms=4, lw=1, capsize=2, color=BLUE, label="readings"
    )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(axis_label("averaging time τ", "s"))
    ax.set_ylabel(axis_label("Allan deviation", found.unit))
    told = [
        f"{f.symbol} = {number(f.value)} {unit_label(f.unit)}"
        for f in found.figures
        if f.symbol and not f.bound
    ]
    ax.set_title(", ".join(told), fontsize=9, loc="left")
    ax.legend(frameon=False, fontsize=8)
    open_sides(ax)
    return figure
