"""Many devices of one type, each by itself: what `fit` gives of it, one by one or all at once.

A device is fitted by `fit`: its result is the mean and covariance of that posterior, and what stands against it. Least
squares of plain devices, against which nothing can stand, has a closed form but for one number, the noise, that gives
the same: the expected output is affine in the coefficients, their priors are fixed, the noise is white. With x₀ the
ordinary least squares, r what it leaves, s prior standard deviations, m prior means and U·diag(d)·Vᵀ the singular value
decomposition of the proper columns of J·s beside the flat ones, the restricted likelihood of the noise σ is

    −2 log L(σ) = (n − f) log σ² + |r|²/σ² + Σ log(1 + d²/σ²) + d²w²/(σ² + d²),     w = Vᵀ·(x₀ − m)/s,

f the number of flat coefficients, and the proper coefficients stand σ²/(σ² + d²) of w from x₀ toward their priors. A
device is no plain one where L has several maxima or a coefficient stands far from its prior's mean (the noise may take
up what a prior forbids), where outputs are so far from zero that digits are lost, and where a unit may be wrong.
Source: D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320 (restricted likelihood).

Devices of equally many readings are one record, whose arrays have a leading axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from bayescal import (
    BayescalError,
    Calibration,
    InputError,
    LeastSquares,
    Marginal,
    Measurements,
    Model,
    fit,
)
from bayescal._annexes.fleet.batch_result import Moments
from bayescal._calibration.claim import Claim
from bayescal._calibration.judgement import noiseless
from bayescal._core import deadline
from bayescal._core.settings import unusual
from bayescal._inference.method import Method
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_name, reference_of
from bayescal._model.parameters import bind
from bayescal._model.unknowns import Unknowns
from bayescal.workshop import UNCERTAINTY

Reference = dict[str, Any]  # constants of bases

CHUNK = 4096  # devices fitted at once at most
NUMBERS = 2_000_000  # readings of these at most
PLAIN_SD = 3.0  # prior standard deviations that a coefficient stands from its prior's mean, at most
PLAIN_SHARE = 1e-5  # of two sizes, above which neither is in a wrong unit
PLAIN_DIGITS = 1e6  # times the noise, up to which an output keeps enough of its digits
ALIKE = 1e-9  # of a Jacobian, up to which devices together have that of each alone
GRID = 32  # places for log σ², among which the best one's neighbours bracket the maximum
NEWTON_STEPS = 10  # safeguarded Newton steps in the bracket, to the last digits
LEAST_NOISE = 1e-24  # share of the readings' variance, below which the noise counts as none
NOISE = "noise.white"
NOT_REACHED = "not reached ({}): give more time"


@dataclass(frozen=True)
class FitOptions:
    """How every device is fitted.

    Attributes:
        method: of every fit.
        seed: of every random number.
        chunk: devices fitted at once at most.
        reference: constants of the bases, in place of each device's own.
    """

    method: Method
    seed: int = 0
    chunk: int = CHUNK
    reference: Reference = field(default_factory=dict)

    @classmethod
    def of(
        cls, method: Method | None, seed: int, chunk: int, reference: Reference | None
    ) -> FitOptions:
        """As a user gives them; chains of single devices, minutes each, are left to `fit`.

        Raises:
            InputError: `chunk` is none.
        """
        if chunk < 1:
            raise InputError(f"chunk is {chunk}: give at least 1")
        method = method or LeastSquares()
        method = replace(method, chains=False) if isinstance(method, Marginal) else method
        return cls(method, seed, chunk, dict(reference or {}))

    def with_common(self, reference: Reference) -> FitOptions:
        """With further constants, where none were given."""
        return replace(self, reference={**reference, **self.reference})

    def compared_at(self, facts: pd.DataFrame) -> FitOptions | None:
        """Return how devices are fitted to be compared, at one temperature; None where they are so already."""
        known = facts.loc[:, "T0"].dropna()
        if "T0" in self.reference or known.nunique() < 2:
            return None
        return replace(
            self.with_common({"T0": float(known.median().round())}), method=LeastSquares()
        )

    def reference_for(self, readings: Measurements) -> Reference:
        """Return the constants of a device."""
        known = reference_of(readings)
        return known | {n: v for n, v in self.reference.items() if n in known}

    def data(self, model: Model) -> dict[str, Any]:
        """What was fitted, as a result says it."""
        return {
            "instrument": model.instrument.name,
            "effects": list(model.names),
            "noise": model.noise.law,
            "method": self.method.name,
            "seed": self.seed,
            "reference": {k: v for k, v in self.reference.items() if not isinstance(v, dict)},
            **({"settings": own} if (own := unusual()) else {}),
        }


def temperature_sums(devices: Iterable[Measurements]) -> dict[str, np.ndarray]:
    """Return sum and number of the readings of each column of temperatures, by the name of its reference."""
    total: dict[str, np.ndarray] = {}
    for one in devices:
        for name in (n for n in one.columns if one.unit(n) == "degC" and n != "temperature_point"):
            known = reference_name(name)
            total[known] = total.get(known, np.zeros(2)) + [np.sum(one[name]), len(one)]
    return total


def tailored(model: Model, readings: Measurements) -> Model:
    """The model with its instrument tailored to one device's readings; the same where nothing has to be.

    What it has of the instrument's own (effects, the noise law) is that of the tailored one; what was changed stays. A
    size that was changed is one in parts of what a record shows, as all of the general instrument's are.
    """
    general = model.instrument
    own = general.for_readings(readings)
    if own is general:
        return model
    stated = {e.name: e for e in (*general.effects, *general.candidates)}
    sized = {e.name: e for e in (*own.effects, *own.candidates)}
    parts = {
        e.name: e.coefficients[0].size / stated[e.name].coefficients[0].size
        for e in model.effects
        if e.name in stated and e == replace(stated[e.name], coefficients=e.coefficients)
    }
    effects = tuple(sized.get(e.name, e) if e.name in parts else e for e in model.effects)
    noise = own.noise if model.noise == general.noise else model.noise
    made = Model(own, effects, noise, model.fixed)
    for name, part in parts.items():
        if part != 1:
            made = made.resize(name, part * made.effect(name).coefficients[0].size)
    return made


def fit_devices(
    models: Mapping[int, Model], devices: Mapping[int, Measurements], options: FitOptions
) -> tuple[list[Moments], dict[int, str]]:
    """Fit each device by its model, plain ones of a model together.

    Returns:
        Their moments, and why devices have none or none to rely on; those that the deadline leaves out are refused.
    """
    made, against, left = list[Moments](), dict[int, str](), dict(devices)
    with suppress(deadline.TimeIsUp):
        for moments in _fit_plain(models, devices, options):
            made.append(moments)
            for i in moments.at.tolist():
                del left[i]
            deadline.current().defer_interrupt()
            deadline.current().ask()
        for i in [*left]:
            moments, why = fit_alone(models[i], i, left.pop(i), options)
            made += [] if moments is None else [moments]
            against |= {i: why} if why else {}
            deadline.current().defer_interrupt()
            deadline.current().ask()
    return made, against | dict.fromkeys(left, NOT_REACHED.format(deadline.current().why))


def fit_alone(
    model: Model, index: int, readings: Measurements, options: FitOptions
) -> tuple[Moments | None, str]:
    """Fit one device by `fit`: the moments of its posterior, and what stands against it."""
    how: dict[str, Any] = {"seed": options.seed, "reference": options.reference_for(readings)}
    try:
        found = fit(model, readings, options.method, strict=False, **how)
    except BayescalError as error:
        return None, str(error)
    table = found.values.reshape(-1, len(found.unknowns))
    covariance = np.atleast_2d(np.cov(table.T))
    held = np.ptp(table, axis=0) == 0
    covariance[held], covariance[:, held] = np.nan, np.nan
    facts = np.array([len(readings)]), np.array([float(found.reference.get("T0", np.nan))])  # pyright: ignore
    own = table.mean(axis=0)[None], covariance[None], *facts
    moments = Moments(np.array([index]), found.unknowns.names, found.unknowns.units, *own)
    return moments, " ".join(map(str, _against(found)))


def _against(found: Calibration) -> Sequence[Any]:
    """Return what stands against a device that was fitted by itself."""
    if not found.verdict.ok:
        return found.verdict.reasons
    free = found.layout.size
    if NOISE not in dict(found.model.fixed) and len(found.readings) <= free:
        return [Claim("readings.too_few", count=len(found.readings), free=free)]
    return [said] if (said := noiseless(found)) else found.conflicts


# Devices all at once ----------------------------------------------------------------------------------------------


def _fit_plain(
    models: Mapping[int, Model], devices: Mapping[int, Measurements], options: FitOptions
) -> Iterator[Moments]:
    """Fit devices of which nothing but the effects of one model may have acted on the outputs, and these linearly."""
    different = {id(model): model for model in models.values()}
    if not isinstance(options.method, LeastSquares) or len(different) != 1:
        return
    (model,) = different.values()
    known = {c.name for c in model.instrument.columns} | model.columns
    alike: dict[Any, list[int]] = {}
    for i, one in devices.items():
        numbers = {name for name in one.columns if one.unit(name) is not None}
        if numbers <= known and UNCERTAINTY not in numbers and {*model.columns} <= {*one.columns}:
            alike.setdefault((len(one), *one.columns), []).append(i)
    for (count, *_), every in alike.items():
        most = min(options.chunk, max(1, NUMBERS // count))
        for begin in range(0, len(every), most):
            some = every[begin : begin + most]
            moments = _together(model, np.array(some), [devices[i] for i in some], options)
            if moments is not None:
                yield moments


def _together(
    model: Model, at: np.ndarray, devices: Sequence[Measurements], options: FitOptions
) -> Moments | None:
    """Fit those of some devices that are plain."""
    references = [options.reference_for(one) for one in devices]
    frames = [build_frame(*each) for each in zip(devices, references, strict=True)]
    layout = bind(model, devices[0], reference=references[0])[0]
    plain = (
        model.noise.first
        and all(h.kind == "noise" for h in layout.hypers)
        and 0 < layout.size < len(devices[0])
        and all(b.place != "input" and b.coefficient.per is None for b in layout.blocks)
        and not any(e.open for e in model.effects)
        and model.with_nuisances(devices[0]) is model
    )
    if not plain:
        return None
    try:
        together = jax.tree.map(lambda *each: np.stack(each), *frames)
        constants = {n: v[:, None] for n, v in together.reference.items()}
        frame = replace(together, reference=constants, silence=together.silence[:, None])
        problem, alone = (
            Problem(layout, Record(model.instrument, f, f["output"])) for f in (frame, frames[0])
        )
        if not alone.affine or problem.noisy:
            return None
        left, jacobian = _linearised(problem)
        # A basis may be of all readings that it is given, a response of one device's.
        own = _linearised(alone)[1]
        if not np.allclose(jacobian[0], own, rtol=ALIKE, atol=ALIKE * np.max(np.abs(own))):
            return None
    except (ValueError, TypeError, IndexError, BayescalError):  # of two axes
        return None
    solved, x, covariance, sd = _solve(problem, left, jacobian)
    if not solved.any():
        return None
    unknowns = Unknowns.of(layout)
    if NOISE not in dict(model.fixed):
        x = np.column_stack([x, sd])
        covariance = np.pad(covariance, ((0, 0), (0, 1), (0, 1)), constant_values=np.nan)
    facts = np.full(len(at), len(devices[0])), [r.get("T0", np.nan) for r in references]
    whole = at, x, covariance, *facts
    at, *own = (np.asarray(a)[solved] for a in whole)
    return Moments(at, unknowns.names, unknowns.units, *own)


def _linearised(
    problem: Problem,
) -> tuple[Float[np.ndarray, "*b n"], Float[np.ndarray, "*b n p"]]:
    """Return what priors' means leave of the outputs, and the Jacobian."""
    hyper = problem.hyper(np.zeros(len(problem.hypers)))
    line = problem.acted(problem.mean_of_x, hyper, problem.terms)
    return problem.record.y - line.mean, line.jacobian


