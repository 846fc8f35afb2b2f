"""The ArviZ DataTree of a calibration: its draws, priors, replicated readings and data."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from bayescal._calibration.fitted import PREDICTIVE_CELLS, Fitted, flat, named
from bayescal._calibration.on_readings import replicate
from bayescal._calibration.storage import draws_dataset
from bayescal._core.atomic_file import renamed, storable
from bayescal._inference.method import Draws
from bayescal._inference.problem import Problem
from bayescal._model.prior import HalfCauchy, HalfNormal

PRIOR_DRAWS = 1000  # for the groups of ArviZ's tree, as many as a picture of a prior needs
STEP = 1e-3  # of a coordinate, for the slope of a prior's value


def build_tree(calibration: Fitted) -> xr.DataTree:
    """Compute all groups of a calibration's tree; see `Calibration.tree`."""
    c, draws = calibration, calibration.joint
    layout, levels, readings = c.layout, c.levels, c.readings
    units = {"units": readings.unit("output")}
    thin, chains = c.thinned(PREDICTIVE_CELLS)
    made = replicate(c.problem, thin, np.random.default_rng([c.seed, 1]))
    made = made.reshape(chains, -1, len(readings)) + (readings["output"] - c.frame["output"])
    groups = {
        "posterior": c.posterior,
        "log_prior": _log_prior(c.problem, named(layout, levels, draws.x, draws.v), draws),
        "posterior_predictive": xr.Dataset({"output": (("chain", "draw", "reading"), made, units)}),
        "sample_stats": xr.Dataset(),
        "observed_data": xr.Dataset({"output": ("reading", readings["output"], units)}),
        "constant_data": readings.to_xarray().drop_vars("output"),
        "draws": draws_dataset(draws),
    }
    groups = {name: _numbered(group, draws.x.shape[1]) for name, group in groups.items()}
    if (prior := _prior_draws(c)) is not None:
        groups["prior"] = _numbered(named(layout, levels, *prior), PRIOR_DRAWS)
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


def _log_prior(problem: Problem, posterior: xr.Dataset, draws: Draws) -> xr.Dataset:
    """Log prior density of each unknown in its own unit, given the hyper-parameters, per draw; no flat ones."""
    found, layout = dict[str, tuple](), problem.layout
    for i, h in enumerate(layout.hypers):
        if h.kind != "promoted" and h.name in posterior:
            v = draws.v[..., i]
            density = h.prior.log_density(v) - np.log(_slope(h.prior, v))
            found[h.name] = (("chain", "draw"), np.asarray(density))
    terms, v = {(t.known.of, t.index): t for t in problem.terms}, flat(draws.v)
    hyper = problem.hyper(v.T)
    for b in layout.blocks:
        if b.name not in posterior or b.coefficient.flat or b.index in b.effect.held:
            continue
        sd = problem.member_sd(terms[b.effect.name, b.index], hyper, len(v))
        values = posterior[b.name]
        sd = sd.reshape(*draws.v.shape[:2], *(1,) * (values.ndim - 2))
        z = (values.values - b.coefficient.mean) / sd
        found[b.name] = (values.dims, -0.5 * z**2 - np.log(sd) - 0.5 * np.log(2 * np.pi))
    return xr.Dataset(found)


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
