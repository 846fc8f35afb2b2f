"""Results as text for people: every table that a result prints."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from bayescal._core.formatting import WIDTH, interval, number, probability, table, with_error
from bayescal._diagnostics.summary import null_directions, summary
from bayescal._readings.units import unit_label

if TYPE_CHECKING:
    from bayescal._calibration.calibration import Calibration
    from bayescal._diagnostics.check import Check, Region
    from bayescal._diagnostics.compare import Comparison
    from bayescal._discovery.discover import Candidate, Discovery
    from bayescal._discovery.next_experiment import NextExperiment
    from bayescal._discovery.search_path import Trail

CLEAR = 5.0  # expected log Bayes factor from which an experiment tells two effects apart
STRUCTURE = (
    3.0  # log Bayes factor from which two covariates together are worth a line, if above each one's
)


def check_text(check: Check) -> str:
    """Where a model fails, the worst covariate first."""
    unit = unit_label(check.unit)
    rows = [
        [
            e.against,
            f"{e.log_bayes_factor:z.1f}",
            f"{e.worst.size:+.3g} {unit}",
            f"{e.worst.z:+.1f}",
            f"{e.against} {e.worst.group}" if e.by_group else _where(e.against, e.worst),
        ]
        for e in check.entries
    ]
    head = ["residuals against", "log Bayes factor", "worst mean", "z", "where"]
    noise = f"judged against noise of {check.noise:.3g} {unit}"
    lines = [f"residuals {check.rms:.3g} {unit} rms, {noise}"]
    if check.fixed:
        lines += [_fixed_text(check), ""]
    lines.append(table(head, rows, fold=25) if rows else "no covariate varies")
    lines += [
        f"{' and '.join(p.against)} together: no sum of one on each explains it (log Bayes factor "
        f"{p.log_bayes_factor:.1f})"
        for p in check.pairs[:2]
        if p.log_bayes_factor > max(STRUCTURE, *(e.log_bayes_factor for e in check.entries))
    ]
    coefficient, z = check.autocorrelation
    lines.append(f"neighbours in time: correlation {coefficient:.2f} (z = {z:.1f})")
    for name, p in check.spread_with.items():
        lines.append(f"scatter changes with {name} (p = {p:.1g})")
    if check.outliers:
        shown = ", ".join(f"row {i + 1} ({z:+.1f} sd)" for i, z in check.outliers[:5])
        lines.append(f"outliers: {shown}{' …' if len(check.outliers) > 5 else ''}")
    lines.append(f"leave-one-out probabilities uniform: p = {check.pit_p:.2g}")
    return "\n".join(lines)


def _where(against: str, region: Region) -> str:
    if against == "order":
        rows = f"{region.low:.0f} to {region.high:.0f}"
        return f"row {region.low:.0f}" if region.low == region.high else f"rows {rows}"
    unit = unit_label(region.covariate_unit)
    place = f"{number(region.low, 4)} to {number(region.high, 4)} {unit}".rstrip()
    if region.low == region.high:
        place = f"at {number(region.low, 4)} {unit}".rstrip()
    return place + (f" in run {region.group}" if region.group else "")


def _fixed_text(check: Check) -> str:
    f, unit = check.fixed, unit_label(check.unit)
    assert f is not None
    known = sum(v**2 for v in f.known.values()) ** 0.5
    lines = [
        f"with the fixed coefficients: {f.positive} of {f.count} residuals are positive, "
        f"mean {f.mean:.2f} ({f.low:.2f} to {f.high:.2f}) {unit}, rms {f.rms:.2f}",
        f"the same model set free leaves {f.free_fit:.3g} {unit}: "
        f"the rms is {f.rms / f.noise:.1f} times that",
    ]
    if known > 0:
        parts = ", ".join(f"{k} {v:.2g}" for k, v in f.known.items())
        lines.append(
            f"known beforehand: {known:.2g} {unit} ({parts}):\n"
            f"  the rms is {f.rms / known:.0f} times that"
        )
    return "\n".join(lines)


def discovery_text(found: Discovery) -> str:
    """What is missing, and every candidate, the most probable first."""
    lines = [f"nothing is missing: probability {probability(found.nothing_missing)}"]
    for s in found.sets:
        names = " or ".join(s.effects)
        tail = "" if len(s.effects) == 1 else "  (one of these; these readings cannot tell which)"
        lines.append(f"missing: {names}, probability {probability(s.probability)}{tail}")
    quiet = (None, "not visible")  # an unknown dependence without evidence is not worth a line
    tested = [
        c
        for c in found.candidates
        if c.kind != "not testable" and not (c.unknown and c.kind in quiet)
    ]
    head = ["candidate", "probability", "log BF", "expected size", "detectable", "remark"]
    lines.append(table(head, [_candidate_row(c) for c in tested], fold=29) if tested else "")
    if any(c.source == "refit" for c in tested):
        lines.append("* log Bayes factor by refit; the others by score")
    lines += _alike(found) + _not_testable(found)
    return "\n".join(line for line in lines if line)


def _candidate_row(c: Candidate) -> list[str]:
    remark = "this experiment cannot see it" if c.kind == "not visible" else c.kind or ""
    factor = "–" if c.log_bayes_factor is None else f"{c.log_bayes_factor:z.1f}"
    return [
        c.effect,
        probability(c.probability),
        factor + ("*" if c.source == "refit" else " "),
        f"{with_error(c.size or 0.0, c.size_sd or 0.0)} {unit_label(c.unit)}".rstrip(),
        number(c.minimum_detectable, 2),
        remark,
    ]


def _alike(found: Discovery) -> list[str]:
    """One line for each group of candidates that these readings can hardly tell apart."""
    groups: dict[frozenset[str], str] = {}
    for c in found.candidates:
        if c.indistinguishable_from:
            members = (c.effect, *c.indistinguishable_from)
            if not any(frozenset(members) <= known for known in groups):
                groups[frozenset(members)] = ", ".join(members)
    return [
        textwrap.fill(f"hard to tell apart: {names}", WIDTH, subsequent_indent="  ")
        for names in groups.values()
    ]


def _not_testable(found: Discovery) -> list[str]:
    """One line for each reason, with the effects that it holds back."""
    by_reason: dict[str, list[str]] = {}
    for c in found.candidates:
        if c.kind == "not testable":
            by_reason.setdefault(c.reason, []).append(c.effect)
    return [
        textwrap.fill(f"not testable, {reason}: {', '.join(names)}", WIDTH, subsequent_indent="  ")
        for reason, names in by_reason.items()
    ]


def comparison_text(found: Comparison) -> str:
    """Models side by side, the best first."""
    unit = unit_label(found.unit)
    grouped = found.chosen_by == "left-out groups"
    head = ["model", f"rmse [{unit}]"]
    head += [f"left-out {found.group}", "score", "difference"] if grouped else []
    head += ["LOO", "difference", "log evidence", "weight"]
    rows = []
    for r in found.rows:
        cells = [r.name, number(r.rmse)]
        if grouped:
            score = "–" if r.group_score is None else f"{r.group_score:.1f}"
            cells += [number(r.group_rmse), score, _gap(r.group_difference, r.group_error)]
        evidence = "null" if r.log_evidence is None else f"{r.log_evidence:.1f}"
        loo = _gap(r.loo_difference, r.loo_error)
        rows.append([*cells, f"{r.loo:.1f}", loo, evidence, f"{r.weight:.2f}"])
    count = f" ({found.groups} of them)" if grouped else ""
    lines = [table(head, rows), f"chosen by {found.chosen_by}{count}"]
    return "\n".join([*lines, *(textwrap.fill(w, WIDTH) for w in found.warnings)])


def _gap(value: float | None, error: float | None) -> str:
    if value is None or error is None or (value == 0 and error == 0):
        return "0" if value == 0 else "–"
    return f"{value:.1f} ± {error:.1f}"


def experiment_text(found: NextExperiment) -> str:
    """Feasible experiments, the most telling first."""
    rows = []
    for e in found.experiments:
        (truth, rival), least = min(e.expected.items(), key=lambda item: item[1])
        rows.append([e.name, f"{least:.1f}", f"{truth} against {rival}"])
    lines = [
        f"to tell apart: {', '.join(found.members)}",
        table(["experiment", "log Bayes factor", "least expected for"], rows, fold=25),
    ]
    if found.experiments[0].worst < CLEAR:
        lines.append(
            f"None of these is expected to tell them apart (a log Bayes factor of {CLEAR:g} would)."
        )
    return "\n".join(lines)


def trail_text(trail: Trail) -> str:
    """The error, step by step."""
    unit = unit_label(trail.final.calibration.unit)
    head = [
        *("step", f"rmse [{unit}]", "left-out", "held-out", "noise", "floor"),
        *("log evidence", "nothing missing"),
    ]
    rows = []
    for i, s in enumerate(trail.steps):
        evidence = s.calibration.log_evidence
        rows.append(
            [
                f"{i} {s.title}",
                number(s.rmse),
                number(s.left_out.rmse if s.left_out else None),
                number(s.holdout_rmse),
                number(s.check.noise),
                number(s.noise_floor),
                "–" if evidence is None else f"{evidence[0]:z.1f}",
                probability(s.discovery.nothing_missing if s.discovery else None),
            ]
        )
    return table(head, rows)


def calibration_text(calibration: Calibration) -> str:
    """Unknowns with standard uncertainty and 95 % credible interval; the verdict."""
    rows = []
    coefficients, spreads = summary(calibration)
    for s in (*coefficients, *spreads):
        contraction = "–" if s["contraction"] is None else f"{s['contraction']:.3f}"
        low, high = s["interval95"]
        ends = interval(low, high, s["mean"], s["sd"])
        value = with_error(s["mean"], s["sd"])
        rows.append([s["name"], value, unit_label(s["unit"]), ends, contraction])
    head = [
        *("unknown", "mean ± standard uncertainty", "unit"),
        *("95 % credible interval", "contraction"),
    ]
    lines = [table(head, rows)] if rows else ["every unknown is fixed"]
    fixed = ", ".join(f"{name} = {value:g}" for name, value in calibration.model.fixed)
    if fixed:
        lines.append(f"fixed: {fixed}")
    at = [
        f"{k} = {v:g} °C"
        for k, v in calibration.reference.items()
        if isinstance(v, float) and k.endswith("0")
    ]
    if at:
        lines.append("constants hold at " + ", ".join(at))
    lines += [f"not measured: {d['in_words']}" for d in null_directions(calibration)]
    lines.append(str(calibration.verdict))
    return "\n".join([lines[0], *(textwrap.fill(line, WIDTH) for line in lines[1:])])
