"""A calibration in numbers: coefficients with intervals, contraction, and directions that were not measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._calibration.claim import Claim, limit
from bayescal._calibration.confounding import stand_alone
from bayescal._calibration.fitted import Fitted
from bayescal._core import null_space
from bayescal._core.formatting import folded, interval, number, probability, with_error
from bayescal._core.result_table import ResultTable, plain_table
from bayescal._data.unit_conversion import unit_label
from bayescal._inference.linear_model import LinearModel
from bayescal._model.frame import derived, held_name
from bayescal._model.unknowns import Unknowns

WEAK_INFORMATION = limit("direction.none", "information")
CONCERNED_SHARE = limit("direction.other", "share")

Direction = Float[np.ndarray, "p"]

MOST_TERMS = 8  # terms of a combination that are written out
TRACE_SHARE = 0.01  # of the largest entry, from which a coefficient is named
MOST_MEMBERS = 4  # of a group, that have a line each


def unknowns_parts(
    calibration: Fitted, effects: Collection[str] | None = None
) -> list[str | ResultTable]:
    """Unknowns with standard uncertainty and 95 % credible interval, and what is held."""
    rows = unknown_rows(calibration, effects)
    head = [
        *("unknown", "mean ± standard uncertainty", "unit"),
        *("95 % credible interval", "contraction"),
    ]
    shown = plain_table(head, rows.values()) if rows else "every unknown is fixed"
    model, lines = calibration.model, list[str]()
    if fixed := ", ".join(f"{name} = {value:g}" for name, value in model.fixed):
        lines.append(f"fixed: {fixed}")
    if model.noise_as_stated:
        squares, freedom, chance = calibration.chi_squared
        lines.append(
            f"noise as stated: χ² = {squares:.4g} with {freedom} degrees of freedom (as much or more by chance in "
            f"{chance:.2g} of cases)"
        )
    if at := [f"{k} = {v:g} {unit_label(u)}" for k, (v, u) in calibration.held_at.items()]:
        lines.append("constants hold at " + ", ".join(at))
    lagging = (e for e in model.effects if any(s.unit == "s" for s in e.column_shapes))
    columns = sorted({column for e in lagging for column in e.columns})
    if held := [n for n in columns if calibration.reference.get(held_name(n))]:
        lines.append(
            f"set in steps and held between readings: {', '.join(held)} (--reference {held_name(held[0])}=0 joins them)"
        )
    given = {s["name"]: if_there(s) for s in summary(calibration)[0] if s["name"] in rows}
    if said := ", ".join(f"{name} {value}" for name, value in given.items() if value):
        lines.append(f"if it is there: {said}")
    return [shown, *(folded(line, "") for line in lines)]


def if_there(row: dict[str, Any], times: float = 1.0) -> str:
    """Return the value given that the effect is there, with the probability of that; empty where it is the same."""
    mean, sd = row["given"]["mean"], row["given"]["sd"]
    if with_error(mean, sd) == with_error(row["mean"], row["sd"]):
        return ""
    value = f"{with_error(mean, times * sd)} {unit_label(row['unit'])}".rstrip()
    return f"{value} (probability {probability(row['probability'])})"


def unknown_rows(
    calibration: Fitted, effects: Collection[str] | None = None
) -> dict[str, list[str]]:
    """Of each unknown its name, value, unit, interval and contraction as they are printed, by what the row is of.

    A curve (an unknown dependence) is one row, and so are the members of a large group: single
    coefficients of these mean nothing by themselves.
    """
    rows: dict[str, list[str]] = {}
    coefficients, hyperparameters = summary(calibration)
    drawn = curves(calibration)
    groups = {name: key for key, own in large_groups(calibration).items() for name in own}
    for s in (*coefficients, *hyperparameters):
        name, effect, unit = s["name"], s["effect"], unit_label(s["unit"])
        key = effect if effect in drawn else groups.get(name)
        if key in rows or (effects is not None and effect not in (*effects, "noise")):
            continue
        if effect in drawn:
            rms, largest, covariate, at = curve_extent(calibration, effect)
            place = place_of(calibration, covariate, at)
            where = f"{number(rms, 2)} rms, {number(largest, 2)} at {place}"
            rows[effect] = [effect, where, unit_label(calibration.unit), "–", "–"]
        elif key is not None:
            means = [c["mean"] for c in coefficients if groups.get(c["name"]) == key]
            extent = f"{number(min(means), 3)} to {number(max(means), 3)}"
            rows[key] = [f"{key} ({len(means)} members)", extent, unit, "–", "–"]
        else:
            (low, high), mean, sd = s["interval95"], s["mean"], s["sd"]
            skewed = low > 0 and sd > 0.5 * mean
            value = f"about {number(mean, 2)}, skewed" if skewed else with_error(mean, sd)
            contraction = "–" if s["contraction"] is None else f"{s['contraction']:.3f}"
            rows[name] = [name, value, unit, interval(low, high, mean, sd), contraction]
    return rows


def curves(calibration: Fitted) -> set[str]:
    """Effects whose coefficients stand for a curve: unknown dependences."""
    return {e.name for e in calibration.model.effects if e.is_placeholder}


def curve_extent(calibration: Fitted, name: str) -> tuple[float, float, str, float | None]:
    """How large a curve is over the readings: rms and the largest, output unit; along what, and where that is."""
    values = np.asarray(calibration.linear.contribution(name))
    values = values - values.mean()
    worst = int(np.argmax(np.abs(values)))
    effect = calibration.model.effect(name)
    of = derived(calibration.readings).get(effect.covariate)
    at = None if of is None else float(of[worst])
    return float(values.std()), float(values[worst]), effect.covariate, at


def place_of(calibration: Fitted, covariate: str, at: float | None) -> str:
    """A place along a covariate, for people: "humidity 0.55"."""
    if at is None:
        return covariate
    readings = calibration.readings
    unit = "s" if covariate == "elapsed" else "degC/s"
    unit = readings.unit(covariate) if readings.has(covariate) else unit
    return f"{covariate} {number(at, 3)} {unit_label(unit or '1')}".rstrip()


def large_groups(calibration: Fitted) -> dict[str, list[str]]:
    """Names of members' coefficients, by coefficient: of groups with many members, of states where runs begin."""
    large = {}
    for key, own in calibration.unknowns.by_key.items():
        members = calibration.unknowns.rows[own]
        block = members[0].block
        initial = block is not None and block.coefficient.initial
        if members[0].group and len(members) > (1 if initial else MOST_MEMBERS):
            large[key] = [u.name for u in members]
    return large


