"""Effective draws per second of three models: ours beside the samplers of today.

    python -m benchmarks samplers        one row after another; stopped, it goes on where it was
    BAYESCAL_ONLY="fleet: nutpie;bayescal" python -m benchmarks samplers      rows whose name holds one of these

The models are in `sampler_problems.py`. Every unknown counts: coefficients, deviations of cells or devices, learned
spreads, noise. All get the same log density, compiled by JAX:

- *plain*: the NumPyro program, non-centred, as anyone would write it;
- *marginal*: of φ alone, coefficients integrated out of the linearised model, but for those that bend it, in φ;
- *whitened*: exact, in coordinates whitened by that.

Effective draws are the least over all unknowns: for weighted draws the variance over the squared Monte-Carlo error,
both from the joint corrected weights; for chains ArviZ's bulk effective sample size. The time is everything after
compilation: for ours the Laplace fit, the search for what to sample, the rounds of adaptation and the draws; for
chains the warm-up too. Every row's posterior is compared with the best chains on an exact target: see `reference`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jax.flatten_util import ravel_pytree

import bayescal as bc
from bayescal._core.weights import smoothed
from bayescal._inference import importance_sampling, laplace, nuts_chains, sampled_products
from bayescal._inference.nuts import program
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from benchmarks.record import ROOT, write
from benchmarks.speed.samplers.peers import (
    CHAINS,
    DRAWS,
    Ran,
    Target,
    blackjax_laplace,
    blackjax_nuts,
    numpyro_nuts,
    nutpie_nuts,
    pymc_nuts,
)
from benchmarks.speed.samplers.problems import PROBLEMS

LINES = ROOT / "benchmarks" / "results" / "samplers.jsonl"
SEED = 20261121
SECONDS = 3300.0  # of one row, after which it is ended; one that was ended is tried again where more are given
PROPOSALS = {"its default": (8192, 3), "65536 proposals, 6 rounds": (65536, 6)}


class Problem(NamedTuple):
    """The model bound to its readings, as given and with what is promoted."""

    plain: Any
    layout: Any
    frame: Any
    y: jax.Array


def bound(model: bc.Model, readings: bc.Measurements) -> Problem:
    plain, _ = bind(model, readings)
    frame = build_frame(readings, reference_of(readings))
    y = jnp.asarray(readings["output"])
    return Problem(plain, sampled_products.choose(plain, frame, y, None)[0], frame, y)


def plain_target(p: Problem) -> Target:
    """The NumPyro program in its own unconstrained coordinates."""
    from numpyro.infer.util import initialize_model

    made = initialize_model(
        jax.random.split(jax.random.key(SEED), CHAINS), program(p.plain, p.frame), model_args=(p.y,)
    )
    first = jax.tree.map(lambda a: a[0], made.param_info.z)
    unravel = ravel_pytree(first)[1]
    start = jax.vmap(lambda z: ravel_pytree(z)[0])(made.param_info.z)

    def unknowns(q: jax.Array) -> jax.Array:
        sites = made.postprocess_fn(unravel(q))
        return jnp.concatenate([sites["x"], sites["v"]])

    inner = {
        n: np.full(np.size(a), n not in {h.name for h in p.plain.hypers}) for n, a in first.items()
    }
    latent = np.concatenate(
        [inner[name] for name in sorted(inner)]
    )  # the order in which they are ravelled
    return Target(lambda q: -made.potential_fn(unravel(q)), start, unknowns, latent)


def whitened_target(p: Problem) -> Target:
    """The exact log density in our whitened coordinates."""
    mode = laplace.compiled_mode(p.layout, p.frame, p.y)
    density, unpack, centre, covariance = nuts_chains.whitened(p.layout, p.frame, p.y, mode)
    root = jnp.linalg.cholesky(covariance)
    noise = jax.random.normal(jax.random.key(SEED), (CHAINS, centre.size))

    def unknowns(q: jax.Array) -> jax.Array:
        x, _, v, _, _ = unpack(centre + root @ q)
        return jnp.concatenate([x, v])

    none = np.zeros(centre.size, bool)
    return Target(lambda q: density(centre + root @ q), 0.5 * noise, unknowns, none)


def marginal_target(p: Problem) -> Target:
    """φ alone."""
    mode = laplace.compiled_mode(p.layout, p.frame, p.y)
    density = laplace.density_of_phi(p.layout, p.frame, p.y, mode.point, mode.flat)
    root = jnp.linalg.cholesky(mode.covariance)
    noise = jax.random.normal(jax.random.key(SEED), (CHAINS, mode.v.size))
    missing = jnp.full(p.layout.size, jnp.nan)

    def unknowns(q: jax.Array) -> jax.Array:
        return jnp.concatenate([missing, mode.v + root @ q])

    none = np.zeros(mode.v.size, bool)
    return Target(lambda q: density(mode.v + root @ q)[0], 0.5 * noise, unknowns, none)


TARGETS = {"plain": plain_target, "whitened": whitened_target, "marginal": marginal_target}


def summary(values: np.ndarray, ran: Ran) -> dict[str, Any]:
    """A row, from every unknown's draws (chains, draws, q)."""
    seen = ~np.isnan(values).any(axis=(0, 1))
    own = values[:, :, seen]
    ess = np.array(
        [array_stats.ess(own[..., i], chain_axis=0, draw_axis=1) for i in range(own.shape[2])]
    )
    r_hat = np.array(
        [array_stats.rhat(own[..., i], chain_axis=0, draw_axis=1) for i in range(own.shape[2])]
    )
    return {
        "seconds": ran.seconds,
        "compiling": ran.compiling,
        "least_ess": float(ess.min()),
        "per_second": float(ess.min()) / ran.seconds,
        "max_r_hat": float(r_hat.max()),
        "divergences": ran.divergences,
        "mean": np.where(seen, values.mean((0, 1)), None).tolist(),
        "sd": np.where(seen, values.std((0, 1)), None).tolist(),
    }


