"""Picture of an Allan deviation, beside that of the noise law."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check_result import Check
from bayescal._calibration.noise_in_time import AllanCheck, allan_check
from bayescal._core.errors import InputError
from bayescal._data.allan_deviation import AllanDeviation
from bayescal._report.plot_colours import BLUE, GREY, RED
from bayescal._report.plot_style import axis_label, new_figure, open_sides


def allan(given: Check | Calibration | AllanDeviation) -> Figure:
    """Allan deviation over averaging time with its 95 % intervals, the noise law's band in grey.

    The averaging time at which the two differ the most is red, where they do.

    Args:
        given: a check, a fit, or what `bc.allan_deviation` returned, which has no noise law.

    Raises:
        InputError: the readings are not evenly spaced in time, or too few.
    """
    found = given.allan if isinstance(given, Check) else given
    found = allan_check(found) if isinstance(found, Calibration) else found
    if found is None:
        raise InputError(
            "there is no Allan deviation to draw: it needs runs of 30 readings or more, evenly spaced in time; "
            "bc.allan_deviation(readings) says what these lack"
        )
    measured = found.measured if isinstance(found, AllanCheck) else found
    figure = new_figure(5.2, 3.6)
    ax = figure.subplots()
    tau, deviation = measured.tau, measured.deviation
    if isinstance(found, AllanCheck):
        seen = found.expected > 0
        ax.fill_between(tau[seen], found.low[seen], found.high[seen], color=GREY, alpha=0.25, lw=0)
        label = f"noise law ({found.law_name}), 95 %"
        ax.plot(tau[seen], found.expected[seen], "--", color=GREY, lw=1.2, label=label)
    error = np.array([deviation - measured.low, measured.high - deviation])
    what = "residuals" if isinstance(found, AllanCheck) else "readings"
    ax.errorbar(
        tau, deviation, yerr=error, fmt="o-", ms=4, lw=1.2, capsize=2, color=BLUE, label=what
    )
    if isinstance(found, AllanCheck) and found.apart is not None:
        ax.plot(tau[found.apart], deviation[found.apart], "o", ms=7, color=RED, zorder=3)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(axis_label("averaging time τ", "s"))
    ax.set_ylabel(axis_label("Allan deviation", measured.unit))
    told = [f"{t.symbol} = {t}" for t in measured.terms if t.value is not None]
    ax.set_title(", ".join(told), fontsize=9, loc="left")
    ax.legend(frameon=False, fontsize=8)
    open_sides(ax)
    return figure
