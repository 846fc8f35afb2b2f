"""The tables of a report, which a template formats, and the summary of a chapter in one paragraph."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.prior_influence import find_prior_dominated_coefficients
from bayescal._calibration.storage import list_sources
from bayescal._calibration.summary import format_rows, is_skewed, summarise_curve, summary
from bayescal._core.flag import Flag
from bayescal._core.formatting import format_interval, format_value, number, probability
from bayescal._core.result_table import ResultTable, TableColumn, make_table
from bayescal._core.settings import settings
from bayescal._data.unit_conversion import unit_label
from bayescal._model.composition import find_response_columns
from bayescal._model.effect import Effect
from bayescal._model.frame import GROUPS
from bayescal._model.model import Model
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, Known, LogNormal, LogUniform, Normal
from bayescal._report.result_json import Chapter
from bayescal._search.discover import group_untested
from bayescal._search.search_path import format_forms, is_rise, list_headings, steps_table

K = 2.0  # coverage factor of every expanded uncertainty in a report
MAX_SIGNED_ROWS = 14  # number of coefficients on the page that is signed
UNUSED_ROLE = "recorded; not used by the model"
OUTPUT_ROLE = "the reading of the instrument"
TEST_ROLE = "of the test only, not a range of use"
DERIVED_ROLE = "derived from the above"


def format_with_unit(value: float, unit: str, digits: int = 4) -> str:
    has_zeros = 1e-4 <= abs(value) < 10 ** (digits - 1)
    text = f"{value:#.{digits}g}" if has_zeros else number(value, digits)
    return f"{text} {unit_label(unit)}".strip()


def tabulate_ranges(calibration: Calibration) -> ResultTable:
    """Tabulate the range, and the role in the model, of numeric columns, temperature rates and the elapsed time."""
    readings, model = calibration.readings, calibration.model
    used_columns = {c for e in model.effects for c in e.columns} | {*model.noise.needs}
    used_columns |= find_response_columns(model.instrument, calibration.frame)
    meanings, rows = {c.name: c.meaning for c in model.instrument.columns}, []
    vector = model.instrument.vector
    in_use = ("temperature", *vector.outputs, *vector.secondary_columns) if vector else ()

    def add_row(name: str, meaning: str, values: np.ndarray, unit: str, role: str) -> None:
        role = TEST_ROLE if vector and name not in in_use and role != UNUSED_ROLE else role
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        quantity = ", ".join(filter(None, (name, meaning)))
        role += " (constant)" * (low == high)
        rows.append([quantity, unit_label(unit), number(low, 4), number(high, 4), role])

    use, roles = model.instrument.use, {"output": OUTPUT_ROLE}
    if use is not None:
        roles = {use.stimulus: "the input, which the instrument measures"} | roles
    if "time" in used_columns and not calibration.dated_effects:
        roles["time"] = "by differences alone: elapsed, lags, correlation of noise"
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is None or name in ("output_uncertainty", "temperature_point"):
            continue
        role = "the model depends on it" if name in used_columns else UNUSED_ROLE
        add_row(name, meanings.get(name, ""), readings[name], unit, roles.get(name, role))
    for name, values in calibration.frame.rates.items():
        rate = np.asarray(values) * 60
        if np.ptp(rate) > 0:
            add_row(f"{name} rate", "rate of change", rate, "degC/min", DERIVED_ROLE)
    if readings.has("time"):
        elapsed = np.asarray(calibration.frame.columns["elapsed"])
        add_row("elapsed", "time since the start of a run", elapsed, "s", DERIVED_ROLE)
    return make_table(["quantity", "unit", "from", "to", "role"], rows, left=2, width=1)


def format_group_sizes(data: dict[str, Any]) -> str:
    """Format the numbers of runs, cells, axes and devices in the data of a result.json, omitting those below two."""
    counts = [(k, data["readings"]["groups"].get(k, 0)) for k in GROUPS]
    return ", ".join(f"{n} {'axes' if k == 'axis' else k + 's'}" for k, n in counts if n > 1)


def tabulate_files(chapter: Chapter) -> ResultTable:
    """Tabulate the files of readings and hold-out data, with the number of readings and the SHA-256 of each."""

    def join_names(names: str | list[str]) -> str:
        return names if isinstance(names, str) else ", ".join(names)

    rows = [[s.file, str(s.rows), s.sha256] for s in list_sources(chapter.calibration.readings)]
    if holdout := chapter.data["holdout"]:
        names = f"hold-out: {join_names(holdout['file']) or 'arrays'}"
        rows.append([names, str(holdout["rows"]), join_names(holdout["sha256"])])
    return make_table(["file", "readings", "SHA-256"], rows, width=1)


def tabulate_coefficients(chapter: Chapter) -> ResultTable:
    """Tabulate the unknowns of the last model, conditional on their effects, with expanded and credible intervals."""
    used, not_measured = chapter.used, find_prior_dominated_coefficients(chapter.used)
    summaries, rows = {r["name"]: r for r in chain(*summary(used))}, list[dict[str, Any]]()
    for key, (name, value, unit, *_) in format_rows(used, chapter.calibration.model.names).items():
        empty = dict.fromkeys(("u", "k2", "credible"), "–")
        if (r := summaries.get(key)) is None:  # a curve or a large group
            name, value = name.replace(" *", " (if present)"), f"{value} {unit}".rstrip()
            rows.append({"name": name, "unit": "", "value": value, "contraction": None, **empty})
            continue
        mean, sd, ends = r["given"].values()
        is_held, inclusion = not sd > 1e-9 * abs(mean), r["probability"]
        note = used.model.form_note(r["effect"]) + " (held)" * is_held
        note += " (mostly its prior)" * (key in not_measured)
        note += f" if present ({probability(inclusion)})" * (inclusion < 1)
        intervals = (mean - K * sd, mean + K * sd), ends
        k2, credible = ("–" if is_held else format_interval(*b, mean, sd) for b in intervals)
        k2 = "–" if is_skewed(mean, sd, *ends) else k2
        value = format_value(mean, K * sd) if is_held or k2 != "–" else f"{credible} (95 %)"
        cells = {"u": "held" if is_held else number(sd, 3), "k2": k2, "credible": credible}
        cells["contraction"] = r["contraction"] if mean == r["mean"] else None
        rows.append({**r, "value": value, "note": note, **cells})
    columns = (
        TableColumn("unknown", "name"),
        TableColumn("unit", "unit", unit_label, left=True),
        TableColumn(f"value ± U (k = {K:g})", "value"),
        TableColumn("standard uncertainty u", "u"),
        TableColumn(f"k = {K:g} interval", "k2"),
        TableColumn("95 % credible interval", "credible"),
        TableColumn("contraction", "contraction", _format_percent),
    )
    return ResultTable(columns, rows)


def tabulate_signed(table: ResultTable, model: Model) -> ResultTable:
    """Tabulate the ungrouped unknowns for the signed page: coefficients, nonlinear parameters, fixed values."""
    ungrouped = [r for r in table.rows if "(" not in r["name"]]
    names = {e.shape_name(shape) for e in model.effects for shape in e.shapes}
    shapes = [r for r in ungrouped if r["name"] in names][:MAX_SIGNED_ROWS]
    others = [r for r in ungrouped if r["name"] not in names][: MAX_SIGNED_ROWS - len(shapes)]
    rows = [[r["name"], r["value"] + r["note"], unit_label(r["unit"])] for r in others + shapes]
    rows += [[name, f"{number(value, 6)} (fixed)", ""] for name, value in model.fixed]
    return make_table(["unknown", f"value ± U (k = {K:g}), or 95 % interval", "unit"], rows)


def _format_percent(share: float | None) -> str:
    percent = f"{100 * (share or 0.0):z.1f} %"
    return "–" if share is None else "> 99.9 %" if share > 0.999 else percent


def tabulate_steps(chapter: Chapter) -> ResultTable:
    """Tabulate the errors of every step, as `SearchPath` prints them."""
    steps_data = chapter.data["steps"]
    complete = {m["step"]: m["nothing_missing_probability"] for m in chapter.data["missing"]}
    rows = [
        {
            **step,
            "number": i,
            "rises": i > 0 and is_rise(step["holdout_rmse"], steps_data[i - 1]["holdout_rmse"]),
            "nothing_missing": complete.get(i),
        }
        for i, step in enumerate(steps_data)
    ]
    return steps_table(rows)


def tabulate_convergence(chapter: Chapter) -> ResultTable:
    """Tabulate the convergence diagnostics of the fit of each step."""

    def entry(key: str) -> Callable[[Any], Any]:
        return lambda row: row[1]["verdict"][key]

    columns = (
        TableColumn("step", lambda row: f"{row[0]} {row[1]['title']}"),
        TableColumn("converged", entry("ok"), lambda ok: "yes" if ok else "no", left=True),
        TableColumn("sampler", entry("sampler"), left=True),
        TableColumn("Pareto k̂", entry("pareto_k"), number),
        TableColumn("ESS", entry("ess"), lambda v: number(v, 4)),
        TableColumn("R-hat", entry("r_hat"), lambda v: number(v, 4)),
        TableColumn("divergences", entry("divergences"), lambda v: "–" if v is None else str(v)),
    )
    return ResultTable(columns, [*enumerate(chapter.data["steps"])])


def tabulate_effects(chapter: Chapter) -> ResultTable:
    """Tabulate the effects of the model: slot, equation, unknowns with priors, the step that added each, source."""
    added_at, model = dict[str, str](), chapter.used.model
    for i, step in enumerate(chapter.data["steps"]):
        for name in step["effects"]:
            added_at.setdefault(name, f"step {i}" if i else "first model")
    columns = (
        TableColumn("effect", lambda e: e.name + model.form_note(e.name)),
        TableColumn("slot", lambda e: e.slot, left=True),
        TableColumn("equation", lambda e: e.equation or "–", left=True),
        TableColumn("unknowns and their priors", lambda e: "\n".join(_prior_lines(e)), left=True),
        TableColumn("added in", lambda e: added_at.get(e.name, "model average"), left=True),
        TableColumn("source", lambda e: e.source, left=True),
    )
    return ResultTable(columns, chapter.used.model.effects)


def _prior_lines(effect: Effect) -> list[str]:
    lines = []
    for i, c in ((i, c) for i, c in enumerate(effect.coefficients) if not c.known):
        prior = c.prior if c.group_sd is None else c.group_sd
        prior = PRIORS.get(type(prior), repr)(prior)
        if c.group_sd is not None:
            prior = f"between-group standard deviation estimated, {prior}"
        if effect.weights is not None:
            sizes = [effect.measure] if effect.measure else effect.weight_shapes
            prior = f"normal prior, mean 0, sd depending on {' and '.join(f'{effect.name}.{s}' for s in sizes)}"
        group = f", one for each {c.per}" if c.per else ""
        if effect.is_placeholder and len(effect.coefficients) > 1:
            lines.append(f"{len(effect.coefficients)} weights of a curve: {prior}{group}")
            break
        lines.append(f"{effect.coefficient_name(i)} [{unit_label(c.unit) or '1'}]: {prior}{group}")
    for s in effect.shapes:
        coverage = "between" if s.scale == "bounded" else "95 % between"
        limits = f"{number(s.low)} and {number(s.high)}"
        lines.append(f"{effect.shape_name(s)} [{unit_label(s.unit) or '1'}]: {coverage} {limits}")
    return lines


PRIORS: dict[type, Callable[[Any], str]] = {
    Normal: lambda p: f"prior {number(p.mean)} ± {number(p.sd)}",
    HalfNormal: lambda p: f"half-normal prior of scale {number(p.scale)}",
    HalfCauchy: lambda p: f"half-Cauchy prior of scale {number(p.scale)}",
    LogNormal: lambda p: f"log-normal prior about {number(p.median)}",
    LogUniform: lambda p: f"log-uniform prior from {number(p.low)} to {number(p.high)}",
    Flat: lambda p: "flat prior",
    Known: lambda p: "1 in structures with the effect, 0 in others" if p.averaged else "1",
}


MAX_NAMED = 4  # number of effects of the first model, and of unknowns of an effect, listed by name


def summarise_chapter(chapter: Chapter) -> str:
    """Return a paragraph on the effects found, the first and last error, the residuals, and open questions."""
    texts = [f(chapter) for f in (_describe_additions, _format_errors, _describe_residuals)]
    open_questions = [*_list_untested(chapter), *_list_undecided(chapter)]
    return " ".join([*_list_failed_checks(chapter), *texts, *open_questions])


def _list_failed_checks(chapter: Chapter) -> Iterator[str]:
    claims = [claim["in_words"] for claim in chapter.data["gate"].get("claims", ())]
    if reasons := [*claims, *chapter.data["verdict"]["reasons"]]:
        yield f"Not fit for use: {reasons[0]}"  # the other reasons are in the verdict


def _describe_additions(chapter: Chapter) -> str:
    """Describe the effects of the last model that the first model lacks, with their coefficients."""
    c, data = chapter.calibration, chapter.data
    latent_names = [set(m.get("latent", ())) for m in data["missing"]] or [set()]
    first_effects = set(data["steps"][0]["effects"]) | latent_names[0] & latent_names[-1]
    added_effects = [e for e in c.model.effects if e.name not in first_effects]
    if not added_effects:
        statement = "No effect was found missing from"
        if (data["search"] or {}).get("stopped"):
            statement = "When the search was ended, no effect had been found missing from"
        if not data["missing"]:
            statement = "No effect was searched beyond"
        names = [n for n in c.model.names if n not in latent_names[-1]]
        model = f"{len(names)} effects" if len(names) > MAX_NAMED else ", ".join(names) or "empty"
        return f"{statement} the first model ({model})."
    candidates = data["missing"][0]["candidates"] if data["missing"] else ()
    probabilities = {c["effect"]: c["probability"] for c in candidates}
    search = data["search"] or {}
    heads, texts = list_headings(search.get("complete", True)), dict[str, list[str]]()
    structures = [(*s.values(),) for s in search.get("averaged_over", ())]
    for effect in added_effects:
        p = probabilities.get(effect.family_name)
        name = format_forms(effect.name, effect.family_name, structures)
        suffix = f", probability {probability(p)}" if p and p < max(heads) else ""
        head = next(h for least, h in heads.items() if p is None or p >= least)
        texts.setdefault(head, []).append(_describe_effect(chapter.used, effect, name) + suffix)
    sentences = list[str]()
    for head in (h for h in heads.values() if h in texts):
        text, where = "; ".join(texts[head]), " in addition to the first model" * (head == "found")
        unit_note = " (± standard uncertainty)" * ("±" in text)
        sentences.append(f"{head.capitalize()}{where}{unit_note}: {text}.")
    return " ".join(sentences)


PHRASES = {  # phrase by an effect's kind
    "linear": "a linear term in",
    "quadratic": "a quadratic term in",
    "cubic": "a cubic term in",
    "quartic": "a quartic term in",
    "rate": "a dependence on the rate of",
    "lag": "a lag behind",
    "warm-up": "a warm-up over",
    "drift": "a drift over",
    "curve": "an unknown dependence on",
    "line": "an unknown linear dependence on",
    "jump": "a step along",
    **{kind: f"a {kind} along" for kind in ("kink", "peak", "hysteresis")},
    "cycle": "a cycle over",
}


def _describe_effect(c: Calibration, effect: Effect, name: str) -> str:
    """Describe an effect: kind of dependence, name, range of its curve or values of its unknowns (if it is present)."""
    base = c.model.instrument.known.get(effect.family_name, effect)  # forms share its text
    along = effect.covariate if effect.is_placeholder else base.columns[-1] if base.columns else ""
    text = f"{PHRASES[base.kind]} {along.replace('_', ' ')}, " if base.kind in PHRASES else ""
    if (per := effect.coefficients[0].per) and not effect.shapes:
        text = f"differences from {per} to {per}, "
    return text + _describe_size(c, effect, name)


def _describe_size(c: Calibration, effect: Effect, effect_name: str) -> str:
    if effect.is_placeholder:
        _, largest, location = summarise_curve(c, effect.name)
        size = format_with_unit(abs(largest), c.unit, 2)
        return f"{effect.name}, up to {size}, most at {location}"
    texts = list[str]()
    for row in chain(*summary(c)):
        name = row["name"].removeprefix(effect.name).removeprefix(".")
        if row["effect"] == effect.name and not {*"[("} & {*name}:
            mean, sd, ends = row["given"].values()
            skewed, unit = is_skewed(mean, sd, *ends), unit_label(row["unit"])
            value = format_interval(*ends, mean, sd) if skewed else format_value(mean, sd)
            texts.append(f"{name} {value} {unit}".strip() + " (95 %)" * skewed)
    texts[MAX_NAMED:] = [f"{len(texts) - MAX_NAMED} more"] * (len(texts) > MAX_NAMED)
    if texts and effect_name.endswith(")"):  # with the probabilities of its forms
        return f"{effect_name[:-1]}; of the first form: {', '.join(texts)})"
    return f"{effect_name} ({', '.join(texts)})" if texts else effect_name


def describe_change(initial: float, final: float) -> str:
    """Format how an error changed, to two digits: "fell from 0.47 to 0.43", "stayed at 6.7"."""
    first_text, last_text = number(initial, 2), number(final, 2)
    change = f"{'fell' if final < initial else 'rose'} from {first_text} to {last_text}"
    return f"stayed at {last_text}" if first_text == last_text else change


def _format_errors(chapter: Chapter) -> str:
    """Compare the first and last rms error of hold-out data, else of left-out groups; if not lower, also as fitted."""
    steps, unit = chapter.data["steps"], unit_label(chapter.calibration.unit)
    ends = steps[0], steps[-1]
    label, errors, beside = "as fitted", [s["rmse_fitted"] for s in ends], ""
    left_out, held_out = ([s[k] for s in ends] for k in ("leave_one_group_out", "holdout_rmse"))
    as_fitted = f"; as fitted, it {describe_change(*errors)} {unit}"
    if None not in held_out:
        label, errors, beside = "on the hold-out data", held_out, as_fitted
    elif all(left_out):
        group = left_out[1]["group"].replace("_", " ")
        errors = [out["rmse"] for out in left_out]
        label, beside = f"of each {group}, predicted from the others,", as_fitted
    change = describe_change(*errors)
    if len(steps) == 1:
        return f"The rms error {label} is {number(errors[1], 2)} {unit}."
    return f"The rms error {label} {change} {unit}{'' if change.startswith('fell') else beside}."


def _describe_residuals(chapter: Chapter) -> str:
    """State on which covariates the residuals depend; if on none, whether they agree with the noise model."""
    c, gate = chapter.calibration, chapter.data["gate"]
    strong = settings().strong_evidence
    covariates = [e.covariate for e in chapter.check.entries if e.log_bayes_factor > strong]
    if covariates:
        return f"The residuals still depend on {join_words(covariates[:3])}."
    noise_text = c.model.noise.looks_like or f"noise ({c.model.noise.in_words})"
    noise = format_with_unit(chapter.data["steps"][-1]["rmse_fitted"], c.unit, 2)
    first_code = next(iter(gate.get("claims", ())), {"code": ""})["code"]
    if first_code in ("noise.correlated", "noise.scatter", "noise.one_sided", "noise.tails"):
        return f"The residuals, {noise} rms, do not agree with the noise model."
    if not gate["ok"]:
        return f"The residuals are {noise} rms."
    return f"The residuals, {noise} rms, resemble {noise_text}."


def _list_last_candidates(chapter: Chapter) -> list[dict[str, Any]]:
    return chapter.data["missing"][-1]["candidates"] if chapter.data["missing"] else []


def _list_untested(chapter: Chapter) -> Iterator[str]:
    """Yield sentences on columns that were ignored, and on effects that could not be tested."""
    flags = (f for f in chapter.calibration.readings.flags if isinstance(f, Flag))
    if names := [name for f in flags if f.code == "column.ignored" for name in f.subjects]:
        yield f"Columns not used: {', '.join(names)}."
    if by_reason := group_untested(_list_last_candidates(chapter)):
        untested = "; ".join(f"{join_words(n)} ({reason})" for reason, n in by_reason.items())
        yield f"Not tested: {untested}."


def _list_undecided(chapter: Chapter) -> Iterator[str]:
    """Yield sentences on the alternatives that these readings cannot decide."""
    in_model, confounders = set(chapter.calibration.model.names), chapter.calibration.confounders
    sets = [list(s["effects"]) for missing in chapter.data["missing"] for s in missing["sets"]]
    questions = [" or ".join(names) for names in sets if len(names) > 1 and in_model & set(names)]
    lead_names = [c["effect"] for c in _list_last_candidates(chapter) if c["kind"] == "lead"]
    questions += [f"whether {name} is missing, too" for name in lead_names if name not in in_model]
    confounded_pairs = [(join_words(c.coefficients), c.column) for c in confounders if not c.step]
    questions += [f"which part of {names} is due to {column}" for names, column in confounded_pairs]
    questions += [f"whether {c.column} was rounded or truncated" for c in confounders if c.step]
    if questions:
        yield f"Not decided: {'; '.join(dict.fromkeys(questions))}."
    if chapter.data["other_path"] is not None:
        rival = chapter.data["other_path"]
        text = f"noise law {rival['noise']}, with {' and '.join(rival['added']) or 'nothing'} added"
        yield f"Undecided: {text}, is nearly as probable (log Bayes factor {rival['log_bayes_factor']:.1f})."


def join_words(words: list[str]) -> str:
    """Join words for a sentence: "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
