"""The ArviZ DataTree of a calibration: its draws, priors, replicated readings and data."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from bayescal._calibration.fitted import MAX_CELLS, Fitted, replicate, to_xarray
from bayescal._core.atomic_file import encode_name
from bayescal._model.prior import HalfCauchy, HalfNormal

PRIOR_DRAWS = 1000  # of the group `prior`: enough to plot a prior density


def build_tree(c: Fitted) -> xr.DataTree:
    """Compute all groups of a calibration's tree; see `Calibration.tree`."""
    readings, dims = c.readings, ("chain", "draw", "reading")
    units = {"units": readings.unit("output")}
    draws, chains = c.thin_draws(MAX_CELLS)
    outputs = replicate(c.problem, draws, np.random.default_rng([c.seed, 1]))
    outputs = outputs.reshape(chains, -1, len(readings)) + (readings["output"] - c.frame["output"])
    groups = {
        "posterior": c.posterior,
        "posterior_predictive": xr.Dataset({"output": (dims, outputs, units)}),
        "observed_data": xr.Dataset({"output": ("reading", readings["output"], units)}),
        "constant_data": readings.to_xarray().drop_vars("output"),
    }
    groups = {name: _for_netcdf(group, c.joint.x.shape[1]) for name, group in groups.items()}
    if not c.layout.is_improper:
        prior = to_xarray(c.unknowns, c.unknowns.values(*_prior_draws(c)))
        groups["prior"] = _for_netcdf(prior, PRIOR_DRAWS)
    return xr.DataTree.from_dict(groups)


def with_log_likelihood(tree: xr.DataTree, calibration: Fitted) -> xr.DataTree:
    """Copy a calibration's tree and add `log_likelihood`; all posterior groups have the same thinned draws."""
    count = calibration.joint.x.shape[1]
    density = _for_netcdf(calibration.log_likelihood(), count)
    groups = {name: child.to_dataset() for name, child in tree.children.items()}
    for name, group in groups.items():
        if name != "prior" and group.sizes.get("draw") == count:
            groups[name] = group.isel(draw=density["draw"].values)
    return xr.DataTree.from_dict({**groups, "log_likelihood": density})


def _for_netcdf(group: xr.Dataset, count: int) -> xr.Dataset:
    """Rename a group's variables for NetCDF and add chain and draw coordinates; thinned draws keep their index."""
    if "draw" in group.sizes:  # ArviZ's plots need the coordinates
        step = -(-count // group.sizes["draw"])
        # Indices of pandas: xarray would load Dask to look at arrays.
        draws = pd.RangeIndex(0, step * group.sizes["draw"], step)
        group = group.assign_coords(chain=pd.RangeIndex(group.sizes["chain"]), draw=draws)
    names = {str(n): encode_name(str(n)) for n in (*group.variables, *group.dims)}
    return group.rename({name: new_name for name, new_name in names.items() if name != new_name})


def _prior_draws(c: Fitted) -> tuple[np.ndarray, np.ndarray]:
    """Draw (x, v) from the prior, as one chain."""
    random = np.random.default_rng([c.seed, 2])
    v = random.standard_normal((PRIOR_DRAWS, len(c.layout.hypers)))
    for i, h in enumerate(c.layout.hypers):
        if isinstance(h.prior, HalfCauchy):
            v[:, i] = random.standard_cauchy(PRIOR_DRAWS)
        if isinstance(h.prior, (HalfCauchy, HalfNormal)):
            v[:, i] = np.log(np.abs(v[:, i]))
    sd = c.problem.prior(c.problem.hyper(v.T), np.ones(c.problem.size), (PRIOR_DRAWS,)).sd
    x = c.problem.mean_of_x + sd * random.standard_normal(sd.shape)
    return x[None], v[None]
