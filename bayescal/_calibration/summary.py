"""Summary of a calibration: coefficients with intervals, contraction, and unidentified directions."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.confounding import is_single_coefficient
from bayescal._calibration.fitted import Fitted
from bayescal._core import null_space
from bayescal._core.formatting import format_interval, format_value, number, probability, wrap
from bayescal._core.result_table import ResultTable, make_table
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.linear_model import LinearModel
from bayescal._model.frame import list_covariates, name_hold_flag
from bayescal._model.parameters import Unknowns

WEAK_INFORMATION = limit("direction.none", "information")
CONCERNED_SHARE = limit("direction.other", "share")

Direction = Float[np.ndarray, "p"]

SKEWED_TEXT = "skewed: see interval"  # in place of value ± u
CONTRACTION = "contraction: 1 − posterior variance/prior variance"
PRIOR_SD_SUFFIX = " (in prior standard deviations)"
MAX_TERMS = 8  # printed terms of a linear combination
NAMED_SHARE = 0.01  # of a null direction's largest entry, above which a coefficient is named
MAX_MEMBER_ROWS = 4  # members of a group that are printed one per line


def list_unknowns(
    calibration: Fitted, effects: Collection[str] | None = None
) -> list[str | ResultTable]:
    """Tabulate unknowns with standard uncertainties and 95 % intervals; list fixed values and constants."""
    rows = format_rows(calibration, effects)
    head = "unknown", "mean ± standard uncertainty", "unit", "95 % credible interval", "contraction"
    table = make_table(head, rows.values()) if rows else "every unknown is fixed"
    model, lines = calibration.model, list[str]()
    if fixed_text := ", ".join(f"{name} = {value:g}" for name, value in model.fixed):
        lines.append(f"fixed: {fixed_text}")
    if model.noise_as_stated:
        squares, dof, p = calibration.chi_squared_test
        chi_squared = f"χ² = {squares:.4g} with {dof} degrees of freedom (p-value {p:.2g})"
        lines.append(f"noise as stated: {chi_squared}")
    if any(row[-1] != "–" for row in rows.values()):
        is_widened = any(row[-1].startswith("-") for row in rows.values())
        lines.append(CONTRACTION + "; below 0: the posterior is wider than the prior" * is_widened)
    if constant_texts := [
        f"{k} = {v:g} {unit_label(u)}" for k, (v, u) in calibration.reference_constants.items()
    ]:
        lines.append("coefficients refer to " + ", ".join(constant_texts))
    if model.noise.law == "white" and "noise.white" in rows:
        suffix = ", besides the stated one" * calibration.readings.has("output_uncertainty")
        lines.append(f"noise.white: standard deviation of one reading{suffix}")
    lag_effects = (e for e in model.effects if any(s.unit == "s" for s in e.column_shapes))
    columns = sorted({column for e in lag_effects for column in e.columns})
    if stepped := [n for n in columns if calibration.reference.get(name_hold_flag(n))]:
        option = f"(--reference {name_hold_flag(stepped[0])}=0 interpolates linearly instead)"
        lines.append(f"constant between readings (set in steps): {', '.join(stepped)} {option}")
    names = calibration.model.names if effects is None else effects
    pairs = ((n, p) for n, p in calibration.inclusion.items() if n in names and p < 1)
    if text := ", ".join(f"{name} {probability(p)}" for name, p in pairs):
        lines.append(f"* conditional on the effect being present; weight in the average: {text}")
    return [table, *(wrap(line, "") for line in lines)]


def is_skewed(mean: float, sd: float, low: float, high: float) -> bool:
    """Return whether value ± 2 u misleads: the 95 % interval is asymmetric, or much narrower (a bounded unknown)."""
    return sd > 0 and max(2 * abs(high + low - 2 * mean), 4 * sd / 2.3) > 0.5 * (high - low)


def format_rows(
    calibration: Fitted, effects: Collection[str] | None = None
) -> dict[str, list[str]]:
    """Return printed rows (name, value, unit, interval, contraction) by name; a curve or a large group has one row."""
    rows: dict[str, list[str]] = {}
    coefficients, hyperparameters = summary(calibration)
    # Coefficients of an unknown dependence describe a curve together.
    curve_effects = {e.name for e in calibration.model.effects if e.is_placeholder}
    groups = find_large_groups(calibration)
    for g in (*coefficients, *hyperparameters):
        name, effect, unit = g["name"], g["effect"], unit_label(g["unit"])
        key = effect if effect in curve_effects else groups.get(name)
        if key in rows or (effects is not None and effect not in (*effects, "noise")):
            continue
        if effect in curve_effects:
            rms, extreme, place = summarise_curve(calibration, effect)
            extent_text = f"{number(rms, 2)} rms, {number(extreme, 2)} at {place}"
            rows[effect] = [effect, extent_text, unit_label(calibration.unit), "–", "–"]
        elif key is not None:
            means = [c["given"]["mean"] for c in coefficients if groups.get(c["name"]) == key]
            extent_text = f"means {number(min(means), 3)} to {number(max(means), 3)}"
            rows[key] = [f"{key} ({len(means)} members)", extent_text, unit, "–", "–"]
        else:
            mean, sd, (low, high) = g["given"].values()
            value = SKEWED_TEXT if is_skewed(mean, sd, low, high) else format_value(mean, sd)
            is_known = g["contraction"] is not None and mean == g["mean"]  # not that of a mixture
            contraction = f"{g['contraction']:.3f}" if is_known else "–"
            rows[name] = [name, value, unit, format_interval(low, high, mean, sd), contraction]
        rows[key or name][0] += " *" * (g["probability"] < 1)
    return rows


def summarise_curve(calibration: Fitted, name: str) -> tuple[float, float, str]:
    """Return a curve's rms and largest deviation from its mean, output unit, and where: "humidity 0.55"."""
    values, readings = np.asarray(calibration.linear.contribution(name)), calibration.readings
    values = values - values.mean()
    worst_index = int(np.argmax(np.abs(values)))
    place = covariate = calibration.model.effect(name).covariate
    if (column := list_covariates(readings).get(covariate)) is not None:
        unit = "s" if covariate == "elapsed" else "degC/s"
        unit = readings.unit(covariate) if readings.has(covariate) else unit
        place += f" {number(float(column[worst_index]), 3)} {unit_label(unit or '1')}".rstrip()
    return float(values.std()), float(values[worst_index]), place


