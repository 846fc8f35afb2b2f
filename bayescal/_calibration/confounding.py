"""Confounding: recorded columns collinear with a model's terms, and common rounding errors of a column.

A recorded column without a known effect gets prior probability 1/2 of a linear effect, with a normal coefficient whose
standard deviation is half the rms of the model's own terms in the output. In the model linearised at its mode, the
coefficient's posterior and its log Bayes factor are closed-form, and so is the shift of the other coefficients. A
column orthogonal to the model's terms shifts none. If a column is collinear with the thermometer, only the sum of both
effects is identified, and the prior divides it. The squared shift, averaged over presence and absence of the effect, is
added to each coefficient's variance. Posterior means remain those of the model, which hold in the test conditions.

A rounded or truncated column may have a common error of up to half a step in all readings. It is treated as a column
whose effect is certain, with standard deviation step/√12 times the derivative of the output with respect to the column.
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
from bayescal._core.renamed import renamed
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import same_dimension
from bayescal._inference.linear_model import LinearModel
from bayescal._model.frame import list_covariates, strip_rate
from bayescal._model.model import Model
from bayescal._model.parameters import Layout

TIME_COLUMNS = ("time", "elapsed")
AMPLITUDE_SHARE = 0.5  # prior sd of a column's effect over the rms of the model's own terms


@renamed(of_column="label")
class Confounder(NamedTuple):
    """A recorded column, collinear with model terms or rounded, that increases the uncertainty of coefficients."""

    column: str
    coefficients: list[str]  # names of the single coefficients whose uncertainty it increases
    told: float  # tolerance: residual over total sum of squares, model columns projected out
    # Standard uncertainty added to each coefficient, by name and member, reported unit; signed: fully correlated.
    shares: dict[str, list[float]]
    step: float = 0.0  # rounding step, unit of the column; 0 for a collinear column

    @property
    def claim(self) -> Claim:
        """Return the claim that names the column and the coefficients."""
        numbers = {"column": self.column, "told": self.told, "grid": self.step}
        numbers |= {"vary": strip_rate(self.column)}
        combination = f"{' and '.join(self.coefficients)} and {self.label}"
        code = "column.rounded" if self.step else "direction.confounded"
        return Claim(code, *self.coefficients, **numbers, combination=combination)

    @property
    def label(self) -> str:
        """Return the column's name; for a rounded column, "half a step of" and the name."""
        return f"half a step of {self.column}" if self.step else self.column


def find_confounders(
    linear_model: LinearModel,
    columns: Mapping[str, Float[np.ndarray, "n"]],
    steps: Mapping[str, tuple[float, Float[np.ndarray, "n"]]],
) -> tuple[Confounder, ...]:
    """Find unmodelled or rounded columns that increase a coefficient's standard uncertainty by a fifth or more."""
    layout, sd, x = linear_model.problem.layout, linear_model.sd, linear_model.mode.x
    indices = np.flatnonzero(is_single_coefficient(layout))
    if not len(indices):
        return ()
    z = (x - linear_model.problem.mean_of_x)[indices] / np.where(sd > 0, sd, 1.0)[indices]
    amplitude = AMPLITUDE_SHARE * float(np.std(linear_model.nuisance[:, indices] @ z))
    # An unmodelled effect enters the first slot (term of the equation) in the output's unit, or that of each axis.
    instrument, vector = layout.model.instrument, layout.model.instrument.vector
    slots = [s.name for s in instrument.slots if s.unit == instrument.unit]
    slots = slots[:1] if vector is None else [n for n in slots if n not in vector.rig]
    candidates = [
        (name, amplitude * (values - values.mean()) / values.std() * linear_model.slopes[slot], 0.0)
        for name, values in columns.items()
        for slot in slots
    ]
    candidates += [(n, step / math.sqrt(12.0) * slope, step) for n, (step, slope) in steps.items()]
    slices, confounders = {b.name: b.x_slice for b in layout.x_blocks}, list[Confounder]()
    for name, values, step in candidates:
        # The whitened, scaled column a, its projection P·a on the model's columns, and K = |a − P·a|².
        column = linear_model.whiten(values[:, None])[:, 0]
        projection = linear_model.project_on_nuisance(column[:, None])[:, 0]
        norm2 = float(column @ column)
        remainder = max(norm2 - float(projection @ projection), 0.0)
        # Log Bayes factor of a standard normal coefficient, u = aᵀr: ½·u²/(1 + K) − ½·log(1 + K).
        score, ratio = float(column @ linear_model.white_conditional), 1 + remainder
        probability = 1.0 if step else float(expit(0.5 * (score**2 / ratio - math.log(ratio))))
        second_moment = probability * (1 / ratio + (score / ratio) ** 2)
        shifts = math.sqrt(second_moment) * find_shifts(linear_model, column[:, None])[:, 0]
        if np.any(is_widened := mask_widened(linear_model, shifts)):
            shares = {n: shifts[part].tolist() for n, part in slices.items() if shifts[part].any()}
            widened_names = [n for n, part in slices.items() if is_widened[part].any()]
            confounders.append(Confounder(name, widened_names, remainder / norm2, shares, step))
    return tuple(confounders)


