"""Many devices of one type, each by itself: what `fit` gives of it, one by one or all at once.

A device is fitted by `fit`: its result is the mean and covariance of that posterior, and what stands against it. Least
squares of plain devices, against which nothing can stand, has a closed form but for one number, the noise, that gives
the same: the expected output is affine in the coefficients, their priors are fixed and proper, the noise is white. With
x₀ the ordinary least squares, r what it leaves, s prior standard deviations, m prior means and U·diag(d)·Vᵀ the
singular value decomposition of J·s, the restricted likelihood of the noise σ is

    −2 log L(σ) = n log σ² + |r|²/σ² + Σ log(1 + d²/σ²) + d²w²/(σ² + d²),     w = Vᵀ·(x₀ − m)/s,

and the coefficients stand σ²/(σ² + d²) of w from x₀ toward their priors. A device is no plain one where L has several
maxima or a coefficient stands far from its prior's mean (the noise may take up what a prior forbids), where outputs are
so far from zero that digits are lost, and where a unit may be wrong.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).

Devices of equally many readings are one record, whose arrays have a leading axis.
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
from bayescal._annexes.fleet.engine import NOT_REACHED
from bayescal.workshop import build_frame, reference_of

Reference = dict[str, Any]  # constants of bases

PLAIN_SD = 3.0  # prior standard deviations that a coefficient stands from its prior's mean, at most
PLAIN_SHARE = 1e-5  # of two sizes, above which neither is in a wrong unit
PLAIN_DIGITS = 1e6  # times the noise, up to which an output keeps enough of its digits
JACOBIAN_TOLERANCE = 1e-9  # of a Jacobian, up to which devices together have that of each alone
ROUNDS = 60  # of σ² and the degrees of freedom that coefficients leave
DIGITS = 1e-12  # of σ², to which it is the same from below and from above
LEAST_NOISE = 1e-24  # share of the readings' variance, below which the noise counts as none
NOISE = "noise.white"


@dataclass(frozen=True)
class FitOptions:
    """How every device is fitted."""

    method: ws.Method  # of every fit
    seed: int  # of every random number
    reference: Reference  # constants of the bases, in place of each device's own

    def reference_for(self, readings: bc.Measurements) -> Reference:
        """Return the constants of a device."""
        of_readings = reference_of(readings)
        return of_readings | {n: v for n, v in self.reference.items() if n in of_readings}


def tailored(model: bc.Model, readings: bc.Measurements) -> bc.Model:
    """Return the model of the instrument tailored to one device's readings, if it can be; what was changed stays."""
    general = model.instrument
    specific = general.for_readings(readings)
    old, tailored = ({e.name: e for e in (*i.effects, *i.candidates)} for i in (general, specific))
    effects = (tailored.get(e.name, e) if e == old.get(e.name) else e for e in model.effects)
    noise = specific.noise if model.noise == general.noise else model.noise
    return bc.Model(specific, tuple(effects), noise, model.fixed)


def fit_devices(
    models: Mapping[str, bc.Model],
    devices: Mapping[str, bc.Measurements],
    options: FitOptions,
    starts: Mapping[str, Mapping[str, float]],
) -> dict[str, DeviceResult]:
    """Fit each device by its model, from `starts`, plain ones together; refuse those that the deadline leaves out."""
    results, deadline = dict[str, DeviceResult](), ws.deadline.current()
    with suppress(ws.deadline.TimeIsUp):
        for some in _fit_linear_devices(models, devices, options):
            results |= some
            deadline.defer_interrupt()
            deadline.ask()
        for name in [name for name in devices if name not in results]:
            start = starts.get(name, {})
            results[name] = fit_alone(models[name], devices[name], options, start)
            deadline.defer_interrupt()
            deadline.ask()
    not_reached = DeviceResult(reason=NOT_REACHED.format(deadline.why))
    return dict.fromkeys(devices, not_reached) | results


