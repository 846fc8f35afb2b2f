"""Poses of a raw log: its still stretches found and averaged, with the standard uncertainty that their means have.

A log is cut into blocks of a quarter of a second. The quietest blocks say how much an output scatters at rest; a block
is still where none of its outputs scatters by six times as much or stands that far from the block before. Samples
that follow each other are correlated (filters, vibration), so that the uncertainty of a mean is that of the means of
its blocks but for the outermost two, pooled over all poses: often 3 to 4 times that of independent samples.
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
QUIET_QUANTILE = 0.1  # quantile of the blocks' scatter, that is taken as at rest
# Times the scatter at rest, up to which a block is still: means of blocks of filtered noise differ by 4 once in 10⁴.
STILL_RATIO = 6.0
SHORTEST_SECONDS = 2.0  # of a pose: eight blocks, whose means say how well theirs is known
# s, of a pose held by hand: taken where more than a share of all still stretches lie between this and the other.
BRIEF_SECONDS = 1.0
BRIEF_SHARE = 0.25  # of them: a unit that is mostly held for longer pauses briefly now and then
INNER_BLOCKS = 2  # fewest between the outer ones, from which on their means say how blocks scatter
BLOCK_SAMPLES = 4  # fewest in a block, from which on their scatter says something


class StillStretches(NamedTuple):
    """Still stretches of a log."""

    first: Int[np.ndarray, "k"]  # first, last: their first sample and the one after the last (k,)
    last: Int[np.ndarray, "k"]
    uncertainty: Float[np.ndarray, "k"]  # standard, of the mean of each output
    of_second: float  # standard uncertainty of a mean over one second, of white noise
    left_out: tuple[float, ...]  # duration of each shorter one of a second or more, s


def still_stretches(
    time: Float[np.ndarray, "n"], outputs: Float[np.ndarray, "n m"], shortest: float | None = None
) -> StillStretches:
    """Find and average still stretches.

    Args:
        time: s, increasing and nearly even.
        outputs: of one unit, such as three accelerometers.
        shortest: of a pose, s; two if None, or one where more than a quarter of all still stretches lie between.

    Raises:
        InputError: samples too far apart, or no stretch is still for so long.
    """
    step = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    size = round(BLOCK_SECONDS / step) if step > 0 else 0
    if size < BLOCK_SAMPLES:
        raise bc.InputError(
            f"samples {step:.3g} s apart: still stretches are found in blocks of {BLOCK_SECONDS:g} s, which need "
            f"{BLOCK_SAMPLES} samples each. If each row is a pose already, calibrate them as they are"
        )
    count = len(time) // size
    blocks = outputs[: count * size].reshape(count, size, -1)
    mean, scatter = blocks.mean(axis=1), blocks.std(axis=1, ddof=1)
    rest_scatter = np.quantile(scatter, QUIET_QUANTILE, axis=0)
    rest_scatter = np.maximum(rest_scatter, np.finfo(float).tiny)
    is_still = np.all(scatter <= STILL_RATIO * rest_scatter, axis=1)
    has_moved = np.any(np.abs(np.diff(mean, axis=0)) > STILL_RATIO * rest_scatter, axis=1)
    label = np.cumsum(np.concatenate([[True], has_moved | (is_still[1:] != is_still[:-1])]))
    begins, counts = ws.equal_runs(label)
    inner = is_still[begins] & (counts > 2)
    first, last = begins[inner] + 1, (begins + counts)[inner] - 1  # a move may reach into the ends
    # A block counts as a quarter of a second, which a step of 1/20 s makes 0.2499999 of.
    lengths = np.round((last - first) * size * step, 6)
    if shortest is None:
        brief = np.mean(lengths[lengths >= BRIEF_SECONDS] < SHORTEST_SECONDS) > BRIEF_SHARE
        shortest = BRIEF_SECONDS if brief else SHORTEST_SECONDS
    long_enough = lengths >= shortest
    shorter = tuple(map(float, lengths[(lengths >= BRIEF_SECONDS) & ~long_enough]))
    if not long_enough.any():
        raise bc.InputError(
            f"no stretch of the log is still for {shortest:g} s: hold the unit still in each pose for longer, or say a "
            "shorter time" + (f": {shorter_stretches_note(shorter)}" if shorter else "")
        )
    first, last = first[long_enough], last[long_enough]
    ends = list(zip(first.tolist(), last.tolist(), strict=True))
    # Beside much noise a move begins unseen, in the outer blocks: their means tell of it rather than of the noise.
    middle = [(a + 1, b - 1) for a, b in ends if b - a >= INNER_BLOCKS + 2] or ends
    block_means = [mean[a:b] for a, b in middle]
    spent = sum(len(o) - 1 for o in block_means) * mean.shape[1]
    between = sum(float(np.sum((o - o.mean(axis=0)) ** 2)) for o in block_means) / spent
    return StillStretches(
        first=first * size,
        last=last * size,
        uncertainty=np.sqrt(between / (last - first)),
        of_second=float(np.sqrt(between * size * step)),
        left_out=shorter,
    )


def shorter_stretches_note(left_out: Sequence[float]) -> str:
    """State how many still stretches are too short, and the option that includes them."""
    least = min(left_out)
    return f"{len(left_out)} shorter still stretches are left out; --shortest {least:g} (shortest={least:g}) takes them"


class LoggedRun(NamedTuple):
    """One run of a log: its samples and still stretches."""

    samples: bc.Measurements
    time: Float[np.ndarray, "n"]  # s
    outputs: Float[np.ndarray, "n 3"]
    at_rest: StillStretches

    @property
    def temperature(self) -> Float[np.ndarray, "n"] | None:
        """Return the temperature of each sample, °C; None where none was logged."""
        return self.samples["temperature"] if self.samples.has("temperature") else None

    def ends(self) -> Float[np.ndarray, "k 2"]:
        return np.stack([self.time[self.at_rest.first], self.time[self.at_rest.last - 1]], axis=1)

    def means(self, windows: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        return np.stack([self.outputs[self.inside(*w)].mean(axis=0) for w in windows])

    def inside(self, begin: float, end: float) -> slice:
        first, last = np.searchsorted(self.time, [begin, end])
        return slice(int(first), int(last) + 1)


def logged_runs(
    log: bc.Measurements, names: tuple[str, ...], shortest: float | None, factor: float = 1.0
) -> dict[str, LoggedRun]:
    """Return the samples, outputs times a factor, and still stretches of each run, by its label.

    Raises:
        InputError: no column `time`, or as of `still_stretches`.
    """
    if not log.has("time"):
        raise bc.InputError(f"{log.file}: still stretches need the column 'time', in s")
    if log.has(ws.ACROSS[0]):  # each sample is three readings
        log = log.select(np.arange(0, len(log), 3))
    labels, codes = log.groups("run")
    runs = {}
    for k, label in enumerate(labels):
        samples = log.select(codes == k)
        outputs = factor * np.stack([samples[name] for name in names], axis=1)
        stretches = still_stretches(samples["time"], outputs, shortest)
        runs[label] = LoggedRun(samples, samples["time"], outputs, stretches)
    return runs


def as_readings(
    columns: dict[str, np.ndarray], instrument: bc.Instrument, log: bc.Measurements
) -> bc.Measurements:
    """Return columns made of a log as readings of an instrument; undeclared columns keep the log's units."""
    declared = {c.name for c in instrument.columns} | {ws.UNCERTAINTY}
    units = {n: str(log.unit(n)) for n in columns if n not in declared and log.unit(n)}
    arguments: dict[str, Any] = {"units": units, "allow_one_temperature": True, **columns}
    return bc.Measurements.from_arrays(instrument, **arguments)


