"""Confounding: recorded columns collinear with a model's terms, and half a step of a rounded column.

A column that is no known cause acts or does not, and nothing is known of it: even odds, and if it acts a line in it,
plausibly half as large as all that the model's own terms change the output by. Beside the model, linear about its mode,
this line's coefficient is Gaussian in closed form, its evidence too, and what it takes the other coefficients give up.
Of a column that the readings tell apart little is left, and that improbable; of one that ran with the thermometer they
know the sum alone, and how it is split is the prior's. What coefficients give up, squared and averaged over the column
acting and not, is a term of their variance. Their values stay those of the model: the sum is what is measured, and what
compensates a sensor that is used as it was tested.

Whether a column was rounded or cut off no file tells: all its readings may be half a step off, alike. That is such a
column too, which acts in any case and whose size is known: the step over √12, times the output's slope by it.
Source: J. Hoeting, D. Madigan, A. Raftery and C. Volinsky, Stat. Sci. 14 (1999) 382 (averaging over models).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit, ndtri

from bayescal._calibration.claim import Claim, limit
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import same_dimension
from bayescal._inference.linear_model import LinearModel
from bayescal._model.frame import list_covariates, strip_rate
from bayescal._model.model import Model
from bayescal._model.parameters import Layout

IN_TIME = ("time", "elapsed")
SIZE = 0.5  # of a column's effect, in parts of what the model's own terms change the output by


class Confounder(NamedTuple):
    """A column that may have acted in place of coefficients, or is off by part of its rounding step."""

    column: str
    coefficients: list[str]  # names of the single coefficients that it makes less certain
    told: float  # share of its sum of squares that the model's columns leave
    # Standard uncertainty added to each coefficient, by name and member, reported unit; signed: fully correlated.
    shares: dict[str, list[float]]
    step: float = 0.0  # to which it is rounded or cut off, its unit; 0 if it ran with the model

    @property
    def claim(self) -> Claim:
        """Return the claim that names the column and the coefficients."""
        numbers = {"column": self.column, "told": self.told, "grid": self.step}
        numbers |= {"vary": strip_rate(self.column)}
        combination = f"{' and '.join(self.coefficients)} and {self.of_column}"
        code = "column.rounded" if self.step else "direction.confounded"
        return Claim(code, *self.coefficients, **numbers, combination=combination)

    @property
    def of_column(self) -> str:
        """Return the column's name, or "half a step of" it."""
        return f"half a step of {self.column}" if self.step else self.column


def confounders(
    linear: LinearModel,
    columns: Mapping[str, Float[np.ndarray, "n"]],
    steps: Mapping[str, tuple[float, Float[np.ndarray, "n"]]],
) -> tuple[Confounder, ...]:
    """Find columns of no known cause, and rounded ones (step, slope of the output), that add a fifth or more to the
    standard uncertainty of a coefficient."""
    layout, sd = linear.problem.layout, linear.sd
    main = np.flatnonzero(is_single_coefficient(layout))
    if not len(main):
        return ()
    x = (linear.mode.x - linear.problem.mean_of_x)[main] / np.where(sd > 0, sd, 1.0)[main]
    size = SIZE * float(np.std(linear.nuisance[:, main] @ x))
    # An unknown cause would add to the first slot in the output's unit; of three axes to each axis's.
    instrument = layout.model.instrument
    slots = [s.name for s in instrument.slots if s.unit == instrument.unit]
    vector = instrument.vector
    slots = slots[:1] if vector is None else [n for n in slots if n not in vector.rig]
    acting = [
        (name, size * (values - values.mean()) / values.std() * linear.slopes[slot], 0.0)
        for name, values in columns.items()
        for slot in slots
    ]
    acting += [(name, step / math.sqrt(12.0) * by, step) for name, (step, by) in steps.items()]
    parts = {b.name: b.x_slice for b in layout.x_blocks}
    confounding = list[Confounder]()
    for name, values, step in acting:
        # The column at its size, whitened; its projection on the model's columns, P, and the rest, K.
        column = linear.whiten(values[:, None])[:, 0]
        explained = linear.project_on_nuisance(column[:, None])[:, 0]
        squares = float(column @ column)
        remainder = max(squares - float(explained @ explained), 0.0)
        # Of a standard normal coefficient: log Bayes factor ½·u²/(1 + K) − ½·log(1 + K).
        score, inner = float(column @ linear.white_conditional), 1 + remainder
        acts = 1.0 if step else float(expit(0.5 * (score**2 / inner - math.log(inner))))
        second_moment = acts * (1 / inner + (score / inner) ** 2)
        added = math.sqrt(second_moment) * shifts(linear, column[:, None])[:, 0]
        if np.any(wider := is_widened_by(linear, added)):
            shares = {n: added[at].tolist() for n, at in parts.items() if added[at].any()}
            concerned = [n for n, at in parts.items() if wider[at].any()]
            confounding.append(Confounder(name, concerned, remainder / squares, shares, step))
    return tuple(confounding)