def is_single_coefficient(layout: Layout) -> Bool[np.ndarray, "p"]:
    """Mask the single coefficients: all but group deviations, weights of curves and coefficients of a rig's slots."""
    vector = layout.model.instrument.vector
    rig = () if vector is None else vector.rig
    is_single = [
        b.coefficient.group_sd is None and b.effect.weights is None and b.slot not in rig
        for b in layout.x_blocks
    ]
    return np.repeat(np.array(is_single, dtype=bool), [b.size for b in layout.x_blocks])


def find_shifts(linear_model: LinearModel, columns: np.ndarray) -> Float[np.ndarray, "p k"]:
    """Return the shift of the posterior mean of x caused by adding each whitened column (n, k), of coefficient one."""
    p, projections = linear_model.problem.layout.size, linear_model.project_on_nuisance(columns)
    return -(linear_model.root[:p] * linear_model.sd[:p, None]) @ projections


def mask_widened(linear_model: LinearModel, added_sd: np.ndarray) -> Bool[np.ndarray, "p"]:
    """Mask the single coefficients whose standard uncertainty grows by a fifth or more with `added_sd` (p,) added."""
    p = linear_model.problem.layout.size
    sd = np.linalg.norm(linear_model.root[:p] * linear_model.sd[:p, None], axis=1)
    is_wider = np.hypot(added_sd, sd) > (1 + limit("direction.confounded", "widening")) * sd
    return is_single_coefficient(linear_model.problem.layout) & is_wider


def find_unmodelled_columns(
    model: Model, readings: Measurements
) -> dict[str, Float[np.ndarray, "n"]]:
    """Return varying columns, by name, neither modelled, nor time, nor declared or of a declared column's dimension."""
    # The catalogue has named effects of declared quantities (a second thermometer, a set point) and of time.
    declared_names = {c.name for c in model.instrument.columns}
    excluded_names = declared_names | model.columns | {*TIME_COLUMNS}
    units = [readings.unit(n) for n in declared_names & {*readings.columns}]
    units, columns = [u for u in units if u not in (None, "1", "s")], dict[str, np.ndarray]()
    for name, values in list_covariates(readings).items():
        column = strip_rate(name)
        unit = readings.unit(column) if readings.has(column) else None
        is_declared = any(unit and same_dimension(unit, str(u)) for u in units)
        if not ({name, column} & excluded_names or is_declared) and np.ptp(values) > 0:
            columns[name] = values
    return columns


def widen_draws(
    x: Float[np.ndarray, "chains draws p"], columns: Sequence[Confounder], layout: Layout, seed: int
) -> Float[np.ndarray, "chains draws p"]:
    """Add the confounders' variance to draws of the coefficients, without changing their mean."""
    for i, confounder in enumerate(columns):
        # Normal quantiles in random order: exact moments, without sampling noise.
        count = x.shape[0] * x.shape[1]
        deviates = ndtri((np.arange(count) + 0.5) / count)
        permutation = np.random.default_rng([seed, 3, i]).permutation(count)
        deviates = (deviates / deviates.std())[permutation].reshape(*x.shape[:2], 1)
        x_shares = [confounder.shares.get(b.name, [0.0] * b.size) for b in layout.x_blocks]
        x = x + deviates * np.concatenate([np.zeros(0), *x_shares])
    return x
