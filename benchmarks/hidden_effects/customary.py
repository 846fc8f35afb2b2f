"""Customary selections of effects, side by side with ours: stepwise by BIC, LASSO, sequential thresholding.

All see the same columns: ∂μ/∂θ of every candidate at the fitted baseline (shapes at the medians of their priors),
the baseline's own columns taken out first by least squares. None knows priors or correlated noise.
Sources: G. Schwarz, Ann. Stat. 6 (1978) 461; R. Tibshirani, J. R. Stat. Soc. B 58 (1996) 267 (by scikit-learn);
S. Brunton, J. Proctor & J. Kutz, PNAS 113 (2016) 3932 (sequentially thresholded least squares, after its description).
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from bayescal._inference.linear_model import linear_model
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.instrument import factor_of
from bayescal._model.terms import ColumnsOf
from benchmarks.hidden_effects.searched import Later, Searched

SELECTIONS = ("stepwise BIC", "LASSO", "STLSQ")
MOST = 5
SEEN = 0.02  # standard deviation of a contribution, in those of the residuals, below which it does not count


class Regressors(NamedTuple):
    """Columns at the fitted baseline on some readings.

    Attributes:
        candidates: (n, P).
        owners: the name of the effect that each of them is of.
        baseline: (n, q).
    """

    candidates: np.ndarray
    owners: np.ndarray
    baseline: np.ndarray


def select(name: str, searched: Searched, later: Later) -> dict[str, Any]:
    """Effects selected by one of the customary ways, and the error of the held-out readings.

    Args:
        name: one of `SELECTIONS`.
        searched: a record; its baseline is fitted.
        later: held-out readings.
    """
    own = _regressors(searched, searched.structures.record)
    y = linear_model(searched.base.problem, searched.base.mode).residual
    way = {"stepwise BIC": _stepwise, "LASSO": _lasso, "STLSQ": _stlsq}[name]
    chosen = way(*_projected(own.candidates, y, own.baseline), own.owners)
    return {"effects": sorted(chosen), "held_out": _held_out(searched, later, chosen, own, y)}


def _regressors(searched: Searched, record: Record) -> Regressors:
    """Columns of the catalogue's candidates and of the baseline on a record, at the fitted baseline."""
    base = searched.base
    there = Problem(base.problem.layout, record)
    hyper = there.hyper(base.mode.v)
    x = base.mode.x
    line, slopes = there.linearise(x, hyper), there.slopes(x, hyper)
    instrument, counts = searched.model.instrument, dict(base.problem.layout.counts)
    columns, owners = [], []
    for name, effect in searched.structures.candidates.items():
        if effect.is_placeholder or name.startswith(f"{effect.family}."):
            continue
        shapes = effect.column_shapes
        middle = tuple(float(s.prior.value(0.0)) for s in shapes)
        made = record.columns(ColumnsOf.of(effect), middle)
        for i, c in enumerate(effect.coefficients):
            slot = instrument.slot(c.slot or effect.slot)
            column = slopes[slot.name] * factor_of(instrument, effect, c) * made[:, i]
            if c.per is None:
                columns.append(column)
            else:
                codes = record.codes[c.per]
                columns += [np.where(codes == m, column, 0.0) for m in range(counts[c.per])]
            owners += [effect.reported] * (len(columns) - len(owners))
    return Regressors(np.column_stack(columns), np.array(owners), line.jacobian)


def _projected(
    columns: np.ndarray, y: np.ndarray, null: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Columns and residuals with the baseline's columns taken out, columns of unit length."""
    both = np.column_stack([columns, y])
    left = both - null @ np.linalg.lstsq(null, both, rcond=None)[0]
    x, y = left[:, :-1], left[:, -1]
    norm = np.sqrt(np.mean(x**2, axis=0))
    keep = norm > 1e-9 * np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-300)
    return np.where(keep, x / np.where(keep, norm, 1.0), 0.0), y


def _bic(x: np.ndarray, y: np.ndarray) -> float:
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0] if x.shape[1] else y
    n = y.size
    return n * np.log(max(float(np.mean(rest**2)), 1e-300)) + x.shape[1] * np.log(n)


def _stepwise(x: np.ndarray, y: np.ndarray, owners: np.ndarray) -> set[str]:
    chosen: set[str] = set()
    best = _bic(x[:, :0], y)
    while len(chosen) < MOST:
        trials = {
            name: _bic(x[:, np.isin(owners, [*chosen, name])], y) for name in set(owners) - chosen
        }
        name = min(trials, key=lambda n: trials[n], default=None)
        if name is None or trials[name] >= best:
            return chosen
        chosen.add(name)
        best = trials[name]
    return chosen


def _lasso(x: np.ndarray, y: np.ndarray, owners: np.ndarray) -> set[str]:
    from sklearn.linear_model import LassoCV  # pyright: ignore[reportMissingImports]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = LassoCV(cv=5, fit_intercept=False, max_iter=20000).fit(x, y / y.std())
    return {str(n) for n, c in zip(owners, found.coef_, strict=True) if abs(c) > SEEN}


def _stlsq(x: np.ndarray, y: np.ndarray, owners: np.ndarray, threshold: float = 0.1) -> set[str]:
    scale = y.std()
    active = np.ones(x.shape[1], bool)
    for _ in range(20):
        inner = x[:, active]
        gram = inner.T @ inner + 1e-6 * len(y) * np.eye(inner.shape[1])
        size = np.zeros(x.shape[1])
        size[active] = np.linalg.solve(gram, inner.T @ y) if active.any() else 0.0
        now = np.abs(size) > threshold * scale
        if (now == active).all():
            break
        active = now
    return {str(n) for n in owners[active]}


def _held_out(
    searched: Searched, later: Later, chosen: set[str], own: Regressors, y: np.ndarray
) -> float:
    """Error of the held-out readings with the chosen columns fitted by least squares beside the baseline's."""
    at = np.isin(own.owners, list(chosen))
    new = _regressors(searched, later.known)
    columns = np.column_stack([own.baseline, own.candidates[:, at]])
    size = np.linalg.lstsq(columns, y, rcond=None)[0]
    guess = later.expected(searched.base)
    guess = guess + np.column_stack([new.baseline, new.candidates[:, at]]) @ size
    return float(np.sqrt(np.mean((later.record.y - guess) ** 2)))
