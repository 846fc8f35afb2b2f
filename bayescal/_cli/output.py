"""Output of commands: text where a result does not print itself, plain JSON data, a file of predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import check_parts
from bayescal._calibration.claim import Claim
from bayescal._calibration.predict import Prediction
from bayescal._calibration.summary import directions_data, summary, unknowns_parts
from bayescal._core import progress
from bayescal._core.formatting import folded, number, probability
from bayescal._core.result_table import plain_table
from bayescal._core.settings import settings
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._model.effect import Effect
from bayescal._model.instrument import Instrument
from bayescal._report.result_json import result
from bayescal._report.save_search import channels_data
from bayescal._search.calibrate_channels import Channels
from bayescal._search.draft_effect import draft_effect
from bayescal._search.search_path import SearchPath, Step

SOURCES = 'sources (numbered in docs/sources.md; "ours": estimated by the authors of bayescal)'
# Lines of a table without --verbose, so that a result is a screen.
MAX_STRUCTURES = 2  # of those averaged over
MAX_CHECKS = 3  # covariates that a first model is checked against, the worst


def instruments_listed(listed: Mapping[str, Instrument]) -> tuple[str, dict[str, Any]]:
    """Format installed instruments as text, and as data."""
    data = {n: {**_about(i), "columns": [c.name for c in i.columns]} for n, i in listed.items()}
    rows = [[name, unit_label(about["unit"]), about["title"]] for name, about in data.items()]
    return str(plain_table(["instrument", "output", "measures"], rows, left=2, fold=40)), data


def _about(instrument: Instrument) -> dict[str, Any]:
    return {"title": instrument.title, "source": instrument.source, "unit": instrument.unit}


def instrument_shown(chosen: Instrument) -> tuple[str, dict[str, Any]]:
    """Format the columns of an instrument's files, and the names of its effects, as text and as data."""
    columns, rows = [], []
    for c in chosen.columns:
        needed = c.required and c.default is None
        entry = {"name": c.name, "unit": c.unit, "needed": needed, "meaning": c.meaning}
        columns.append(entry)
        unit = unit_label(c.unit) if c.unit else "label"
        rows.append([c.name, unit, "needed" if needed else "optional", c.meaning])
    baseline, candidates = ([e.name for e in of] for of in (chosen.effects, chosen.candidates))
    lines = [
        f"{chosen.name}: {chosen.title}",
        f"effects of the first model: {', '.join(baseline)}",
        f"looked for beside them: {', '.join(candidates)}",
        f"what each of them is: bayescal effects --instrument {chosen.name}",
    ]
    title, *notes = map(folded, lines)
    table = plain_table(["column", "unit", "", "meaning"], rows, left=4, fold=60)
    data = {**_about(chosen), "columns": columns, "baseline": baseline, "candidates": candidates}
    return "\n\n".join([title, str(table), "\n".join(notes)]), data


def effects_listed(kinds: Mapping[str, Sequence[Effect]]) -> tuple[str, list[dict[str, Any]]]:
    """Format effects as text, a table for each kind ("baseline", …), then the source of each; and as data."""
    data, parts, by_source = [], [], dict[str, list[str]]()
    for kind, effects in kinds.items():
        rows = []
        for e in effects:
            first = e.coefficients[0]
            about = {"name": e.name, "kind": kind, "equation": e.equation, "size": first.size}
            details = {"unit": first.unit, "columns": list(e.columns), "source": e.source}
            data.append({**about, **details})
            size = f"{number(first.size)} {unit_label(first.unit)}".rstrip()
            equation = e.equation.replace(",  ", ",\n")
            rows.append([e.name, size, ", ".join(e.columns) or "–", equation])
            by_source.setdefault(e.source, []).append(e.name)
        if rows:
            head = [kind, "plausible size", "needs", "equation"]
            parts.append(str(plain_table(head, rows, left=3, fold=42)))
    sources = (folded(f"{source}: {', '.join(names)}") for source, names in by_source.items())
    return "\n\n".join([*parts, "\n".join([SOURCES, *sources])]), data


def fit_data(calibration: Calibration) -> dict[str, Any]:
    """Convert a fit to data."""
    verdict = calibration.verdict
    coefficients, hyperparameters = summary(calibration)
    return {
        "coefficients": coefficients,
        "hyperparameters": hyperparameters,
        "reference": {**calibration.reference, **calibration.hold_at},
        "fixed": dict(calibration.model.fixed),
        "log_evidence": calibration.log_evidence,
        "verdict": {
            **vars(verdict),
            "ok": verdict.reliable,
            "reasons": [*verdict.reasons, *verdict.against],
        },
        "identifiability": {"null_directions": directions_data(calibration)},
    }


def first_text(trail: SearchPath, verbose: bool = False) -> str:
    """Format the output of `calibrate` after the fit of the first model."""
    parts = check_parts(trail.steps[0].check, None if verbose else MAX_CHECKS)
    return _headed("RESIDUALS OF THE FIRST MODEL", *parts)


def _headed(head: str, *parts: object) -> str:
    return "\n".join([head, *map(str, parts)])


