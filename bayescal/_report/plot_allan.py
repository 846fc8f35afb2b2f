"""Pictures of an Allan deviation, beside that of the noise law: of a record, of residuals, of a sensor at rest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check_result import Check
from bayescal._calibration.noise_in_time import AllanCheck, allan_check
from bayescal._calibration.sensor_noise import SensorNoise
from bayescal._core.errors import InputError
from bayescal._core.formatting import number
from bayescal._data.allan_deviation import AllanDeviation
from bayescal._data.unit_conversion import unit_label
from bayescal._report.plot_colours import BLUE, GREY, ORANGE, RED
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
    ax = new_figure(5.2, 3.6).subplots()
    tau, deviation = measured.tau, measured.deviation
    if isinstance(found, AllanCheck):
        seen = found.expected > 0
        ax.fill_between(tau[seen], found.low[seen], found.high[seen], color=GREY, alpha=0.25, lw=0)
        label = f"noise law ({found.law_name}), 95 %"
        ax.plot(tau[seen], found.expected[seen], "--", color=GREY, lw=1.2, label=label)
    what = "residuals" if isinstance(found, AllanCheck) else "readings"
    _measured(ax, measured, fmt="o-", lw=1.2, label=what)
    if isinstance(found, AllanCheck) and found.apart is not None:
        ax.plot(tau[found.apart], deviation[found.apart], "o", ms=7, color=RED, zorder=3)
    return _labelled(
        ax, measured.unit, [f"{t.symbol} = {t}" for t in measured.terms if t.value is not None]
    )


def noise(found: SensorNoise) -> Figure:
    """Allan deviation of the record with its 95 % intervals; the law's posterior band, and that of such records.

    Args:
        found: what `bc.noise` returned.
    """
    told = [
        f"{f.symbol} = {number(f.value)} {unit_label(f.unit)}"
        for f in found.figures
        if f.symbol and not f.bound
    ]
    ax, tau = new_figure(5.2, 3.6).subplots(), found.measured.tau
    bands = (
        (found.estimate_low, found.estimate_high, GREY, 0.2, "95 % of such records"),
        (found.low, found.high, ORANGE, 0.4, "law, 95 %"),
    )
    for low, high, colour, alpha, label in bands:
        ax.fill_between(tau, low, high, color=colour, alpha=alpha, lw=0, label=label)
    ax.plot(tau, found.expected, "--", color=ORANGE, lw=1.2, label=found.law)
    _measured(ax, found.measured, fmt="o", lw=1, label="readings")
    return _labelled(ax, found.unit, told)


def _measured(ax: Any, m: AllanDeviation, **how: Any) -> None:
    error = np.array([m.deviation - m.low, m.high - m.deviation])
    ax.errorbar(m.tau, m.deviation, yerr=error, ms=4, capsize=2, color=BLUE, **how)


def _labelled(ax: Any, unit: str, told: Sequence[str]) -> Figure:
    """The figure of an Allan deviation in `unit`, with what is told of it above."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(axis_label("averaging time τ", "s"))
    ax.set_ylabel(axis_label("Allan deviation", unit))
    ax.set_title(", ".join(told), fontsize=9, loc="left")
    ax.legend(frameon=False, fontsize=8)
    open_sides(ax)
    return ax.figure