def _solve(
    problem: Problem, y: Float[np.ndarray, "b n"], jacobian: Float[np.ndarray, "b n p"]
) -> tuple[
    Bool[np.ndarray, "b"],
    Float[np.ndarray, "b p"],
    Float[np.ndarray, "b p p"],
    Float[np.ndarray, "b"],
]:
    """Return which devices are plain, their coefficients with covariances, and σ.

    Args:
        problem: of all.
        y: outputs less those expected at the priors' means.
        jacobian: by the coefficients.
    """
    order = np.argsort(problem.weight_of_x, kind="stable")  # flat ones first
    f, p, n = int(np.sum(problem.weight_of_x == 0)), problem.size, y.shape[1]
    norm = np.linalg.norm(jacobian, axis=1)
    norm = np.where(norm > 0, norm, 1.0)
    proper = np.broadcast_to(problem.sizes.at(problem.fixed_values), norm.shape)
    scale = np.where(problem.weight_of_x == 0, 1 / norm, proper)
    columns = (jacobian * scale[:, None])[:, :, order]
    base, upper = np.linalg.qr(columns)
    diagonal, size = np.abs(np.diagonal(upper, axis1=1, axis2=2)), np.linalg.norm(columns, axis=1)
    determined = np.all(diagonal > PLAIN_SHARE * size, axis=1) & np.all(np.isfinite(y), axis=1)
    upper = np.where(determined[:, None, None], upper, np.eye(p))
    left, z0 = np.where(determined[:, None], y, 0.0), np.zeros((len(y), p))
    for _ in range(2):  # a second time for the digits of outputs far from zero
        step = np.linalg.solve(upper, base.mT @ left[:, :, None])
        left, z0 = left - (columns @ step)[:, :, 0], z0 + step[:, :, 0]
    rest = np.sum(left**2, axis=1)
    _, d, vt = np.linalg.svd(upper[:, f:, f:])
    d2, w = d**2, (vt @ z0[:, f:, None])[:, :, 0]
    if NOISE in problem.fixed_values:
        variance, alone = np.full(len(y), problem.fixed_values[NOISE] ** 2), True
    else:
        variance, alone = _noise_variance(n - f, rest, d2 * w**2, d2)
    sd = np.sqrt(variance)
    share = variance[:, None] / (variance[:, None] + d2)
    # What the proper coefficients go toward their priors, the flat ones go with them: R₁₁·u = −R₁₂·z.
    flat = np.linalg.inv(upper[:, :f, :f])
    along = np.broadcast_to(np.eye(p)[:, f:], (len(y), p, p - f)).copy()
    along[:, :f] = -flat @ upper[:, :f, f:]
    z = z0 - (along @ vt.mT @ (share * w)[:, :, None])[:, :, 0]
    covariance = along @ (vt.mT * share[:, None]) @ vt @ along.mT
    covariance[:, :f, :f] += variance[:, None, None] * flat @ flat.mT
    back = np.argsort(order)
    x = problem.mean_of_x + scale * z[:, back]
    covariance = scale[:, :, None] * covariance[:, back][:, :, back] * scale[:, None]
    largest, range_ = np.max(np.abs(problem.record.y), axis=1), np.ptp(problem.record.y, axis=1)
    reach = np.max(np.abs(columns[:, :, f:]), axis=1)  # of coefficients of plausible sizes
    far = np.maximum(largest, np.max(np.abs(y), axis=1))
    plain = (
        determined
        & alone
        & np.all(np.abs(z[:, f:]) < PLAIN_SD, axis=1)
        & (rest > LEAST_NOISE * np.sum(y**2, axis=1))
        & (sd < range_)
        & np.all((PLAIN_SHARE * reach < sd[:, None]) & (PLAIN_SHARE * sd[:, None] < reach), axis=1)
        & (PLAIN_DIGITS * np.minimum(sd, range_) > far)
        & np.all(np.isfinite(x), axis=1)
    )
    return plain, x, covariance, sd