def find_large_groups(calibration: Fitted) -> dict[str, str]:
    """Return coefficient name → key common to its group ("bias.run"), for large groups.

    A group is large if it has more than `MAX_MEMBER_ROWS` members, or is of initial states and has more than one.
    """
    keys = dict[str, str]()
    for key, rows in calibration.unknowns.by_key.items():
        members = calibration.unknowns.rows[rows]
        is_initial = (block := members[0].block) is not None and block.coefficient.initial
        if members[0].group and len(members) > (1 if is_initial else MAX_MEMBER_ROWS):
            keys |= {u.name: key for u in members}
    return keys


def summary(calibration: Fitted) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Summarise coefficients, and hyperparameters (noise, group standard deviations, shapes), as rows.

    A row has name, effect, unit, mean, sd, interval95, contraction, the inclusion `probability` of the effect, and
    `given`: mean, sd and interval95 conditional on inclusion. All values of a hyperparameter are conditional.
    Contraction is 1 − (posterior variance)/(prior variance); None for flat priors and constant draws.
    """
    coefficients, hyperparameters = list[dict[str, Any]](), list[dict[str, Any]]()
    for u in (u for u in calibration.unknowns if not u.held):
        values = calibration.samples(u.name)
        is_present = calibration.inclusion_masks.get(u.effect, np.ones(len(values), dtype=bool))
        subset = values[is_present] if is_present.sum() > 1 else values
        conditional = {
            "mean": float(subset.mean()),
            "sd": float(subset.std(ddof=1)) * bool(np.ptp(subset)),
        }
        conditional["interval95"] = np.quantile(subset, [0.025, 0.975]).tolist()
        values = subset if u.block is None else values  # absent, a hyperparameter has no value
        low, high = np.quantile(values, [0.025, 0.975])
        sd, prior = float(values.std(ddof=1)) * bool(np.ptp(values)), u.prior_sd  # equal ones round
        row = {
            "name": u.name,
            "effect": u.effect,
            "unit": u.unit,
            "probability": float(is_present.mean()),
            "given": conditional,
            "mean": float(values.mean()),
            "sd": sd,
            "interval95": [float(low), float(high)],
            "contraction": None if prior is None or sd == 0 else float(1 - (sd / prior) ** 2),
        }
        (hyperparameters if u.block is None else coefficients).append(row)
    return coefficients, hyperparameters


def null_directions(calibration: Fitted) -> list[Claim]:
    """Return claims on unidentified linear combinations of coefficients.

    In this order: exact null directions of the design matrix, each with as few coefficients as possible; weak
    directions, on which readings have less than a tenth of the prior's information; one claim for all directions of
    group deviations or unknown functions; pairs of coefficients of which only one combination is measured; confounders.
    """
    claims = find_unidentified(calibration.linear, calibration.levels)
    return [*claims, *(confounder.claim for confounder in calibration.confounders)]


def list_directions(calibration: Fitted) -> list[dict[str, str]]:
    """Return the records of `null_directions` in result.json."""
    claims = null_directions(calibration)
    return [{"combination": c.numbers["combination"], "in_words": str(c)} for c in claims]


def find_unidentified(
    linear_model: LinearModel, levels: Mapping[str, Sequence[str]], include_exact: bool = True
) -> list[Claim]:
    """Return claims on unidentified combinations of a linearised structure, without those due to confounders."""
    layout = linear_model.problem.layout
    if layout.size == 0:
        return []
    names, claims = [u.name for u in Unknowns.of(layout, levels) if u.x is not None], list[Claim]()
    exact_vectors, weak_vectors, member_vectors = find_null_vectors(linear_model, include_exact)
    for v in exact_vectors:  # no reading changes; in the coefficients' units if of small integers
        order = np.flatnonzero(np.abs(v) > NAMED_SHARE * np.abs(v).max())
        factors, suffix = null_space.scale_to_integers((v * linear_model.sd[: len(v)])[order]), ""
        if np.any(factors != np.rint(factors)):  # else in prior sd, the largest first
            order = order[np.argsort(-np.abs(v[order]), kind="stable")]
            factors, suffix = null_space.scale_to_integers(v[order]), PRIOR_SD_SUFFIX
        code = "direction.none_exactly" if len(order) == 1 else "direction.other_exactly"
        subjects = [names[i] for i in order]
        combination = _format_combination([*zip(factors, subjects, strict=True)]) + suffix
        claims.append(Claim(code, *subjects, combination=combination))
    for v in weak_vectors:  # weakly identified directions, in prior standard deviations
        v = v / np.linalg.norm(v)
        order = [i for i in np.argsort(-np.abs(v)) if v[i] ** 2 > CONCERNED_SHARE]
        order = order or [int(np.argmax(np.abs(v)))]
        sign = float(np.sign(v[order[0]]))
        combination = _format_combination([(sign * round(float(v[i]), 2), names[i]) for i in order])
        code = "direction.none" if len(order) == 1 else "direction.other"
        subjects = [names[i] for i in order]
        claims.append(Claim(code, *subjects, combination=combination + PRIOR_SD_SUFFIX))
    if member_vectors:  # those of group deviations and unknown functions' coefficients
        largest, is_single = np.max(np.abs(member_vectors), axis=0), is_single_coefficient(layout)
        is_named = np.where(is_single, 0.0, largest) > NAMED_SHARE * largest.max()
        blocks = (b for b in layout.x_blocks if is_named[b.x_slice].any())
        effects = dict.fromkeys(b.effect.name for b in blocks)
        numbers = {"count": len(member_vectors), "combination": ", ".join(effects)}
        claims.append(Claim("direction.members", *effects, **numbers))
    # Pairs: one's variance is due to the other, on which the prior is more informative than the readings.
    hypers = [layout.hypers[i] for i in layout.nonlinear_phi]
    names, sd = [*names, *(h.name for h in hypers)], np.linalg.norm(linear_model.root, axis=1)
    is_single = np.array([*is_single_coefficient(layout), *(h.kind == "promoted" for h in hypers)])
    correlation = linear_model.root @ linear_model.root.T / np.outer(sd, sd).clip(1e-300)
    is_pair = np.outer(is_single & (linear_model.weight * sd**2 > 0.5), is_single)
    for i, j in np.argwhere(is_pair & (correlation**2 > limit("direction.pair", "share"))):
        pair, r = (names[j], names[i]), float(correlation[i, j])
        if i != j and not any({*pair} <= {*claim.subjects} for claim in claims):
            combination = " and ".join(pair)
            claims.append(Claim("direction.pair", *pair, combination=combination, correlation=r))
    return claims


def find_null_vectors(
    linear_model: LinearModel, include_exact: bool = True
) -> tuple[list[Direction], list[Direction], list[Direction]]:
    """Return exact, weak, and group-deviation null directions (p,), in prior standard deviations."""
    layout = linear_model.problem.layout
    single, share = is_single_coefficient(layout), limit("direction.none", "share")
    is_unknown = linear_model.sd[: layout.size] > 0  # the others are numbers by definition
    whitened = linear_model.white_nuisance[:, : layout.size][:, is_unknown]
    exact = null_space.find_null_rows(whitened) if include_exact else np.zeros((0, len(whitened.T)))
    weak = null_space.find_weak_rows(whitened, exact, WEAK_INFORMATION, share)
    directions_by_kind: tuple[list[Direction], ...] = [], [], []
    for kind_index, directions in enumerate((exact, weak)):
        for direction in directions:
            vector = np.zeros(layout.size)
            vector[is_unknown] = direction
            # Directions without single coefficients are those of group deviations or curves.
            concerns = float(np.sum(vector[single] ** 2)) > CONCERNED_SHARE * float(vector @ vector)
            directions_by_kind[kind_index if concerns else 2].append(vector)
    return directions_by_kind[0], directions_by_kind[1], directions_by_kind[2]


def _format_combination(terms: list[tuple[float, str]]) -> str:
    """Format a linear combination: a − b − 2·c."""
    term_texts = []
    for factor, name in terms[:MAX_TERMS]:
        coefficient = "" if abs(factor) == 1 else f"{abs(factor):.3g}·"
        term_texts.append(f"{'+' if factor > 0 else '−'} {coefficient}{name}")
    if len(terms) > MAX_TERMS:
        term_texts.append(f"… and {len(terms) - MAX_TERMS} more")
    return " ".join(term_texts).removeprefix("+ ")
