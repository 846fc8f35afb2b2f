"""Columns, their statistics and an exact answer: what the tests of single effects share."""

from __future__ import annotations

from itertools import product

import numpy as np

from bayescal._discovery.susie import Item, log_bayes_factor


def singles(count: int) -> list[Item]:
    return [Item(i, 1.0, (i,)) for i in range(count)]


def correlated_columns(rng: np.random.Generator, readings: int, count: int) -> np.ndarray:
    """Columns of unit length; neighbours correlate by about a half."""
    columns = rng.standard_normal((readings, count + 1))
    columns = columns[:, 1:] + columns[:, :-1]
    return columns / np.linalg.norm(columns, axis=0)


def statistics(X: np.ndarray, truth: dict[int, float], rng: np.random.Generator):
    """Score and information of columns X for unit white noise and the true coefficients."""
    y = sum((b * X[:, c] for c, b in truth.items()), rng.standard_normal(len(X)))
    return X.T @ y, X.T @ X


def exact_two_rows(u, I, W, items, prior, nothing_prior=0.5):  # noqa: E741
    """Log evidence and P(nothing) of the model with two rows, by summing over all row contents."""
    null = np.sqrt(nothing_prior)
    contents = [
        ((), null),
        *(((i.columns), (1 - null) * prior[i.candidate] * i.weight) for i in items),
    ]
    terms = []
    for (a, p), (b, q) in product(contents, contents):
        c = [*a, *b]
        terms.append(np.log(p * q) + (log_bayes_factor(u[c], I[np.ix_(c, c)], W[c]) if c else 0.0))
    evidence = float(np.logaddexp.reduce(terms))
    return evidence, nothing_prior * np.exp(-evidence)
