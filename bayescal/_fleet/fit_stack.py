"""The unknowns of each device of a stack: mean, covariance and whether to trust them, in compiled programs."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.importance_weights import smoothed
from bayescal._core.jit import compiled
from bayescal._core.parallel import over
from bayescal._engine.assembly import Assembly
from bayescal._engine.record import Record
from bayescal._fleet import closed_form
from bayescal._fleet.stacks import DeviceStack, weighed
from bayescal._inference import importance_sampling, least_squares, sampled_products, trust
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import by_engine
from bayescal._model import forward
from bayescal._model.parameters import Layout, Levels

FEW = 8  # devices up to which the engine fits them one by one: a program of their own takes longer to compile
NUDGE = 1e-5  # of a coordinate, for the slope of its value
TOGETHER = 64  # devices that a program of many readings or proposals holds at once
NO_SCATTER = (
    "The readings leave no scatter about the model, so that the noise cannot be told: too few readings for the "
    "coefficients, or made without noise."
)


class StackFit(NamedTuple):
    """Of the devices of one stack, every unknown in its reported unit.

    Attributes:
        layout: where the unknowns stand.
        mean: (b, q).
        covariance: (b, q, q); NaN where a spread or noise is held at its estimate.
        reasons: what stands against each device; empty if nothing.
        pareto_k: k̂ of each; None where nothing was sampled.
        notes: how it was done.
    """

    layout: Layout
    mean: np.ndarray
    covariance: np.ndarray
    reasons: list[str]
    pareto_k: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def unknowns(layout: Layout, levels: Levels) -> list[tuple[str, str]]:
    """(name, unit) of every unknown but those of single readings, in the order of `StackFit.mean`."""
    found = []
    for b in layout.blocks:
        if b.place not in ("fixed", "row"):
            found += [(name, b.coefficient.unit) for name in b.member_names(levels)]
    return found + [(h.name, h.unit) for h in layout.hypers if h.kind != "promoted"]


def solve(
    layout: Layout, stack: DeviceStack, method: LeastSquares | Marginal, seed: int, straight: bool
) -> StackFit:
    """Fit every device of a stack by itself; `straight` says that least squares may go the quick way."""
    few = len(stack.devices)
    if isinstance(method, Marginal):
        found = _sampled(layout, _filled(stack), method, seed)
    elif straight:
        found = _quick(layout, _filled(stack))
    else:
        found = _ordinary(layout, stack, method)
    pareto_k = None if found.pareto_k is None else found.pareto_k[:few]
    return found._replace(
        mean=found.mean[:few],
        covariance=found.covariance[:few],
        reasons=found.reasons[:few],
        pareto_k=pareto_k,
    )


def straight(layout: Layout, stack: DeviceStack, method: LeastSquares | Marginal) -> bool:
    """Whether the quick way through least squares is open to devices like these."""
    return isinstance(method, LeastSquares) and closed_form.applies(layout, _first(stack.frame))


def _filled(stack: DeviceStack) -> DeviceStack:
    """A few devices more, the last one repeated, so that few programs are compiled: at most an eighth above 64."""
    few = len(stack.devices)
    step = max(64, 1 << max((few - 1).bit_length() - 4, 0))
    many = 1 << (few - 1).bit_length() if few < 64 else -(-few // step) * step
    if many == few:
        return stack
    pick = np.minimum(np.arange(many), few - 1)
    return stack._replace(
        devices=stack.devices[pick],
        frame=jax.tree.map(lambda a: np.asarray(a)[pick], stack.frame),
        y=stack.y[pick],
        real=stack.real[pick],
    )


def _first(frames):
    return jax.tree.map(lambda a: jnp.asarray(a[0]), frames)


def _quick(layout: Layout, stack: DeviceStack) -> StackFit:
    line = jax.tree.map(
        np.asarray, closed_form.solve(layout, stack.frame, *map(jnp.asarray, (stack.y, stack.real)))
    )
    fixed = closed_form.NOISE in dict(layout.model.fixed)
    mean = line.x if fixed else np.column_stack([line.x, line.noise])
    covariance = _widened(line.covariance, mean.shape[1])
    reasons = [""] * len(mean)
    for i in np.flatnonzero(~line.scatter) if not fixed else ():
        reasons[i] = NO_SCATTER
    for i in np.flatnonzero(~line.determined):
        reasons[i] = trust.SINGULAR
    return StackFit(layout, mean, covariance, reasons)


def _widened(covariance: np.ndarray, size: int) -> np.ndarray:
    """With NaN for the unknowns that are held at their estimates."""
    own = covariance.shape[-1]
    if own == size:
        return covariance
    wide = np.full((len(covariance), size, size), np.nan)
    wide[:, :own, :own] = covariance
    return wide


@compiled
def _ordinary_batch(layout: Layout, frames, ys, full_hessian: bool):
    _, places = least_squares.split_hypers(layout)

    def one(given):
        frame, y = given
        found = least_squares.solve(layout, frame, y, full_hessian)
        hyper = forward.hyper_values(layout, found.mode.v)
        values = jnp.stack([hyper[h.name] for h in layout.hypers] or [jnp.zeros(())])
        slopes = [
            jax.grad(lambda v, h=layout.hypers[i]: h.prior.value(v))(found.mode.v[i])
            for i in places
        ]
        slopes = jnp.concatenate([jnp.ones(layout.size), jnp.asarray(slopes, dtype=float)])
        covariance = slopes[:, None] * found.covariance * slopes
        return found.mode.point.x, values[: len(layout.hypers)], covariance, found.converged

    return over(one, (frames, ys), TOGETHER)


def _one_by_one(layout: Layout, stack: DeviceStack, full_hessian: bool) -> tuple[np.ndarray, ...]:
    """The same as `_ordinary_batch`, by the engine."""
    _, places = least_squares.split_hypers(layout)
    made = []
    for i, y in enumerate(stack.y):
        frame = jax.tree.map(lambda a, i=i: a[i], stack.frame)
        assembly = Assembly(layout, Record(layout.model.instrument, frame, y))
        found = least_squares.solution_on(assembly, full_hessian)
        v, priors = found.mode.v, [layout.hypers[at].prior for at in places]
        ends = [
            [p.value(v[at] + d) for d in (-NUDGE, NUDGE)]
            for at, p in zip(places, priors, strict=True)
        ]
        slopes = np.concatenate([np.ones(layout.size), [(b - a) / (2 * NUDGE) for a, b in ends]])
        values = [float(h.prior.value(one)) for h, one in zip(layout.hypers, v, strict=True)]
        covariance = slopes[:, None] * found.covariance * slopes
        made.append((found.mode.point.x, values, covariance, found.converged))
    return tuple(np.array(one, dtype=float) for one in zip(*made, strict=True))


def _ordinary(layout: Layout, stack: DeviceStack, method: LeastSquares) -> StackFit:
    """`LeastSquares` itself, mapped over the devices, or of a few by the engine one by one."""
    _, places = least_squares.split_hypers(layout)
    hessian = method.curvature == "hessian"
    if len(stack.devices) <= FEW and by_engine(layout) and np.all(stack.real):
        made = _one_by_one(layout, stack, hessian)
    else:
        stack = _filled(stack)
        made = _ordinary_batch(layout, weighed(stack), stack.y, hessian)
    x, values, own, converged = (np.asarray(a) for a in made)
    mean = np.concatenate([x, values], axis=1)
    at = np.array([*range(layout.size), *(layout.size + i for i in places)], dtype=int)
    covariance = np.full((len(mean), mean.shape[1], mean.shape[1]), np.nan)
    covariance[:, at[:, None], at] = own
    reasons = [""] * len(mean)
    for i in np.flatnonzero(converged == 0):
        reasons[i] = trust.NOT_CONVERGED
    for i in np.flatnonzero(~np.all(np.isfinite(own), axis=(1, 2)) | ~np.isfinite(mean).all(1)):
        reasons[i] = trust.SINGULAR
    notes = (
        "Shapes have the standard uncertainty of their coordinate times its slope; noise and between-group "
        "standard deviations are held at their restricted-likelihood estimates.",
    )
    return StackFit(layout, mean, covariance, reasons, notes=notes if places else ())


@compiled
def _values(layout: Layout, x, rows, v, weights):
    """Weighted mean and covariance of all unknowns, from the draws of one device."""

    def one(x, rows, v):
        hyper = forward.hyper_values(layout, v)
        values = forward.coefficients(layout, x, rows, hyper)
        parts = [values[b.name] for b in layout.blocks if b.place not in ("fixed", "row")]
        parts += [hyper[h.name][None] for h in layout.hypers if h.kind != "promoted"]
        return jnp.concatenate(parts)

    values = jax.vmap(one)(x, rows, v)
    mean = weights @ values
    apart = values - mean
    return mean, (weights[:, None] * apart).T @ apart


def _sampled(layout: Layout, stack: DeviceStack, method: Marginal, seed: int) -> StackFit:
    """`Marginal` by importance sampling; where its weights fail, the verdict says so."""
    frames, first = weighed(stack), _first(stack.frame)
    layout, notes = sampled_products.choose(layout, first, jnp.asarray(stack.y[0]), method.promote)
    key = jax.random.key(seed)
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.asarray(stack.devices))
    mean, covariance, reasons, k_hats = [], [], [], []
    for begin in range(0, len(stack.y), TOGETHER):
        some = slice(begin, begin + TOGETHER)
        found = importance_sampling.sample_batch(
            layout,
            jax.tree.map(lambda a, some=some: a[some], frames),
            jnp.asarray(stack.y[some]),
            keys[some],
            method.proposals or 8192,
            method.rounds,
        )
        for i, log_weight in enumerate(np.asarray(found.log_weight)):
            weights, k_hat = _weights(log_weight)
            own = _values(layout, found.x[i], found.rows[i], found.v[i], weights)
            mean.append(np.asarray(own[0]))
            covariance.append(np.asarray(own[1]))
            k_hats.append(k_hat)
            reasons.append(_why_not(mean[-1], k_hat, weights))
    return StackFit(
        layout,
        np.stack(mean),
        np.stack(covariance),
        reasons,
        pareto_k=np.array(k_hats),
        notes=notes,
    )


def _weights(log_weight: np.ndarray) -> tuple[np.ndarray, float]:
    if not np.any(np.isfinite(log_weight)):
        return np.full(log_weight.size, np.nan), np.inf
    return smoothed(np.where(np.isfinite(log_weight), log_weight, -1e300))


def _why_not(mean: np.ndarray, k_hat: float, weights: np.ndarray) -> str:
    if not np.all(np.isfinite(mean)):
        return trust.SINGULAR
    if why := trust.unevenness(weights, k_hat):
        return (
            f"Importance weights were uneven ({why}): fit this device by bc.fit, which goes over to "
            "NUTS."
        )
    return ""
