"""Output of commands: text, data for JSON, and a file of predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check import format_check
from bayescal._calibration.claim import Claim
from bayescal._calibration.predict import Prediction
from bayescal._calibration.summary import list_directions, list_unknowns, summary
from bayescal._core import progress
from bayescal._core.formatting import number, probability, wrap
from bayescal._core.result_table import make_table
from bayescal._core.settings import settings
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._model.effect import Effect
from bayescal._model.instrument import Instrument
from bayescal._report.result_json import result
from bayescal._report.save_search import channels_data
from bayescal._search.calibrate_channels import Channels
from bayescal._search.search_path import SearchPath, Step

SOURCES = 'sources (numbered in docs/sources.md; "ours": estimated by the authors of bayescal)'
MAX_STRUCTURES = 2  # structures of a model average that are printed without --verbose
MAX_CHECKS = 3  # covariates in the residual checks of the first model, without --verbose


def format_instruments(instruments: Mapping[str, Instrument]) -> tuple[str, dict[str, Any]]:
    """Return the list of installed instruments as text and as data for JSON."""
    items = instruments.items()
    data = {n: {**_describe(i), "columns": [c.name for c in i.columns]} for n, i in items}
    rows = [[name, unit_label(about["unit"]), about["title"]] for name, about in data.items()]
    return str(make_table(["instrument", "output", "measures"], rows, left=2, width=40)), data


def _describe(instrument: Instrument) -> dict[str, Any]:
    return {"title": instrument.title, "source": instrument.source, "unit": instrument.unit}


def format_instrument(instrument: Instrument) -> tuple[str, dict[str, Any]]:
    """Return the columns and effects of an instrument as text and as data for JSON."""
    columns, rows = [], []
    for c in instrument.columns:
        is_needed = c.required and c.default is None
        columns.append({"name": c.name, "unit": c.unit, "needed": is_needed, "meaning": c.meaning})
        unit = unit_label(c.unit) if c.unit else "label"
        rows.append([c.name, unit, "needed" if is_needed else "optional", c.meaning])
    baseline = [e.name for e in instrument.effects]
    candidates = [e.name for e in instrument.candidates]
    lines = [
        f"{instrument.name}: {instrument.title}",
        f"effects of the first model: {', '.join(baseline)}",
        f"candidate effects: {', '.join(candidates)}",
        f"description of the effects: bayescal effects --instrument {instrument.name}",
    ]
    title, *notes = map(wrap, lines)
    table = make_table(["column", "unit", "", "meaning"], rows, left=4, width=60)
    data = {"columns": columns, "baseline": baseline, "candidates": candidates}
    return "\n\n".join([title, str(table), "\n".join(notes)]), _describe(instrument) | data


def format_effects(kinds: Mapping[str, Sequence[Effect]]) -> tuple[str, list[dict[str, Any]]]:
    """Return effects as text (a table for each kind, such as "baseline", then sources) and as data for JSON."""
    data, parts, by_source = [], [], dict[str, list[str]]()
    for kind, effects in kinds.items():
        rows = []
        for e in effects:
            coefficient = e.coefficients[0]
            entry = {"name": e.name, "kind": kind, "equation": e.equation, "size": coefficient.size}
            details = {"unit": coefficient.unit, "columns": list(e.columns), "source": e.source}
            data.append({**entry, **details})
            size = f"{number(coefficient.size)} {unit_label(coefficient.unit)}".rstrip()
            equation = e.equation.replace(",  ", ",\n")
            rows.append([e.name, size, ", ".join(e.columns) or "–", equation])
            by_source.setdefault(e.source, []).append(e.name)
        if rows:
            heading = [kind, "plausible size", "needs", "equation"]
            parts.append(str(make_table(heading, rows, left=3, width=42)))
    sources = (wrap(f"{source}: {', '.join(names)}") for source, names in by_source.items())
    return "\n\n".join([*parts, "\n".join([SOURCES, *sources])]), data


def convert_fit(calibration: Calibration) -> dict[str, Any]:
    """Convert the results of a fit to data for JSON."""
    verdict, (coefficients, hyperparameters) = calibration.verdict, summary(calibration)
    reasons = [*verdict.reasons, *verdict.against]
    return {
        "coefficients": coefficients,
        "hyperparameters": hyperparameters,
        "reference": {**calibration.reference, **calibration.hold_at},
        "fixed": dict(calibration.model.fixed),
        "log_evidence": calibration.log_evidence,
        "verdict": {**vars(verdict), "ok": verdict.reliable, "reasons": reasons},
        "identifiability": {"null_directions": list_directions(calibration)},
    }


def format_first_model(path: SearchPath, verbose: bool = False) -> str:
    """Format the output of `calibrate` after the fit of the first model."""
    parts = format_check(path.steps[0].check, None if verbose else MAX_CHECKS)
    method = ", fitted by least squares" * (path.steps[0].calibration.method == LeastSquares.name)
    return _section(f"RESIDUALS OF THE FIRST MODEL{method}", *parts)


def _section(heading: str, *parts: object) -> str:
    return "\n".join([heading, *map(str, parts)])


class ConsoleReporter:
    """Printer of a search's progress: the first table, then a line at each new best structure or every ten seconds."""

    def __init__(self, started: bool, verbose: bool = False, channels: Sequence[str] = ()) -> None:
        self.has_begun, self.verbose, self.channels = started, verbose, [*channels]
        self._printed = dict[str, tuple[int, str]]()

    def follow(self, name: str, path: SearchPath) -> None:
        """Print the progress of the search of channel `name` ("" for a single output)."""
        if not self.has_begun:
            print(format_first_model(path, self.verbose), flush=True)
            self.has_begun = True
        if line := path.progress:
            assert path.search is not None  # a progress line implies a search
            state = (len(path.steps), str(path.search.structures[0]))
            if state != self._printed.get(name) or progress.silence() >= progress.INTERVAL_SECONDS:
                channel_number = self.channels.index(name) + 1 if name else 0
                prefix = f"{name}, channel {channel_number} of {len(self.channels)}: " * bool(name)
                progress.notify(prefix + line)
                self._printed[name] = state


