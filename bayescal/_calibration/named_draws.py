"""Names and units put to draws: one variable for each unknown."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from bayescal._model import forward
from bayescal._model.parameters import Layout, Levels


def named(
    layout: Layout, levels: Levels, x: np.ndarray, rows: np.ndarray, v: np.ndarray
) -> xr.Dataset:
    """Draws (chains, draws, …) as one variable per unknown, in its reported unit."""

    def one(x, rows, v):
        return forward.coefficients(layout, x, rows, forward.hyper_values(layout, v))

    if (
        not layout.row_blocks
    ):  # XLA spends seconds and gigabytes on an empty array that has a place for each reading
        rows = rows[:, :, :1]
    coordinates_of_phi = jnp.asarray(v)
    values = jax.vmap(jax.vmap(one))(jnp.asarray(x), jnp.asarray(rows), coordinates_of_phi)
    found: dict[str, tuple] = {}
    coordinates: dict[str, list[str]] = {}
    for b in layout.blocks:
        if b.place == "fixed":
            continue
        value, dims = np.asarray(values[b.name]), ("chain", "draw")
        if b.coefficient.per is None:
            value = value[..., 0]
        else:
            dims = (*dims, b.coefficient.per)
            if b.coefficient.per != "reading":
                coordinates[b.coefficient.per] = list(levels[b.coefficient.per])
        found[b.name] = (dims, value, {"units": b.coefficient.unit, "effect": b.effect.name})
    for i, h in enumerate(layout.hypers):
        if h.kind != "promoted":
            value = np.asarray(h.prior.value(coordinates_of_phi[..., i]))
            found[h.name] = (("chain", "draw"), value, {"units": h.unit, "kind": h.kind})
    return xr.Dataset(found, coords=coordinates)
