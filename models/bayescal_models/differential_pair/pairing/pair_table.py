"""Table of all pairs with probabilities, the best pair and the best set of disjoint pairs."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal.workshop import as_json, make_table, renamed

Array = NDArray[np.float64]

UNIT = "ug"
REMARK_WIDTH = 110  # characters per line of a remark
MAX_PRINTED_PAIRS = 12  # in the printed table
CRITERIA = ("residual", "ratio_variance", "ratio_variance_raw")
FORMER_NAMES = {f"probability_{c}": f"probability_smallest_{c}" for c in CRITERIA}
MIN_RELATIVE_VARIATION = 0.01  # smallest relative range of a varying commanded acceleration


@dataclass(frozen=True)
class Ratio:
    """Environment ratio λbd of a pair: the outer device's sensitivity λd over that of the inner one.

    Attributes:
        median, low, high: posterior median, and limits of the 95 % credible interval.
        sd: robust posterior standard deviation, (q84 − q16)/2, since a ratio may have no variance.
        document: estimate by the ratio of sums in source 3, step 2.
        document_reliable: whether the denominator of this estimate differs significantly from zero.
    """

    median: float
    low: float
    high: float
    sd: float
    document: float
    document_reliable: bool


@renamed(**FORMER_NAMES)
@dataclass(frozen=True)
class Pair:
    """Criteria of one pair of an outer and an inner device.

    Attributes:
        outer, inner: names of the devices.
        probability_smallest_residual: probability that the pair has the smallest residual.
        probability_smallest_ratio_variance: the same for the ratio variance without the commanded acceleration.
        probability_smallest_ratio_variance_raw: the same for the ratio variance of raw records.
        expected_residual: posterior mean of the residual, µg.
        expected_loss: expected excess of the residual over that of the best pair, µg.
        ratio_variance, ratio_variance_raw: ratio variances computed from the records (source 3).
        orders_near_zero: polynomial orders at which the ratio's denominator, of the inner device, is near zero.
        environment_ratio: environment ratio λbd.
    """

    outer: str
    inner: str
    probability_smallest_residual: float
    probability_smallest_ratio_variance: float
    probability_smallest_ratio_variance_raw: float
    expected_residual: float
    expected_loss: float
    ratio_variance: float
    ratio_variance_raw: float
    orders_near_zero: tuple[int, ...]
    environment_ratio: Ratio

    @property
    def names(self) -> tuple[str, str]:
        """Return the names of the outer and the inner device."""
        return self.outer, self.inner

    def __str__(self) -> str:
        return f"{self.outer} with {self.inner}"


_CELLS: dict[str, Callable[[Pair], str]] = {  # cells of the printed table, by column header
    "outer": lambda p: p.outer,
    "inner": lambda p: p.inner,
    "P(best)": lambda p: f"{p.probability_smallest_residual:.2f}",
    "P(ratios)": lambda p: f"{p.probability_smallest_ratio_variance:.2f}",
    "P(raw)": lambda p: f"{p.probability_smallest_ratio_variance_raw:.2f}",
    "residual": lambda p: f"{p.expected_residual:.0f}",
    "loss": lambda p: f"{p.expected_loss:.0f}",
    "λbd": lambda p: f"{p.environment_ratio.median:.3f}",
    "95 %": lambda p: f"{p.environment_ratio.low:.3f} to {p.environment_ratio.high:.3f}",
}


@dataclass(frozen=True)
class PairTable:
    """Table of all pairs, the best pair, and the best disjoint set; printable.

    Attributes:
        pairs: all pairs, the best by the criterion first.
        best: names of the outer and the inner device of the best pair.
        matching: the best set of disjoint pairs.
        criterion: name of the ranking criterion.
        remarks: remarks on the ranking, one sentence each.
    """

    pairs: tuple[Pair, ...]
    best: tuple[str, str]
    matching: tuple[tuple[str, str], ...]
    criterion: str
    remarks: tuple[str, ...]

    def of(self, outer: str, inner: str) -> Pair:
        """Return the pair of these two devices.

        Raises:
            InputError: there is no such pair.
        """
        for pair in self.pairs:
            if (pair.outer, pair.inner) == (outer, inner):
                return pair
        raise bc.InputError(
            f"{outer!r} and {inner!r} are not a pair: give an outer and an inner device"
        )

    def to_json_data(self) -> dict[str, Any]:
        """Return the table as JSON data."""
        return {
            "criterion": self.criterion,
            "pairs": [
                as_json(pair)
                | {k: getattr(pair, n) for k, n in FORMER_NAMES.items()}
                | {"unit": UNIT}
                for pair in self.pairs
            ],
            "best": list(self.best),
            "matching": [list(pair) for pair in self.matching],
            "environment_ratio": vars(self.of(*self.best).environment_ratio),
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        best = self.of(*self.best)
        ratio = best.environment_ratio
        printed_pairs = self.pairs[:MAX_PRINTED_PAIRS]
        cells = [[format_cell(pair) for format_cell in _CELLS.values()] for pair in printed_pairs]
        lines = str(make_table([*_CELLS], cells, left=2)).splitlines()
        omitted_count = len(self.pairs) - len(printed_pairs)
        if omitted_count > 0:
            lines.append(f"… and {omitted_count} more")
        lines += [
            "",
            "Residual and loss in µg. Probabilities: P(best), smallest residual; P(ratios), smallest ratio variance",
            "without the commanded acceleration; P(raw), the same on raw records.",
            "",
            f"best pair by {self.criterion}: {best}, expected residual {best.expected_residual:.0f} µg, "
            f"expected loss {best.expected_loss:.0f} µg",
            f"environment ratio λbd: {ratio.median:.3f} ± {ratio.sd:.3f} "
            f"(by sums over the record: {ratio.document:.3f})",
            "best set of pairs: "
            + "; ".join(f"{outer} with {inner}" for outer, inner in self.matching),
        ]
        remarks = [textwrap.fill(s, REMARK_WIDTH, subsequent_indent="  ") for s in self.remarks]
        return "\n".join([*lines, "", *remarks])


def list_remarks(pairs: Sequence[Pair], commanded: Array) -> tuple[str, ...]:
    """Return remarks on the reliability of a ranking of pairs, one sentence each.

    Args:
        pairs: all pairs, the best first.
        commanded: commanded acceleration, µg, (T,).
    """
    remarks, best = [], pairs[0]
    residual_pair = min(pairs, key=lambda p: p.expected_residual)
    ratio_pair = max(pairs, key=lambda p: p.probability_smallest_ratio_variance)
    raw_pair = max(pairs, key=lambda p: p.probability_smallest_ratio_variance_raw)
    if residual_pair.names != ratio_pair.names:
        remarks.append(
            f"The criteria disagree. Smallest residual: {residual_pair} ({residual_pair.expected_residual:.0f} µg, "
            f"probability {residual_pair.probability_smallest_residual:.2f}). Smallest variance of ratios, most "
            f"probably: {ratio_pair} ({ratio_pair.expected_residual:.0f} µg, expected loss "
            f"{ratio_pair.expected_loss:.0f} µg). The variance of ratios gives every order of the polynomial equal "
            "weight, even where the environment contributes little."
        )
    near_zero = sorted({(p.inner, n) for p in pairs for n in p.orders_near_zero})
    if near_zero:
        terms = ", ".join(f"order {n} of {name}" for name, n in near_zero[:4])
        remainder = f" and {len(near_zero) - 4} more" if len(near_zero) > 4 else ""
        remarks.append(
            f"Ratios with denominators near zero: {terms}{remainder}. They are heavy-tailed, without a finite mean; "
            "their noise dominates the variance of ratios; the residual does not depend on them."
        )
    remarks.append(
        "On raw records (P(raw)) the commanded acceleration dominates every order, so that the variance of ratios "
        "favours pairs of low sensitivity, matched or not: here "
        f"{raw_pair} ({raw_pair.expected_residual:.0f} µg)."
    )
    if np.ptp(commanded) <= MIN_RELATIVE_VARIATION * np.abs(commanded).max():
        remarks.append(
            "At constant acceleration a device's scale factor and the constant part of its environment are confounded: "
            "record steps."
        )
    if not best.environment_ratio.document_reliable:
        remarks.append(
            f"The environment ratio of {best} from sums over the record ({best.environment_ratio.document:.3g}) is "
            "unreliable, because its denominator is near zero: use the posterior median."
        )
    return tuple(remarks)