def format_search(search: SearchPath | Channels, as_data: bool, **options: Any) -> Any:
    """Return the output of `calibrate` as data for JSON (`as_data`) or as text; `options` as in `format_loop`."""
    if isinstance(search, SearchPath):
        return result(search) if as_data else format_loop(search, **options)
    texts = (wrap(f"{name}: {path.in_short}") for name, path in search.search_paths.items())
    return channels_data(search) if as_data else "\n".join([f"{search}\n\nIN SHORT\n", *texts])


def format_loop(path: SearchPath, has_begun: bool = False, verbose: bool = False) -> str:
    """Format the output of `calibrate` for one output, from the first model to the last.

    Args:
        path: result of the search.
        has_begun: whether the first table has been printed.
        verbose: whether to include all candidates of every step.
    """
    final = path.final
    parts = [""] if has_begun else [format_first_model(path, verbose)]
    claims = final.discovery.equivalent if final.discovery else ()
    sets = ((c.subjects[0], *c.numbers["beside"]) for c in claims)
    sets = (s for s in sets if not {*s} <= {*final.calibration.model.names})  # else in its remarks
    if lines := [wrap(f"{first} and {' + '.join(others)}") for first, *others in sets]:
        parts.append(_section("EFFECTS THAT THESE READINGS CANNOT TELL APART", *lines))
    for i, step in enumerate(path.steps if verbose else ()):
        heading = f"EFFECTS MISSING FROM STEP {i} ({step.title})"
        parts.append(_section(heading, step.discovery or _explain_not_tested(step)))
    notes = [] if verbose else _format_missing(path)
    notes += [wrap(f"end: {path.ending}")] if path.ending else []
    parts.append(_section("THE ERROR, STEP BY STEP", path, *notes))
    notes = [format_average(path, verbose), wrap(f"verdict: {path.gate}")]
    parts.append(_section("COEFFICIENTS", format_coefficients(path, verbose), *filter(None, notes)))
    parts.append(_section("IN SHORT", wrap(path.in_short, "")))
    return "\n\n".join(parts).removeprefix("\n")


def format_coefficients(path: SearchPath, verbose: bool = False) -> str:
    """Format the coefficients of the model average; unless `verbose`, without effects that the last model lacks."""
    final = path.final.calibration
    tables = list_unknowns(path.calibration, None if verbose else final.model.names)
    return "\n".join([*map(str, tables), final.remarks])


def format_average(path: SearchPath, verbose: bool = False) -> str:
    """Format the structures of a model average with their probabilities; "" without an average."""
    if path.average is None:
        return ""
    shares = [(" + ".join(s.effects) or "nothing added", s.probability) for s in path.shares]
    if verbose:
        rows = [(name, probability(p)) for name, p in shares]
        return _section("STRUCTURES", make_table(["effects added", "probability"], rows, width=60))
    if (others := len(shares) - MAX_STRUCTURES) > 1:
        shares[MAX_STRUCTURES:] = [(f"{others} others", sum(p for _, p in shares[MAX_STRUCTURES:]))]
    texts = ", ".join(f"{name} {probability(p)}" for name, p in shares)
    first, s = path.steps[0].discovery, settings()
    given = "contain what is missing from step 0 and " * bool(first and first.findings)
    head = f"coefficients, corrections and budgets are averaged over {len(path.shares)} structures"
    note = f"those of the {100 * s.found_probability:g} % credible set that {given}have a probability of at least "
    note += f"{s.averaged_probability:g}; scaled to a sum of 1"
    return wrap(f"{head}: {texts} ({note}); --structure best uses the first alone")


def _explain_not_tested(step: Step) -> str:
    reasons = " ".join(step.calibration.verdict.reasons)
    return f"no probabilities: {reasons or 'effects missing from this model were not evaluated'}"


def _format_missing(path: SearchPath) -> list[str]:
    """Return lines on the effects missing at each step, except those added later, and on doubtful units."""
    lines, questions = list[str](), dict[Claim, None]()
    model, threshold = path.final.calibration.model, settings().found_probability
    added_alone = {
        (model.effect(n).family_name,) for n, p in path.added.items() if (p or 0.0) >= threshold
    }
    for i, step in enumerate(path.steps):
        if (discovery := step.discovery) is None:
            lines.append(f"missing from step {i}: {_explain_not_tested(step)}")
            continue
        questions |= dict.fromkeys(discovery.off_scale)
        for s in (s for s in discovery.findings if tuple(s.effects) not in added_alone):
            names = f"at least one of {', '.join(s.effects)}" if s.effects[1:] else s.effects[0]
            lines.append(f"missing from step {i}: {names} ({probability(s.probability)})")
    return [wrap(line) for line in (*lines, *(f"unit? {words}" for words in questions))]


def write_prediction(prediction: Prediction, readings: Measurements, path: Path) -> None:
    """Write readings and the columns predicted, predicted_standard_uncertainty and residual to a .csv file."""
    p = prediction
    columns = {"predicted": p.mean, "predicted_standard_uncertainty": p.sd, "residual": p.residual}
    for name, values in columns.items():
        readings = readings.with_column(name, values, readings.unit("output"))
    readings.write(path)
