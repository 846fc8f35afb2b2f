"""Gradients under white noise, at a thousand to a million readings, on one core.

After one pass over the readings the density of φ needs their products alone; NumPyro's log density of the same line,
coefficients as unknowns, needs every reading each time. The two are compared by integrating the coefficients out of
NumPyro's in closed form.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.speed.scaling.gradient_cost import AT, T0, Bound, bound, per_call, slopes
from benchmarks.speed.timing import clocks, interleaved

GOAL = 1.2  # growth from 10³ readings to 10⁶
SIZES = (1_000, 10_000, 100_000, 1_000_000)
REPEATS = 5


def plain(model: Any) -> Callable[..., Any]:
    """NumPyro's log density of the line, as a function of (offset, slope) in prior sd and of the noise's coordinate."""
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist
    from numpyro.infer.util import log_density

    sizes = [e.coefficients[0].size for e in model.effects]
    scale = model.noise.scale.scale

    def program(t: Any, y: Any) -> None:
        offset = numpyro.sample("offset", dist.Normal(0.0, sizes[0]))
        slope = numpyro.sample("slope", dist.Normal(0.0, sizes[1]))
        noise = numpyro.sample("noise", dist.HalfCauchy(scale))
        numpyro.sample("y", dist.Normal(offset + slope * t, noise), obs=y)

    def joint(q: Any, t: Any, y: Any) -> Any:
        noise = scale * jnp.exp(q[2])
        sites = {"offset": sizes[0] * q[0], "slope": sizes[1] * q[1], "noise": noise}
        volume = jnp.log(sizes[0]) + jnp.log(sizes[1]) + jnp.log(noise)
        return log_density(program, (t, y), {}, sites)[0] + volume

    return joint


def integrated(joint: Callable[..., Any]) -> Callable[..., Any]:
    """The two coefficients integrated out of a density that is Gaussian in them, exactly."""
    import jax
    import jax.numpy as jnp

    def of_phi(v: Any, t: Any, y: Any) -> Any:
        def at(x: Any) -> Any:
            return joint(jnp.append(x, v), t, y)

        x, curvature = jnp.zeros(2), -jax.hessian(at)(jnp.zeros(2))
        for _ in range(3):
            x = x + jnp.linalg.solve(curvature, jax.grad(at)(x))
        return at(x) + jnp.log(2 * jnp.pi) - 0.5 * jnp.linalg.slogdet(curvature)[1]

    return of_phi


def _white_at(n: int) -> tuple[Bound, dict[str, float]]:
    """The line, and seconds of one gradient, ours and NumPyro's.

    Raises:
        RuntimeError: values or slopes differ.
    """
    import jax

    b = bound(n, correlated=False)
    joint = plain(b.layout.model)
    data = (b.frame["temperature"] - T0, b.y)

    mine = b.density.slope(b.v)
    theirs = jax.jit(jax.value_and_grad(lambda v: integrated(joint)(v[0], *data)))(b.v)
    for a, c in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        if not np.allclose(a, c, rtol=1e-7, atol=1e-6):
            raise RuntimeError(f"at {n} readings: {mine}, NumPyro's integrated {theirs}")
    steps, few = 2000, max(4, 4_000_000 // n)
    q = np.append([0.04, 0.6], b.v)
    runs = {"ours": slopes(b.density, b.v, steps), "plain": per_call(joint, q, few, *data)}
    best = clocks(interleaved(runs, REPEATS))
    return b, {"ours": best["ours"] / steps, "NumPyro": best["plain"] / few}


def _one_pass(b: Bound) -> dict[str, float]:
    """The pass over the readings, beside a copy in memory and a product of dense matrices.

    Raises:
        RuntimeError: the products are wrong.
    """
    from bayescal._inference.density import Density
    from bayescal._inference.problem import Problem
    from bayescal._inference.record import Record

    problem = Problem(b.layout, Record(b.layout.model.instrument, b.frame, np.asarray(b.y)))
    v = b.v

    def run() -> Any:
        density = Density(problem, problem.start, np.ones(b.layout.size), v)
        return density.gram(v, problem.hyper(v))

    gram, n = run(), len(b.y)
    j = np.column_stack([np.ones(n), np.asarray(b.frame["temperature"]) - T0])
    variance = AT["noise.white"] ** 2
    if not np.allclose(gram.jtj, j.T @ j / variance, rtol=1e-9, atol=1e-9 * n):
        raise RuntimeError(f"the products are {gram.jtj}, by numpy {j.T @ j / variance}")
    source, target = np.ones(16_000_000), np.zeros(16_000_000)
    square = np.random.default_rng(0).normal(size=(1500, 1500))
    runs: dict[str, Callable[[], Any]] = {
        "pass": run,
        "copy": lambda: np.copyto(target, source),
        "product": lambda: square @ square,
    }
    best = clocks(interleaved(runs, REPEATS))
    least_bytes, columns = 16 * n, 3  # temperature and output; 1, T − T0, residual
    bandwidth = 2 * source.nbytes / best["copy"]
    rate = 2 * 1500**3 / best["product"]
    flops = n * columns * (columns + 1)  # six products, each multiplied and added
    return {
        "seconds": best["pass"],
        "bytes_at_least": least_bytes,
        "bandwidth_of_a_copy": bandwidth,
        "share_of_bandwidth": least_bytes / best["pass"] / bandwidth,
        "flops_of_a_dense_product": rate,
        "share_of_flops": flops / best["pass"] / rate,
    }


def white() -> dict[str, Any]:
    """Gradients after the one pass, and the pass itself."""
    found, b = {}, None
    for n in SIZES:
        b, found[n] = _white_at(n)
    assert b is not None
    one = _one_pass(b)
    growth = {k: found[SIZES[-1]][k] / found[SIZES[0]][k] for k in ("ours", "NumPyro")}
    first, last = found[SIZES[0]], found[SIZES[-1]]
    return {
        "seconds": found,
        "growth": growth,
        "goal": GOAL,
        "one_pass": one,
        "told": f"one gradient {1e6 * first['ours']:.1f} µs at 10³ readings, {1e6 * last['ours']:.1f} µs at 10⁶: "
        f"{growth['ours']:.2f} × (goal {GOAL}); NumPyro's {1e6 * first['NumPyro']:.0f} µs and "
        f"{1e6 * last['NumPyro']:.0f} µs, {growth['NumPyro']:.0f} ×. The one pass at 10⁶: "
        f"{1e3 * one['seconds']:.1f} ms, "
        f"{100 * one['share_of_bandwidth']:.0f} % of the memory bandwidth of a copy "
        f"({one['bandwidth_of_a_copy'] / 1e9:.1f} GB/s), {100 * one['share_of_flops']:.1f} % of a dense product's "
        f"{one['flops_of_a_dense_product'] / 1e9:.0f} GFLOP/s",
    }
