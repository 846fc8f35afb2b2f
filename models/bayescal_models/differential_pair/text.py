"""What a choice of pairs says to people: a table, and what to know of it."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from bayescal_models.differential_pair.selection import Pair, PairTable

WIDTH = 110
SHOWN = 12  # pairs in the table
VARIES = 0.01  # relative change of the commanded acceleration, above which it is not constant


def remarks(table: PairTable, commanded: NDArray[np.float64]) -> tuple[str, ...]:
    """What to know of a choice, a sentence each."""
    said = []
    physical = min(table.pairs, key=lambda p: p.expected_residual)
    ratios = max(table.pairs, key=lambda p: p.probability_ratio_variance)
    raw = max(table.pairs, key=lambda p: p.probability_ratio_variance_raw)
    if _names(physical) != _names(ratios):
        said.append(
            f"The criteria disagree: the least residual is left by {_both(physical)} "
            f"({physical.expected_residual:.0f} µg; best with probability {physical.probability_residual:.2f}), the "
            f"least variance of ratios most probably has {_both(ratios)} ({ratios.expected_residual:.0f} µg, an "
            f"expected loss of {ratios.expected_loss:.0f} µg). Ratios weigh every order alike, however little of the "
            "environment is in it."
        )
    near = sorted({(p.inner, n) for p in table.pairs for n in p.near_zero})
    if near:
        what = ", ".join(f"order {n} of {name}" for name, n in near[:4])
        more = f" and {len(near) - 4} more" if len(near) > 4 else ""
        said.append(
            f"Denominators near zero: {what}{more}. Such a ratio is heavy-tailed, without a finite mean, and the "
            "variance of ratios is then decided by that order's noise; the residual is not touched by it."
        )
    if np.ptp(commanded) <= VARIES * np.abs(commanded).max():
        said.append(
            "On raw records, as printed, order 0 carries the commanded acceleration, with the ratio −λ1/λ2, and the "
            "other orders the environment, with +λ1d/λ2d: ideal pairs then have a variance near 0.75 and unlike "
            f"ones less. It prefers {_both(raw)} here ({raw.expected_residual:.0f} µg). Nor can a constant "
            "acceleration tell a device's scale factor from the constant part of its environment: record steps."
        )
    else:
        said.append(
            "On raw records, as printed, the commanded acceleration makes up nearly all of every order, and the "
            "variance of ratios is least for devices of little sensitivity, alike or not. It prefers "
            f"{_both(raw)} here ({raw.expected_residual:.0f} µg)."
        )
    best = table.of(*table.best)
    if not best.ratio.document_reliable:
        said.append(
            f"The environment ratio of {_both(best)} by sums over the record ({best.ratio.document:.3g}) is not to be "
            "trusted: the sum of the environment is near zero. Use the posterior."
        )
    return tuple(said)


def table_text(table: PairTable) -> str:
    """The table, the best pair, the set, and the remarks."""
    best = table.of(*table.best)
    head = ("outer", "inner", "P(best)", "P(ratios)", "P(raw)", "residual", "loss", "λbd", "95 %")
    rows = [head, *(_row(pair) for pair in table.pairs[:SHOWN])]
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    lines = [
        "  ".join(
            cell.ljust(w) if i < 2 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    lines.insert(1, "  ".join("─" * w for w in widths))
    hidden = len(table.pairs) - SHOWN
    if hidden > 0:
        lines.append(f"… and {hidden} more")
    lines += [
        "",
        "Residual and loss in µg. P(best): least residual; P(ratios): least variance of ratios, commanded part",
        "removed; P(raw): the same on raw records.",
        "",
        f"best pair by {table.criterion}: {_both(best)}, expected residual {best.expected_residual:.0f} µg, "
        f"expected loss {best.expected_loss:.0f} µg",
        f"environment ratio λbd: {best.ratio.median:.3f} ± {best.ratio.sd:.3f} "
        f"(by sums over the record: {best.ratio.document:.3f})",
        "best set of pairs: "
        + "; ".join(f"{outer} with {inner}" for outer, inner in table.matching),
    ]
    notes = [textwrap.fill(remark, WIDTH, subsequent_indent="  ") for remark in table.remarks]
    return "\n".join([*lines, "", *notes])


def _row(pair: Pair) -> tuple[str, ...]:
    return (
        pair.outer,
        pair.inner,
        f"{pair.probability_residual:.2f}",
        f"{pair.probability_ratio_variance:.2f}",
        f"{pair.probability_ratio_variance_raw:.2f}",
        f"{pair.expected_residual:.0f}",
        f"{pair.expected_loss:.0f}",
        f"{pair.ratio.median:.3f}",
        f"{pair.ratio.low:.3f} to {pair.ratio.high:.3f}",
    )


def _names(pair: Pair) -> tuple[str, str]:
    return pair.outer, pair.inner


def _both(pair: Pair) -> str:
    return f"{pair.outer} with {pair.inner}"
