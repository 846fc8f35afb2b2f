"""What one gradient of the log density costs at a thousand to a million readings, on one core.

White noise: after one pass over the readings the density of φ needs their products alone; NumPyro's log density of
the same line, coefficients as unknowns, needs every reading each time. The two are compared by integrating the
coefficients out of NumPyro's in closed form. Ornstein–Uhlenbeck noise: a pass at each evaluation, linear in the
readings, beside the dense Cholesky factor that it replaces.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks.speed.scaling.fit_cost import interleaved

GROWTH_GOAL, RATE_GOAL = 1.2, 1e5  # times from 10³ to 10⁶; readings a second
SIZES = (1_000, 10_000, 100_000, 1_000_000)
WANDER_SIZES, DENSE = (1_000, 3_000, 10_000, 100_000, 1_000_000), (1_000, 3_000)
T0, STEP, NOISE, SEED = 20.0, 1.0, 0.2, 3  # °C, s, °/s
WANDER, TIME = 0.1, 100.0  # °/s, s
AT = {"noise.white": 0.21, "noise.correlated": 0.11, "noise.correlated.time": 90.0}
REPEATS = 5


class Bound(NamedTuple):
    """The gyroscope's line bound to readings."""

    layout: Any
    frame: Any
    y: Any
    point: Any
    flat: Any
    v: Any


def bound(n: int, correlated: bool) -> Bound:
    """Readings of a line at random temperatures, with noise, and a point φ near the truth."""
    import jax.numpy as jnp
    from scipy.signal import lfilter

    import bayescal as bc
    from bayescal._inference import laplace
    from bayescal._model.frame import build_frame, reference_of
    from bayescal._model.parameters import bind
    from bayescal_models import mems_gyro

    rng = np.random.default_rng(SEED)
    t = rng.uniform(T0 - 50.0, T0 + 50.0, n)
    y = 2.0 + 0.03 * (t - T0) + rng.normal(0.0, NOISE, n)
    model, more = mems_gyro.INSTRUMENT.baseline(), {}
    if correlated:
        keep = np.exp(-STEP / TIME)
        y = y + lfilter([WANDER * np.sqrt(1 - keep**2)], [1.0, -keep], rng.normal(size=n))
        more = {"time": STEP * np.arange(n)}
        scale = bc.HalfCauchy(0.1)
        model = model.with_noise(bc.OrnsteinUhlenbeck(1.0, 1000.0, scale, scale))
    readings = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, temperature=t, output=y, **more)
    layout, _ = bind(model, readings)
    reference = {**reference_of(readings), "T0": T0}
    frame = build_frame(readings, reference)
    v = jnp.array([_at(h) for h in layout.hypers])
    point = laplace.start_point(layout, frame)
    return Bound(layout, frame, jnp.asarray(y), point, jnp.ones(layout.size), v)


def _at(h: Any) -> float:
    """The coordinate of a hyper-parameter's value in `AT`."""
    prior, value = h.prior, AT[h.name]
    if hasattr(prior, "coordinate"):
        return prior.coordinate(value)
    return float(np.log(value / prior.median) / prior.sd)


def per_call(function: Callable[..., Any], start: Any, steps: int, *data: Any) -> Callable[[], Any]:
    """`steps` values and gradients one after another in one compiled loop, each where the last one points.

    Returns:
        A call that runs them; it has run once.
    """
    import jax

    both = jax.value_and_grad(function)

    @jax.jit
    def loop(x: Any, *data: Any) -> Any:
        def one(x: Any, _: Any) -> Any:
            value, slope = both(x, *data)
            return x + 1e-12 * slope, value  # so that none can be left out

        return jax.lax.scan(one, x, None, length=steps)[1]

    jax.block_until_ready(loop(start, *data))
    return lambda: jax.block_until_ready(loop(start, *data))


