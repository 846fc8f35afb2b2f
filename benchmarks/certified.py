"""Certified data: NIST regression sets and posteriordb, written as `docs/certified.md` and as JSON."""

from __future__ import annotations

from typing import Any

from benchmarks import nist, posteriordb
from benchmarks.record import REFERENCE_DATA, ROOT, write

MEANINGLESS = ("Lanczos1", "wampler1", "wampler2")  # standard deviations of data without noise
WANTED_PARAMETERS, WANTED_SD = 8.0, 6.0  # digits
SHIFT = 0.05  # of a posterior mean, in reference standard deviations

HEAD = """# Certified data

Written by `python -m benchmarks certified`; the tests `test_certified_nist.py` and
`test_certified_posteriordb.py` hold the same claims. The data stand beside the checkout, in
`../shared/data`, and are not part of the project; without them the tests of these tables are skipped, and
small cases of the project's own, with answers known exactly, are tested in their place.

Digits are −log10 of the relative error, the worst parameter of a set counting. The nonlinear certificates
print 11 digits, so that 10.3 to 11.3 is all that can be met. Wanted are 8 digits of the parameters and 6 of
their standard deviations.
"""


def main() -> None:
    """Run all and write both files."""
    if not REFERENCE_DATA.is_dir():
        print(f"certified: needs the reference data in {REFERENCE_DATA}, which is not there; nothing written")
        return
    results: dict[str, Any] = {
        "nonlinear": [row for name in nist.NONLINEAR for row in nist.nonlinear_digits(name)],
        "linear": [nist.linear_digits(name) for name in nist.LINEAR],
        "linear_as_given": [nist.linear_digits(name, centred=False) for name in nist.CENTRED],
        "posteriordb": [posterior_row(name) for name in posteriordb.PROBLEMS],
    }
    print("wrote", write("certified", results).relative_to(ROOT))
    page = ROOT / "docs" / "certified.md"
    page.write_text(render(results), encoding="utf-8")
    print("wrote", page.relative_to(ROOT))


def posterior_row(name: str) -> dict[str, Any]:
    """The worst unknown of a reference posterior."""
    fit, rows = posteriordb.compare(name)
    shift = max(rows, key=lambda r: abs(r.shift))
    ratio = max(rows, key=lambda r: abs(r.ratio - 1) / r.ratio_allowed)
    return {
        "posterior": name,
        "unknowns": len(rows),
        "shift": round(shift.shift, 3),
        "shift_of": shift.name,
        "ratio": round(ratio.ratio, 3),
        "ratio_allowed": round(ratio.ratio_allowed, 3),
        "ratio_of": ratio.name,
        "pareto_k": None if fit.verdict.pareto_k is None else round(fit.verdict.pareto_k, 2),
        "effective_draws": None if fit.verdict.ess is None else round(fit.verdict.ess),
    }


def render(results: dict[str, Any]) -> str:
    """The page, from the same numbers as the JSON."""
    parts = [HEAD, _shortfalls(results), _nonlinear(results["nonlinear"]), _linear(results)]
    return "\n".join([*parts, _posteriors(results["posteriordb"])])


def shortfalls(results: dict[str, Any]) -> list[str]:
    """What is below the digits wanted, in words; empty if nothing is."""
    found = []
    for row in (*results["nonlinear"], *results["linear"]):
        label = f"{row['set']} from start {row['start']}" if "start" in row else row["set"]
        if row["parameters"] < WANTED_PARAMETERS:
            found.append(f"{label}: {row['parameters']:.1f} digits of the parameters")
        if row["set"] not in MEANINGLESS and row["sd"] < WANTED_SD:
            found.append(f"{label}: {row['sd']:.1f} digits of the standard deviations")
    for row in results["posteriordb"]:
        if abs(row["shift"]) > SHIFT or abs(row["ratio"] - 1) > row["ratio_allowed"]:
            found.append(f"{row['posterior']}: {row['shift_of']} or {row['ratio_of']}")
    return found


def _shortfalls(results: dict[str, Any]) -> str:
    found = shortfalls(results)
    return "## Shortfalls\n\n" + ("\n".join(f"- {line}." for line in found) or "None.") + "\n"


def _nonlinear(rows: list[dict[str, Any]]) -> str:
    lines = [
        "## NIST, nonlinear: 27 sets from both starts\n",
        "By the one least-squares routine of the library (`_optimise.least_squares`), unknowns scaled by their "
        "start; standard\ndeviations are Gauss–Newton, the noise Σr²/(n − p). Each start is fitted without a "
        "hint which set is hard. Those known as\nhard come out so: MGH10 and BoxBOD from start 1 "
        "are met by the second way of damping only, after the first ends short of an\noptimum; MGH17 from "
        "start 1 and Bennett5 need hundreds of steps along a curved valley.\n",
        "| set | start | parameters, digits | standard deviations, digits | steps |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        sd = "–" if row["set"] in MEANINGLESS else f"{row['sd']:.1f}"
        lines.append(f"| {row['set']} | {row['start']} | {row['parameters']:.1f} | {sd} | {row['steps']} |")
    lines.append(
        "\nLanczos1 is data without noise: its residuals are rounding, and so would be its standard deviations.\n"
    )
    return "\n".join(lines)


def _linear(results: dict[str, Any]) -> str:
    raw = {row["set"]: row for row in results["linear_as_given"]}
    lines = [
        "## NIST, linear: 11 sets\n",
        "By `bc.fit` with `LeastSquares`, flat priors, against values exact to 20 digits (rational arithmetic). "
        "Filip and the\nWamplers have powers of x that are nearly parallel to a double: their effect is "
        "written in powers of (x − c)/h, as one\nwould write T − T0, and the coefficients are multiplied out "
        "afterwards. The last column is the same set in plain powers of\nx. The standard deviations follow the "
        "noise, whose restricted likelihood is maximised to about 8 digits.\n",
        "| set | basis | parameters, digits | standard deviations, digits | parameters in plain powers |",
        "|---|---|---|---|---|",
    ]
    for row in results["linear"]:
        sd = "–" if row["sd"] is None else f"{row['sd']:.1f}"
        plain = f"{raw[row['set']]['parameters']:.1f}" if row["set"] in raw else ""
        lines.append(f"| {row['set']} | {row['basis']} | {row['parameters']:.1f} | {sd} | {plain} |")
    lines.append(
        "\nWampler1 and Wampler2 are exact polynomials: no noise is left to estimate, the fit says that it did "
        "not converge, and the\nstandard deviations mean nothing.\n"
    )
    return "\n".join(lines)


def _posteriors(rows: list[dict[str, Any]]) -> str:
    lines = [
        "## posteriordb: six reference posteriors\n",
        f"By `bc.fit` with `Marginal`, {posteriordb.METHOD.draws:,} draws, against 10,000 reference draws of "
        "each. Wanted: means within\n0.05 reference standard deviations, standard deviations within 3 % plus "
        "three combined Monte-Carlo errors. The worst unknown of\neach is shown.\n",
        "| posterior | unknowns | mean off by, sd | of | sd ratio | allowed | of | k̂ |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        cells = (
            *(r["posterior"], r["unknowns"], f"{r['shift']:+.3f}", r["shift_of"], f"{r['ratio']:.3f}"),
            *(f"1 ± {r['ratio_allowed']:.3f}", r["ratio_of"], r["pareto_k"]),
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"