def _noise_variance(
    count: int,
    rest: Float[np.ndarray, "b"],
    c2: Float[np.ndarray, "b m"],
    d2: Float[np.ndarray, "b m"],
) -> tuple[Float[np.ndarray, "b"], Bool[np.ndarray, "b"]]:
    """Return where the restricted likelihood of σ² is greatest, and whether it has one maximum.

    Args:
        count: readings less flat coefficients.
        rest: sums of squares that no column explains.
        c2, d2: squares along the singular vectors, and of the singular values.
    """

    def slopes(t: Float[np.ndarray, "b"]) -> tuple[np.ndarray, np.ndarray]:
        """Of the log likelihood, times two, by t = log σ²; the second too."""
        s = np.exp(t)[:, None]
        share = s / (s + d2)
        pull = c2 * share / (s + d2)
        first = rest / s[:, 0] - count + np.sum(1 - share + pull, axis=1)
        return first, np.sum(pull * (1 - 2 * share) - share * (1 - share), axis=1) - rest / s[:, 0]

    # From none of it explained by noise to all of it.
    least = np.log(rest / count + 1e-300) - 0.5
    most = np.log((rest + np.sum(c2, axis=1)) / count + 1e-300) + 4.0
    grid = least[:, None] + (most - least)[:, None] * np.linspace(0.0, 1.0, GRID) ** 2
    s = np.exp(grid)
    values = -count * grid - rest[:, None] / s
    s = s[:, :, None]
    values -= np.sum(np.log1p(d2[:, None] / s) + c2[:, None] / (s + d2[:, None]), axis=2)
    rises = np.diff(values, axis=1) > 0
    maxima = np.sum(rises[:, :-1] & ~rises[:, 1:], axis=1) + ~rises[:, 0] + rises[:, -1]
    best, every = np.argmax(values, axis=1), np.arange(len(grid))
    low, high = (grid[every, np.clip(best + side, 0, GRID - 1)] for side in (-1, 1))
    t = grid[every, best]
    for _ in range(NEWTON_STEPS):
        first, second = slopes(t)
        low, high = np.where(first > 0, t, low), np.where(first > 0, high, t)
        step = t - first / np.where(second < 0, second, -1.0)
        inside = (step >= low) & (step <= high) & (second < 0)
        t = np.where(inside, step, 0.5 * (low + high))
    return np.exp(t), maxima == 1