def ours(p: Problem, proposals: int, rounds: int) -> dict[str, Any]:
    """`Marginal`: joint importance draws with their corrected weights."""

    def once(seed: int):
        layout = sampled_products.choose(p.plain, p.frame, p.y, None)[0]
        mode = laplace.compiled_mode(layout, p.frame, p.y)
        key = jax.random.key(seed)
        found = importance_sampling.sample_jit(layout, p.frame, p.y, mode, key, proposals, rounds)
        return layout, jax.tree.map(np.asarray, found)

    begun = time.perf_counter()
    once(1)
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    layout, found = once(2)
    weights, k_hat = smoothed(found.log_weight)
    seconds = time.perf_counter() - begun
    values = _in_plain_order(p.plain, layout, found.x, found.v)
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


def _in_plain_order(plain: Any, layout: Any, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Draws of all unknowns in the order of the plain layout's (x, v)."""
    at = {h.name: i for i, h in enumerate(layout.hypers)}
    own = {b.name: b for b in layout.x_blocks}
    columns = []
    for b in plain.x_blocks:
        if b.name in own:
            columns.append(x[:, own[b.name].start : own[b.name].start + b.size])
        else:
            for name in b.member_names():
                h = layout.hypers[at[name]]
                columns.append(np.asarray(h.prior.value(jnp.asarray(v[:, at[name]])))[:, None])
    columns += [v[:, [at[h.name]]] for h in plain.hypers]
    return np.concatenate(columns, axis=1)


ROWS: dict[str, Callable[[Problem], dict[str, Any]]] = {
    f"bayescal, {name}": partial(ours, proposals=proposals, rounds=rounds)
    for name, (proposals, rounds) in PROPOSALS.items()
}


def _chains_row(kind: str, sampler: Callable[[Target], Ran]) -> Callable[[Problem], dict[str, Any]]:
    def row(p: Problem) -> dict[str, Any]:
        target = TARGETS[kind](p)
        ran = sampler(target)
        place = jax.jit(jax.vmap(jax.vmap(target.unknowns)))
        values = np.asarray(place(jnp.asarray(ran.draws)))
        if kind != "plain":
            shape = values.shape[:2]
            flat = values.reshape(-1, values.shape[2])
            x, v = flat[:, : p.layout.size], flat[:, p.layout.size :]
            values = _in_plain_order(p.plain, p.layout, x, v).reshape(*shape, -1)
        return summary(values, ran)

    return row


for _kind, _warmups in (("plain", (1000, 5000)), ("whitened", (500,)), ("marginal", (500,))):
    for _warmup in _warmups:
        for _name, _run in {
            "NumPyro NUTS, diagonal": lambda t, w=_warmup: numpyro_nuts(t, False, w),
            "NumPyro NUTS, dense": lambda t, w=_warmup: numpyro_nuts(t, True, w),
            "BlackJAX NUTS, dense": lambda t, w=_warmup: blackjax_nuts(t, w),
            "nutpie, diagonal": lambda t, w=_warmup: nutpie_nuts(t, False, w),
            "nutpie, low rank": lambda t, w=_warmup: nutpie_nuts(t, True, w),
            "PyMC NUTS": lambda t, w=_warmup: pymc_nuts(t, w),
            "BlackJAX Laplace HMC": lambda t, w=_warmup: blackjax_laplace(t, w),
        }.items():
            long = _warmup == 5000 and "nutpie" not in _name  # asked of nutpie alone
            few = _kind != "plain" and "nutpie, diagonal" not in _name and "dense" not in _name
            if not (long or few):
                ROWS[f"{_name}, {_kind}, {_warmup} warm-up"] = _chains_row(_kind, _run)


def main() -> None:
    """Run the rows that are missing, each in a process of its own; write and print the table."""
    limit = float(os.environ.get("BAYESCAL_SECONDS", SECONDS))
    text = LINES.read_text("utf-8") if LINES.is_file() else ""
    done = {line["row"]: line for line in map(json.loads, text.splitlines())}
    only = [part for part in os.environ.get("BAYESCAL_ONLY", "").split(";") if part]
    for name in (f"{problem}: {row}" for problem in PROBLEMS for row in ROWS):
        ended = done.get(name, {}).get("ended_after", 0.0 if name not in done else np.inf)
        if ended >= limit or (only and not any(part in name for part in only)):
            continue
        found = _apart(name, limit)
        if found is None:
            continue
        done[name] = {"row": name, **found}
        with LINES.open("a", encoding="utf-8") as out:
            out.write(json.dumps(done[name]) + "\n")
        print(_told(done[name], done), flush=True)
    rows = [_short(r, done) for r in done.values()]
    write("samplers", {"draws": DRAWS, "chains": CHAINS, "rows": rows})
    print("\n".join(_told(r, done) for r in done.values()))


def _apart(name: str, limit: float) -> dict[str, Any] | None:
    """A row from a process of its own, which is ended after some seconds; None if its sampler is not installed.

    Raises:
        RuntimeError: it failed.
    """
    code = "import sys; from benchmarks.speed.samplers.rows import in_here; in_here(*sys.argv[1:])"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "row.json"
        try:
            ran = subprocess.run(
                [sys.executable, "-c", code, name, str(out)], cwd=ROOT, timeout=limit, check=False
            )
        except subprocess.TimeoutExpired:
            return {"ended_after": limit}
        if ran.returncode:
            raise RuntimeError(f"{name}: ended with {ran.returncode}; its reason stands above")
        return json.loads(out.read_text("utf-8"))


def in_here(name: str, out: str) -> None:
    """One row, in this process, to a file."""
    problem, _, row = name.partition(": ")
    found = None
    try:
        found = ROWS[row](bound(*PROBLEMS[problem]()))
    except ImportError as missing:
        print(f"{name}: skipped, {missing.name} is not installed", file=sys.stderr)
    Path(out).write_text(json.dumps(found), encoding="utf-8")


def reference(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """The row of chains on an exact target of the same problem with most effective draws, R̂ below 1.01."""
    problem = row["row"].partition(":")[0]
    good = [
        r
        for n, r in done.items()
        if n.startswith(f"{problem}:") and r.get("max_r_hat", 2) < 1.01 and "marginal" not in n
    ]
    return max(good, key=lambda r: r["least_ess"], default=None)


def _short(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> dict[str, Any]:
    kept = {k: v for k, v in row.items() if k not in ("mean", "sd")}
    if "ended_after" in row:
        return kept
    against = reference(row, done)
    if against is None or against is row:
        return kept
    sd = np.array(against["sd"], float)
    distance = np.abs(np.array(row["mean"], float) - np.array(against["mean"], float)) / sd
    ratio = np.array(row["sd"], float) / sd
    return {
        **kept,
        "largest_distance_of_a_mean_sd": float(np.nanmax(distance)),
        "sd_ratio": [float(np.nanmin(ratio)), float(np.nanmax(ratio))],
    }


def _told(row: dict[str, Any], done: dict[str, dict[str, Any]]) -> str:
    own = _short(row, done)
    if "ended_after" in own:
        return f"{own['row']:62s} not ended in {own['ended_after']:.0f} s"
    health = f"k̂ {own['pareto_k']:.2f}" if "pareto_k" in own else f"R̂ {own['max_r_hat']:.2f}"
    apart = own.get("largest_distance_of_a_mean_sd")
    return (
        f"{own['row']:62s} {own['per_second']:9.3g} a second, least ESS {own['least_ess']:6.0f} in "
        f"{own['seconds']:6.2f} s, compiling {own['compiling']:5.1f} s, {health}"
        + ("" if apart is None else f", means within {apart:.2f} sd")
    )
