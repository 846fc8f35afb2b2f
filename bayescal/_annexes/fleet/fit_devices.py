"""Fits of many devices of one type: each by `fit`, or many jointly in closed form, with the same result.

The result of a device is the mean and covariance of its posterior, and its failed checks. The least-squares fit of a
*regular* device, which passes all checks, has a closed form except for the noise σ: its expected output is affine in
the coefficients, their priors are fixed and proper, and its noise is white. With J the Jacobian, x₀ the ordinary
least-squares estimate, r its n residuals, s the prior standard deviations, m the prior means and U·diag(d)·Vᵀ the
singular value decomposition of J·s, the restricted likelihood of σ is

    −2 log L(σ) = n log σ² + |r|²/σ² + Σ log(1 + d²/σ²) + d²w²/(σ² + d²),     w = Vᵀ·(x₀ − m)/s,

and the coefficients are shrunk from x₀ toward m by the fraction σ²/(σ² + d²) of w. A device is not regular if L has
several maxima, if a coefficient is far from its prior mean (the noise may absorb what a prior excludes), if its outputs
are so far from zero that digits are lost, or if a unit may be wrong.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).

Devices with the same number of readings are fitted as one record, whose arrays have a leading axis over devices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

import bayescal as bc
from bayescal import workshop as ws
from bayescal._annexes.fleet.batch_result import DeviceResult
from bayescal._annexes.fleet.engine import NOT_PROCESSED
from bayescal.workshop import build_frame, reference_of

Reference = dict[str, Any]  # constants of bases

MAX_PRIOR_DISTANCE_SD = 3.0  # of a regular device's coefficient from its prior mean
MIN_SIZE_RATIO = 1e-5  # between noise and column sizes; below it a unit may be wrong
MAX_OUTPUT_TO_NOISE = 1e6  # up to which an output keeps enough digits
JACOBIAN_RTOL = 1e-9  # between the joint and a single device's Jacobian
NOISE_ITERATIONS = 60  # of σ² and the effective degrees of freedom
VARIANCE_RTOL = 1e-12  # between the σ² iterated from below and from above
MIN_RSS_FRACTION = 1e-24  # residual over total sum of squares, below which the noise counts as zero
NOISE_NAME = "noise.white"


@dataclass(frozen=True)
class Request:
    """Model to fit to every device, and the options of the fits and searches."""

    model: bc.Model
    method: ws.Method  # method of inference
    seed: int  # of the random numbers
    reference: Reference  # given constants; the others are those of each device's readings
    find: bool  # whether to search each device for missing effects
    candidates: tuple[bc.Effect, ...]  # user-defined effects for that search

    def choose_reference(self, readings: bc.Measurements) -> Reference:
        """Return the reference constants of a device: the given ones, the others computed from its readings."""
        constants = reference_of(readings)
        return constants | {n: v for n, v in self.reference.items() if n in constants}


def fit_devices(
    models: Mapping[str, bc.Model],
    devices: Mapping[str, bc.Measurements],
    request: Request,
    starts: Mapping[str, Mapping[str, float]],
) -> dict[str, DeviceResult]:
    """Fit each device with its model, regular devices jointly; reject devices not fitted before the deadline."""
    results, deadline = dict[str, DeviceResult](), ws.deadline.current()
    with suppress(ws.deadline.TimeIsUp):
        for group_results in _fit_regular_devices(models, devices, request):
            results |= group_results
            deadline.defer_interrupt()
            deadline.raise_if_over()
        for name in [name for name in devices if name not in results]:
            start = starts.get(name, {})
            results[name] = fit_device(models[name], devices[name], request, start)
            deadline.defer_interrupt()
            deadline.raise_if_over()
    not_processed = DeviceResult(reason=NOT_PROCESSED.format(deadline.reason))
    return dict.fromkeys(devices, not_processed) | results


def fit_device(
    model: bc.Model, readings: bc.Measurements, request: Request, start: Mapping[str, float]
) -> DeviceResult:
    """Fit one device by `fit`; return its posterior moments and failed checks."""
    reference = request.choose_reference(readings)
    options: dict[str, Any] = {"seed": request.seed, "reference": reference, "start": start}
    try:
        fitted = bc.fit(model, readings, request.method, strict=False, **options)
    except bc.BayescalError as error:
        return DeviceResult(reason=str(error))
    draws, unknowns = fitted.values.reshape(-1, len(fitted.unknowns)), fitted.unknowns
    covariance = np.atleast_2d(np.cov(draws.T))
    is_constant = np.ptp(draws, axis=0) == 0
    covariance[is_constant], covariance[:, is_constant] = np.nan, np.nan
    reason, t0 = " ".join(map(str, _list_failed_checks(fitted))), fitted.reference.get("T0", np.nan)
    moments = unknowns.names, unknowns.units, draws.mean(axis=0), covariance
    return DeviceResult("", reason, *moments, len(readings), float(t0))  # pyright: ignore


def _list_failed_checks(fitted: bc.Calibration) -> Sequence[Any]:
    """Return the failed checks of a single device's fit."""
    if not fitted.verdict.ok:
        return fitted.verdict.reasons
    n_coefficients = fitted.layout.size
    if NOISE_NAME not in dict(fitted.model.fixed) and len(fitted.readings) <= n_coefficients:
        return [ws.Claim("readings.too_few", count=len(fitted.readings), free=n_coefficients)]
    return [claim] if (claim := ws.explain_missing_noise(fitted)) else fitted.conflicts


