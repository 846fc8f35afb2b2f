"""The whole search beside forward selection by BIC with lmfit, as it is done by hand.

Both get the gyroscope's campaign of the README and its catalogue. lmfit refits every extension of the model by each
effect that is left, shapes included, with columns that the engine has at hand; the search also weighs free curves, the
noise law, sizes, pairs and exchanges. Ours must find what is hidden; what BIC took is told.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayescal._inference.linear_model import linear_model
from bayescal._model.terms import ColumnsOf
from bayescal_models import mems_gyro
from benchmarks.hidden_effects.searched import MOST, Searched
from benchmarks.speed.timing import clocks, interleaved

HIDDEN = {"bias.thermal_lag": 0.05}  # °/s per °C
REPEATS = 3
GOAL = 1.0  # times lmfit's


def forward(searched: Searched) -> list[str]:
    """Effects in the order in which BIC takes them."""
    import lmfit  # pyright: ignore[reportMissingImports]

    base, record = searched.base, searched.structures.record
    line = linear_model(base.problem, base.mode)
    slopes, jacobian, counts = line.slopes, line.line.jacobian, dict(base.problem.layout.counts)
    structures = searched.structures  # of which a body's temperature is no column of a linear model
    effects = {
        n: e
        for n, e in structures.candidates.items()
        if not (e.is_placeholder or structures.moves_a_column(n))
    }

    def columns(name: str, values: tuple[float, ...]) -> np.ndarray:
        effect, made = effects[name], []
        table = record.columns(ColumnsOf.of(effect), values)
        for c, column in zip(effect.coefficients, table.T, strict=True):
            column = slopes[c.slot or effect.slot] * column
            codes = np.zeros(record.size) if c.per is None else record.codes[c.per]
            members = 1 if c.per is None else counts[c.per]
            made += [column * (codes == m) for m in range(members)]
        return np.column_stack(made)

    def bic(names: list[str]) -> float:
        start = lmfit.Parameters()
        for i in range(jacobian.shape[1]):
            start.add(f"base_{i}", value=0.0)
        for at, name in enumerate(names):
            shapes = effects[name].column_shapes
            wide = columns(name, tuple(float(s.prior.value(0.0)) for s in shapes)).shape[1]
            for i in range(wide):
                start.add(f"size_{at}_{i}", value=0.0)
            for i in range(len(shapes)):
                start.add(f"shape_{at}_{i}", value=0.0, min=-3.0, max=3.0)

        def left(p: Any) -> np.ndarray:
            found = p.valuesdict()
            one = line.residual - jacobian @ [found[f"base_{i}"] for i in range(jacobian.shape[1])]
            for at, name in enumerate(names):
                shapes = effects[name].column_shapes
                values = tuple(
                    float(s.prior.value(found[f"shape_{at}_{i}"])) for i, s in enumerate(shapes)
                )
                table = columns(name, values)
                one = one - table @ [found[f"size_{at}_{i}"] for i in range(table.shape[1])]
            return one

        return float(lmfit.minimize(left, start).bic)

    chosen, least = [], bic([])
    while len(chosen) < MOST:
        tried = {name: bic([*chosen, name]) for name in effects if name not in chosen}
        best = min(tried, key=tried.__getitem__)
        if tried[best] >= least:
            break
        chosen, least = [*chosen, best], tried[best]
    return chosen


def stepwise() -> dict[str, Any]:
    """The row.

    Raises:
        RuntimeError: the search misses what is hidden.
    """
    readings, model = mems_gyro.simulate(HIDDEN, seed=1), mems_gyro.INSTRUMENT.baseline()
    searched = Searched.of(model, readings)
    timed = interleaved(
        {"search": lambda: Searched.of(model, readings), "lmfit": lambda: forward(searched)},
        REPEATS,
    )
    best = clocks(timed)
    found, theirs = timed["search"].made, timed["lmfit"].made
    ours = found.reported_names(found.chosen)
    if ours != sorted(HIDDEN):
        raise RuntimeError(f"hidden {HIDDEN}; the search chose {ours}, BIC {theirs}")
    ratio = best["search"] / best["lmfit"]
    return {
        "readings": len(readings),
        "seconds": best,
        "chosen": {"search": ours, "lmfit": theirs},
        "search_over_lmfit": ratio,
        "goal": GOAL,
        "told": f"search {best['search']:.2f} s = {ratio:.2f} × lmfit's (goal {GOAL:.0f}); chosen {', '.join(ours)} "
        f"against {', '.join(theirs)}",
    }
