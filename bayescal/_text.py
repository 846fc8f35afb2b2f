"""Results as text for people: every table that a result prints."""

from __future__ import annotations

from math import floor, log10
from typing import TYPE_CHECKING

from bayescal._summary import null_directions, summary
from bayescal._units import pretty as pretty_unit

if TYPE_CHECKING:
    from bayescal._calibrate import Trail
    from bayescal._calibration import Calibration
    from bayescal._check import Check
    from bayescal._compare import Comparison
    from bayescal._discover import Discovery


def pretty(unit: str) -> str:
    """A unit for people; nothing for a number without one."""
    return pretty_unit(unit) if unit not in ("", "1") else ""


def table(head: list[str], rows: list[list[str]], left: int = 1) -> str:
    """Columns under a ruled head; the first `left` columns flush left, the others flush right."""
    widths = [max(len(r[i]) for r in [head, *rows]) for i in range(len(head))]

    def line(cells: list[str]) -> str:
        parts = [c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths, strict=True))]
        return "  ".join(parts).rstrip()

    return "\n".join([line(head), "  ".join("─" * w for w in widths), *(line(r) for r in rows)])


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits, no exponent where it can be avoided, – for nothing."""
    if value is None:
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e6:
        text = f"{value:.{digits}g}"
        return f"{float(text):.0f}" if "e" in text else text
    return f"{value:.{digits - 1}e}"


def with_error(value: float, error: float) -> str:
    """value ± error, the error to two significant digits and the value to the same place."""
    if not error > 0:
        return number(value, 6)
    places = max(0, 1 - floor(log10(error)))
    if places > 8 or abs(value) >= 1e7:
        return f"{value:.4g} ± {error:.2g}"
    return f"{value:.{places}f} ± {error:.{places}f}"


def probability(p: float | None) -> str:
    if p is None:
        return "–"
    if p > 0.995:
        return "> 0.99"
    return f"{p:.2f}" if p >= 0.005 else "< 0.01"


def check_text(check: Check) -> str:
    unit = pretty(check.unit)
    rows = [
        [
            e.against,
            f"{e.log_bayes_factor:.1f}",
            f"{e.worst.size:+.3g} {unit}",
            f"{e.worst.z:+.1f}",
            _where(e.worst),
        ]
        for e in check.entries
    ]
    head = ["residuals against", "log Bayes factor", "worst", "z", "where"]
    lines = [f"residuals {check.rms:.3g} {unit} rms, judged against noise of {check.noise:.3g} {unit}"]
    if check.fixed:
        lines += [_fixed_text(check), ""]
    lines.append(table(head, rows) if rows else "no covariate varies")
    coefficient, z = check.autocorrelation
    lines.append(f"neighbours in time: correlation {coefficient:.2f} (z = {z:.1f})")
    for name, p in check.spread_with.items():
        lines.append(f"scatter changes with {name} (p = {p:.1g})")
    if check.outliers:
        shown = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers: {shown}{' …' if len(check.outliers) > 5 else ''}")
    lines.append(f"leave-one-out probabilities uniform: p = {check.pit_p:.2g}")
    return "\n".join(lines)


def _where(region) -> str:
    unit = pretty(region.covariate_unit)
    if region.low == region.high:
        place = f"at {region.low:.4g} {unit}".rstrip()
    else:
        place = f"between {region.low:.4g} and {region.high:.4g} {unit}".rstrip()
    return place + (f" in run {region.group}" if region.group else "")


def _fixed_text(check: Check) -> str:
    f, unit = check.fixed, pretty(check.unit)
    assert f is not None
    known = sum(v**2 for v in f.known.values()) ** 0.5
    lines = [
        f"with the fixed coefficients: {f.positive} of {f.count} residuals are positive, mean {f.mean:.2f} "
        f"({f.low:.2f} to {f.high:.2f}) {unit}, rms {f.rms:.2f}",
        f"the same model set free leaves {f.free_fit:.3g} {unit}: the rms is {f.rms / f.noise:.1f} times that",
    ]
    if known > 0:
        parts = ", ".join(f"{k} {v:.2g}" for k, v in f.known.items())
        lines.append(
            f"known beforehand: {known:.2g} {unit} ({parts}): the rms is {f.rms / known:.0f} times that"
        )
    return "\n".join(lines)


def discovery_text(found: Discovery) -> str:
    lines = [f"nothing is missing: probability {probability(found.nothing_missing)}"]
    for s in found.sets:
        names = " or ".join(s.effects)
        tail = "" if len(s.effects) == 1 else "  (one of these; these readings cannot tell which)"
        lines.append(f"missing: {names}, probability {probability(s.probability)}{tail}")
    rows = []
    for c in found.candidates:
        if c.kind == "not testable":
            rows.append([c.effect, "–", "–", "–", "–", f"not testable: {c.reason}"])
            continue
        size = with_error(c.size or 0.0, c.size_sd or 0.0) + f" {pretty(c.unit)}"
        remark = c.kind or ""
        if c.kind == "not visible":
            remark = "this experiment cannot see it"
        if c.indistinguishable_from:
            remark += f" (like {', '.join(c.indistinguishable_from)})"
        detectable = "–" if c.minimum_detectable is None else f"{number(c.minimum_detectable, 2)}"
        rows.append(
            [
                c.effect,
                probability(c.probability),
                f"{c.log_bayes_factor:.1f}{'*' if c.source == 'refit' else ''}",
                size,
                detectable,
                remark.strip(),
            ]
        )
    head = ["candidate", "probability", "log BF", "expected size", "detectable", ""]
    widths_left = table(head, [[*r] for r in rows])
    lines.append(widths_left)
    if found.verified:
        lines.append("* log Bayes factor by refit; the others by score")
    return "\n".join(lines)


def comparison_text(found: Comparison) -> str:
    unit = pretty(found.unit)
    grouped = found.chosen_by == "left-out groups"
    head = ["model", f"rmse [{unit}]"]
    head += [f"left-out {found.group} rmse", "left-out score", "difference"] if grouped else []
    head += ["LOO", "difference", "log evidence", "weight"]
    rows = []
    for r in found.rows:
        cells = [r.name, number(r.rmse)]
        if grouped:
            cells += [number(r.group_rmse), f"{r.group_score:.1f}", _gap(r.group_difference, r.group_error)]
        evidence = "null" if r.log_evidence is None else f"{r.log_evidence:.1f}"
        cells += [f"{r.loo:.1f}", _gap(r.loo_difference, r.loo_error), evidence, f"{r.weight:.2f}"]
        rows.append(cells)
    lines = [table(head, rows), f"chosen by {found.chosen_by} ({found.groups} of them)"]
    return "\n".join([*lines, *found.warnings])


def _gap(value: float | None, error: float | None) -> str:
    if value is None or error is None or (value == 0 and error == 0):
        return "0" if value == 0 else "–"
    return f"{value:.1f} ± {error:.1f}"


def trail_text(trail: Trail) -> str:
    unit = pretty(trail.final.calibration.unit)
    head = ["step", f"rmse [{unit}]", "left-out", "held-out", "noise", "floor", "log evidence", "nothing missing"]
    rows = []
    for i, s in enumerate(trail.steps):
        name = "baseline" if s.added is None else f"+ {s.added}"
        if s.dropped:
            name += f" (drops {', '.join(s.dropped)})"
        evidence = s.calibration.log_evidence
        rows.append(
            [
                f"{i} {name}",
                number(s.rmse),
                number(s.left_out.rmse if s.left_out else None),
                number(s.holdout_rmse),
                number(s.check.noise),
                number(s.noise_floor),
                "–" if evidence is None else f"{evidence[0]:.1f}",
                probability(s.discovery.nothing_missing if s.discovery else None),
            ]
        )
    return table(head, rows)


def calibration_text(calibration: Calibration) -> str:
    """Coefficients and hyper-parameters with standard uncertainty and 95 % credible interval; the verdict."""
    rows = []
    for found in summary(calibration):
        for s in found:
            low, high = s["interval95"]
            contraction = "–" if s["contraction"] is None else f"{s['contraction']:.3f}"
            interval = f"[{low:.5g}, {high:.5g}]"
            rows.append([s["name"], with_error(s["mean"], s["sd"]), pretty(s["unit"]), interval, contraction])
    head = ["unknown", "mean ± standard uncertainty", "unit", "95 % credible interval", "contraction"]
    lines = [table(head, rows)] if rows else ["every unknown is fixed"]
    fixed = ", ".join(f"{name} = {value:g}" for name, value in calibration.model.fixed)
    if fixed:
        lines.append(f"fixed: {fixed}")
    zeros = [(k, v) for k, v in calibration.reference.items() if isinstance(v, float) and k.endswith("0")]
    if zeros:
        lines.append("constants hold at " + ", ".join(f"{k} = {v:g} °C" for k, v in zeros))
    lines += [f"not measured: {d['in_words']}" for d in null_directions(calibration)]
    return "\n".join([*lines, str(calibration.verdict)])
