"""The uncertainty budget of a compensated value, after JCGM 100 (GUM), at a chosen operating point.

Two tables split the same variance, correlations included:

- *by coefficient*: sensitivity c = ∂value/∂θ, contribution |c|·u(θ), and the share c_i·Σ_j C_ij·c_j/u², which adds up
  to one and may be negative where correlation takes away (JCGM 100, 5.2.2);
- *by source*: where the posterior's width comes from. With J the Jacobian of the readings, Σ their noise and D the
  prior covariance at the fit, P = (JᵀΣ⁻¹J + D⁻¹)⁻¹ splits exactly into P·JᵀΣ⁻¹J·P, the noise of the calibration's
  readings (Type A), and P·D⁻¹·P, a sum over the priors (Type B): the nuisance angles among them, which do not act
  in use and yet set how well a bias is known.

What the sampling of spreads and shapes adds to that linear split is its own row, "spreads, shapes, curvature".
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fitted import PREDICTIVE_CELLS
from bayescal._compensation import inversion
from bayescal._compensation.compensator import Compensator, compensator
from bayescal._core.errors import InputError
from bayescal._core.jit import compiled
from bayescal._inference import laplace
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout
from bayescal._readings.units import coefficient_factor, convert, needs_gravity, same_dimension

REST = "spreads, shapes, curvature"
READINGS = "noise of the calibration's readings"


@dataclass(frozen=True)
class Contribution:
    """One coefficient's part.

    Attributes:
        name, unit: of the coefficient, as reported.
        value, uncertainty: posterior mean and standard uncertainty, in that unit.
        sensitivity: ∂value/∂coefficient, stimulus unit per reported unit.
        contribution: |sensitivity|·uncertainty, stimulus unit.
        share: of the variance, correlations included.
    """

    name: str
    unit: str
    value: float
    uncertainty: float
    sensitivity: float
    contribution: float
    share: float


@dataclass(frozen=True)
class SourceShare:
    """One source's part: kind "A" (from the readings), "B" (a prior) or "" (the rest); share of the variance."""

    name: str
    kind: str
    contribution: float
    share: float


@dataclass(frozen=True)
class Budget:
    """An uncertainty budget.

    Attributes:
        stimulus, unit: what the value is of.
        at: operating point: the stimulus and every covariate, in `at_units`.
        at_units: the fixed units.
        reading: expected there, in `output_unit`.
        output_unit: of the instrument's readings.
        uncertainty: combined standard uncertainty of the compensated value, without the noise of the reading.
        noise: standard uncertainty that the noise of one reading adds, stimulus unit.
        k: coverage factor.
        coefficients, sources: the two tables.
        covariance: of the coefficients, in their order, reported units.
    """

    stimulus: str
    unit: str
    at: dict[str, float]
    at_units: dict[str, str]
    reading: float
    output_unit: str
    uncertainty: float
    noise: float
    k: float
    coefficients: tuple[Contribution, ...]
    sources: tuple[SourceShare, ...]
    covariance: np.ndarray

    @property
    def expanded(self) -> float:
        """k times the combined standard uncertainty, without the noise of the reading."""
        return self.k * self.uncertainty

    @property
    def expanded_reading(self) -> float:
        """The same with the noise of one reading."""
        return self.k * float(np.hypot(self.uncertainty, self.noise))

    @property
    def correlation(self) -> np.ndarray:
        sd = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.where(sd > 0, np.outer(sd, sd), 1.0)

    def shown(self) -> Budget:
        """The same as people read it: in the unit of the readings where the stimulus is of their kind, angles of the
        operating point in degrees."""
        to = self.output_unit
        if to == self.unit or not same_dimension(self.unit, to) or needs_gravity(self.unit, to):
            to = self.unit
        factor = coefficient_factor(self.unit, to)
        coefficients = tuple(
            replace(c, sensitivity=factor * c.sensitivity, contribution=factor * c.contribution)
            for c in self.coefficients
        )
        degrees = {n: "deg" if unit == "rad" else unit for n, unit in self.at_units.items()}
        return replace(
            self,
            unit=to,
            at={n: float(convert(v, self.at_units[n], degrees[n])) for n, v in self.at.items()},
            at_units=degrees,
            uncertainty=factor * self.uncertainty,
            noise=factor * self.noise,
            coefficients=coefficients,
            sources=tuple(replace(s, contribution=factor * s.contribution) for s in self.sources),
        )

    def data(self) -> dict[str, Any]:
        """As JSON, in fixed units."""
        return {
            **asdict(self),
            "expanded": self.expanded,
            "expanded_reading": self.expanded_reading,
            "covariance": self.covariance.tolist(),
        }

    def __str__(self) -> str:
        from bayescal._diagnostics.text import (
            budget_text,
        )  # tables for people stand above this floor

        return budget_text(self.shown())