def _ready(function: Callable[..., Any], *data: Any) -> Any:
    """What a compiled function returns, once it is there."""
    import jax

    return jax.block_until_ready(function(*data))


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

    from bayescal._inference import laplace

    b = bound(n, correlated=False)
    density = laplace.density_of_phi(b.layout, b.frame, b.y, b.point, b.flat)
    joint = plain(b.layout.model)
    data = (b.frame["temperature"] - T0, b.y)

    def of_phi(v: Any) -> Any:
        return density(v)[0]

    mine = jax.jit(jax.value_and_grad(of_phi))(b.v)
    theirs = jax.jit(jax.value_and_grad(lambda v: integrated(joint)(v[0], *data)))(b.v)
    for a, c in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        if not np.allclose(a, c, rtol=1e-7, atol=1e-6):
            raise RuntimeError(f"at {n} readings: {mine}, NumPyro's integrated {theirs}")
    steps, few = 2000, max(4, 4_000_000 // n)
    q = np.append(np.array([0.04, 0.6]), np.asarray(b.v))
    runs = {"ours": per_call(of_phi, b.v, steps), "plain": per_call(joint, q, few, *data)}
    best, _ = interleaved(runs, REPEATS)
    return b, {"ours": best["ours"] / steps, "NumPyro": best["plain"] / few}


def _one_pass(b: Bound) -> dict[str, float]:
    """The pass over the readings, beside a copy in memory and a product of dense matrices.

    Raises:
        RuntimeError: the products are wrong.
    """
    import jax

    from bayescal._core.jit import compiled
    from bayescal._inference import gaussian
    from bayescal._model import forward

    @compiled
    def products(layout: Any, frame: Any, y: Any, point: Any, v: Any) -> Any:
        grams = gaussian.gram_function(layout, frame, y, point)
        return grams(forward.hyper_values(layout, v), v)

    def run() -> Any:
        return jax.block_until_ready(products(b.layout, b.frame, b.y, b.point, b.v))

    gram, n = run(), len(b.y)
    j = np.column_stack([np.ones(n), np.asarray(b.frame["temperature"]) - T0])
    variance = AT["noise.white"] ** 2
    if not np.allclose(gram.jtj, j.T @ j / variance, rtol=1e-9, atol=1e-9 * n):
        raise RuntimeError(f"the products are {gram.jtj}, by numpy {j.T @ j / variance}")
    source, target = np.ones(16_000_000), np.zeros(16_000_000)
    square = np.random.default_rng(0).normal(size=(1500, 1500))
    best, _ = interleaved(
        {
            "pass": run,
            "copy": lambda: np.copyto(target, source),
            "product": lambda: square @ square,
        },
        REPEATS,
    )
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
        "goal": GROWTH_GOAL,
        "one_pass": one,
        "told": f"one gradient {1e6 * first['ours']:.1f} µs at 10³ readings, {1e6 * last['ours']:.1f} µs at 10⁶: "
        f"{growth['ours']:.2f} × (goal {GROWTH_GOAL}); NumPyro's {1e6 * first['NumPyro']:.0f} µs and "
        f"{1e6 * last['NumPyro']:.0f} µs, {growth['NumPyro']:.0f} ×. The one pass at 10⁶: "
        f"{1e3 * one['seconds']:.1f} ms, "
        f"{100 * one['share_of_bandwidth']:.0f} % of the memory bandwidth of a copy "
        f"({one['bandwidth_of_a_copy'] / 1e9:.1f} GB/s), {100 * one['share_of_flops']:.1f} % of a dense product's "
        f"{one['flops_of_a_dense_product'] / 1e9:.0f} GFLOP/s",
    }


def dense_density(b: Bound) -> float:
    """log p(y, φ) by the Cholesky factor of the whole covariance, coefficients and all, in numpy alone."""
    from scipy.linalg import cho_factor, cho_solve

    white, size, tau = (AT[k] for k in ("noise.white", "noise.correlated", "noise.correlated.time"))
    time_s = np.asarray(b.frame["time"])
    j = np.column_stack([np.ones(len(b.y)), np.asarray(b.frame["temperature"]) - T0])
    j = j * [e.coefficients[0].size for e in b.layout.model.effects]
    covariance = size**2 * np.exp(-np.abs(time_s[:, None] - time_s) / tau) + j @ j.T
    covariance[np.diag_indices(len(time_s))] += white**2
    factor = cho_factor(covariance, lower=True, overwrite_a=True)
    y = np.asarray(b.y)
    rest = y @ cho_solve(factor, y)
    volume = 2 * np.sum(np.log(np.diag(factor[0])))
    prior = sum(float(h.prior.log_density(b.v[i])) for i, h in enumerate(b.layout.hypers))
    return -0.5 * (rest + volume + len(y) * np.log(2 * np.pi)) + prior


def wander() -> dict[str, Any]:
    """Values and gradients under Ornstein–Uhlenbeck noise.

    Raises:
        RuntimeError: the value is not the dense one's.
    """
    import jax

    from bayescal._inference import laplace

    seconds: dict[int, dict[str, float]] = {}
    for n in WANDER_SIZES:
        b = bound(n, correlated=True)

        def of_phi(v: Any, frame: Any, y: Any, b: Bound = b) -> Any:
            point = laplace.start_point(b.layout, frame)
            return laplace.density_of_phi(b.layout, frame, y, point, b.flat)(v)[0]

        value = jax.jit(of_phi)
        mine, steps = float(value(b.v, b.frame, b.y)), max(1, 30_000 // n)
        runs: dict[str, Callable[[], Any]] = {
            "gradient": per_call(of_phi, b.v, steps, b.frame, b.y),
            "value": partial(_ready, value, b.v, b.frame, b.y),
        }
        if n in DENSE:
            theirs = dense_density(b)
            if not abs(mine - theirs) <= 1e-8 * abs(theirs):
                raise RuntimeError(f"at {n} readings: log density {mine}, dense {theirs}")
            runs["dense value"] = partial(dense_density, b)
        best, _ = interleaved(runs, 3)
        seconds[n] = {**best, "gradient": best["gradient"] / steps}
    first, middle, last = WANDER_SIZES[0], WANDER_SIZES[2], WANDER_SIZES[-1]
    exponent = np.log10(seconds[last]["gradient"] / seconds[middle]["gradient"]) / np.log10(
        last / middle
    )
    rate = {n: n / s["gradient"] for n, s in seconds.items()}
    ratio = seconds[DENSE[-1]]["dense value"] / seconds[DENSE[-1]]["value"]
    return {
        "seconds": seconds,
        "readings_per_second": rate,
        "exponent": float(exponent),
        "goal_rate": RATE_GOAL,
        "dense_over_ours": ratio,
        "told": f"gradient {1e3 * seconds[first]['gradient']:.2f} ms at 10³ readings, "
        f"{1e3 * seconds[last]['gradient']:.0f} ms at 10⁶; growth from 10⁴ to 10⁶ as n^{exponent:.2f}; "
        f"{rate[first]:.2g} to {rate[last]:.2g} readings per core-second, value and gradient (goal {RATE_GOAL:.0e}); "
        f"the dense value takes {ratio:.0f} × ours at {DENSE[-1]}, equal to 1e-8",
    }
