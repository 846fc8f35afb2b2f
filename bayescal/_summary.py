"""A calibration in numbers: coefficients with intervals, contraction, and directions that were not measured."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from bayescal import _score as scores
from bayescal._calibration import Calibration
from bayescal._layout import Block

WEAK = 0.1  # information against the prior below which a direction counts as not measured
SHARE = 0.1  # of a direction's squared length below which a coefficient is left out of its words


def summary(calibration: Calibration) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Coefficients, and spreads with noise and shapes: name, effect, unit, mean, sd, interval95, contraction.

    Contraction is 1 − (posterior variance)/(prior variance): 1 where the readings said everything, 0 where they
    said nothing; None where the prior is flat or has no variance.
    """
    layout, levels = calibration.layout, calibration.levels
    coefficients, spreads = [], []
    for b in layout.blocks:
        if b.place == "fixed":
            continue
        values = calibration.samples(b.name)
        prior = (
            None if b.coefficient.flat or b.coefficient.spread is not None else b.coefficient.size
        )
        per = b.coefficient.per
        if per is None:
            coefficients.append(_row(b.name, b.effect.name, b.coefficient.unit, values, prior))
        elif per != "reading":
            for i, member in enumerate(levels[per]):
                name = f"{b.name}({member})"
                coefficients.append(
                    _row(name, b.effect.name, b.coefficient.unit, values[:, i], prior)
                )
    for h in layout.hypers:
        if h.kind != "promoted":
            effect = "noise" if h.kind == "noise" else h.name.rpartition(".")[0]
            spreads.append(
                _row(h.name, effect, h.unit, calibration.samples(h.name), _prior_sd(h.prior))
            )
    return coefficients, spreads


def _row(
    name: str, effect: str, unit: str, values: np.ndarray, prior: float | None
) -> dict[str, Any]:
    low, high = np.quantile(values, [0.025, 0.975])
    sd = float(values.std(ddof=1))
    return {
        "name": name,
        "effect": effect,
        "unit": unit,
        "mean": float(values.mean()),
        "sd": sd,
        "interval95": [float(low), float(high)],
        "contraction": None if prior is None else float(1 - (sd / prior) ** 2),
    }


def _prior_sd(prior: Any) -> float | None:
    """Standard deviation of a hyper-parameter's prior, where it has one."""
    kind = type(prior).__name__
    if kind == "HalfNormal":
        return prior.scale * float(np.sqrt(1 - 2 / np.pi))
    if kind == "LogNormal":
        s2 = prior.sd**2
        return float(prior.median * np.sqrt((np.exp(s2) - 1) * np.exp(s2)))
    return prior.sd if kind == "Normal" else None


def null_directions(calibration: Calibration) -> list[dict[str, str]]:
    """Combinations of coefficients that the readings leave as the prior had them, in words.

    Eigenvectors of the information of the readings, in units of the prior: where it is below a tenth, the
    posterior is the prior.
    """
    y = jnp.asarray(calibration.readings["output"])
    null = scores.null_model(calibration.layout, calibration.frame, y, calibration.mode)
    count = calibration.layout.size
    if count == 0:
        return []
    scaled = null.nuisance[:, :count] * null.prior.sd[:count]
    frame, noise = calibration.frame, calibration.model.noise
    gram = noise.gram(scaled, null.residual, null.extra, null.hyper, frame)
    values, vectors = np.linalg.eigh(np.asarray(gram.jtj))
    names = _entry_names(calibration)
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value < WEAK:
            found.append(_words(vector, value, names))
    return found


def _entry_names(calibration: Calibration) -> list[str]:
    names: list[str] = []
    for b in calibration.layout.x_blocks:
        names += _members(b, calibration.levels)
    return names


def _members(block: Block, levels: dict[str, tuple[str, ...]]) -> list[str]:
    per = block.coefficient.per
    if per is None:
        return [block.name]
    return [f"{block.name}({m})" for m in levels[per]]


def _words(vector: np.ndarray, value: float, names: list[str]) -> dict[str, str]:
    order = [i for i in np.argsort(-np.abs(vector)) if vector[i] ** 2 > SHARE]
    sign = np.sign(vector[order[0]])
    terms = [
        f"{'+' if sign * vector[i] > 0 else '−'} {abs(vector[i]):.2f}·{names[i]}" for i in order
    ]
    combination = " ".join(terms).removeprefix("+ ") + "  (in prior standard deviations)"
    who = " and ".join(names[i] for i in order)
    if len(order) == 1:
        words = f"{who}: these readings say nothing of it; its interval is the prior's"
    else:
        words = (
            f"{who}: only another combination of them is measured; this one keeps the prior's width"
        )
    exact = " (exactly)" if value < 1e-8 else ""
    return {"combination": combination, "in_words": words + exact}
