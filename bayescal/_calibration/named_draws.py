"""Names and units put to draws: one variable for each unknown."""

from __future__ import annotations

import numpy as np
import xarray as xr

from bayescal._model.parameters import Layout, Levels


def named(
    layout: Layout, levels: Levels, x: np.ndarray, rows: np.ndarray, v: np.ndarray
) -> xr.Dataset:
    """Draws (chains, draws, …) as one variable per unknown, in its reported unit."""

    x, rows, v = (np.asarray(a) for a in (x, rows, v))
    hyper = _hyper_values(layout, v)
    row = 0
    found: dict[str, tuple] = {}
    coordinates: dict[str, list[str]] = {}
    for b in layout.blocks:
        if b.place == "fixed":
            continue
        dims = ("chain", "draw")
        if b.place == "row":
            value = rows[..., row]
            row += 1
        elif b.place == "x":
            value = x[..., b.start : b.start + b.size]
        else:
            value = np.stack([hyper[name] for name in b.member_names()], axis=-1)
            if b.coefficient.group_sd is not None:
                value = b.coefficient.mean + hyper[b.group_sd_name][..., None] * value
        if b.coefficient.per is None:
            value = value[..., 0]
        else:
            dims = (*dims, b.coefficient.per)
            if b.coefficient.per != "reading":
                coordinates[b.coefficient.per] = list(levels[b.coefficient.per])
        found[b.name] = (dims, value, {"units": b.coefficient.unit, "effect": b.effect.name})
    for h in layout.hypers:
        if h.kind != "promoted":
            found[h.name] = (("chain", "draw"), hyper[h.name], {"units": h.unit, "kind": h.kind})
    return xr.Dataset(found, coords=coordinates)


def _hyper_values(layout: Layout, v: np.ndarray) -> dict[str, np.ndarray]:
    """The entries of φ by name, (chains, draws) each; fixed ones included."""
    values = {name: np.broadcast_to(value, v.shape[:-1]) for name, value in layout.model.fixed}
    own = {h.name: np.asarray(h.prior.value(v[..., i])) for i, h in enumerate(layout.hypers)}
    return {**values, **own}
