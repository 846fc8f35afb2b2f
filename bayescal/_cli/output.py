"""Results of commands: text where a result does not print itself, plain JSON data, a file of predictions."""

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

# Lines of a table without --verbose, so that a result is a screen.
SHOWN_STRUCTURES = 2  # of those averaged over
SHOWN_CHECKS = 3  # covariates that a first model is checked against, the worst


def instruments_listed(known: Mapping[str, Instrument]) -> tuple[str, dict[str, Any]]:
    """Installed instruments as text, and as data."""
    data = {n: {**_about(i), "columns": [c.name for c in i.columns]} for n, i in known.items()}
    rows = [[name, unit_label(one["unit"]), one["title"]] for name, one in data.items()]
    return str(plain_table(["instrument", "output", "measures"], rows, left=2, fold=40)), data


def _about(one: Instrument) -> dict[str, Any]:
    return {"title": one.title, "source": one.source, "unit": one.unit}


def instrument_shown(one: Instrument) -> tuple[str, dict[str, Any]]:
    """What the files of an instrument hold, and the names of its effects, as text and as data."""
    columns, rows = [], []
    for c in one.columns:
        needed = c.required and c.default is None
        own = {"name": c.name, "unit": c.unit, "needed": needed, "meaning": c.meaning}
        columns.append(own)
        unit = unit_label(c.unit) if c.unit else "label"
        rows.append([c.name, unit, "needed" if needed else "optional", c.meaning])
    baseline, candidates = ([e.name for e in of] for of in (one.effects, one.candidates))
    said = [
        f"{one.name}: {one.title}",
        f"effects of the first model: {', '.join(baseline)}",
        f"looked for beside them: {', '.join(candidates)}",
        f"what each of them is: bayescal effects --instrument {one.name}",
    ]
    title, *rest = map(folded, said)
    table = plain_table(["column", "unit", "", "meaning"], rows, left=4, fold=60)
    data = {**_about(one), "columns": columns, "baseline": baseline, "candidates": candidates}
    return "\n\n".join([title, str(table), "\n".join(rest)]), data


def effects_listed(kinds: Mapping[str, Sequence[Effect]]) -> tuple[str, list[dict[str, Any]]]:
    """Effects as text, a table for each kind ("baseline", …), then the source of each; and as data."""
    data, parts, by_source = [], [], dict[str, list[str]]()
    for kind, effects in kinds.items():
        rows = []
        for e in effects:
            first = e.coefficients[0]
            about = {"name": e.name, "kind": kind, "equation": e.equation, "size": first.size}
            more = {"unit": first.unit, "columns": list(e.columns), "source": e.source}
            data.append({**about, **more})
            size = f"{number(first.size)} {unit_label(first.unit)}".rstrip()
            equation = e.equation.replace(",  ", ",\n")
            rows.append([e.name, size, ", ".join(e.columns) or "–", equation])
            by_source.setdefault(e.source, []).append(e.name)
        if rows:
            head = [kind, "plausible size", "needs", "equation"]
            parts.append(str(plain_table(head, rows, left=3, fold=42)))
    sources = (folded(f"{source}: {', '.join(names)}") for source, names in by_source.items())
    return "\n\n".join([*parts, "\n".join(["sources", *sources])]), data


def fit_data(calibration: Calibration) -> dict[str, Any]:
    """A fit as data."""
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
    """Return `calibrate` as soon as the first model stands."""
    parts = check_parts(trail.steps[0].check, None if verbose else SHOWN_CHECKS)
    return _headed("WHERE THE FIRST MODEL FAILS", *parts)


def _headed(head: str, *parts: object) -> str:
    return "\n".join([head, *map(str, parts)])


class ConsoleReporter:
    """Follows a search: the first table at once, a line where the best so far changes or ten seconds have passed."""

    def __init__(self, begun: bool, verbose: bool = False) -> None:
        self.begun, self.verbose = begun, verbose
        self._told = dict[str, tuple[int, str]]()

    def follow(self, name: str, trail: SearchPath) -> None:
        """Say how the search of a channel stands; "" where there is one output."""
        if not self.begun:
            print(first_text(trail, self.verbose), flush=True)
            self.begun = True
        if line := trail.progress:
            assert trail.search is not None  # where a line is told of it
            best = (len(trail.steps), str(trail.search.structures[0]))
            if best != self._told.get(name) or progress.quiet() >= progress.INTERVAL_SECONDS:
                progress.tell(f"{name}: {line}" if name else line)
                self._told[name] = best


