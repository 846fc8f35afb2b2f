"""Poses of a raw log: detection and averaging of its static segments, with the standard uncertainty of their means.

A log is divided into blocks of a quarter of a second. The quietest blocks give the scatter of each output at rest; a
block is static if no output's scatter, or step from the block before, exceeds six times that. Consecutive samples are
autocorrelated (filters, vibration); the uncertainty of a mean is therefore computed from block means, without the
outermost two blocks, pooled over all poses: often 3 to 4 times that of independent samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

import bayescal as bc
from bayescal import workshop as ws

BLOCK_SECONDS = 0.25  # short against a move by hand, long against a filter of 20 Hz
REST_QUANTILE = 0.1  # quantile of the blocks' scatter that is taken as the scatter at rest
# Scatter or step of a static block over the scatter at rest: means of blocks of filtered noise differ by 4 once in 10⁴.
MAX_STATIC_RATIO = 6.0
POSE_S = 2.0  # default minimum of a pose: eight blocks, whose means give the uncertainty of theirs
BRIEF_POSE_S = 1.0  # the same for poses held by hand, if enough segments are that brief
MIN_BRIEF_FRACTION = 0.25  # of all segments for that; fewer are brief pauses between longer poses
MIN_INNER_BLOCKS = 2  # without the outer two, for an estimate of the scatter of block means
MIN_SAMPLES_PER_BLOCK = 4  # for an estimate of the scatter


class StaticSegments(NamedTuple):
    """Static segments of a log."""

    first: Int[np.ndarray, "k"]  # index of each segment's first sample
    last: Int[np.ndarray, "k"]  # index after its last sample
    uncertainty: Float[np.ndarray, "k"]  # standard uncertainty of each segment's mean output
    one_second_sd: float  # standard deviation of a mean over one second, for white noise
    omitted_durations: tuple[float, ...]  # of shorter segments of a second or more, s


def find_static_segments(
    time: Float[np.ndarray, "n"], outputs: Float[np.ndarray, "n m"], min_duration: float | None
) -> StaticSegments:
    """Find the static segments of a log, and the standard uncertainty of their means.

    Args:
        time: sampling times, s, increasing and nearly equidistant.
        outputs: outputs of one unit, such as three accelerometers.
        min_duration: of a pose, s; None: 2, or 1 if more than a quarter of the segments of at least 1 s are under 2 s.

    Raises:
        InputError: the sampling rate is too low, or no segment is long enough.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    size = round(BLOCK_SECONDS / step) if step > 0 else 0
    if size < MIN_SAMPLES_PER_BLOCK:
        raise bc.InputError(
            f"the samples are {step:.3g} s apart, but the search for static segments needs {MIN_SAMPLES_PER_BLOCK} "
            f"in {BLOCK_SECONDS:g} s: log at a higher rate. If each row is already a pose, calibrate the rows directly"
        )
    n_blocks = len(time) // size
    blocks = outputs[: n_blocks * size].reshape(n_blocks, size, -1)
    mean, scatter = blocks.mean(axis=1), blocks.std(axis=1, ddof=1)
    rest_scatter = np.quantile(scatter, REST_QUANTILE, axis=0)
    limit = MAX_STATIC_RATIO * np.maximum(rest_scatter, np.finfo(float).tiny)
    is_static = np.all(scatter <= limit, axis=1)
    has_moved = np.any(np.abs(np.diff(mean, axis=0)) > limit, axis=1)
    labels = np.cumsum(np.concatenate([[True], has_moved | (is_static[1:] != is_static[:-1])]))
    starts_of_parts, counts = ws.equal_runs(labels)
    is_segment = is_static[starts_of_parts] & (counts > 2)
    # Without the end blocks, in which a move may begin or end.
    starts, stops = starts_of_parts[is_segment] + 1, (starts_of_parts + counts)[is_segment] - 1
    durations = np.round((stops - starts) * size * step, 6)  # rounded: 5 steps of 1/20 s are 0.25 s
    if min_duration is None:
        is_brief = np.mean(durations[durations >= BRIEF_POSE_S] < POSE_S) > MIN_BRIEF_FRACTION
        min_duration = BRIEF_POSE_S if is_brief else POSE_S
    is_long = durations >= min_duration
    omitted_durations = tuple(durations[(durations >= BRIEF_POSE_S) & ~is_long].tolist())
    if not is_long.any():
        note = f": {format_omission(omitted_durations)}" if omitted_durations else ""
        fault = f"no segment of the log is static for {min_duration:g} s"
        advice = "hold the unit still in each pose for longer, or give a shorter minimum duration"
        raise bc.InputError(f"{fault}: {advice}{note}")
    starts, stops = starts[is_long], stops[is_long]
    ranges = list(zip(starts.tolist(), stops.tolist(), strict=True))
    # With much noise, moves begin undetected in the outer blocks, whose means then differ by more than noise.
    inner_ranges = [(a + 1, b - 1) for a, b in ranges if b - a >= MIN_INNER_BLOCKS + 2] or ranges
    block_means = [mean[a:b] for a, b in inner_ranges]
    dof = sum(len(means) - 1 for means in block_means) * mean.shape[1]
    variance = sum(float(np.sum((m - m.mean(axis=0)) ** 2)) for m in block_means) / dof
    return StaticSegments(
        first=starts * size,
        last=stops * size,
        uncertainty=np.sqrt(variance / (stops - starts)),
        one_second_sd=float(np.sqrt(variance * size * step)),
        omitted_durations=omitted_durations,
    )


