"""Pages of `docs/` with results: what was measured, when, the command to measure it again, and a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.record import DOCS

Texts = dict[Path, str]  # pages by their paths
Rows = list[dict[str, Any]]
INTERVAL = re.compile(r" \([^)]*%\)")
Claim = tuple[str, Callable[[Rows], str]]  # in words, and what rows say of it


def page(name: str, title: str, again: str, days: Iterable[str], *parts: str) -> Texts:
    """Return a page by its path.

    Args:
        name: file name in `docs/`, without suffix.
        title: title of the page.
        again: name of the benchmark, after `python -m benchmarks`.
        days: dates of the measurements, in any order.
        parts: paragraphs and tables.
    """
    ends = sorted(days)
    when = " to ".join(dict.fromkeys((ends[0], ends[-1]))) if ends else "not yet"
    head = f"# {title}\n\n*Measured: {when}. Repeat: `python -m benchmarks {again}`.*"
    text = "\n\n".join([head, *(part.strip() for part in parts)])
    return {DOCS / f"{name}.md": text + "\n"}


def table(head: Iterable[Any], rows: Iterable[Iterable[Any]]) -> str:
    """Return a table in Markdown."""
    head = list(head)
    return "\n".join([_line(head), "|" + "---|" * len(head), *map(_line, rows)]) + "\n"


def _line(cells: Iterable[Any]) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def claims_table(
    groups: Mapping[str, Rows], claims: Sequence[Claim], what: str = "campaigns"
) -> str:
    """Return a table with a row per claim and a column per group of rows; the column of all has intervals."""
    all_rows = [row for rows in groups.values() for row in rows]

    def line(name: str, say: Callable[[Rows], str]) -> list[str]:
        cells = [INTERVAL.sub("", say(rows)) for rows in groups.values()] if len(groups) > 1 else []
        return [name, *cells, say(all_rows)]

    counted = ((what, lambda rows: f"{len(rows):,}"), *claims)
    head = ["", *([*groups, "all"] if len(groups) > 1 else groups)]
    return table(head, [line(*claim) for claim in counted])


def share(flags: Iterable[bool]) -> str:
    """Return a count and its exact (Clopper–Pearson) 95 % interval as text."""
    values = list(flags)
    return proportion(sum(values), len(values))


def proportion(count: int, total: int) -> str:
    """Return a proportion with its exact (Clopper–Pearson) 95 % interval as text."""
    if total == 0:
        return "–"
    low, high = stats.binomtest(int(count), total).proportion_ci(0.95, method="exact")
    places = 1 if total > 2000 else 0
    return f"{count}/{total} ({100 * low:.{places}f}–{100 * high:.{places}f} %)"


def stated_and_true(pairs: Iterable[tuple[float, bool]], low: float, high: float) -> str:
    """Return how often statements of a probability from `low` to `high` were true, and how often they should be.

    The latter is the central 95 % of the Poisson binomial distribution of calibrated statements.
    """
    inside = [(p, true) for p, true in pairs if low <= p < high or p == high == 1.0]
    if not inside:
        return "–"
    stated = np.array([p for p, _ in inside])
    draws = (np.random.default_rng(0).random((4000, stated.size)) < stated).sum(axis=1)
    least, most = np.quantile(draws, [0.025, 0.975])
    return f"{sum(t for _, t in inside)}/{stated.size}, expected {least:.0f} to {most:.0f}"