def budget(
    calibration: Calibration | Compensator,
    at: Mapping[str, float] | None = None,
    *,
    k: float = 2.0,
) -> Budget:
    """The uncertainty budget of a compensated value.

    Args:
        calibration: a fit, or a compensator of one.
        at: operating point: the stimulus and covariates by name, fixed units. Left out are the middle of the
            calibrated range; zero for the stimulus where that is not known, and for rates and lags.
        k: coverage factor of the expanded uncertainty.

    Raises:
        InputError: a name that the calibration does not know, or k is not positive.
        ModelError: the instrument does not say what it measures.
    """
    chosen = compensator(calibration) if isinstance(calibration, Calibration) else calibration
    if chosen.calibration is None or chosen.equation is None:
        raise InputError("a loaded compensator has no posterior: give the calibration itself")
    if not (np.isfinite(k) and k > 0):
        raise InputError(f"k = {k}: a coverage factor is a positive number, such as 2")
    point = _operating_point(chosen, dict(at or {}))
    found = inversion.at_point(
        chosen.equation, chosen._inverse.reference, chosen._known.mean, point, chosen._inverse.names
    )
    gradient = 0.0 - found.gradient / found.slope
    covariance = chosen._known.covariance
    variance = float(gradient @ covariance @ gradient)
    return Budget(
        chosen.stimulus,
        chosen.unit,
        point,
        _units_of(chosen),
        found.expected,
        chosen.output_unit,
        variance**0.5,
        chosen.noise / abs(found.slope),
        float(k),
        _by_coefficient(chosen, gradient, variance),
        _by_source(chosen, gradient, variance),
        covariance,
    )


def _units_of(chosen: Compensator) -> dict[str, str]:
    return {chosen.stimulus: chosen.unit, **{i.name: i.unit for i in chosen.inputs}}


def _operating_point(chosen: Compensator, at: dict[str, float]) -> dict[str, float]:
    inputs = {i.name: i for i in chosen.inputs}
    for name, value in at.items():
        if name != chosen.stimulus and name not in inputs:
            raise InputError(
                f"{name!r} plays no part in this compensation; what does: "
                f"{', '.join([chosen.stimulus, *inputs])}"
            )
        if not np.isfinite(value):
            raise InputError(f"{name} = {value}: give a finite number")
    low, high = chosen.stimulus_range or (0.0, 0.0)
    point = {chosen.stimulus: 0.5 * (low + high)}
    for name, i in inputs.items():
        point[name] = 0.5 * (i.low + i.high) if i.kind in ("column", "elapsed") else 0.0
    return {**point, **{n: float(v) for n, v in at.items()}}


def _by_coefficient(
    chosen: Compensator, gradient: np.ndarray, variance: float
) -> tuple[Contribution, ...]:
    known = chosen._known
    pulled = known.covariance @ gradient
    assert chosen.equation is not None
    rows = []
    for i, entry in enumerate(chosen.equation.entries()):
        sd, c = float(known.covariance[i, i] ** 0.5), float(gradient[i])
        share = c * float(pulled[i]) / variance if variance > 0 else 0.0
        rows.append(
            Contribution(entry.name, entry.unit, float(known.mean[i]), sd, c, abs(c) * sd, share)
        )
    return tuple(rows)


def _by_source(
    chosen: Compensator, gradient: np.ndarray, variance: float
) -> tuple[SourceShare, ...]:
    """The split by what the calibration knew: noise, each prior, each deviation that is new in use."""
    calibration, equation = chosen.calibration, chosen.equation
    assert calibration is not None and equation is not None
    parts: dict[tuple[str, str], float] = {}
    weights = np.zeros(_size(calibration))
    places = _places(calibration)
    for i, entry in enumerate(equation.entries()):
        if entry.kind == "new":
            parts[entry.name, "B"] = gradient[i] ** 2 * chosen._known.covariance[i, i]
        elif entry.name in places:
            place, scale = places[entry.name]
            weights[place] += gradient[i] * scale
    if weights.any():
        noise, priors = _posterior_split(calibration, weights)
        parts[READINGS, "A"] = noise
        for name, value in priors.items():
            parts[f"prior of {name}", "B"] = value
    rest = variance - sum(parts.values())
    rows = [
        SourceShare(name, kind, value**0.5, value / variance if variance > 0 else 0.0)
        for (name, kind), value in sorted(parts.items(), key=lambda p: -p[1])
    ]
    share = rest / variance if variance > 0 else 0.0
    rows.append(SourceShare(REST, "", float(np.sign(rest) * abs(rest) ** 0.5), share))
    return tuple(rows)


