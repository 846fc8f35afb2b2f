"""Table of all pairs with probabilities, the best pair and the best set."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal.workshop import as_json, plain_table

Array = NDArray[np.float64]

UNIT = "ug"
WIDTH = 110  # columns of a sentence
PRINTED_PAIRS = 12  # pairs in the table
VARIES = 0.01  # relative change of the commanded acceleration, above which it is not constant


@dataclass(frozen=True)
class Ratio:
    """λbd = λ1d/λ2d of a pair.

    Attributes:
        median, low, high: of the posterior, with the limits of its 95 % credible interval.
        sd: of the posterior; a robust one, (q84 − q16)/2, because a ratio need not have a variance.
        document: the estimator of source 3, step 2.
        document_reliable: whether its denominator Σu is away from zero.
    """

    median: float
    low: float
    high: float
    sd: float
    document: float
    document_reliable: bool


@dataclass(frozen=True)
class Pair:
    """An outer and an inner device.

    Attributes:
        outer, inner: names.
        probability_residual: of leaving the least residual.
        probability_ratio_variance: of the least variance of ratios, commanded part removed.
        probability_ratio_variance_raw: the same on raw records.
        expected_residual: posterior mean, µg.
        expected_loss: expected residual beyond that of the best pair, µg.
        ratio_variance, ratio_variance_raw: the document's own figures, from the records as they are.
        orders_near_zero: orders whose denominator, the inner device's coefficient, is near zero.
        environment_ratio: λbd.
    """

    outer: str
    inner: str
    probability_residual: float
    probability_ratio_variance: float
    probability_ratio_variance_raw: float
    expected_residual: float
    expected_loss: float
    ratio_variance: float
    ratio_variance_raw: float
    orders_near_zero: tuple[int, ...]
    environment_ratio: Ratio

    @property
    def names(self) -> tuple[str, str]:
        """Return outer and inner name."""
        return self.outer, self.inner

    def __str__(self) -> str:
        return f"{self.outer} with {self.inner}"


_CELLS: dict[str, Callable[[Pair], str]] = {  # of the printed table, by their heads
    "outer": lambda p: p.outer,
    "inner": lambda p: p.inner,
    "P(best)": lambda p: f"{p.probability_residual:.2f}",
    "P(ratios)": lambda p: f"{p.probability_ratio_variance:.2f}",
    "P(raw)": lambda p: f"{p.probability_ratio_variance_raw:.2f}",
    "residual": lambda p: f"{p.expected_residual:.0f}",
    "loss": lambda p: f"{p.expected_loss:.0f}",
    "λbd": lambda p: f"{p.environment_ratio.median:.3f}",
    "95 %": lambda p: f"{p.environment_ratio.low:.3f} to {p.environment_ratio.high:.3f}",
}


@dataclass(frozen=True)
class PairTable:
    """Every pair, the best of them, and the best disjoint set; prints itself.

    Attributes:
        pairs: the best first, by the criterion.
        best: outer and inner name.
        matching: the best set of disjoint pairs.
        criterion: by which.
        remarks: what to know of this choice, a sentence each.
    """

    pairs: tuple[Pair, ...]
    best: tuple[str, str]
    matching: tuple[tuple[str, str], ...]
    criterion: str
    remarks: tuple[str, ...]

    def of(self, outer: str, inner: str) -> Pair:
        """Return a pair by its names.

        Raises:
            InputError: there is no such pair.
        """
        for pair in self.pairs:
            if (pair.outer, pair.inner) == (outer, inner):
                return pair
        raise bc.InputError(f"there is no pair of {outer!r} and {inner!r}")

    def data(self) -> dict[str, Any]:
        """Return the table as plain JSON."""
        return {
            "criterion": self.criterion,
            "pairs": [as_json(pair) | {"unit": UNIT} for pair in self.pairs],
            "best": list(self.best),
            "matching": [list(pair) for pair in self.matching],
            "environment_ratio": vars(self.of(*self.best).environment_ratio),
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        best = self.of(*self.best)
        ratio = best.environment_ratio
        cells = [[cell(pair) for cell in _CELLS.values()] for pair in self.pairs[:PRINTED_PAIRS]]
        lines = str(plain_table([*_CELLS], cells, left=2)).splitlines()
        hidden = len(self.pairs) - PRINTED_PAIRS
        if hidden > 0:
            lines.append(f"… and {hidden} more")
        lines += [
            "",
            "Residual and loss in µg. P(best): least residual; P(ratios): least variance of ratios, commanded part",
            "removed; P(raw): the same on raw records.",
            "",
            f"best pair by {self.criterion}: {best}, expected residual {best.expected_residual:.0f} µg, "
            f"expected loss {best.expected_loss:.0f} µg",
            f"environment ratio λbd: {ratio.median:.3f} ± {ratio.sd:.3f} "
            f"(by sums over the record: {ratio.document:.3f})",
            "best set of pairs: "
            + "; ".join(f"{outer} with {inner}" for outer, inner in self.matching),
        ]
        notes = [textwrap.fill(remark, WIDTH, subsequent_indent="  ") for remark in self.remarks]
        return "\n".join([*lines, "", *notes])


def remarks(pairs: Sequence[Pair], commanded: Array) -> tuple[str, ...]:
    """Return remarks on a choice of pairs, one sentence each.

    Args:
        pairs: the best first.
        commanded: acceleration, µg, (T,).
    """
    sentences, best = [], pairs[0]
    physical = min(pairs, key=lambda p: p.expected_residual)
    ratios = max(pairs, key=lambda p: p.probability_ratio_variance)
    raw = max(pairs, key=lambda p: p.probability_ratio_variance_raw)
    if physical.names != ratios.names:
        sentences.append(
            f"The criteria disagree: the least residual is left by {physical} "
            f"({physical.expected_residual:.0f} µg; best with probability {physical.probability_residual:.2f}), the "
            f"least variance of ratios is most probably that of {ratios} ({ratios.expected_residual:.0f} µg, an "
            f"expected loss of {ratios.expected_loss:.0f} µg). Each order has equal weight in the ratios, "
            "even where the environment contributes little."
        )
    near = sorted({(p.inner, n) for p in pairs for n in p.orders_near_zero})
    if near:
        what = ", ".join(f"order {n} of {name}" for name, n in near[:4])
        others = f" and {len(near) - 4} more" if len(near) > 4 else ""
        sentences.append(
            f"Denominators near zero: {what}{others}. Such a ratio is heavy-tailed, without a finite mean, and the "
            "variance of ratios is then decided by that order's noise; the residual is not touched by it."
        )
    sentences.append(
        "On raw records (P(raw)) the commanded acceleration dominates every order, so that the variance of ratios "
        "favours insensitive pairs, whether or not they match: here "
        f"{raw} ({raw.expected_residual:.0f} µg)."
    )
    if np.ptp(commanded) <= VARIES * np.abs(commanded).max():
        sentences.append(
            "A constant acceleration does not tell a device's scale factor from the constant part of its environment: "
            "record steps."
        )
    if not best.environment_ratio.document_reliable:
        sentences.append(
            f"The environment ratio of {best} by sums over the record ({best.environment_ratio.document:.3g}) is not "
            "reliable: the sum of the environment is near zero. Use the posterior."
        )
    return tuple(sentences)