class ConsoleReporter:
    """Printer of a search's progress: the first table at once, a line where the best changes or every ten seconds."""

    def __init__(self, started: bool, verbose: bool = False, channels: Sequence[str] = ()) -> None:
        self.begun, self.verbose, self.channels = started, verbose, [*channels]
        self._printed = dict[str, tuple[int, str]]()

    def follow(self, name: str, trail: SearchPath) -> None:
        """Print the progress of a channel's search; `name` is "" where there is one output."""
        if not self.begun:
            print(first_text(trail, self.verbose), flush=True)
            self.begun = True
        if line := trail.progress:
            assert trail.search is not None  # where it has a line
            best = (len(trail.steps), str(trail.search.structures[0]))
            if best != self._printed.get(name) or progress.quiet() >= progress.INTERVAL_SECONDS:
                place = self.channels.index(name) + 1 if name else 0
                where = f"{name}, channel {place} of {len(self.channels)}: " * bool(name)
                progress.tell(where + line)
                self._printed[name] = best


def search_shown(search: SearchPath | Channels, as_data: bool, **how: Any) -> Any:
    """Return the output of `calibrate`: JSON data, or text."""
    if isinstance(search, SearchPath):
        return result(search) if as_data else loop_text(search, **how)
    texts = (folded(f"{name}: {trail.in_short}") for name, trail in search.search_paths.items())
    return channels_data(search) if as_data else "\n".join([f"{search}\n\nIN SHORT\n", *texts])


def loop_text(trail: SearchPath, started: bool = False, verbose: bool = False) -> str:
    """Format the output of `calibrate` from its first model to its last.

    Args:
        trail: its result.
        started: whether the first table was printed already.
        verbose: with all candidates of every step, and drafts of effects.
    """
    final = trail.final
    parts = [""] if started else [first_text(trail, verbose)]
    if final.discovery and (sets := final.discovery.equivalent):
        lines = [f"{claim.subjects[0]} and {' + '.join(claim.numbers['beside'])}" for claim in sets]
        parts.append(_headed("WHAT THESE READINGS CANNOT TELL APART", *map(folded, lines)))
    for i, step in enumerate(trail.steps if verbose else ()):
        head = f"WHAT IS MISSING FROM STEP {i} ({step.title})"
        parts.append(_headed(head, step.discovery or _not_asked(step)))
    unknown = [e.name for e in final.calibration.model.effects if e.is_placeholder]
    for name in unknown if verbose else ():
        head = f"A FIRST DRAFT OF AN EFFECT IN PLACE OF {name} (edit it, give it with --effects)"
        parts.append(_headed(head, draft_effect(final.calibration, name)))
    notes = [] if verbose else _missing_lines(trail)
    notes += [folded(f"end: {trail.ending}")] if trail.ending else []
    parts.append(_headed("THE ERROR, STEP BY STEP", trail, *notes))
    notes = [averaged_text(trail, verbose), folded(f"verdict: {trail.gate}")]
    parts.append(_headed("COEFFICIENTS", coefficients_text(trail, verbose), *filter(None, notes)))
    parts.append(_headed("IN SHORT", folded(trail.in_short, "")))
    return "\n\n".join(parts).removeprefix("\n")


def coefficients_text(trail: SearchPath, verbose: bool = False) -> str:
    """Format coefficients averaged over the structures; if verbose, also those that the most probable one lacks."""
    final = trail.final.calibration
    tables = unknowns_parts(trail.calibration, None if verbose else final.model.names)
    return "\n".join([*map(str, tables), final.remarks])


def averaged_text(trail: SearchPath, verbose: bool = False) -> str:
    """Format the structures that are averaged over; "" where one has all probability."""
    if trail.average is None:
        return ""
    shares = [(" + ".join(s.effects) or "nothing added", s.probability) for s in trail.shares]
    if verbose:
        rows = [(name, probability(p)) for name, p in shares]
        return _headed("STRUCTURES", plain_table(["effects added", "probability"], rows, fold=60))
    if (others := len(shares) - MAX_STRUCTURES) > 1:
        shares[MAX_STRUCTURES:] = [(f"{others} others", sum(p for _, p in shares[MAX_STRUCTURES:]))]
    named = ", ".join(f"{name} {probability(p)}" for name, p in shares)
    return folded(f"averaged over {named}; --structure best uses the first alone")


def _not_asked(step: Step) -> str:
    reasons = " ".join(step.calibration.verdict.reasons)
    return f"no probabilities: {reasons or 'the search was ended before'}"


def _missing_lines(trail: SearchPath) -> list[str]:
    """Format the effects missing from each step, with probabilities, except those added alone; unit questions once."""
    lines, questions = list[str](), dict[Claim, None]()
    model, sure = trail.final.calibration.model, settings().found_probability
    found_alone = {
        (model.effect(n).reported,) for n, p in trail.added.items() if (p or 0.0) >= sure
    }
    for i, step in enumerate(trail.steps):
        if (discovery := step.discovery) is None:
            lines.append(f"missing from step {i}: {_not_asked(step)}")
            continue
        questions |= dict.fromkeys(discovery.off_scale)
        sets = [
            f"{' or '.join(s.effects)} ({probability(s.probability)})"
            for s in discovery.findings
            if tuple(s.effects) not in found_alone
        ]
        lines += [f"missing from step {i}: {'; '.join(sets)}"] if sets else []
    return [folded(line) for line in (*lines, *(f"unit? {words}" for words in questions))]


def write_prediction(prediction: Prediction, readings: Measurements, path: Path) -> None:
    """Write the readings with columns predicted, predicted_standard_uncertainty, residual."""
    p = prediction
    columns = {"predicted": p.mean, "predicted_standard_uncertainty": p.sd, "residual": p.residual}
    for name, values in columns.items():
        readings = readings.with_column(name, values, readings.unit("output"))
    readings.write(path)
