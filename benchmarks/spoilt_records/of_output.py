"""Kinds of faulty outputs: clipped, rounded, with outliers, heteroscedastic, far from nominal, drifting."""

from __future__ import annotations

import numpy as np

from benchmarks.spoilt_records.kinds import changed, kind, records
from benchmarks.spoilt_records.subject import Columns, Shift, Subject

Generator = np.random.Generator
FAR = 30.0  # prior standard deviations of a nominal zero that is off
STEEP = 90.0  # and of a slope
RESOLUTION = 1e17  # a constant in parts of the noise, beyond which doubles cannot show the noise
SCATTER = (
    "scatter|heteroscedastic|varies with|noise (grows|depends|is larger)|Noise model inadequate"
)


def _added(columns: Columns, addition: np.ndarray | float) -> Columns:
    return changed(columns, output=columns["output"] + addition)


def _scattered(columns: Columns, subject: Subject, times: np.ndarray, rng: Generator) -> Columns:
    """Add noise, in units of the record's own."""
    scatter = subject.noise * times * rng.standard_normal(len(times))
    return _added(columns, scatter)


def _rounded(columns: Columns, to: float) -> Columns:
    return changed(columns, output=to * np.rint(columns["output"] / to))


def _by(shift: Shift, times: float) -> dict[str, float]:
    return dict.fromkeys(shift.names, times * shift.size)


