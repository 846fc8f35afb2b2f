"""The tables of a report as plain data, which a template lays out."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from typing import Any

import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.check_result import Check
from bayescal._calibration.summary import summary
from bayescal._core.errors import InputError
from bayescal._core.formatting import interval, number, with_error
from bayescal._data.column import NominalScale
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import convert, same_dimension, unit_label
from bayescal._model.effect import Effect
from bayescal._model.prior import Flat, HalfCauchy, HalfNormal, LogNormal, LogUniform, Normal
from bayescal._report.section import Chapter

K = 2.0  # coverage factor of every expanded uncertainty in a report
GAUSSIAN = 0.9545  # what k = 2 covers of a Gaussian
SUMMARY = 14  # coefficients on the page that is signed
UNUSED = "recorded; the model does not use it"
READ = "what was read"
FOLLOWS = "follows from the above"


def measured(value: float, unit: str, digits: int = 4) -> str:
    return f"{number(value, digits)} {unit_label(unit)}".strip()


def channels(readings: Measurements) -> list[str]:
    """Columns of the files that were read as the output, where the user chose one."""
    return [name for name in dict.fromkeys(s.output for s in readings.sources) if name]


def devices(readings: Measurements) -> list[str]:
    return list(readings.groups("device")[0]) if readings.has("device") else []


def ranges(calibration: Calibration) -> list[dict[str, Any]]:
    """What was covered: each numeric covariate and each rate of a temperature, with its range and part."""
    readings, model = calibration.readings, calibration.model
    used = {c for e in model.effects for c in e.columns}
    use = model.instrument.use
    about = {c.name: c.meaning for c in model.instrument.columns}
    found = []
    for name in readings.columns:
        unit = readings.unit(name)
        if unit is None or name in ("output_uncertainty", "temperature_point"):
            continue
        values = readings[name]
        part = "the model depends on it" if name in used else UNUSED
        if name == "output":
            part = READ
        elif use is not None and name == use.stimulus:
            part = "the input, what the instrument is to measure"
        found.append(_range(name, about.get(name, ""), values, unit, part))
    for name, values in calibration.frame.rates.items():
        rate = np.asarray(values) * 60
        if np.ptp(rate) > 0:
            what = f"{name} rate", "speed of the change"
            found.append(_range(*what, rate, "degC/min", FOLLOWS))
    if readings.has("time"):
        span = np.asarray(calibration.frame.columns["elapsed"])
        found.append(_range("elapsed", "time since the start of a run", span, "s", FOLLOWS))
    return found


def _range(name: str, meaning: str, values: np.ndarray, unit: str, part: str) -> dict[str, Any]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return {
        "name": name,
        "meaning": meaning,
        "low": number(low, 4).replace("-", "−"),
        "high": number(high, 4).replace("-", "−"),
        "unit": unit_label(unit),
        "part": part,
        "constant": low == high,
    }


def coefficients(chapter: Chapter) -> list[dict[str, Any]]:
    """Coefficients, then hyperparameters: k = 2 interval and 95 % credible interval, apart."""
    rows = []
    for r in (*chapter.data["coefficients"], *chapter.data["hyperparameters"]):
        mean, sd = r["mean"], r["sd"]
        held = not sd > 1e-9 * abs(mean)
        low, high = r["interval95"]
        rows.append(
            {
                "name": r["name"],
                "effect": r["effect"],
                "unit": unit_label(r["unit"]),
                "value": with_error(mean, K * sd),
                "u": "held" if held else number(sd, 2),
                "k2": "–" if held else interval(mean - K * sd, mean + K * sd, mean, sd),
                "interval": "–" if held else interval(low, high, mean, sd),
                "said": "–" if r["contraction"] is None else _percent(r["contraction"]),
                "member": "(" in r["name"],
            }
        )
    return rows


def _percent(share: float) -> str:
    return "> 99.9 %" if share > 0.999 else f"{100 * share:z.1f} %".replace("-", "−")


def allan(check: Check) -> dict[str, Any] | None:
    """The terms of the Allan deviation, of the residuals and of the noise law; None where there is none."""
    found = check.allan
    if found is None:
        return None
    law = {t.symbol: str(t) for t in found.law_terms}
    rows = [(f"{t.name} {t.symbol}", str(t), law.get(t.symbol, "–")) for t in found.measured.terms]
    said = found.sentence()
    return {"rows": rows, "law": found.law_name, "said": f"{said[0].upper()}{said[1:]}."}


def skewed(chapter: Chapter) -> list[str]:
    """Unknowns whose mean ± 2 u holds clearly more or less than a Gaussian's share of the draws."""
    found, c = [], chapter.calibration
    posterior = c.posterior
    for name in map(str, posterior):
        if "reading" in posterior[name].dims:
            continue
        draws = c.samples(name)
        sd = draws.std(axis=0)
        if np.all(sd > 1e-9 * np.abs(draws.mean(axis=0))):
            inside = float(np.mean(np.abs(draws - draws.mean(axis=0)) <= K * sd))
            if abs(inside - GAUSSIAN) > 0.01:
                found.append(f"{name} {100 * inside:.1f} %")
    return found


