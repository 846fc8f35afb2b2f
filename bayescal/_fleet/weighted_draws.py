"""Weighted joint draws of many data sets of one shape, by importance sampling: programs are compiled once.

For simulation studies and for decisions that need whole draws; `fit_batch` keeps means and covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from bayescal._calibration.posterior_tree import named
from bayescal._core.errors import InputError, ModelError
from bayescal._core.importance_weights import smoothed
from bayescal._data.measurements import Measurements
from bayescal._fleet.fit_devices import drawn
from bayescal._inference import sampled_products
from bayescal._inference.laplace import Mode
from bayescal._inference.marginal import Marginal
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, bind


@dataclass(frozen=True)
class Batch:
    """Weighted joint draws of many data sets.

    Attributes:
        layout: of the model, common to all.
        log_weight: (b, s), not normalised.
        x, v: (b, s, p) and (b, s, d).
        mode: φ̂ and x̂ of each.
        log_evidence: (b,).
        pareto_k: (b,).
    """

    layout: Layout
    levels: dict[str, tuple[str, ...]]
    log_weight: np.ndarray
    x: np.ndarray
    rows: np.ndarray
    v: np.ndarray
    mode: Mode
    log_evidence: np.ndarray
    pareto_k: np.ndarray

    def weights(self) -> np.ndarray:
        """Pareto-smoothed weights, summing to one for each data set, (b, s)."""
        return np.stack([smoothed(w)[0] for w in self.log_weight])

    def samples(self, index: int) -> dict[str, np.ndarray]:
        """Draws of every unknown of one data set, (s,) or (s, members), to be weighted."""
        made = named(
            self.layout, self.levels, *(a[index][None] for a in (self.x, self.rows, self.v))
        )
        return {str(name): made[name].values[0] for name in made}


def weighted_draws(
    model: Model, readings: Sequence[Measurements], method: Marginal | None = None, *, seed: int = 0
) -> Batch:
    """Fit one model to many data sets of one shape, each on its own, without compiling anew.

    Args:
        model: must have Gaussian noise.
        readings: data sets with equal columns, numbers of rows and group sizes.
        method: `Marginal`, whose `proposals`, `rounds` and `promote` count.
        seed: of every random number.

    Raises:
        InputError: the data sets differ in shape.
        ModelError: the noise law is not Gaussian, or a name to promote is no coefficient of the model.
    """
    method = Marginal() if method is None else method
    if not model.noise.gaussian:
        raise ModelError(
            f"weighted_draws needs Gaussian noise, not {model.noise.law}: fit one by one"
        )
    each = []
    for one in readings:
        model.require(one)
        each.append((*bind(model, one), build_frame(one, reference_of(one))))
    shapes = {(str(jax.tree.map(np.shape, frame)), own.counts) for own, _, frame in each}
    if len(shapes) != 1:
        raise InputError(
            f"weighted_draws needs data sets of one shape; these {len(readings)} have {len(shapes)} different "
            "ones (rows, columns or group sizes differ)"
        )
    ys = [np.asarray(one["output"]) for one in readings]
    layout, levels, frame = each[0]
    first = Problem(layout, Record(model.instrument, frame, ys[0]))
    layout = sampled_products.choose(first, method.promote or ())[0].layout
    made = [
        drawn(layout, frame, y, method, seed, i)
        for i, ((*_, frame), y) in enumerate(zip(each, ys, strict=True))
    ]
    draws, modes = zip(*made, strict=True)

    def stacked(name: str) -> np.ndarray:
        return np.stack([getattr(one, name) for one in draws])

    return Batch(
        layout=layout,
        levels=levels,
        log_weight=stacked("log_weight"),
        x=stacked("x"),
        rows=stacked("rows"),
        v=stacked("v"),
        mode=jax.tree.map(lambda *a: np.stack(a), *modes),
        log_evidence=stacked("log_evidence"),
        pareto_k=np.array([smoothed(one.log_weight)[1] for one in draws]),
    )
