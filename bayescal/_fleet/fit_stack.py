"""The unknowns of each device of a stack: mean, covariance and whether to trust them, in compiled programs."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.importance_weights import smoothed
from bayescal._fleet import closed_form
from bayescal._fleet.stacks import DeviceStack
from bayescal._inference import least_squares, sampled_products, trust
from bayescal._inference.assembly import Assembly
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.marginal import Marginal
from bayescal._inference.mode import Mode, find_mode
from bayescal._inference.record import Record
from bayescal._inference.sampling import WeightedDraws, weighted_draws
from bayescal._model.frame import Frame
from bayescal._model.parameters import Layout, Levels

NUDGE = 1e-5  # of a coordinate, for the slope of its value
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
        found = _sampled(layout, stack, method, seed)
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


def _one_by_one(layout: Layout, stack: DeviceStack, full_hessian: bool) -> tuple[np.ndarray, ...]:
    """x̂, values of φ, covariance and convergence of each device."""
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
    """`LeastSquares` itself, one device after the other: programs are those of the first."""
    _, places = least_squares.split_hypers(layout)
    x, values, own, converged = _one_by_one(layout, stack, method.curvature == "hessian")
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


def _values(layout: Layout, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """All unknowns of draws (s, q), in the order of `unknowns`."""
    hyper = {h.name: np.asarray(h.prior.value(v[:, i])) for i, h in enumerate(layout.hypers)}
    parts = []
    for b in layout.blocks:
        if b.place == "x":
            parts.append(x[:, b.start : b.start + b.size])
        elif b.place == "phi":
            value = np.stack([hyper[name] for name in b.member_names()], axis=1)
            if b.coefficient.group_sd is not None:
                value = b.coefficient.mean + hyper[b.group_sd_name][:, None] * value
            parts.append(value)
    parts += [hyper[h.name][:, None] for h in layout.hypers if h.kind != "promoted"]
    return np.concatenate(parts, axis=1)


def drawn(
    layout: Layout, frame: Frame, y: np.ndarray, method: Marginal, seed: int, device: int
) -> tuple[WeightedDraws, Mode]:
    """Weighted joint draws of one device, and the mode that they were proposed around."""
    assembly = Assembly(layout, Record(layout.model.instrument, frame, y))
    mode = find_mode(assembly)
    own = int(np.random.SeedSequence([seed, device]).generate_state(1)[0])
    return weighted_draws(assembly, mode, own, method.proposals, method.rounds), mode


def _sampled(layout: Layout, stack: DeviceStack, method: Marginal, seed: int) -> StackFit:
    """`Marginal` by importance sampling; where its weights fail, the verdict says so."""
    first = jax.tree.map(lambda a: a[0], stack.frame)
    layout, notes = sampled_products.choose(layout, first, stack.y[0], method.promote)
    mean, covariance, reasons, k_hats = [], [], [], []
    for i, y in enumerate(stack.y):
        frame = jax.tree.map(lambda a, i=i: a[i], stack.frame)
        found, _ = drawn(layout, frame, y, method, seed, int(stack.devices[i]))
        weights, k_hat = _weights(found.log_weight)
        values = _values(layout, found.x, found.v)
        mean.append(weights @ values)
        apart = values - mean[-1]
        covariance.append((weights[:, None] * apart).T @ apart)
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