# Joint fits -------------------------------------------------------------------------------------------------------


def _fit_regular_devices(
    models: Mapping[str, bc.Model], devices: Mapping[str, bc.Measurements], request: Request
) -> Iterator[dict[str, DeviceResult]]:
    """Fit the regular devices jointly, if all have one model that is affine; yield results, by name, of each group."""
    distinct_models = {id(model): model for model in models.values()}
    if not isinstance(request.method, bc.LeastSquares) or len(distinct_models) != 1:
        return
    (model,) = distinct_models.values()
    columns = ({c.name for c in model.instrument.columns} | model.columns) - {ws.UNCERTAINTY}
    groups: dict[Any, list[str]] = {}
    for name, device in devices.items():
        numeric_columns = {n for n in device.columns if device.unit(n) is not None}
        if numeric_columns <= columns and {*model.columns} <= {*device.columns}:
            groups.setdefault((len(device), *device.columns), []).append(name)
    for (count, *_), names in groups.items():
        group = [devices[name] for name in names]
        if model.with_nuisances(group[0]) is not model:
            continue
        references = [request.choose_reference(device) for device in group]
        frames = [build_frame(d, r) for d, r in zip(group, references, strict=True)]
        problem = _bind_jointly(model, group[0], frames)
        if problem is None:
            continue
        with np.errstate(all="ignore"):  # in devices that are not regular
            is_regular, x, covariance, sd = _fit_jointly(problem, *_linearise(problem))
        if NOISE_NAME not in dict(model.fixed):
            x = np.column_stack([x, sd])
            covariance = np.pad(covariance, ((0, 0), (0, 1), (0, 1)), constant_values=np.nan)
        unknowns = ws.Unknowns.of(problem.layout)
        common_fields = "", "", unknowns.names, unknowns.units
        t0 = [r.get("T0", np.nan) for r in references]
        yield {
            names[k]: DeviceResult(*common_fields, x[k], covariance[k], count, t0[k])
            for k in np.flatnonzero(is_regular)
        }


def _stack(arrays: Sequence[Any]) -> Any:
    """Stack arrays of several devices along a leading axis, also within dictionaries."""
    if not isinstance(arrays[0], Mapping):
        return np.stack(arrays)
    return {name: _stack([array[name] for array in arrays]) for name in arrays[0]}


def _bind_jointly(
    model: bc.Model, first: bc.Measurements, frames: Sequence[bc.Frame]
) -> ws.Problem | None:
    """Bind a model to several devices' readings jointly; return None without a closed form, or if Jacobians differ."""
    layout = ws.bind(model, first, reference=frames[0].reference)[0]
    has_fixed_priors = all(
        b.place != "input" and b.coefficient.per is None and not b.coefficient.flat
        for b in layout.blocks
    )
    is_determined = 0 < layout.size < len(first) and not any(e.open for e in model.effects)
    is_white = model.noise.first and all(h.kind == "noise" for h in layout.hypers)
    if not (has_fixed_priors and is_determined and is_white):
        return None
    try:
        stacked_frame = bc.Frame(**_stack([*map(vars, frames)]))
        constants = {n: v[:, None] for n, v in stacked_frame.reference.items()}
        frame = replace(stacked_frame, reference=constants, max_gap=stacked_frame.max_gap[:, None])
        problem, single_problem = (
            ws.Problem(layout, ws.Record(model.instrument, f, f["output"]))
            for f in (frame, frames[0])
        )
        if single_problem.is_affine:
            # A basis may depend on all readings in its frame: then a device alone has another Jacobian.
            jacobian, single_jacobian = _linearise(problem)[1][0], _linearise(single_problem)[1]
            atol = JACOBIAN_RTOL * np.max(np.abs(single_jacobian))
            return problem if np.allclose(jacobian, single_jacobian, JACOBIAN_RTOL, atol) else None
    except (ValueError, TypeError, LookupError, bc.BayescalError):  # two-dimensional arrays
        pass
    return None