def fit_alone(
    model: bc.Model, readings: bc.Measurements, options: FitOptions, start: Mapping[str, float]
) -> DeviceResult:
    """Fit one device by `fit`: the moments of its posterior, and what stands against it."""
    reference = options.reference_for(readings)
    how: dict[str, Any] = {"seed": options.seed, "reference": reference, "start": start}
    try:
        fitted = bc.fit(model, readings, options.method, strict=False, **how)
    except bc.BayescalError as error:
        return DeviceResult(reason=str(error))
    table, of = fitted.values.reshape(-1, len(fitted.unknowns)), fitted.unknowns
    covariance = np.atleast_2d(np.cov(table.T))
    constant = np.ptp(table, axis=0) == 0
    covariance[constant], covariance[:, constant] = np.nan, np.nan
    reason, t0 = " ".join(map(str, _against(fitted))), float(fitted.reference.get("T0", np.nan))  # pyright: ignore
    moments = of.names, of.units, table.mean(axis=0), covariance, len(readings), t0
    return DeviceResult("", reason, *moments)


def _against(fitted: bc.Calibration) -> Sequence[Any]:
    """Return what stands against a device that was fitted by itself."""
    if not fitted.verdict.ok:
        return fitted.verdict.reasons
    free = fitted.layout.size
    if NOISE not in dict(fitted.model.fixed) and len(fitted.readings) <= free:
        return [ws.Claim("readings.too_few", count=len(fitted.readings), free=free)]
    return [claim] if (claim := ws.explain_missing_noise(fitted)) else fitted.conflicts


# Devices all at once ----------------------------------------------------------------------------------------------


def _fit_linear_devices(
    models: Mapping[str, bc.Model], devices: Mapping[str, bc.Measurements], options: FitOptions
) -> Iterator[dict[str, DeviceResult]]:
    """Fit devices whose outputs depend on the effects of one model alone, and on these linearly."""
    distinct_models = {id(model): model for model in models.values()}
    if not isinstance(options.method, bc.LeastSquares) or len(distinct_models) != 1:
        return
    (model,) = distinct_models.values()
    columns = ({c.name for c in model.instrument.columns} | model.columns) - {ws.UNCERTAINTY}
    groups: dict[Any, list[str]] = {}
    for name, device in devices.items():
        numbers = {n for n in device.columns if device.unit(n) is not None}
        if numbers <= columns and {*model.columns} <= {*device.columns}:
            groups.setdefault((len(device), *device.columns), []).append(name)
    for (count, *_), names in groups.items():
        some = [devices[name] for name in names]
        if model.with_nuisances(some[0]) is not model:
            continue
        references = [options.reference_for(device) for device in some]
        frames = [build_frame(d, r) for d, r in zip(some, references, strict=True)]
        problem = _together(model, some[0], frames)
        if problem is None:
            continue
        with np.errstate(all="ignore"):  # of devices that are no plain ones
            plain, x, covariance, sd = _solve(problem, *_linearise(problem))
        if NOISE not in dict(model.fixed):
            x = np.column_stack([x, sd])
            covariance = np.pad(covariance, ((0, 0), (0, 1), (0, 1)), constant_values=np.nan)
        of = ws.Unknowns.of(problem.layout)
        t0 = [r.get("T0", np.nan) for r in references]
        yield {
            names[k]: DeviceResult("", "", of.names, of.units, x[k], covariance[k], count, t0[k])
            for k in np.flatnonzero(plain)
        }


def _stack(arrays: Sequence[Any]) -> Any:
    """Return arrays of several devices with a leading axis, also within dictionaries."""
    if not isinstance(arrays[0], Mapping):
        return np.stack(arrays)
    return {name: _stack([array[name] for array in arrays]) for name in arrays[0]}


def _together(
    model: bc.Model, first: bc.Measurements, frames: Sequence[bc.Frame]
) -> ws.Problem | None:
    """Return a model on the readings of several devices at once; None where it has no closed form, or not together."""
    layout = ws.bind(model, first, reference=frames[0].reference)[0]
    plain = all(
        b.place != "input" and b.coefficient.per is None and not b.coefficient.flat
        for b in layout.blocks
    )
    sized = 0 < layout.size < len(first) and not any(e.open for e in model.effects)
    if not (
        plain and sized and model.noise.first and all(h.kind == "noise" for h in layout.hypers)
    ):
        return None
    try:
        together = bc.Frame(**_stack([*map(vars, frames)]))
        constants = {n: v[:, None] for n, v in together.reference.items()}
        frame = replace(together, reference=constants, silence=together.silence[:, None])
        problem, alone = (
            ws.Problem(layout, ws.Record(model.instrument, f, f["output"]))
            for f in (frame, frames[0])
        )
        if alone.affine:
            # A basis may be of all readings that it is given, a response of one device's.
            jacobian, single = _linearise(problem)[1][0], _linearise(alone)[1]
            atol = JACOBIAN_TOLERANCE * np.max(np.abs(single))
            how = {"rtol": JACOBIAN_TOLERANCE, "atol": atol}
            return problem if np.allclose(jacobian, single, **how) else None
    except (ValueError, TypeError, LookupError, bc.BayescalError):  # of two axes
        pass
    return None


