"""What customary selections begin with: columns on both parts of a task, the base's taken out by least squares.

Of a term that is not linear in a shape, the value that fits best beside the base alone is taken, of `NODES` values.
A run that is held out has an offset that nobody knows: it widens the prediction by the stated size.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from missing_effect.task import Task, Term

Array = np.ndarray
NODES = 15  # values tried of a shape, evenly in its logarithm: steps of a sixth where its range is of 1 to 12


@dataclass(frozen=True)
class Columns:
    """Of one term: on the training readings, and on those held out, (n, k) and (m, k)."""

    name: str
    train: Array
    holdout: Array


class Regression:
    """A task as a linear regression.

    Attributes:
        y: training output, (n,).
        base: columns of the base's terms, (n, q).
        left: training output without what the base explains, (n,).
        candidates: in the task's order, each at its best shape.
        extra: variance of a reading that is held out, of offsets that the training readings do not show.
        correlation: of neighbouring readings' noise: training readings are whitened by it, first-order autoregressive.
    """

    def __init__(self, task: Task, correlation: float = 0.0) -> None:
        self.task = task
        self.correlation = correlation
        labels = [task.train[g].to_numpy() for g in ("run", "device") if g in task.train]
        self._first = np.arange(len(task.train)) == 0
        for label in labels:
            self._first[1:] |= np.diff(label) != 0
        self.y = self._whitened(task.train["output"].to_numpy(float))
        base = [_about_mean(_both(term, task), term) for term in task.base]
        self.base = self._whitened(np.hstack([c.train for c in base]))
        self._base_later = np.hstack([c.holdout for c in base])
        self.extra = sum(t.size**2 for t in task.base if _unseen(_both(t, task), t))
        self._orthogonal = _orthogonal(self.base)
        self.left = self.without_base(self.y)
        self.candidates = [self._best(term) for term in task.candidates]

    @property
    def parameters(self) -> int:
        """Return the parameters of the base."""
        return self._orthogonal.shape[1]

    def without_base(self, columns: Array) -> Array:
        """Project the base's columns out of others."""
        return columns - self._orthogonal @ (self._orthogonal.T @ columns)

    @cached_property
    def projected(self) -> list[Array]:
        """Candidates' training columns without what the base explains."""
        return [self.without_base(c.train) for c in self.candidates]

    @cached_property
    def beyond(self) -> Array:
        """Candidates' columns on the readings held out, less what the base makes of them by least squares, (m, p)."""
        x = np.hstack([c.train for c in self.candidates])
        scale = np.maximum(np.sqrt(np.mean(self.base**2, axis=0)), 1e-300)
        share = np.linalg.lstsq(self.base / scale, x, rcond=1e-10)[0]
        return np.hstack([c.holdout for c in self.candidates]) - self._base_later / scale @ share

    @cached_property
    def of_base(self) -> Array:
        """Variance of a reading held out about the base fitted alone, in units of the noise's, (m,)."""
        noise = float(self.left @ self.left) / (self.y.size - self.parameters)
        return (self.predict(())[1] ** 2 - self.extra) / noise

    @cached_property
    def cost(self) -> list[int]:
        """Parameters of each candidate: coefficients, and shapes."""
        shapes = [len(t.shapes) for t in self.task.candidates]
        return [c.train.shape[1] + s for c, s in zip(self.candidates, shapes, strict=True)]

    def squares(self, chosen: Collection[int]) -> float:
        """Sum of squared residuals with some candidates beside the base."""
        if not chosen:
            return float(self.left @ self.left)
        basis = _orthogonal(np.hstack([self.projected[i] for i in sorted(chosen)]))
        return float(self.left @ self.left - np.sum((basis.T @ self.left) ** 2))

    def names(self, chosen: Collection[int]) -> tuple[str, ...]:
        return tuple(sorted(self.candidates[i].name for i in chosen))

    def predict(self, chosen: Collection[int]) -> tuple[Array, Array]:
        """Mean and standard deviation of the readings held out, of a least-squares fit: (m,) each."""
        chosen = sorted(chosen)
        x = np.hstack([self.base, *(self.candidates[i].train for i in chosen)])
        later = np.hstack([self._base_later, *(self.candidates[i].holdout for i in chosen)])
        scale = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
        u, s, vt = np.linalg.svd(x / scale, full_matrices=False)
        significant = s > 1e-10 * s[0]
        inverse = vt[significant].T / s[significant]
        size = inverse @ (u[:, significant].T @ self.y)
        residual = self.y - x / scale @ size
        variance = float(residual @ residual) / max(1, self.y.size - int(significant.sum()))
        spread = np.sum((later / scale @ inverse) ** 2, axis=1)
        of_reading = 1 / (1 - self.correlation**2)  # against the whitened ones' variance
        return later / scale @ size, np.sqrt(variance * (of_reading + spread) + self.extra)

    def correlated(self) -> float:
        """Correlation of neighbouring residuals beside all candidates at once, within runs; not below zero."""
        basis = _orthogonal(np.hstack(self.projected))
        e = self.left - basis @ (basis.T @ self.left)
        inside = ~self._first[1:]
        shared = float(np.sum((e[1:] * e[:-1])[inside]))
        return float(np.clip(shared / (e @ e) * e.size / inside.sum(), 0.0, 0.95))

    def _whitened(self, columns: Array) -> Array:
        """Columns of training readings less what the reading before says of each; the first of a run scaled."""
        whitened = columns - self.correlation * np.roll(columns, 1, axis=0)
        whitened[self._first] = np.sqrt(1 - self.correlation**2) * columns[self._first]
        return whitened

    def average(self, models: Sequence[tuple[Collection[int], float]]) -> tuple[Array, Array]:
        """Average predictions over sets with their probabilities; those below 1 % are left out."""
        probable = [m for m in models if m[1] >= 0.01] or [max(models, key=lambda m: m[1])]
        weights = np.array([p for _, p in probable])
        weights = weights / weights.sum()
        pairs = [self.predict(chosen) for chosen, _ in probable]
        means, variances = (np.array([m for m, _ in pairs]), np.array([s**2 for _, s in pairs]))
        mean = weights @ means
        return mean, np.sqrt(weights @ (variances + (means - mean) ** 2))

    def _best(self, term: Term) -> Columns:
        """A candidate's columns at the shape that fits best beside the base."""
        trials = []
        for shapes in grid(term, NODES):
            plain = _both(term, self.task, shapes)
            candidate = Columns(plain.name, self._whitened(plain.train), plain.holdout)
            basis = _orthogonal(self.without_base(candidate.train))
            trials.append((float(np.sum((basis.T @ self.left) ** 2)), candidate))
        return max(trials, key=lambda trial: trial[0])[1]