def format_omission(durations: Sequence[float]) -> str:
    """Return a sentence on the number of omitted shorter segments, and the option that includes them."""
    option = f"--shortest {min(durations):g} (min_duration={min(durations):g})"
    return f"{len(durations)} shorter static segments are omitted; {option} includes them"


class LoggedRun(NamedTuple):
    """One run of a log: its samples and static segments."""

    samples: bc.Measurements
    time: Float[np.ndarray, "n"]  # s
    outputs: Float[np.ndarray, "n 3"]
    segments: StaticSegments

    @property
    def temperature(self) -> Float[np.ndarray, "n"] | None:
        """Return the temperature of each sample, °C; None if not logged."""
        return self.samples["temperature"] if self.samples.has("temperature") else None

    @property
    def pose_windows(self) -> Float[np.ndarray, "k 2"]:
        return np.stack([self.time[self.segments.first], self.time[self.segments.last - 1]], axis=1)

    def average_outputs(self, windows: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        return np.stack([self.outputs[self.find_rows(*w)].mean(axis=0) for w in windows])

    def find_rows(self, begin: float, end: float) -> slice:
        first, last = np.searchsorted(self.time, [begin, end])
        return slice(int(first), int(last) + 1)


def split_runs(
    log: bc.Measurements, names: tuple[str, ...], min_duration: float | None, factor: float = 1.0
) -> dict[str, LoggedRun]:
    """Split a log by its column `run`; return label → run, with the outputs `names` multiplied by `factor`.

    Raises:
        InputError: no column `time`, or as in `find_static_segments`.
    """
    if not log.has("time"):
        raise bc.InputError(f"{log.file}: static segments need the column 'time', in s")
    if log.has(ws.ACROSS[0]):  # each sample is three readings
        log = log.select(np.arange(0, len(log), 3))
    labels, codes = log.groups("run")
    runs = {}
    for k, label in enumerate(labels):
        samples = log.select(codes == k)
        outputs = factor * np.stack([samples[name] for name in names], axis=1)
        segments = find_static_segments(samples["time"], outputs, min_duration)
        runs[label] = LoggedRun(samples, samples["time"], outputs, segments)
    return runs


def build_readings(
    columns: dict[str, np.ndarray], instrument: bc.Instrument, log: bc.Measurements
) -> bc.Measurements:
    """Build an instrument's readings from columns of a log; columns that it does not declare keep the log's units."""
    declared_names = {c.name for c in instrument.columns} | {ws.UNCERTAINTY}
    units = {n: str(log.unit(n)) for n in columns if n not in declared_names and log.unit(n)}
    arguments: dict[str, Any] = {"units": units, "allow_one_temperature": True, **columns}
    return bc.Measurements.from_arrays(instrument, **arguments)


def average_segments(
    log: bc.Measurements, names: Iterable[str], segments: Iterable[slice]
) -> dict[str, np.ndarray]:
    """Return the mean of each column `names` in each segment of a run, or the first label of a column of labels."""
    segments = [*segments]
    return {
        n: np.array([v[s].mean() if v.dtype.kind == "f" else v[s.start] for s in segments])
        for n, v in ((name, log[name]) for name in names)
    }


def intersect_windows(a: Float[np.ndarray, "k 2"], b: Float[np.ndarray, "l 2"]) -> np.ndarray:
    """Return intersections (m, 2) of time windows, s, if at least half as long as the shortest of the windows."""
    begin = np.maximum(a[:, None, 0], b[None, :, 0])
    end = np.minimum(a[:, None, 1], b[None, :, 1])
    min_duration = 0.5 * min(np.min(a[:, 1] - a[:, 0]), np.min(b[:, 1] - b[:, 0]))
    is_long = end - begin >= min_duration
    windows = np.stack([begin[is_long], end[is_long]], axis=1)
    return windows[np.argsort(windows[:, 0])]


@ws.renamed(shortest="min_duration")
def poses(
    log: bc.Measurements, instrument: bc.Instrument, *, min_duration: float | None = None
) -> bc.Measurements:
    """Average each static segment of a log to one pose; all numeric columns are averaged.

    For gyroscopes on a rate table, segments of constant rate are static.

    Args:
        log: samples of the three outputs, read with the instrument, with a column `time`.
        instrument: a three-axis instrument.
        min_duration: minimum duration of a pose, s; default 2, or 1 if many segments of the log are shorter than 2 s.

    Raises:
        InputError: an instrument with one output, no column `time`, or no static segment.
    """
    if instrument.vector is None:
        raise bc.InputError(f"instrument {instrument.name!r} has one output; poses need three axes")
    runs = split_runs(log, instrument.vector.outputs, min_duration).values()
    names = [n for n in log.columns if n not in ("output", ws.UNCERTAINTY, ws.AXIS, *ws.ACROSS)]
    tables = [
        {ws.UNCERTAINTY: run.segments.uncertainty}
        | average_segments(run.samples, names, map(slice, run.segments.first, run.segments.last))
        for run in runs
    ]
    columns = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    readings = build_readings(columns, instrument, log)
    count = len(columns[ws.UNCERTAINTY])
    notes = [f"{len(readings['output'])} readings of {count} poses found in {log.file}"]
    omitted_durations = [seconds for run in runs for seconds in run.segments.omitted_durations]
    notes += [f"{log.file}: {format_omission(omitted_durations)}"] if omitted_durations else []
    return replace(readings, sources=log.sources, flags=(*log.flags, *readings.flags, *notes))