@kind(
    "zero far from nominal", "prior's mean|nominal", alike=True, changed=lambda s: _by(s.zero, FAR)
)
def zero_far(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Shift the unit's constant by 30 prior standard deviations. True: that constant, and all else as it was."""
    return _added(columns, FAR * subject.zero.size * subject.zero.column(columns))


@kind(
    "slope far from nominal",
    "prior's mean|nominal",
    alike=True,
    changed=lambda s: _by(s.slope, STEEP),
)
def slope_far(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Shift the unit's slope (or scale factor) by 90 prior standard deviations. True: that slope."""
    return _added(columns, STEEP * subject.slope.size * subject.slope.column(columns))


def _constant(times: float) -> None:
    """Register the addition of a constant of so many times the noise, as in a raw output. True: with that constant."""

    def constant_bias(subject: Subject) -> dict[str, float]:
        return dict.fromkeys(subject.zero.names, times * subject.noise)

    label = f"constant {times:.0e} times the noise"

    @kind(label, "prior's mean|nominal", alike=True, changed=constant_bias)
    def constant(columns: Columns, subject: Subject, rng: Generator) -> Columns:
        return _added(columns, times * subject.noise)


for size in (1e4, 1e6, 1e9):
    _constant(size)


@kind(
    "noise below the resolution of doubles",
    "round|resolution|digits|prior's mean|nominal",
    alike=True,
    changed=lambda s: dict.fromkeys(s.zero.names, RESOLUTION * s.noise),
    noise=lambda s: float(np.spacing(RESOLUTION * s.noise)) / s.noise / np.sqrt(12.0),
)
def beyond_doubles(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Add a constant so large that doubles round the noise away. True: with that constant; the rounding is noise."""
    return _added(columns, RESOLUTION * subject.noise)


@kind("clipped at both ends", "saturat|clip")
def clipped(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Clip the output at its 5 and 95 % points. True: the unit without the clipping."""
    low, high = np.quantile(columns["output"], [0.05, 0.95])
    return changed(columns, output=np.clip(columns["output"], low, high))


@kind("clipped at one end", "saturat|clip")
def clipped_above(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Clip the output at its 85 % point. True: the unit without the clipping."""
    high = np.quantile(columns["output"], 0.85)
    return changed(columns, output=np.minimum(columns["output"], high))


@kind("30 % outliers, one-sided", "outl|spike|heavy|skew|one-sided|systematically")
def one_sided(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Raise three readings in ten by 5 to 30 times the noise. True: the unit of the other seven."""
    n = len(columns["output"])
    high = subject.noise * (5.0 + 25.0 * rng.random(n))
    return _added(columns, np.where(rng.random(n) < 0.3, high, 0.0))


@kind("3 % outliers, two-sided", "outl|spike|heavy|tail")
def two_sided(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Shift three readings in a hundred by 10 to 50 times the noise, up or down. True: the unit of the others."""
    n = len(columns["output"])
    off = subject.noise * (10.0 + 40.0 * rng.random(n)) * rng.choice([-1.0, 1.0], n)
    return _added(columns, np.where(rng.random(n) < 0.03, off, 0.0))


@kind("scatter only when hot", SCATTER)
def hot_scatter(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Increase the noise tenfold in the hottest third of the readings. True: the unit as it was."""
    warm = columns[subject.thermometer]
    return _scattered(columns, subject, np.where(warm > np.quantile(warm, 0.67), 10.0, 0.0), rng)


@kind("scatter growing with the input or with time", SCATTER)
def growing_scatter(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Increase the noise up to tenfold with the input, or with time at rest. True: the unit as it was."""
    by = columns["time"] - columns["time"].min()
    if subject.input:
        by = np.abs(columns["output"] - np.median(columns["output"]))
    return _scattered(columns, subject, 10.0 * by / by.max(), rng)


@kind("scatter ten times larger in one run", SCATTER)
def run_scatter(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Increase the noise of the second run (or device) tenfold. True: the unit as it was."""
    times = np.zeros(len(columns["output"]))
    times[records(columns, subject)[1]] = 10.0
    return _scattered(columns, subject, times, rng)


@kind("output rounded to 25 times the noise", "round|quanti|resolution|step")
def rounded_coarsely(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Round the output to few digits. True: the unit as it was, as well known as such digits allow."""
    return _rounded(columns, 25.0 * subject.noise)


@kind("output rounded to 3 times the noise", "round|quanti|resolution|step")
def rounded_finely(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Round the output to one digit too few. True: the unit as it was."""
    return _rounded(columns, 3.0 * subject.noise)


@kind("constant output", "constant|stuck|throughout|does not (change|vary)", must_say=True)
def constant_output(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Hold one value in all rows, as a logger that hung. True: only that the record is of no use."""
    middle = np.median(columns["output"])
    return changed(columns, output=np.full(len(columns["output"]), middle))


@kind("−999 in a few rows of the output", "spike|outl|−999|-999|set aside")
def missing_output(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Put a logger's mark for a missing value in one row of a hundred. True: the unit of the other rows."""
    n = len(columns["output"])
    output = columns["output"].copy()
    output[rng.choice(n, max(3, n // 100), replace=False)] = -999.0
    return changed(columns, output=output)


@kind("one long excursion", "outl|spike|excursion|rows? \\d|jump|neighbouring residuals|transient")
def excursion(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Raise twenty successive readings by 20 times the noise. True: the unit of the others."""
    first = records(columns, subject)[0]
    length = min(20, len(first) // 4)
    begin = int(rng.integers(length, len(first) - 2 * length))
    addition = np.zeros(len(columns["output"]))
    addition[first[begin : begin + length]] = 20.0 * subject.noise
    return _added(columns, addition)


@kind("wrong sign of the output", "prior's mean|nominal|sign", fits=lambda s: s.sign)
def wrong_sign(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Exchange two wires: reverse the sign. True: the unit with the sign that the known input gives."""
    return changed(columns, output=-columns["output"])


@kind(
    "scale drifting by 1 % over the record",
    "drift|neighbouring residuals|time",
    finds="drift|time",
    alike=True,
)
def drifting(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Increase the output's scale by 1 % over the record. True: the unit half-way; the second campaign drifts alike."""
    time = columns["time"]
    progress = (time - time.min()) / np.ptp(time) - 0.5
    return changed(columns, output=columns["output"] * (1.0 + 0.01 * progress))


@kind(
    "a lag a thousand times the noise",
    "lag|prior's mean|neighbouring residuals",
    fits=lambda s: bool(s.lag),
    hides=lambda s: s.loud(s.lag, 1000.0),
)
def great_lag(columns: Columns, subject: Subject, rng: Generator) -> Columns:
    """Add a thermal lag with an rms of a thousand times the noise. True: that lag, and all else as it was."""
    return columns
