"""A task as a linear regression: columns of training and hold-out readings, with the base terms projected out.

The shape of a term is the one of `NODES` values that fits best with the base alone. The unknown offset of a run that
occurs only in the hold-out data increases the variance of its prediction by the stated size squared.
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
    """Columns of one term, for the training readings (n, k) and the hold-out readings (m, k)."""

    name: str
    train: Array
    holdout: Array


class Regression:
    """A task as a linear regression.

    Attributes:
        y: training output, (n,).
        base: columns of the base terms, (n, q).
        left: residuals of the training output from a fit of the base terms, (n,).
        candidates: columns of the candidates, in the task's order, each at its best shape.
        extra: variance of a hold-out reading due to offsets of groups without training readings.
        correlation: correlation of the noise of neighbouring readings (first-order autoregressive), used for whitening.
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
        """Return the number of parameters of the base."""
        return self._orthogonal.shape[1]

    def without_base(self, columns: Array) -> Array:
        """Project the base columns out of other columns."""
        return columns - self._orthogonal @ (self._orthogonal.T @ columns)

    @cached_property
    def projected(self) -> list[Array]:
        """Return the candidates' training columns with the base projected out."""
        return [self.without_base(c.train) for c in self.candidates]

    @cached_property
    def beyond(self) -> Array:
        """Return the candidates' hold-out columns minus their least-squares prediction from the base, (m, p)."""
        x = np.hstack([c.train for c in self.candidates])
        scale = np.maximum(np.sqrt(np.mean(self.base**2, axis=0)), 1e-300)
        share = np.linalg.lstsq(self.base / scale, x, rcond=1e-10)[0]
        return np.hstack([c.holdout for c in self.candidates]) - self._base_later / scale @ share

    @cached_property
    def of_base(self) -> Array:
        """Return the prediction variance of hold-out readings by the base, relative to the noise variance, (m,)."""
        noise = float(self.left @ self.left) / (self.y.size - self.parameters)
        return (self.predict(())[1] ** 2 - self.extra) / noise

    @cached_property
    def cost(self) -> list[int]:
        """Return the number of parameters of each candidate, coefficients and shapes."""
        shapes = [len(t.shapes) for t in self.task.candidates]
        return [c.train.shape[1] + s for c, s in zip(self.candidates, shapes, strict=True)]

    def squares(self, chosen: Collection[int]) -> float:
        """Return the residual sum of squares of the base with some candidates."""
        if not chosen:
            return float(self.left @ self.left)
        basis = _orthogonal(np.hstack([self.projected[i] for i in sorted(chosen)]))
        return float(self.left @ self.left - np.sum((basis.T @ self.left) ** 2))

    def names(self, chosen: Collection[int]) -> tuple[str, ...]:
        return tuple(sorted(self.candidates[i].name for i in chosen))

    def predict(self, chosen: Collection[int]) -> tuple[Array, Array]:
        """Return mean and standard deviation of the hold-out readings from a least-squares fit, (m,) each."""
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
        """Estimate the correlation of neighbouring residuals within runs after fitting all candidates; at least 0."""
        basis = _orthogonal(np.hstack(self.projected))
        e = self.left - basis @ (basis.T @ self.left)
        inside = ~self._first[1:]
        shared = float(np.sum((e[1:] * e[:-1])[inside]))
        return float(np.clip(shared / (e @ e) * e.size / inside.sum(), 0.0, 0.95))

    def _whitened(self, columns: Array) -> Array:
        """Whiten columns of the training readings by the autoregressive noise; the first reading of a run is scaled."""
        whitened = columns - self.correlation * np.roll(columns, 1, axis=0)
        whitened[self._first] = np.sqrt(1 - self.correlation**2) * columns[self._first]
        return whitened

    def average(self, models: Sequence[tuple[Collection[int], float]]) -> tuple[Array, Array]:
        """Average the predictions of several sets by their probabilities; sets below 1 % are omitted."""
        probable = [m for m in models if m[1] >= 0.01] or [max(models, key=lambda m: m[1])]
        weights = np.array([p for _, p in probable])
        weights = weights / weights.sum()
        pairs = [self.predict(chosen) for chosen, _ in probable]
        means, variances = (np.array([m for m, _ in pairs]), np.array([s**2 for _, s in pairs]))
        mean = weights @ means
        return mean, np.sqrt(weights @ (variances + (means - mean) ** 2))

    def _best(self, term: Term) -> Columns:
        """Return a candidate's columns at the shape that fits best with the base."""
        trials = []
        for shapes in grid(term, NODES):
            plain = _both(term, self.task, shapes)
            candidate = Columns(plain.name, self._whitened(plain.train), plain.holdout)
            basis = _orthogonal(self.without_base(candidate.train))
            trials.append((float(np.sum((basis.T @ self.left) ** 2)), candidate))
        return max(trials, key=lambda trial: trial[0])[1]


def grid(term: Term, count: int) -> list[dict[str, float]]:
    """Return values of a term's shape on a logarithmic grid; a single empty dictionary if it has no shape."""
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
    """Return whether the hold-out readings are of unseen group members only."""
    return bool(term.group) and not columns.holdout.any()


def _about_mean(columns: Columns, term: Term) -> Columns:
    """Return offsets relative to their mean, if the runs of the hold-out data are unseen; otherwise the columns."""
    if not _unseen(columns, term):
        return columns
    return Columns(columns.name, columns.train - 1 / columns.train.shape[1], columns.holdout)


def _orthogonal(columns: Array) -> Array:
    """Return an orthonormal basis of the span of columns."""
    scale = np.sqrt(np.sum(columns**2, axis=0))
    if not scale.any():
        return np.zeros((len(columns), 0))
    u, s, _ = np.linalg.svd(columns[:, scale > 0] / scale[scale > 0], full_matrices=False)
    return u[:, s > 1e-9 * s[0]]
