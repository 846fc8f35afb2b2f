"""One row of the table: a sampler on a target, its draws of every unknown, and what they are worth."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.importance_weights import smoothed
from bayescal._inference import sampled_products
from bayescal._inference.laplace import find_mode
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._inference.sampling import weighted_draws
from benchmarks import chains
from benchmarks.speed.samplers.peers import (
    Ran,
    Target,
    blackjax_laplace,
    blackjax_nuts,
    numpyro_nuts,
    nutpie_nuts,
    pymc_nuts,
)
from benchmarks.speed.samplers.targets import TARGETS, BoundProblem, in_plain_order

PROPOSALS: dict[str, tuple[int | None, int]] = {
    "its default": (None, 3),
    "65536 proposals, 6 rounds": (65536, 6),
}
Sampler = Callable[[Target], Ran]
Row = Callable[[BoundProblem], dict[str, Any]]


def summary(values: np.ndarray, ran: Ran) -> dict[str, Any]:
    """A row, from every unknown's draws (chains, draws, q)."""
    seen = np.asarray(~np.isnan(values).any(axis=(0, 1)))
    own = values[:, :, seen]
    each = [own[..., i] for i in range(own.shape[2])]
    least = float(np.min([chains.effective_draws(draws) for draws in each]))
    r_hat = float(np.max([chains.r_hat(draws) for draws in each]))
    return {
        "seconds": ran.seconds,
        "compiling": ran.compiling,
        "least_ess": least,
        "per_second": least / ran.seconds,
        "max_r_hat": r_hat,
        "divergences": ran.divergences,
        "mean": _where(seen, values.mean((0, 1))),
        "sd": _where(seen, values.std((0, 1))),
    }


def _where(seen: np.ndarray, values: np.ndarray) -> list[float | None]:
    """None for what the target integrates out."""
    return [float(v) if s else None for s, v in zip(seen, values, strict=True)]


def ours(p: BoundProblem, proposals: int | None, rounds: int) -> dict[str, Any]:
    """`Marginal`: joint importance draws with their corrected weights."""

    def once(seed: int):
        record = Record(p.plain.model.instrument, p.frame, np.asarray(p.y))
        layout = sampled_products.choose(Problem(p.plain, record), None)[0].layout
        problem = Problem(layout, record)
        return layout, weighted_draws(problem, find_mode(problem), seed, proposals, rounds)

    begun = time.perf_counter()
    once(1)
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    layout, found = once(2)
    weights, k_hat = smoothed(found.log_weight)
    seconds = time.perf_counter() - begun
    values = in_plain_order(p.plain, layout, found.x, found.v)
    mean = weights @ values
    variance = weights @ (values - mean) ** 2
    error = (weights**2) @ (values - mean) ** 2
    ess = variance / error
    return {
        "seconds": seconds,
        "compiling": first - seconds,
        "least_ess": float(ess.min()),
        "per_second": float(ess.min()) / seconds,
        "pareto_k": float(k_hat),
        "mean": mean.tolist(),
        "sd": np.sqrt(variance).tolist(),
    }


def of_chains(kind: str, sampler: Sampler) -> Row:
    """A row of chains on a target of this kind."""

    def row(p: BoundProblem) -> dict[str, Any]:
        target = TARGETS[kind](p)
        ran = sampler(target)
        place = jax.jit(jax.vmap(jax.vmap(target.unknowns)))
        values = np.asarray(place(jnp.asarray(ran.draws)))
        if kind != "plain":
            shape = values.shape[:2]
            flat = values.reshape(-1, values.shape[2])
            x, v = flat[:, : p.layout.size], flat[:, p.layout.size :]
            values = in_plain_order(p.plain, p.layout, x, v).reshape(*shape, -1)
        return summary(values, ran)

    return row


def _peers(warmup: int) -> dict[str, Sampler]:
    return {
        "NumPyro NUTS, diagonal": partial(numpyro_nuts, dense=False, warmup=warmup),
        "NumPyro NUTS, dense": partial(numpyro_nuts, dense=True, warmup=warmup),
        "BlackJAX NUTS, dense": partial(blackjax_nuts, warmup=warmup),
        "nutpie, diagonal": partial(nutpie_nuts, low_rank=False, warmup=warmup),
        "nutpie, low rank": partial(nutpie_nuts, low_rank=True, warmup=warmup),
        "PyMC NUTS": partial(pymc_nuts, warmup=warmup),
        "BlackJAX Laplace HMC": partial(blackjax_laplace, warmup=warmup),
    }


def _asked(kind: str, warmup: int, name: str) -> bool:
    """Long warm-ups are asked of nutpie alone; of our own targets, what suits coordinates with even curvature."""
    if warmup == 5000 and "nutpie" not in name:
        return False
    return kind == "plain" or "nutpie, diagonal" in name or "dense" in name


def rows() -> dict[str, Row]:
    """Every row of a model, by name."""
    found: dict[str, Row] = {
        f"bayescal, {name}": partial(ours, proposals=proposals, rounds=rounds)
        for name, (proposals, rounds) in PROPOSALS.items()
    }
    for kind, warmup in (("plain", 1000), ("plain", 5000), ("whitened", 500)):
        for name, sampler in _peers(warmup).items():
            if _asked(kind, warmup, name):
                found[f"{name}, {kind}, {warmup} warm-up"] = of_chains(kind, sampler)
    return found