def _linearise(
    problem: ws.Problem,
) -> tuple[Float[np.ndarray, "*b n"], Float[np.ndarray, "*b n p"]]:
    """Return the residuals of the outputs at the prior means, and the Jacobian with respect to the coefficients."""
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    linear_model = problem.linearise_dynamic(problem.mean_of_x, hyper, problem.terms)
    return problem.record.y - linear_model.mean, linear_model.jacobian


def _fit_jointly(
    problem: ws.Problem, y: Float[np.ndarray, "b n"], jacobian: Float[np.ndarray, "b n p"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit b devices; return a mask of the regular ones (b,), coefficients (b, p), covariances (b, p, p) and σ (b,).

    Args:
        problem: joint problem of the devices.
        y: residuals of the outputs at the prior means.
        jacobian: Jacobian of the outputs with respect to the coefficients.
    """
    n, p = jacobian.shape[1:]
    scale = problem.sizes.evaluate(problem.fixed_values)
    columns = jacobian * scale
    q, upper = np.linalg.qr(columns)
    diagonal = np.abs(np.diagonal(upper, axis1=1, axis2=2))
    is_determined = np.all(diagonal > MIN_SIZE_RATIO * np.linalg.norm(columns, axis=1), axis=1)
    upper = np.where(is_determined[:, None, None], upper, np.eye(p))
    residual, z0 = y, np.zeros((len(y), p, 1))
    for _ in range(2):  # the second is iterative refinement, for outputs far from zero
        step = np.linalg.solve(upper, q.mT @ residual[:, :, None])
        residual, z0 = residual - (columns @ step)[:, :, 0], z0 + step
    _, d, vt = np.linalg.svd(upper)
    rss, d2, w = np.sum(residual**2, axis=1), d**2, (vt @ z0)[:, :, 0]
    if NOISE_NAME in problem.fixed_values:
        variance, is_unique = np.full(len(y), problem.fixed_values[NOISE_NAME] ** 2), True
    else:
        variance, is_unique = _estimate_noise_variance(n - p, rss, d2 * w**2, d2)
    shrinkage, sd = variance[:, None] / (variance[:, None] + d2), np.sqrt(variance)
    z = (z0 - vt.mT @ (shrinkage * w)[:, :, None])[:, :, 0]
    covariance = scale[:, None] * (vt.mT * shrinkage[:, None] @ vt) * scale
    x, output = problem.mean_of_x + scale * z, problem.record.y
    output_range, sizes = np.ptp(output, axis=1), np.max(np.abs(columns), axis=1)
    noise, max_output = sd[:, None], np.max(np.abs([output, y]), axis=(0, 2))
    is_regular = (
        is_determined
        & is_unique
        & np.all(np.abs(z) < MAX_PRIOR_DISTANCE_SD, axis=1)
        & (rss > MIN_RSS_FRACTION * np.sum(y**2, axis=1))
        & (sd < output_range)
        & np.all((MIN_SIZE_RATIO * sizes < noise) & (MIN_SIZE_RATIO * noise < sizes), axis=1)
        & (MAX_OUTPUT_TO_NOISE * np.minimum(sd, output_range) > max_output)
        & np.all(np.isfinite(x), axis=1)
    )
    return is_regular, x, covariance, sd


def _estimate_noise_variance(
    dof: int,
    rss: Float[np.ndarray, "b"],
    c2: Float[np.ndarray, "b p"],
    d2: Float[np.ndarray, "b p"],
) -> tuple[Float[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
    """Return the restricted-likelihood estimate of σ², and whether iterations from below and from above agree.

    σ² is the residual sum of squares over the effective degrees of freedom, iterated as in `LeastSquares` from two
    starting values: without, and with full, shrinkage of the coefficients to their prior means.

    Args:
        dof: number of readings less number of coefficients.
        rss: residual sums of squares of ordinary least squares.
        c2, d2: d²w² and d² in the restricted likelihood of the module's docstring.
    """
    s = np.stack([rss / dof, (rss + np.sum(c2, axis=1)) / (dof + d2.shape[1])])
    for _ in range(NOISE_ITERATIONS):
        shrinkage = s[:, :, None] / (s[:, :, None] + d2)
        s = (rss + np.sum(shrinkage**2 * c2, axis=2)) / (dof + np.sum(shrinkage, axis=2))
    return s[0], np.abs(s[1] / s[0] - 1) < VARIANCE_RTOL
