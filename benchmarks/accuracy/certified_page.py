"""The page `docs/certified.md`, rendered from the results of `certified.py` beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.accuracy import posteriordb
from benchmarks.markdown import table
from benchmarks.record import DOCS

MEANINGLESS = ("Lanczos1", "wampler1", "wampler2")  # standard deviations of data without noise
WANTED_PARAMETERS, WANTED_SD = 8.0, 6.0  # digits
SHIFT = 0.05  # of a posterior mean, in reference standard deviations

HEAD = """# Certified data

Written by `python -m benchmarks certified`; the tests `test_certified_nist.py` and
`test_certified_posteriordb.py` hold the same claims. The data stand beside the checkout, in
`../shared/data`, and are not part of the project; without them the tests of these tables are
skipped, and small cases of the project's own, with answers known exactly, stand in their place.

Digits are −log10 of the relative error; the worst parameter of a set counts. The nonlinear
certificates print 11 digits, so that about 10.3 to 11.3 is all that can be met. Wanted are 8 digits
of the parameters and 6 of their standard deviations.
"""

NONLINEAR = """## NIST, nonlinear: 27 sets from both starts

By `LeastSquares` as every fit has it (`bayescal/_inference/least_squares.py`), unknowns scaled by
their start; standard deviations are Gauss–Newton, the noise Σr²/(n − p). No set gets a hint. The
hard ones are BoxBOD and MGH10 from start 1, where Gauss–Newton runs away and a trust region of steps
begins anew, and MGH17 from start 1 and Bennett5, which lie in a curved valley.

"""
AFTER_NONLINEAR = """
Lanczos1 is data without noise: its residuals are rounding, and so would be the standard deviations; that no step
makes them smaller is said (*not converged*).
"""

LINEAR = """## NIST, linear: 11 sets

By `bc.fit` with `LeastSquares` and flat priors, against values exact to 20 digits (rational
arithmetic). Powers of x are nearly parallel to a double in Filip and the Wamplers: their effect
is written in Legendre polynomials of (x − c)/h, and the coefficients are multiplied out afterwards.
The last column is the same set in plain powers of x. Where standard deviations stop at 8 digits it
is by the noise, whose restricted likelihood is maximised numerically.

"""
AFTER_LINEAR = """
Wampler1 and Wampler2 are exact polynomials: no noise is left to estimate, the fit says that it did
not converge, and the standard deviations mean nothing.
"""

POSTERIORS = f"""## posteriordb: six reference posteriors

By `bc.fit` with `Marginal`, {posteriordb.METHOD.draws:,} draws, against 10,000 reference draws of
each. Wanted: means within 0.05 reference standard deviations, standard deviations within 3 % plus
three combined Monte-Carlo errors. The worst unknown of each is shown.

"""


def write(results: dict[str, Any]) -> Path:
    """Write the page from the numbers of `results/certified.json`."""
    path = DOCS / "certified.md"
    path.write_text(render(results), encoding="utf-8")
    return path


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
    lines = []
    for row in rows:
        sd = "–" if row["set"] in MEANINGLESS else f"{row['sd']:.1f}"
        lines.append([row["set"], row["start"], f"{row['parameters']:.1f}", sd])
    head = ("set", "start", "parameters, digits", "standard deviations, digits")
    return NONLINEAR + table(head, lines) + AFTER_NONLINEAR


def _linear(results: dict[str, Any]) -> str:
    plain = {row["set"]: f"{row['parameters']:.1f}" for row in results["linear_as_given"]}
    lines = []
    for row in results["linear"]:
        sd = "–" if row["sd"] is None else f"{row['sd']:.1f}"
        name, met = row["set"], f"{row['parameters']:.1f}"
        lines.append([name, row["basis"], met, sd, plain.get(name, "")])
    head = ("set", "basis", "parameters, digits", "standard deviations, digits")
    return LINEAR + table([*head, "parameters in plain powers"], lines) + AFTER_LINEAR


def _posteriors(rows: list[dict[str, Any]]) -> str:
    head = ("posterior", "unknowns", "mean off by, sd", "of", "sd ratio", "allowed", "of", "k̂")
    lines = [
        [
            *(r["posterior"], r["unknowns"], f"{r['shift']:+.3f}", r["shift_of"]),
            *(f"{r['ratio']:.3f}", f"1 ± {r['ratio_allowed']:.3f}", r["ratio_of"], r["pareto_k"]),
        ]
        for r in rows
    ]
    return POSTERIORS + table(head, lines)
