"""Means of readings that follow each other: what a long record is looked over by, where columns hardly change in one.

Products over means are those over all readings but for what happens within a mean: enough to say where to look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.linear_model import LinearModel
from bayescal._inference.noise_on_record import Independent, Whitening
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import BY_READING
from bayescal._model.noise_law import WHITE


@dataclass(frozen=True, eq=False)
class Means:
    """Means of the readings of a record, in the order of time within runs.

    Attributes:
        of, record: the readings, and their means as readings.
        begins: where each mean begins in the order of time (m,).
        count: readings of most means.
    """

    of: Record
    record: Record
    begins: Int[np.ndarray, "m"]
    count: int

    @classmethod
    def over(cls, record: Record, count: int) -> Means:
        """Return means of so many readings each, fewer where a run or a label ends."""
        frame, (order, step) = record.frame, record.in_time
        new = step < 0
        for labels in (*frame.codes.values(), *frame.labels.values()):
            new[1:] |= np.diff(np.asarray(labels)[order]) != 0
        stretches = np.flatnonzero(new)
        place = np.arange(len(new)) - np.repeat(stretches, np.diff(stretches, append=len(new)))
        begins = np.flatnonzero(place % count == 0)
        clock = mean_rows(np.cumsum(np.maximum(step, 0.0)), begins)
        found = {
            n: {k: mean_rows(np.asarray(a)[order], begins) for k, a in getattr(frame, n).items()}
            for n in BY_READING
        }
        found["codes"] = {k: np.asarray(a)[order][begins] for k, a in frame.codes.items()}
        steps = np.where(step[begins] < 0, -1.0, np.diff(clock, prepend=0.0))
        short = replace(frame, **found, order=np.arange(len(begins)), step=steps)
        y = mean_rows(record.y[order], begins)
        return cls(record, Record(record.instrument, short, y), begins, count)

    def __call__(self, rows: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "m *k"]:
        """Return means of what belongs to readings."""
        order = self.of.in_time[0]
        return mean_rows(rows if self.of.ordered else rows[order], self.begins)

    def within(self, rows: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k"]:
        """Return the share of each column's variance that is within means."""
        counts = np.diff(self.begins, append=len(rows))
        centred = rows - rows.mean(axis=0)
        total = np.sum(centred**2, axis=0)
        kept = counts @ self(centred) ** 2
        return np.where(total > 0, 1 - kept / np.where(total > 0, total, 1.0), 0.0)

    def line(self, line: LinearModel) -> LinearModel:
        """Return a linear model of the means about the mode of the readings."""
        problem, whiten = line.problem, line.whiten
        if isinstance(whiten, Independent):
            precision = 1 / whiten.sd**2
            counts, each = np.diff(self.begins, append=line.size), self(precision)
            whiten = Independent(1 / np.sqrt(counts * each))
            residual = self(precision * line.residual) / each
            nuisance = self(precision[:, None] * line.nuisance) / each[:, None]
        else:
            residual, nuisance = self(line.residual), self(line.nuisance)
            values = problem.hyper(line.mode.v)
            values |= {WHITE: values[WHITE] / math.sqrt(self.count)}
            extra = self(np.broadcast_to(line.extra, line.size)) / self.count
            whiten = Whitening(problem.noise, values, self.record, extra)
        short = Problem(problem.layout, self.record, problem.size_factors)
        made = replace(line, problem=short, residual=residual, nuisance=nuisance, whiten=whiten)
        slopes = line.slopes.items()
        vars(made)["slopes"] = {n: self(np.broadcast_to(s, line.size)) for n, s in slopes}
        return made


def mean_rows(rows: Float[np.ndarray, "n *k"], begins: Int[np.ndarray, "m"]) -> np.ndarray:
    """Return means of stretches of rows, each from where it begins to the next."""
    counts = np.diff(begins, append=len(rows))
    return np.add.reduceat(rows, begins, axis=0) / counts.reshape(-1, *(1,) * (rows.ndim - 1))
