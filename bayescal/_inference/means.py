"""Means of readings that follow each other: what a long record is looked over by, where columns hardly change in one.

Products over means are those over all readings but for what happens within a mean: enough to say where to look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from bayescal._data.averaging import mean_rows
from bayescal._inference.linear_model import LinearModel
from bayescal._inference.noise_on_record import Independent, Whitening
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import BY_READING
from bayescal._model.noise_law import WHITE


@dataclass(frozen=True, eq=False)
class Means:
    """Means of the readings of a record, in the order of time within runs."""

    of: Record
    record: Record  # the means, as readings
    begins: Int[np.ndarray, "m"]  # where each begins in the order of time
    count: int  # readings of most

    @classmethod
    def over(cls, record: Record, count: int) -> Means:
        """Return means of so many readings each, fewer where a run or a label ends."""
        frame = record.frame.in_time()
        new = frame.step < 0
        for labels in (*frame.codes.values(), *frame.labels.values()):
            new[1:] |= np.diff(labels) != 0
        stretches = np.flatnonzero(new)
        place = np.arange(len(new)) - np.repeat(stretches, np.diff(stretches, append=len(new)))
        begins = np.flatnonzero(place % count == 0)
        clock = mean_rows(np.cumsum(np.maximum(frame.step, 0.0)), begins)
        step = np.where(frame.step[begins] < 0, -1.0, np.diff(clock, prepend=0.0))
        short = frame.reordered(begins, np.arange(len(begins)), step)
        averaged = {
            n: {k: mean_rows(a, begins) for k, a in getattr(frame, n).items()}
            for n in BY_READING
            if n not in ("codes", "labels")  # the same in each
        }
        y = mean_rows(record.y[record.in_time[0]], begins)
        return cls(record, Record(record.instrument, replace(short, **averaged), y), begins, count)

    @cached_property
    def counts(self) -> Int[np.ndarray, "m"]:
        """Return the number of readings of each mean."""
        return np.diff(self.begins, append=self.of.size)

    def __call__(self, rows: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "m *k"]:
        """Return means of what belongs to readings."""
        order = self.of.in_time[0]
        return mean_rows(rows if self.of.ordered else rows[order], self.begins)

    def within(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k"]:
        """Return the share of each column's variance that is within means."""
        centred = rows - rows.mean(axis=0)
        total = np.sum(centred**2, axis=0)
        between = self.counts @ self(centred) ** 2
        return np.where(total > 0, 1 - between / np.where(total > 0, total, 1.0), 0.0)

    def line(self, line: LinearModel) -> LinearModel:
        """Return a linear model of the means about the mode of the readings."""
        problem, whiten = line.problem, line.whiten
        if isinstance(whiten, Independent):
            precision = 1 / whiten.sd**2
            weight = self(precision)
            whiten = Independent(1 / np.sqrt(self.counts * weight))
            residual = self(precision * line.residual) / weight
            nuisance = np.transpose([self(precision * c) / weight for c in line.nuisance.T])
        else:
            residual, nuisance = self(line.residual), self(line.nuisance)
            values = problem.hyper(line.mode.v)
            values |= {WHITE: values[WHITE] / math.sqrt(self.count)}
            extra = self(np.broadcast_to(line.extra, line.size)) / self.count
            whiten = Whitening(problem.noise, values, self.record, extra)
        short = Problem(problem.layout, self.record, problem.size_factors)
        of_means = replace(line, problem=short, residual=residual, nuisance=nuisance, whiten=whiten)
        vars(of_means)["slopes"] = {n: self(s) for n, s in line.slopes.items()}
        return of_means
