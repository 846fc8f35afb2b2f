"""How much of what a calibration knows comes from its priors, and how much from the readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from bayescal._calibration.calibration import Calibration
from bayescal._core.atomic_file import named_back
from bayescal._core.errors import InputError


@dataclass(frozen=True)
class VarianceByOrigin:
    """Two kinds of variance that add up to that of the linearised posterior.

    Attributes:
        readings: from the noise of the readings.
        priors: from the prior of each unknown, by its name; those of nothing left out.
    """

    readings: float
    priors: dict[str, float]


def variance_by_origin(
    calibration: Calibration, slopes: Mapping[str, float]
) -> VarianceByOrigin | None:
    """Where the variance of Σ slope·unknown comes from.

    With J the Jacobian of the readings, Σ their noise and D the prior covariance at the fit, the linearised
    posterior covariance P = (JᵀΣ⁻¹J + D⁻¹)⁻¹ splits exactly into P·JᵀΣ⁻¹J·P and P·D⁻¹·P, a sum over priors.

    Args:
        calibration: a fit.
        slopes: by name of the coefficient, member ("bias.run(3)") or shape, per reported unit; what is no unknown
            of the fit is passed over.

    Returns:
        The split; None if no unknown of the fit counts. Not a number where the readings and priors leave a
        direction open.
    """
    layout, linear = calibration.layout, calibration.linear
    moving = layout.moving
    weights = np.zeros(layout.size + len(moving))
    places = _places(calibration, moving)
    for name, slope in slopes.items():
        if name in places:
            place, unit = places[name]
            weights[place] += slope * unit
    if not weights.any():
        return None
    proper = linear.weight
    information = linear.white_nuisance.T @ linear.white_nuisance  # in units of the priors
    try:
        pulled = np.linalg.solve(information + np.diag(proper), weights * linear.sd)
    except np.linalg.LinAlgError:
        return VarianceByOrigin(float("nan"), {})
    readings = max(0.0, float(pulled @ information @ pulled))  # zero, but for rounding
    names = [b.name for b in layout.x_blocks for _ in range(b.size)]
    names += [layout.hypers[i].name for i in moving]
    priors: dict[str, float] = {}
    for name, value in zip(names, proper * pulled**2, strict=True):
        priors[name] = priors.get(name, 0.0) + float(value)
    return VarianceByOrigin(readings, {n: v for n, v in priors.items() if v > 0})


def _places(calibration: Calibration, moving: list[int]) -> dict[str, tuple[int, float]]:
    """Where an unknown stands in the linearised fit (x, then shapes and promoted ones), and its unit: dvalue/dv."""
    layout, v = calibration.layout, np.asarray(calibration.mode.v)
    found: dict[str, tuple[int, float]] = {}
    promoted: dict[str, str] = {}
    for b in layout.blocks:
        if b.place == "x":
            names = b.member_names(calibration.levels)
            found |= {name: (b.start + i, 1.0) for i, name in enumerate(names)}
        elif b.place == "phi":
            promoted |= dict(zip(b.member_names(), b.member_names(calibration.levels), strict=True))
    for place, i in enumerate(moving):
        h, step = layout.hypers[i], 1e-6
        slope = float((h.prior.value(v[i] + step) - h.prior.value(v[i] - step)) / (2 * step))
        found[promoted.get(h.name, h.name)] = (layout.size + place, slope)
    return found


def prior_sensitivity(calibration: Calibration) -> Any:
    """How much each posterior moves when the prior, or the likelihood, is scaled a little (ArviZ's psense).

    Returns:
        ArviZ's table: columns prior, likelihood (sensitivities; above 0.05 matters) and diagnosis; a row for each
        unknown.

    Raises:
        InputError: no unknown has a proper prior.
    """
    from arviz_stats.psense import psense_summary  # a second that only this needs

    priors, posterior = (calibration.tree[n].to_dataset() for n in ("log_prior", "posterior"))
    if not len(priors.data_vars):
        raise InputError("every prior is flat: there is no prior to be sensitive to")
    likelihood = calibration.log_likelihood()
    step = -(-posterior.sizes["draw"] // likelihood.sizes["draw"])
    priors, posterior = (
        group.drop_vars([n for n in group.data_vars if "reading" in group[n].dims])
        for group in (priors, posterior)
    )
    spread, size = posterior.std(), abs(posterior.mean())
    moved = [n for n in posterior.data_vars if float(spread[n]) > 1e-12 * float(size[n])]
    posterior = posterior[moved]  # what is held at an estimate has nothing to move
    every = slice(None, None, step)
    thinned = {"posterior": posterior.isel(draw=every), "log_prior": priors.isel(draw=every)}
    tree = xr.DataTree.from_dict({**thinned, "log_likelihood": likelihood})
    return psense_summary(tree).rename(index=named_back)
