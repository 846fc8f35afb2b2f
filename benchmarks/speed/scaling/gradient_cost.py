"""What one gradient of the log density costs: the line that it is taken of, and how its seconds are measured."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

T0, STEP, NOISE, SEED = 20.0, 1.0, 0.2, 3  # °C, s, °/s
WANDER, TIME = 0.1, 100.0  # °/s, s
AT = {
    "noise.white": 0.21,
    "noise.diffusion": 0.0164,
    "noise.correlated.time": 90.0,
}  # 0.11 °/s of correlated noise


class Bound(NamedTuple):
    """The gyroscope's line bound to readings."""

    layout: Any
    frame: Any
    y: Any
    density: Any
    v: Any


def bound(n: int, correlated: bool) -> Bound:
    """Readings of a line at random temperatures, with noise, and a point φ near the truth."""
    import jax.numpy as jnp
    from scipy.signal import lfilter

    import bayescal as bc
    from bayescal._inference.density import Density
    from bayescal._inference.problem import Problem
    from bayescal._inference.record import Record
    from bayescal._model.frame import build_frame, reference_of
    from bayescal._model.parameters import bind
    from bayescal_models import mems_gyro

    rng = np.random.default_rng(SEED)
    t = rng.uniform(T0 - 50.0, T0 + 50.0, n)
    y = 2.0 + 0.03 * (t - T0) + rng.normal(0.0, NOISE, n)
    model = mems_gyro.INSTRUMENT.baseline()
    columns: dict[str, Any] = {"temperature": t, "output": y}
    if correlated:
        keep = np.exp(-STEP / TIME)
        y = y + lfilter([WANDER * np.sqrt(1 - keep**2)], [1.0, -keep], rng.normal(size=n))
        columns |= {"output": y, "time": STEP * np.arange(n)}
        scale = bc.HalfCauchy(0.1)
        model = model.with_noise(bc.OrnsteinUhlenbeck(1.0, 1000.0, scale, scale))
    readings = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, **columns)
    layout, _ = bind(model, readings)
    reference = {**reference_of(readings), "T0": T0}
    frame = build_frame(readings, reference)
    v = np.array([_at(h) for h in layout.hypers])
    problem = Problem(layout, Record(model.instrument, frame, y))
    density = Density(problem, problem.start, np.ones(layout.size), v)
    return Bound(layout=layout, frame=frame, y=jnp.asarray(y), density=density, v=v)


def _at(h: Any) -> float:
    """The coordinate of a hyper-parameter's value in `AT`."""
    prior, value = h.prior, AT[h.name]
    if hasattr(prior, "coordinate"):
        return prior.coordinate(value)
    return float(np.log(value / prior.median) / prior.sd)


def slopes(density: Any, v: np.ndarray, steps: int) -> Callable[[], Any]:
    """`steps` values and gradients of our density one after another, each where the last one points.

    Returns:
        A call that runs them; it has run once.
    """

    def loop() -> Any:
        at = v
        for _ in range(steps):
            value, slope = density.slope(at)
            at = at + 1e-12 * slope  # so that nothing kept from the last one serves
        return value

    loop()
    return loop


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
