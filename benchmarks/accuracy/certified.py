"""Certified data, NIST and posteriordb: writes `docs/certified.md` and its numbers as JSON."""

from __future__ import annotations

from typing import Any

from benchmarks.accuracy import certified_page, nist_linear, nist_nonlinear, posteriordb
from benchmarks.record import REFERENCE_DATA, ROOT, write


def main() -> None:
    """Run all and write both files."""
    if not REFERENCE_DATA.is_dir():
        print(f"certified: no reference data in {REFERENCE_DATA}; nothing written")
        return
    results: dict[str, Any] = {
        "nonlinear": [
            row
            for name in nist_nonlinear.NONLINEAR
            for row in nist_nonlinear.nonlinear_digits(name)
        ],
        "linear": [nist_linear.linear_digits(name) for name in nist_linear.LINEAR],
        "linear_as_given": [
            nist_linear.linear_digits(name, centred=False) for name in nist_linear.CENTRED
        ],
        "posteriordb": [posterior_row(name) for name in posteriordb.PROBLEMS],
    }
    print("wrote", write("certified", results).relative_to(ROOT))
    print("wrote", certified_page.write(results).relative_to(ROOT))


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
