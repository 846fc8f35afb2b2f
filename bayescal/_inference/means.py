"""Block means of successive readings: a shorter record for a coarse search, where columns vary little in a block.

Inner products over means approximate those over all readings, up to the variance within blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from bayescal._data.averaging import average
from bayescal._inference.linear_model import LinearModel
from bayescal._inference.noise_on_record import SdWhitening, Whitening
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import ROW_FIELDS
from bayescal._model.noise_law import WHITE


@dataclass(frozen=True, eq=False)
class Means:
    """Block means of a record's readings, in the order of time within runs."""

    source: Record  # readings
    record: Record  # block means
    starts: Int[np.ndarray, "m"]  # index of each block's first reading, in time order
    count: int  # readings per block, except in the last block of a run

    @classmethod
    def from_record(cls, record: Record, count: int) -> Means:
        """Return means of blocks of `count` readings; a block ends earlier where a run ends or a label changes."""
        frame = record.frame.sort_by_time()
        is_first = frame.step < 0
        for labels in (*frame.codes.values(), *frame.labels.values()):
            is_first[1:] |= np.diff(labels) != 0
        run_starts = np.flatnonzero(is_first)
        lengths = np.diff(run_starts, append=len(is_first))
        position = np.arange(len(is_first)) - np.repeat(run_starts, lengths)
        starts = np.flatnonzero(position % count == 0)
        clock = average(np.cumsum(np.maximum(frame.step, 0.0)), starts)
        step = np.where(frame.step[starts] < 0, -1.0, np.diff(clock, prepend=0.0))
        means = frame.reorder(starts, np.arange(len(starts)), step)
        arrays = {
            n: {k: average(a, starts) for k, a in getattr(frame, n).items()}
            for n in ROW_FIELDS
            if n not in ("codes", "labels")  # constant within a block
        }
        y = average(record.y[record.time_order[0]], starts)
        return cls(record, Record(record.instrument, replace(means, **arrays), y), starts, count)

    @cached_property
    def counts(self) -> Int[np.ndarray, "m"]:
        """Return the number of readings in each block (m,)."""
        return np.diff(self.starts, append=self.source.size)

    def __call__(self, rows: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "m *k"]:
        """Return the mean of rows, one per reading (n, …), in each block (m, …)."""
        order = self.source.time_order[0]
        return average(rows if self.source.is_time_ordered else rows[order], self.starts)

    def within_fraction(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k"]:
        """Return the fraction of each column's variance that is within blocks (k,)."""
        deviations = rows - rows.mean(axis=0)
        total = np.sum(deviations**2, axis=0)
        between_sum = self.counts @ self(deviations) ** 2
        return np.where(total > 0, 1 - between_sum / np.where(total > 0, total, 1.0), 0.0)

    def linear_model(self, line: LinearModel) -> LinearModel:
        """Return the linear model of block means, from a model of all readings linearised about its mode."""
        problem, whiten = line.problem, line.whiten
        if isinstance(whiten, SdWhitening):
            precision = 1 / whiten.sd**2
            weight = self(precision)
            whiten = SdWhitening(1 / np.sqrt(self.counts * weight))
            residual = self(precision * line.residual) / weight
            nuisance = np.transpose([self(precision * c) / weight for c in line.nuisance.T])
        else:
            residual, nuisance = self(line.residual), self(line.nuisance)
            values = problem.hyper(line.mode.v)
            values |= {WHITE: values[WHITE] / math.sqrt(self.count)}
            variance = self(np.broadcast_to(line.extra, line.size)) / self.count
            whiten = Whitening(problem.noise, values, self.record, variance)
        problem = Problem(problem.layout, self.record, problem.size_factors)
        result = replace(line, problem=problem, residual=residual, nuisance=nuisance, whiten=whiten)
        vars(result)["slopes"] = {n: self(s) for n, s in line.slopes.items()}
        return result