def is_single_coefficient(layout: Layout) -> Bool[np.ndarray, "p"]:
    """Mask the coefficients that are no group deviation, no part of a curve and not of a rig."""
    vector = layout.model.instrument.vector
    rig = () if vector is None else vector.rig
    alone = [
        b.coefficient.group_sd is None and b.effect.weights is None and b.slot not in rig
        for b in layout.x_blocks
    ]
    return np.repeat(np.array(alone, dtype=bool), [b.size for b in layout.x_blocks])


def shifts(linear: LinearModel, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "p k"]:
    """Return the shifts of a model's coefficients by further columns of one standard deviation each."""
    p = linear.problem.layout.size
    return -(linear.root[:p] * linear.sd[:p, None]) @ linear.project_on_nuisance(columns)


def is_widened_by(linear: LinearModel, added: Float[np.ndarray, "p"]) -> Bool[np.ndarray, "p"]:
    """Mask the single coefficients whose standard uncertainty grows by a fifth or more."""
    p = linear.problem.layout.size
    sd = np.linalg.norm(linear.root[:p] * linear.sd[:p, None], axis=1)
    wider = np.hypot(added, sd) > (1 + limit("direction.confounded", "widening")) * sd
    return is_single_coefficient(linear.problem.layout) & wider


def unexplained(model: Model, readings: Measurements) -> dict[str, Float[np.ndarray, "n"]]:
    """Return the columns that no effect depends on, without those that the instrument declares or that measure the same
    quantity (another thermometer, a set point), and without time, whose effects have names and stated sizes."""
    declared = {c.name for c in model.instrument.columns}
    named = declared | model.columns | {*IN_TIME}
    units = [readings.unit(n) for n in declared & {*readings.columns}]
    units = [u for u in units if u not in (None, "1", "s")]
    columns = dict[str, np.ndarray]()
    for name, values in list_covariates(readings).items():
        column = strip_rate(name)
        unit = readings.unit(column) if readings.has(column) else None
        same = any(unit and same_dimension(unit, str(u)) for u in units)
        if np.ptp(values) > 0 and name not in named and column not in named and not same:
            columns[name] = values
    return columns


def widen_draws(
    x: Float[np.ndarray, "chains draws p"], shared: Sequence[Confounder], layout: Layout, seed: int
) -> Float[np.ndarray, "chains draws p"]:
    """Widen draws of the coefficients by the confounders' contributions; the mean is unchanged."""
    for i, confounder in enumerate(shared):
        # Normal quantiles in random order: exact moments, without sampling noise.
        count = x.shape[0] * x.shape[1]
        normal = ndtri((np.arange(count) + 0.5) / count)
        order = np.random.default_rng([seed, 3, i]).permutation(count)
        normal = (normal / normal.std())[order].reshape(*x.shape[:2], 1)
        shares = [confounder.shares.get(b.name, [0.0] * b.size) for b in layout.x_blocks]
        x = x + normal * np.concatenate([np.zeros(0), *shares])
    return x