def averaged(
    log: bc.Measurements, names: Iterable[str], stretches: Iterable[slice]
) -> dict[str, np.ndarray]:
    """Average columns over stretches of a run; of labels the first in each stretch holds."""
    stretches = [*stretches]
    return {
        n: np.array([v[s].mean() if v.dtype.kind == "f" else v[s.start] for s in stretches])
        for n, v in ((name, log[name]) for name in names)
    }


def in_common(first: Float[np.ndarray, "k 2"], second: Float[np.ndarray, "l 2"]) -> np.ndarray:
    """Return the windows in which both are still, at least half as long as the shortest stretch of either (m, 2)."""
    begin = np.maximum(first[:, None, 0], second[None, :, 0])
    end = np.minimum(first[:, None, 1], second[None, :, 1])
    least = 0.5 * min(np.min(first[:, 1] - first[:, 0]), np.min(second[:, 1] - second[:, 0]))
    long_enough = end - begin >= least
    windows = np.stack([begin[long_enough], end[long_enough]], axis=1)
    return windows[np.argsort(windows[:, 0])]


def poses(
    log: bc.Measurements, instrument: bc.Instrument, *, shortest: float | None = None
) -> bc.Measurements:
    """Average the still stretches of a log, a row each; other numeric columns are averaged too.

    Of gyroscopes on a rate table they are stretches of a steady rate.

    Args:
        log: samples of the three outputs, read with the instrument, with a column `time`.
        instrument: of three axes.
        shortest: of a pose, s; None for two, or one where the log holds many that are shorter.

    Raises:
        InputError: an instrument of one output, no column `time`, or no still stretch.
    """
    if instrument.vector is None:
        raise bc.InputError(
            f"instrument {instrument.name!r} has one output: poses are of three axes"
        )
    runs = logged_runs(log, instrument.vector.outputs, shortest).values()
    names = [n for n in log.columns if n not in ("output", ws.UNCERTAINTY, ws.OF, *ws.ACROSS)]
    parts = [
        {ws.UNCERTAINTY: run.at_rest.uncertainty}
        | averaged(run.samples, names, map(slice, run.at_rest.first, run.at_rest.last))
        for run in runs
    ]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    readings = as_readings(columns, instrument, log)
    count = len(columns[ws.UNCERTAINTY])
    note = f"{len(readings['output'])} readings of {count} poses found in {log.file}"
    left_out = [seconds for run in runs for seconds in run.at_rest.left_out]
    short = (f"{log.file}: {shorter_stretches_note(left_out)}",) if left_out else ()
    return replace(readings, sources=log.sources, flags=(*log.flags, *readings.flags, note, *short))