def grid(term: Term, count: int) -> list[dict[str, float]]:
    """Values of a term's shape, evenly in the logarithm; one empty dictionary where it has none."""
    if not term.shapes:
        return [{}]
    ((name, (low, high)),) = term.shapes.items()
    return [{name: float(value)} for value in np.geomspace(low, high, count)]


def _both(term: Term, task: Task, shapes: dict[str, float] | None = None) -> Columns:
    values = shapes or {}
    return Columns(
        term.name, term.columns(task.train, **values), term.columns(task.holdout, **values)
    )


def _unseen(columns: Columns, term: Term) -> bool:
    """Return whether the held-out readings are of unseen group members only."""
    return bool(term.group) and not columns.holdout.any()


def _about_mean(columns: Columns, term: Term) -> Columns:
    """Offsets of runs about the runs' mean, which an unseen run then has."""
    if not _unseen(columns, term):
        return columns
    return Columns(columns.name, columns.train - 1 / columns.train.shape[1], columns.holdout)


def _orthogonal(columns: Array) -> Array:
    """An orthonormal basis of what columns span."""
    scale = np.sqrt(np.sum(columns**2, axis=0))
    if not scale.any():
        return np.zeros((len(columns), 0))
    u, s, _ = np.linalg.svd(columns[:, scale > 0] / scale[scale > 0], full_matrices=False)
    return u[:, s > 1e-9 * s[0]]
