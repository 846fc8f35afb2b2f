"""The ArviZ DataTree of a calibration: its draws, priors, replicated readings and data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from bayescal._calibration.fitted import PREDICTIVE_CELLS, Fitted, named
from bayescal._calibration.on_readings import replicate
from bayescal._core.atomic_file import renamed, storable
from bayescal._inference.method import Draws
from bayescal._model.parameters import CoefficientBlock, Layout
from bayescal._model.prior import HalfCauchy, HalfNormal

PRIOR_DRAWS = 1000  # for the groups of ArviZ's tree, as many as a picture of a prior needs
STEP = 1e-3  # of a coordinate, for the slope of a prior's value
TINY = float(np.finfo(float).tiny)


def build_tree(calibration: Fitted, cells: int = PREDICTIVE_CELLS) -> xr.DataTree:
    """All groups of a calibration's tree, with so many replicated readings at most.

    `draws` beside ArviZ's own groups holds the same joint draws as plain vectors x and v, from which
    everything else can be computed again.
    """
    c, draws = calibration, calibration.joint
    layout, readings = c.layout, c.readings

    def values(x: np.ndarray, v: np.ndarray) -> xr.Dataset:
        return named(c.unknowns, c.unknowns.values(x, v))

    vectors = xr.Dataset(
        {
            "x": (("chain", "draw", "x_entry"), draws.x),
            "v": (("chain", "draw", "v_entry"), draws.v),
        }
    )
    units = {"units": readings.unit("output")}
    thin, chains = c.thinned(cells)
    made = replicate(c.problem, thin, np.random.default_rng([c.seed, 1]))
    made = made.reshape(chains, -1, len(readings)) + (readings["output"] - c.frame["output"])
    groups = {
        "posterior": c.posterior,
        "log_prior": _log_prior(layout, values(draws.x, draws.v), draws),
        "posterior_predictive": xr.Dataset({"output": (("chain", "draw", "reading"), made, units)}),
        "sample_stats": xr.Dataset(),
        "observed_data": xr.Dataset({"output": ("reading", readings["output"], units)}),
        "constant_data": readings.to_xarray().drop_vars("output"),
        "draws": vectors,
    }
    prior = _prior_draws(c)
    groups = {name: _numbered(group, draws.x.shape[1]) for name, group in groups.items()}
    if prior is not None:
        groups["prior"] = _numbered(values(*prior), PRIOR_DRAWS)
    return xr.DataTree.from_dict({n: renamed(group, storable) for n, group in groups.items()})


def with_log_likelihood(tree: xr.DataTree, calibration: Fitted) -> xr.DataTree:
    """A copy of a calibration's tree with the group `log_likelihood`, all groups of the posterior thinned alike."""
    count = calibration.joint.x.shape[1]
    density = renamed(_numbered(calibration.log_likelihood(), count), storable)
    groups = {name: child.to_dataset() for name, child in tree.children.items()}
    for name, group in groups.items():
        if name != "prior" and group.sizes.get("draw") == count:
            groups[name] = group.isel(draw=density["draw"].values)
    return xr.DataTree.from_dict({**groups, "log_likelihood": density})


def _numbered(group: xr.Dataset, count: int) -> xr.Dataset:
    """Chains and draws by number, which ArviZ's pictures count on; thinned draws by theirs among all `count`."""
    if "draw" not in group.sizes:
        return group
    chains, size = group.sizes["chain"], group.sizes["draw"]
    step = -(-count // size)
    # Indices of pandas: xarray would load Dask to look at arrays.
    return group.assign_coords(
        chain=pd.RangeIndex(chains), draw=pd.RangeIndex(0, step * size, step)
    )


def _log_prior(layout: Layout, posterior: xr.Dataset, draws: Draws) -> xr.Dataset:
    """Log prior density of each unknown in its own unit, given the hyper-parameters, per draw; no flat ones."""
    found: dict[str, tuple] = {}
    fixed = dict(layout.model.fixed)
    for i, h in enumerate(layout.hypers):
        if h.kind == "promoted" or h.name not in posterior:
            continue
        density = h.prior.log_density(draws.v[..., i]) - np.log(_slope(h.prior, draws.v[..., i]))
        found[h.name] = (("chain", "draw"), np.asarray(density))
    for b in layout.blocks:
        if b.place == "fixed" or b.coefficient.flat or b.name not in posterior:
            continue
        if b.index in b.effect.held:
            continue
        spread = fixed.get(b.group_sd_name, b.coefficient.size)
        if b.group_sd_name in posterior.data_vars:  # `get` would take ".group_sd" for an attribute
            spread = posterior[b.group_sd_name]
        if b.effect.weights is not None:
            spread = _weighted(b, posterior, fixed)
        z = (posterior[b.name] - b.coefficient.mean) / spread
        log_spread = np.log(np.asarray(spread))  # of a DataArray NumPy would load Dask
        if isinstance(spread, xr.DataArray):
            log_spread = spread.copy(data=log_spread)
        density = -0.5 * z**2 - log_spread - 0.5 * np.log(2 * np.pi)
        found[b.name] = (posterior[b.name].dims, density.transpose(*posterior[b.name].dims).values)
    return xr.Dataset(found)


def _weighted(
    block: CoefficientBlock, posterior: xr.Dataset, fixed: dict[str, float]
) -> xr.DataArray:
    """Prior standard deviations of a coefficient whose size is an amplitude's."""
    effect = block.effect
    names = {n: f"{effect.name}.{n}" for n in effect.weight_shapes}
    at = [posterior[n] if n in posterior else xr.DataArray(fixed[n]) for n in names.values()]

    def sd(*values: np.ndarray) -> np.ndarray:
        named = dict(zip(names, (v[..., None] for v in values), strict=True))
        made = effect.weights(**named)  # pyright: ignore[reportOptionalCall]
        made = np.maximum(made, TINY)  # the last ones of a curve that hardly bends underflow
        return np.broadcast_to(made, (*np.shape(made)[:-1], len(effect.coefficients)))[
            ..., block.index
        ]

    return xr.apply_ufunc(sd, *at)


def _slope(prior: Any, v: np.ndarray) -> np.ndarray:
    """Of a value by its coordinate: differences of the fourth order."""
    value, h = prior.value, STEP
    return (8 * (value(v + h) - value(v - h)) - (value(v + 2 * h) - value(v - 2 * h))) / (12 * h)


def _prior_draws(calibration: Fitted) -> tuple[np.ndarray, np.ndarray] | None:
    """Joint draws (x, v) from the prior, as one chain; none where a prior is flat."""
    layout, problem = calibration.layout, calibration.problem
    if layout.improper:
        return None
    random = np.random.default_rng([calibration.seed, 2])
    v = random.standard_normal((PRIOR_DRAWS, len(layout.hypers)))
    for i, h in enumerate(layout.hypers):
        if isinstance(h.prior, HalfCauchy):
            v[:, i] = random.standard_cauchy(PRIOR_DRAWS)
        if isinstance(h.prior, (HalfCauchy, HalfNormal)):
            v[:, i] = np.log(np.abs(v[:, i]))
    sd = problem.prior(problem.hyper(v.T), np.ones(problem.size), (PRIOR_DRAWS,)).sd
    x = problem.mean_of_x + sd * random.standard_normal(sd.shape)
    return x[None], v[None]