def effects(chapter: Chapter) -> list[dict[str, Any]]:
    """Each effect of the model: equation, unknowns with their priors, source, the step that brought it."""
    since = {}
    for i, step in enumerate(chapter.data["steps"]):
        for name in step["effects"]:
            since.setdefault(name, i)
    return [
        {
            "name": e.name,
            "slot": e.slot,
            "equation": e.equation or "–",
            "unknowns": _unknowns(e),
            "source": e.source,
            "since": "the start" if since.get(e.name, 0) == 0 else f"step {since[e.name]}",
        }
        for e in chapter.calibration.model.effects
    ]


def _unknowns(effect: Effect) -> list[str]:
    found = []
    for i, c in enumerate(effect.coefficients):
        prior = (
            f"between-group standard deviation estimated, {_prior(c.group_sd)}"
            if c.group_sd is not None
            else _prior(c.prior)
        )
        if effect.weights is not None:
            prior = f"prior 0 ± a part of {effect.name}.{effect.measure}"
        per = f", one for each {c.per}" if c.per else ""
        found.append(f"{effect.coefficient_name(i)} [{unit_label(c.unit) or '1'}]: {prior}{per}")
    for s in effect.shapes:
        share = "between" if s.scale == "bounded" else "95 % between"
        found.append(
            f"{effect.shape_name(s)} [{unit_label(s.unit) or '1'}]: {share} {number(s.low)} and {number(s.high)}"
        )
    return found


def _prior(prior: Any) -> str:
    words: dict[type, Callable[[Any], str]] = {
        Normal: lambda p: f"prior {number(p.mean)} ± {number(p.sd)} (one standard deviation)",
        HalfNormal: lambda p: f"half-normal prior of scale {number(p.scale)}",
        HalfCauchy: lambda p: f"half-Cauchy prior of scale {number(p.scale)}",
        LogNormal: lambda p: f"log-normal prior about {number(p.median)}",
        LogUniform: lambda p: f"log-uniform prior from {number(p.low)} to {number(p.high)}",
        Flat: lambda p: "flat prior",
    }
    return words.get(type(prior), repr)(prior)


def matrix(chapter: Chapter) -> list[tuple[str, str, str, str]]:
    """Of three axes, terms of the correction at T0 and by temperature: name, power of T − T0, value ± u, unit."""
    found = chapter.data.get("vector")
    if not found or "terms" not in found:
        return []
    axes = "xyz"
    names = [f"offset {a}" for a in axes] + [f"matrix {a}{b}" for a in axes for b in axes]
    own = len(found["terms"][0]) - 9 * bool(found["beside"])
    if own > 12:
        names += [
            f"second order {a}·{p}" for a in axes for p in ("xx", "yy", "zz", "xy", "xz", "yz")
        ]
    if own > 30:
        names += [f"cube {a}" for a in axes]
    if found["beside"]:
        names += [f"{g} on {a}" for a in axes for g in found["beside"]]
    rows = []
    for power, (values, sds) in enumerate(zip(found["terms"], found["uncertainty"], strict=True)):
        for name, value, sd in zip(names, values, sds, strict=True):
            if value or sd:
                of = found["unit"] if name.startswith("offset") else ""
                rows.append((name, str(power), with_error(value, sd), unit_label(of)))
    return rows


def output_factor(unit: str, of: str, scale: NominalScale | None) -> float:
    """What one of the output's unit, in which a calibration keeps it, is in another; differences, all of them.

    Args:
        unit: asked for, of the output or of the raw one.
        of: that the output is kept in.
        scale: by which the raw output became the output; None where it did not.

    Raises:
        InputError: the unit is neither's.
    """
    if same_dimension(unit, of):
        return float(convert(1.0, of, unit, difference=True))
    if scale is not None and same_dimension(unit, scale.unit):
        return float(abs(scale.gain) * convert(1.0, scale.unit, unit, difference=True))
    raw = f", made of readings in {scale.unit}" if scale is not None else ""
    raise InputError(
        f"--output-unit {unit}: the output is in {of}{raw}. Give a unit of that dimension, or say by "
        '--nominal-scale what one unit of the output makes of the raw one, such as "2.44 mV/(deg/s)"'
    )


def exchanged(whole: str, of: str, unit: str) -> str | None:
    """A unit that is the output's, `of`, or per something else, with another in its place; None where it is neither."""
    rest = whole.removeprefix(of)
    return unit + rest if whole.startswith(of) and rest[:1] in ("", "/", "*") else None


def rows_in_output_unit(chapter: Chapter, unit: str) -> list[list[str]]:
    """The errors of every step, and the coefficients that are in the output's unit or per something, as cells.

    Returns:
        Name, value with its standard uncertainty, unit.

    Raises:
        InputError: the output is in no such unit.
    """
    c, rows = chapter.calibration, list[list[str]]()
    factor = output_factor(unit, c.unit, c.readings.scale or c.model.instrument.nominal_scale)
    for i, step in enumerate(chapter.data["steps"]):
        for key, what in (("rmse_fitted", "as fitted"), ("holdout_rmse", "of hold-out data")):
            if step[key] is not None:
                error = number(step[key] * factor, 2)
                name = f"rms error {what}, step {i} ({step['title']})"
                rows.append([name, error, unit_label(unit)])
    for one in chain(*summary(c)):
        if (shown := exchanged(one["unit"], c.unit, unit)) is not None:
            value = with_error(one["mean"] * factor, one["sd"] * factor)
            rows.append([one["name"], value, unit_label(shown)])
    return rows