def summary(calibration: Fitted) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Coefficients, and hyperparameters (noise, group standard deviations, shapes), as rows.

    Each has its name, effect, unit, mean, sd, interval95 and contraction; of an average over structures, of whose draws
    some lack its effect, also the `probability` that the effect is there and, given that, its mean and sd: `given`.

    Contraction is 1 − (posterior variance)/(prior variance): 1 where the readings said everything, 0 where they
    said nothing; None where the prior is flat or has no variance, and of a value that the method holds.
    """
    coefficients, hyperparameters = list[dict[str, Any]](), list[dict[str, Any]]()
    for u in (u for u in calibration.unknowns if not u.held):
        values = calibration.samples(u.name)
        own = calibration.having.get(u.effect, np.ones(len(values), dtype=bool))
        given = values[own] if own.sum() > 1 else values
        low, high = np.quantile(values, [0.025, 0.975])
        sd, prior = float(values.std(ddof=1)), u.prior_sd
        row = {
            "name": u.name,
            "effect": u.effect,
            "unit": u.unit,
            "probability": float(own.mean()),
            "given": {"mean": float(given.mean()), "sd": float(given.std(ddof=1))},
            "mean": float(values.mean()),
            "sd": sd,
            "interval95": [float(low), float(high)],
            "contraction": None if prior is None or sd == 0 else float(1 - (sd / prior) ** 2),
        }
        (hyperparameters if u.block is None else coefficients).append(row)
    return coefficients, hyperparameters


def null_directions(calibration: Fitted) -> list[Claim]:
    """Combinations of coefficients that the readings leave as the prior had them.

    First the exact ones: combinations that change no reading whatsoever, in the coefficients' own units and with
    as few coefficients in each as can be. Then those whose information, in units of the prior, is below a tenth:
    there the posterior is the prior. What concerns next to nothing but deviations of a group's members, or the
    coefficients of unknown functions, is counted in one line for all. Last, what cannot be told from recorded columns.
    """
    found = untold(calibration.linear, calibration.levels)
    return [*found, *(one.claim for one in calibration.confounders)]


def directions_data(calibration: Fitted) -> list[dict[str, str]]:
    """`null_directions` as in result.json."""
    found = null_directions(calibration)
    return [{"combination": c.numbers["combination"], "in_words": str(c)} for c in found]


def untold(
    linear: LinearModel, levels: Mapping[str, Sequence[str]], exactly: bool = True
) -> list[Claim]:
    """`null_directions` of a structure about any point."""
    layout = linear.problem.layout
    if layout.size == 0:
        return []
    names, found = [u.name for u in Unknowns.of(layout, levels) if u.x is not None], list[Claim]()
    exact, weak, others = null_vectors(linear, exactly)
    for v in exact:  # combinations that leave no trace, in the coefficients' own units
        vector = v * linear.sd[: len(v)]
        vector, order = null_space.simple(vector), np.flatnonzero(vector)
        code = "direction.none_exactly" if len(order) == 1 else "direction.other_exactly"
        combination = _sum([(vector[i], names[i]) for i in order])
        found.append(Claim(code, *(names[i] for i in order), combination=combination))
    for v in weak:  # directions that readings hardly tell, in prior standard deviations
        v = v / np.linalg.norm(v)
        order = [i for i in np.argsort(-np.abs(v)) if v[i] ** 2 > CONCERNED_SHARE]
        order = order or [int(np.argmax(np.abs(v)))]
        sign = float(np.sign(v[order[0]]))
        combination = _sum([(sign * round(float(v[i]), 2), names[i]) for i in order])
        told = {"combination": f"{combination}  (in prior standard deviations)"}
        code = "direction.none" if len(order) == 1 else "direction.other"
        found.append(Claim(code, *(names[i] for i in order), **told))
    if others:  # all those among deviations of groups and unknown functions' coefficients
        size, main = np.max(np.abs(others), axis=0), stand_alone(layout)
        traced = np.where(main, 0.0, size) > TRACE_SHARE * size.max()
        seen = (b for b in layout.x_blocks if traced[b.at].any())
        several = dict.fromkeys(b.effect.name for b in seen)
        told = {"count": len(others), "combination": ", ".join(several)}
        found.append(Claim("direction.members", *several, **told))
    return found


def null_vectors(
    linear: LinearModel, exactly: bool = True
) -> tuple[list[Direction], list[Direction], list[Direction]]:
    """Directions that are not told, in prior standard deviations: exactly; nearly; of members of groups alone."""
    layout = linear.problem.layout
    main = stand_alone(layout)
    unknown = linear.sd[: layout.size] > 0  # the others are numbers by definition
    white = linear.white_nuisance[:, : layout.size][:, unknown]
    exact = null_space.exact(white) if exactly else np.zeros((0, white.shape[1]))
    weak = null_space.weak(white, exact, WEAK_INFORMATION, limit("direction.none", "share"))
    found: tuple[list[Direction], ...] = [], [], []
    for kind, directions in enumerate((exact, weak)):
        for direction in directions:
            vector = np.zeros(layout.size)
            vector[unknown] = direction
            # Of coefficients that stand for themselves it has a share, or it is of members alone.
            concerns = float(np.sum(vector[main] ** 2)) > CONCERNED_SHARE * float(vector @ vector)
            found[kind if concerns else 2].append(vector)
    return found[0], found[1], found[2]


def _sum(terms: list[tuple[float, str]]) -> str:
    """A sum for people: a − b − 2·c."""
    shown = []
    for factor, name in terms[:MOST_TERMS]:
        size = "" if abs(factor) == 1 else f"{abs(factor):.3g}·"
        shown.append(f"{'+' if factor > 0 else '−'} {size}{name}")
    if len(terms) > MOST_TERMS:
        shown.append(f"… and {len(terms) - MOST_TERMS} more")
    return " ".join(shown).removeprefix("+ ")
