"""What a model does not hold and coefficients may hide: columns that ran with it, and half a step of a rounded one.

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
from bayescal._model.frame import derived, measured_column
from bayescal._model.model import Model
from bayescal._model.parameters import Layout

IN_TIME = ("time", "elapsed")
SIZE = 0.5  # of a column's effect, in parts of what the model's own terms change the output by


class Confounder(NamedTuple):
    """A column that may have acted in the place of coefficients, or is off by a part of its step."""

    column: str
    coefficients: list[str]  # names of those that stand for themselves and are less certain for it
    told: float  # part of its squares that the model's own columns leave
    # The standard uncertainty that it adds to each coefficient, by name and member, reported unit; signed, as they
    # move together.
    shares: dict[str, list[float]]
    step: float = 0.0  # to which it is rounded or cut off, its unit; 0 if it ran with the model

    @property
    def claim(self) -> Claim:
        """What ran with what."""
        told = {"column": self.column, "told": self.told, "grid": self.step}
        told |= {"vary": measured_column(self.column)}
        combination = f"{' and '.join(self.coefficients)} and {self.of_column}"
        code = "column.rounded" if self.step else "direction.confounded"
        return Claim(code, *self.coefficients, **told, combination=combination)

    @property
    def of_column(self) -> str:
        """What of the column it is, in words."""
        return f"half a step of {self.column}" if self.step else self.column


def confounders(
    linear: LinearModel,
    columns: Mapping[str, Float[np.ndarray, "n"]],
    steps: Mapping[str, tuple[float, Float[np.ndarray, "n"]]],
) -> tuple[Confounder, ...]:
    """Of columns of no known cause, and of rounded ones (step, slope of the output by it), those that add a fifth or
    more to the standard uncertainty of a coefficient of a model."""
    layout, sd = linear.problem.layout, linear.sd
    main = np.flatnonzero(stand_alone(layout))
    if not len(main):
        return ()
    x = (linear.mode.x - linear.problem.mean_of_x)[main] / np.where(sd > 0, sd, 1.0)[main]
    size = SIZE * float(np.std(linear.nuisance[:, main] @ x))
    # Something unknown would add to the first slot in the output's unit, of three axes to each axis' own.
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
    parts = {b.name: b.at for b in layout.x_blocks}
    found = list[Confounder]()
    for name, values, step in acting:
        # The column at its size, whitened; what the model's columns take of it, P, and leave, K.
        column = linear.whiten(values[:, None])[:, 0]
        taken = linear.projected(column[:, None])[:, 0]
        whole = float(column @ column)
        left = max(whole - float(taken @ taken), 0.0)
        # Of a standard normal coefficient: log Bayes factor ½·u²/(1 + K) − ½·log(1 + K).
        pull, inner = float(column @ linear.white_settled), 1 + left
        acts = 1.0 if step else float(expit(0.5 * (pull**2 / inner - math.log(inner))))
        second_moment = acts * (1 / inner + (pull / inner) ** 2)
        added = math.sqrt(second_moment) * given_up(linear, column[:, None])[:, 0]
        if np.any(wider := widened_by(linear, added)):
            shares = {n: added[at].tolist() for n, at in parts.items() if added[at].any()}
            concerned = [n for n, at in parts.items() if wider[at].any()]
            found.append(Confounder(name, concerned, left / whole, shares, step))
    return tuple(found)


def stand_alone(layout: Layout) -> Bool[np.ndarray, "p"]:
    """Which coefficients are those of a law: no deviation of a group, no part of a curve, nothing of a rig's own."""
    vector = layout.model.instrument.vector
    rig = () if vector is None else vector.rig
    alone = [
        b.coefficient.group_sd is None and b.effect.weights is None and b.slot not in rig
        for b in layout.x_blocks
    ]
    return np.repeat(np.array(alone, dtype=bool), [b.size for b in layout.x_blocks])


def given_up(linear: LinearModel, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "p k"]:
    """By how much a model's coefficients would stand elsewhere beside further ones of one standard deviation each."""
    p = linear.problem.layout.size
    return -(linear.root[:p] * linear.sd[:p, None]) @ linear.projected(columns)


def widened_by(linear: LinearModel, added: Float[np.ndarray, "p"]) -> Bool[np.ndarray, "p"]:
    """Which coefficients of a law are a fifth or more less certain by so many standard deviations."""
    p = linear.problem.layout.size
    known = np.linalg.norm(linear.root[:p] * linear.sd[:p, None], axis=1)
    wider = np.hypot(added, known) > (1 + limit("direction.confounded", "widening")) * known
    return stand_alone(linear.problem.layout) & wider


def unexplained(model: Model, readings: Measurements) -> dict[str, Float[np.ndarray, "n"]]:
    """Columns that no effect is a function of; not what the instrument declares, nor what measures the same quantity as
    that does: another thermometer, a set point. Nor time: what drifts or warms up has names, and sizes that are stated,
    with which a search weighs it."""
    declared = {c.name for c in model.instrument.columns}
    known = declared | model.columns | {*IN_TIME}
    units = [readings.unit(n) for n in declared & {*readings.columns}]
    units = [u for u in units if u not in (None, "1", "s")]
    found = dict[str, np.ndarray]()
    for name, values in derived(readings).items():
        column = measured_column(name)
        unit = readings.unit(column) if readings.has(column) else None
        alike = any(unit and same_dimension(unit, str(u)) for u in units)
        if np.ptp(values) > 0 and name not in known and column not in known and not alike:
            found[name] = values
    return found


def widened(
    x: Float[np.ndarray, "chains draws p"], found: Sequence[Confounder], layout: Layout, seed: int
) -> Float[np.ndarray, "chains draws p"]:
    """Draws of the coefficients that hold what columns may have done: of the same mean."""
    for i, one in enumerate(found):
        # Quantiles of the normal distribution in a random order: its moments, and not those of the draws' luck.
        count = x.shape[0] * x.shape[1]
        normal = ndtri((np.arange(count) + 0.5) / count)
        order = np.random.default_rng([seed, 3, i]).permutation(count)
        normal = (normal / normal.std())[order].reshape(*x.shape[:2], 1)
        own = [one.shares.get(b.name, [0.0] * b.size) for b in layout.x_blocks]
        x = x + normal * np.concatenate([np.zeros(0), *own])
    return x