def _size(calibration: Calibration) -> int:
    return calibration.layout.size + len(calibration.layout.moving)


def _places(calibration: Calibration) -> dict[str, tuple[int, float]]:
    """Where an unknown in use stands in the linearised fit (x, then shapes and promoted ones), and its unit there:
    coordinates of shapes are standard normal, so a reported unit is dvalue/dv of them."""
    layout, v = calibration.layout, calibration.mode.v
    found: dict[str, tuple[int, float]] = {}
    for b in layout.x_blocks:
        names = b.member_names(calibration.levels)
        found |= {name: (b.start + i, 1.0) for i, name in enumerate(names)}
    promoted = {}
    for b in layout.blocks:
        if b.place == "phi":
            members = b.member_names(calibration.levels)
            promoted |= dict(zip(b.member_names(), members, strict=True))
    for place, i in enumerate(layout.moving):
        h = layout.hypers[i]
        step = 1e-6
        slope = float((h.prior.value(v[i] + step) - h.prior.value(v[i] - step)) / (2 * step))
        found[promoted.get(h.name, h.name)] = (layout.size + place, slope)
    return found


@compiled
def _information(layout: Layout, frame: Frame, y: Array, mode: Any):
    """Information of the readings in units of the prior; prior standard deviations; 0 where a prior is flat."""
    null = laplace.linearised(layout, frame, y, mode)
    scaled = null.nuisance * null.prior.sd
    gram = layout.model.noise.gram(scaled, null.residual, null.extra, null.hyper, frame)
    return gram.jtj, null.prior.sd, null.prior.weight


def _posterior_split(
    calibration: Calibration, weights: np.ndarray
) -> tuple[float, dict[str, float]]:
    """Variance of weights·(x, shapes) that comes from the readings' noise, and from each prior."""
    layout, y = calibration.layout, jnp.asarray(calibration.readings["output"])
    found = _information(layout, calibration.frame, y, calibration.mode)
    information, sd, weight = (np.asarray(a) for a in found)
    try:
        pulled = np.linalg.solve(information + np.diag(weight), weights * sd)
    except np.linalg.LinAlgError:
        return float("nan"), {}
    noise = max(0.0, float(pulled @ information @ pulled))  # zero, but for rounding
    names = [b.name for b in layout.x_blocks for _ in range(b.size)]
    names += [layout.hypers[i].name for i in layout.moving]
    priors: dict[str, float] = {}
    for name, value in zip(names, weight * pulled**2, strict=True):
        priors[name] = priors.get(name, 0.0) + float(value)
    return noise, {n: v for n, v in priors.items() if v > 0}


def prior_sensitivity(calibration: Calibration) -> Any:
    """How much each posterior moves when the prior, or the likelihood, is scaled a little (ArviZ's psense).

    Returns:
        ArviZ's table: columns prior, likelihood (sensitivities; above 0.05 matters) and diagnosis; a row for each
        unknown.

    Raises:
        InputError: no unknown has a proper prior.
    """
    import xarray as xr
    from arviz_stats.psense import psense_summary  # a second that only this needs

    tree = calibration.tree
    if not len(tree["log_prior"].data_vars):
        raise InputError("every prior is flat: there is no prior to be sensitive to")
    likelihood, sizes = calibration.log_likelihood(), tree["posterior"].sizes
    keep = PREDICTIVE_CELLS // max(1, sizes["chain"] * len(calibration.readings))
    step = -(-sizes["draw"] // max(1, min(sizes["draw"], keep)))
    priors = tree["log_prior"].to_dataset()
    posterior = tree["posterior"].to_dataset()
    own = [  # what is held at an estimate has no distribution to move
        n
        for n in posterior
        if "reading" not in posterior[n].dims
        and float(posterior[n].std()) > 1e-12 * abs(float(posterior[n].mean()))
    ]
    thinned = {
        "posterior": posterior[own].isel(draw=slice(None, None, step)),
        "log_prior": priors[[n for n in priors if "reading" not in priors[n].dims]].isel(
            draw=slice(None, None, step)
        ),
        "log_likelihood": likelihood,
    }
    return psense_summary(xr.DataTree.from_dict(thinned))
