"""Certified data: number of digits to which NIST's regressions and posteriordb's posteriors are reproduced."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bayescal._annexes.validation import nist_strd
from benchmarks import pages
from benchmarks.accuracy import posteriordb
from benchmarks.record import read, write

ABOUT = f"""
Digits are −log10 of the relative error of the worst parameter of a set, and of its worst standard deviation; the
certificates of the nonlinear sets have 11. Required are 8 and 6. Nonlinear sets: `LeastSquares`, from both starts.
Linear sets: `LeastSquares` with flat priors; Filip and the Wamplers, whose powers of x are collinear in double
precision, in Legendre polynomials, converted afterwards. posteriordb: `Marginal`, {posteriordb.METHOD.draws:,} draws
against 10,000 reference draws; required are means within 0.05 reference standard deviations, and standard deviations
within 3 % plus three combined Monte-Carlo errors. Lanczos1, Wampler1 and Wampler2 are data without noise: their
standard deviations are meaningless, and the fit states that it did not converge. Tests check all of these.
`bayescal validate` compares NIST's sets, and examples of standards, on your installation.
"""


def main() -> None:
    """Measure all sets and write the results."""
    kinds = {kind: nist_strd.load_certificates(kind) for kind in ("nonlinear", "linear")}
    found = {kind: [row for name in names for row in digits(name)] for kind, names in kinds.items()}
    write("certified", {**found, "posteriordb": [posterior_row(n) for n in posteriordb.PROBLEMS]})


def digits(name: str) -> list[dict[str, Any]]:
    """Return the digits reached for one of NIST's sets, from each start."""
    rows = []
    for start, one in enumerate(nist_strd.fit_data_set(name), 1):
        met = [round(nist_strd.count_digits(error), 2) for error in one.errors[:2]]
        rows.append({"set": name, "start": start, "parameters": met[0], "sd": met[1]})
    return rows


def posterior_row(name: str) -> dict[str, Any]:
    """Return the results for the worst unknown of a reference posterior."""
    _, rows = posteriordb.compare(name)
    shift = max(rows, key=lambda r: abs(r.shift))
    ratio = max(rows, key=lambda r: abs(r.ratio - 1) / r.ratio_allowed)
    return {
        "posterior": name,
        "unknowns": len(rows),
        "shift": round(shift.shift, 3),
        "ratio": round(ratio.ratio, 3),
        "ratio_allowed": round(ratio.ratio_allowed, 3),
    }


def worst(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return the worst parameter and the worst standard deviation of some sets, with their sets."""
    sure = [row for row in rows if row["set"] not in nist_strd.NOISELESS_DATA_SETS]
    parameter = min(rows, key=lambda r: r["parameters"])
    sd = min(sure, key=lambda r: r["sd"])
    return [f"{parameter['parameters']:.1f} ({parameter['set']})", f"{sd['sd']:.1f} ({sd['set']})"]


def render() -> pages.Texts:
    """Render the page from the stored results."""
    results = read("certified")
    lines = [
        ["NIST, nonlinear, 27 sets from both starts", *worst(results["nonlinear"])],
        ["NIST, linear, 11 sets", *worst(results["linear"])],
    ]
    for row in results["posteriordb"]:
        off, allowed = f"mean shifted by {row['shift']:+.3f} sd", f"{row['ratio_allowed']:.3f}"
        ratio = f"sd ratio {row['ratio']:.3f}, allowed 1 ± {allowed}"
        lines.append([f"posteriordb {row['posterior']}, {row['unknowns']} unknowns", off, ratio])
    table = pages.table(["", "worst parameter, digits", "worst standard deviation, digits"], lines)
    return pages.page(
        "certified", "Certified data", "certified", [results["surroundings"]["day"]], ABOUT, table
    )