def search_shown(found: SearchPath | Channels, as_data: bool, **how: Any) -> Any:
    """Return what `calibrate` prints of what it found: JSON data, or text."""
    if isinstance(found, SearchPath):
        return result(found) if as_data else loop_text(found, **how)
    said = (folded(f"{name}: {trail.in_short}") for name, trail in found.trails.items())
    return channels_data(found) if as_data else "\n".join([f"{found}\n\nIN SHORT\n", *said])


def loop_text(trail: SearchPath, begun: bool = False, verbose: bool = False) -> str:
    """`calibrate` from its first model to its last.

    Args:
        trail: what it did.
        begun: the first table stands already.
        verbose: with all candidates of every step, and drafts of effects.
    """
    final = trail.final
    parts = [""] if begun else [first_text(trail, verbose)]
    if final.discovery and (sets := final.discovery.equivalent):
        lines = [f"{one.of[0]} and {' + '.join(one.numbers['beside'])}" for one in sets]
        parts.append(_headed("WHAT THESE READINGS CANNOT TELL APART", *map(folded, lines)))
    for i, step in enumerate(trail.steps if verbose else ()):
        head = f"WHAT IS MISSING FROM STEP {i} ({step.title})"
        parts.append(_headed(head, step.discovery or _not_asked(step)))
    unknown = [e.name for e in final.calibration.model.effects if e.is_placeholder]
    for name in unknown if verbose else ():
        head = f"A FIRST DRAFT OF AN EFFECT IN PLACE OF {name} (edit it, give it with --effects)"
        parts.append(_headed(head, draft_effect(final.calibration, name)))
    said = [] if verbose else _missing_lines(trail)
    said += [folded(f"end: {trail.ending}")] if trail.ending else []
    parts.append(_headed("THE ERROR, STEP BY STEP", trail, *said))
    said = [averaged_text(trail, verbose), folded(f"gate: {trail.gate.reason}")]
    parts.append(_headed("COEFFICIENTS", coefficients_text(trail, verbose), *filter(None, said)))
    parts.append(_headed("IN SHORT", folded(trail.in_short, "")))
    return "\n\n".join(parts).removeprefix("\n")


def coefficients_text(trail: SearchPath, verbose: bool = False) -> str:
    """Coefficients as they leave, averaged over the structures; those that the most probable one lacks if verbose."""
    final = trail.final.calibration
    shown = unknowns_parts(trail.calibration, None if verbose else final.model.names)
    return "\n".join([*map(str, shown), final.remarks])


def averaged_text(trail: SearchPath, verbose: bool = False) -> str:
    """The structures that are averaged over; empty where one has it all."""
    if trail.average is None:
        return ""
    each = [(" + ".join(s.effects) or "nothing added", s.probability) for s in trail.shares]
    if verbose:
        rows = [(name, probability(p)) for name, p in each]
        return _headed("STRUCTURES", plain_table(["effects added", "probability"], rows, fold=60))
    if (more := len(each) - SHOWN_STRUCTURES) > 1:
        each[SHOWN_STRUCTURES:] = [(f"{more} others", sum(p for _, p in each[SHOWN_STRUCTURES:]))]
    named = ", ".join(f"{name} {probability(p)}" for name, p in each)
    return folded(f"averaged over {named}; --structure best uses the first alone")


def _not_asked(step: Step) -> str:
    reasons = " ".join(step.calibration.verdict.reasons)
    return f"no probabilities: {reasons or 'the search was ended before'}"


def _missing_lines(trail: SearchPath) -> list[str]:
    """What is missing from each step, with its probability, but what was found alone; questions of units once."""
    lines, asked = list[str](), dict[Claim, None]()
    model, sure = trail.final.calibration.model, settings().found_probability
    found_alone = {
        (model.effect(n).reported,) for n, p in trail.added.items() if (p or 0.0) >= sure
    }
    for i, step in enumerate(trail.steps):
        if (found := step.discovery) is None:
            lines.append(f"missing from step {i}: {_not_asked(step)}")
            continue
        asked |= dict.fromkeys(found.off_scale)
        said = [
            f"{' or '.join(s.effects)} ({probability(s.probability)})"
            for s in found.sets
            if tuple(s.effects) not in found_alone
        ]
        lines += [f"missing from step {i}: {'; '.join(said)}"] if said else []
    return [folded(line) for line in (*lines, *(f"unit? {words}" for words in asked))]


def write_prediction(prediction: Prediction, readings: Measurements, path: Path) -> None:
    """Write the readings with columns predicted, predicted_uncertainty, residual."""
    p = prediction
    columns = {"predicted": p.mean, "predicted_uncertainty": p.sd, "residual": p.residual}
    for name, values in columns.items():
        readings = readings.with_column(name, values, readings.unit("output"))
    readings.write(path)