def _linearise(
    problem: ws.Problem,
) -> tuple[Float[np.ndarray, "*b n"], Float[np.ndarray, "*b n p"]]:
    """Return what priors' means leave of the outputs, and the Jacobian."""
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    line = problem.linearise_dynamic(problem.mean_of_x, hyper, problem.terms)
    return problem.record.y - line.mean, line.jacobian


def _solve(
    problem: ws.Problem, y: Float[np.ndarray, "b n"], jacobian: Float[np.ndarray, "b n p"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return which devices are plain (b,), their coefficients (b, p), covariances (b, p, p) and σ (b,).

    Args:
        problem: of all.
        y: outputs less those expected at the priors' means.
        jacobian: by the coefficients.
    """
    n, p = jacobian.shape[1:]
    scale = problem.sizes.evaluate(problem.fixed_values)
    columns = jacobian * scale
    base, upper = np.linalg.qr(columns)
    diagonal = np.abs(np.diagonal(upper, axis1=1, axis2=2))
    determined = np.all(diagonal > PLAIN_SHARE * np.linalg.norm(columns, axis=1), axis=1)
    upper = np.where(determined[:, None, None], upper, np.eye(p))
    residual, z0 = y, np.zeros((len(y), p, 1))
    for _ in range(2):  # a second time for the digits of outputs far from zero
        step = np.linalg.solve(upper, base.mT @ residual[:, :, None])
        residual, z0 = residual - (columns @ step)[:, :, 0], z0 + step
    _, d, vt = np.linalg.svd(upper)
    rss, d2, w = np.sum(residual**2, axis=1), d**2, (vt @ z0)[:, :, 0]
    if NOISE in problem.fixed_values:
        variance, alone = np.full(len(y), problem.fixed_values[NOISE] ** 2), True
    else:
        variance, alone = _noise_variance(n - p, rss, d2 * w**2, d2)
    share, sd = variance[:, None] / (variance[:, None] + d2), np.sqrt(variance)
    z = (z0 - vt.mT @ (share * w)[:, :, None])[:, :, 0]
    covariance = scale[:, None] * (vt.mT * share[:, None] @ vt) * scale
    x, output = problem.mean_of_x + scale * z, problem.record.y
    range_, reach = np.ptp(output, axis=1), np.max(np.abs(columns), axis=1)
    plain = (
        determined
        & alone
        & np.all(np.abs(z) < PLAIN_SD, axis=1)
        & (rss > LEAST_NOISE * np.sum(y**2, axis=1))
        & (sd < range_)
        & np.all((PLAIN_SHARE * reach < sd[:, None]) & (PLAIN_SHARE * sd[:, None] < reach), axis=1)
        & (PLAIN_DIGITS * np.minimum(sd, range_) > np.max(np.abs([output, y]), axis=(0, 2)))
        & np.all(np.isfinite(x), axis=1)
    )
    return plain, x, covariance, sd


def _noise_variance(
    free: int,
    rss: Float[np.ndarray, "b"],
    c2: Float[np.ndarray, "b p"],
    d2: Float[np.ndarray, "b p"],
) -> tuple[Float[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
    """Return the σ² of greatest restricted likelihood, and whether it is so from below and from above.

    There it is the squares of the residuals over the degrees of freedom that they have, which are found in turn as
    `LeastSquares` finds them: from where noise explains none of the readings, and from where it explains all.

    Args:
        free: readings less coefficients.
        rss: sums of squares that no column explains.
        c2, d2: squares along the singular vectors, and of the singular values.
    """
    s = np.stack([rss / free, (rss + np.sum(c2, axis=1)) / (free + d2.shape[1])])
    for _ in range(ROUNDS):
        share = s[:, :, None] / (s[:, :, None] + d2)
        s = (rss + np.sum(share**2 * c2, axis=2)) / (free + np.sum(share, axis=2))
    return s[0], np.abs(s[1] / s[0] - 1) < DIGITS
