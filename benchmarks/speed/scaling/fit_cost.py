"""One least-squares fit beside `scipy.optimize.least_squares` and lmfit.

All minimise the same sum of squares from the same start, the priors' centre: residuals over the noise's standard
deviation, and every unknown over its prior's. The peers are told the noise, which `bc.fit` has to find; it also draws,
names, and judges. Where a model is not written out here by hand, the peers are given our compiled expected output.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.speed.timing import clocks, interleaved

READINGS, SEED, T0, NOISE = 600, 5, 20.0, 0.2
REPEATS = 7
TIGHT = 1e-12  # tolerances of the peers, for answers that can be compared
NEAR = 1e-6  # standard deviations that ours may be off the optimum by
PEERS_NEAR = 0.01  # and the peers, who take finite differences of residuals
GOAL = 5.0


class PeerProblem(NamedTuple):
    """Least squares in standardised unknowns z: residuals of z, and how many z there are."""

    residuals: Callable[[np.ndarray], np.ndarray]
    size: int
    jacobian: Callable[[np.ndarray], np.ndarray] | None = None  # where it is known exactly


def arrays() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, s; temperature, °C; output, °/s, of one run that warms up."""
    rng = np.random.default_rng(SEED)
    t = 10.0 * np.arange(READINGS)
    temperature = T0 + 30.0 * np.sin(2 * np.pi * t / 4000.0)
    temperature -= temperature.mean() - T0  # so that the reference temperature is T0
    output = 2.0 + 0.03 * (temperature - T0) + 0.6 * np.exp(-t / 700.0)
    return t, temperature, output + rng.normal(0.0, NOISE, READINGS)


def by_hand(kind: str, scale: dict[str, float], noise: float) -> PeerProblem:
    """The gyroscope's line, or with its warm-up, written out in numpy.

    Args:
        kind: "line" or "warm-up".
        scale: prior sd of "offset", "slope", "warm_up"; median of τ and its sd in log τ.
        noise: standard deviation, °/s.
    """
    t, temperature, output = arrays()
    warm, centred = t - t[0], temperature - T0

    def residuals(z: np.ndarray) -> np.ndarray:
        guess = scale["offset"] * z[0] + scale["slope"] * z[1] * centred
        if kind == "warm-up":
            tau = scale["tau"] * np.exp(scale["log_tau"] * z[3])
            guess = guess + scale["warm_up"] * z[2] * np.exp(-warm / tau)
        return np.concatenate([(output - guess) / noise, z])

    return PeerProblem(residuals, 4 if kind == "warm-up" else 2)


def by_scipy(problem: PeerProblem, method: Any) -> tuple[np.ndarray, np.ndarray]:
    """z and its covariance by `scipy.optimize.least_squares`."""
    from scipy.optimize import least_squares

    start = np.zeros(problem.size)
    found: Any = least_squares(
        problem.residuals, start, method=method, ftol=TIGHT, xtol=TIGHT, gtol=TIGHT
    )
    return found.x, np.linalg.inv(found.jac.T @ found.jac)


def by_lmfit(problem: PeerProblem) -> tuple[np.ndarray, np.ndarray]:
    """The same by lmfit's `minimize` (leastsq)."""
    import lmfit  # pyright: ignore[reportMissingImports]

    start = lmfit.Parameters()
    for i in range(problem.size):
        start.add(f"z{i}", value=0.0)

    def residuals(p: Any) -> np.ndarray:
        return problem.residuals(np.array([p[f"z{i}"].value for i in range(problem.size)]))

    found: Any = lmfit.minimize(residuals, start, scale_covar=False, ftol=TIGHT, xtol=TIGHT)
    return np.array([p.value for p in found.params.values()]), found.covar


def exactly(problem: PeerProblem, near: np.ndarray) -> np.ndarray:
    """z by Gauss–Newton steps from near the answer, until rounding stops them; central differences at need."""
    step = 1e-5

    def differences(z: np.ndarray) -> np.ndarray:
        both = [
            (problem.residuals(z + step * e), problem.residuals(z - step * e))
            for e in np.eye(problem.size)
        ]
        return np.column_stack([(up - down) / (2 * step) for up, down in both])

    z, jacobian = near.copy(), problem.jacobian or differences
    for _ in range(20):
        z = z - np.linalg.lstsq(jacobian(z), problem.residuals(z), rcond=None)[0]
    return z


def case(kind: str) -> tuple[Any, Any]:
    """Model and readings."""
    import bayescal as bc
    from bayescal_models import mems_gyro, ng_accelerometer

    if kind == "ng accelerometer":
        return ng_accelerometer.INSTRUMENT.baseline(), ng_accelerometer.simulate(seed=0)
    t, temperature, output = arrays()
    readings = bc.Measurements.from_arrays(
        mems_gyro.INSTRUMENT, time=t, temperature=temperature, output=output
    )
    model = mems_gyro.INSTRUMENT.baseline()
    return model + "bias.warm_up" if kind == "warm-up" else model, readings


def scales(found: Any) -> tuple[dict[str, float], float]:
    """What `by_hand` needs of a fit: the priors' sizes, and the noise that was found."""
    model, layout = found.model, found.layout
    sizes = [e.coefficients[0].size for e in model.effects]
    scale: dict[str, float] = dict(zip(("offset", "slope", "warm_up"), sizes, strict=False))
    for h in layout.hypers:
        if h.kind == "shape":
            scale |= {"tau": float(h.prior.median), "log_tau": float(h.prior.sd)}
    place = [h.name for h in layout.hypers].index("noise.white")
    return scale, float(layout.hypers[place].prior.value(found.mode.v[place]))


def problem_of(kind: str, found: Any) -> tuple[PeerProblem, np.ndarray]:
    """The same problem for the peers, with the noise that `bc.fit` found; and its answer in z."""
    import jax
    import jax.numpy as jnp

    from bayescal._model import forward

    layout, frame, mode = found.layout, found.frame, found.mode
    prior = found.problem.prior(found.problem.hyper(mode.v), mode.flat)
    places = layout.positions("shape", "promoted")
    if found.problem.noisy or layout.improper:
        raise RuntimeError(f"{kind}: has flat priors or noise on an input")
    hyper = forward.hyper_values(layout, mode.v)
    noise = np.sqrt(np.asarray(layout.model.noise.variance(hyper, frame)))
    answer = np.concatenate([(mode.x - prior.mean) / prior.sd, mode.v[jnp.array(places, int)]])
    if kind != "ng accelerometer":
        return by_hand(kind, *scales(found)), answer
    y, sd = found.readings["output"], jnp.asarray(noise)

    @jax.jit
    def residuals(z: jax.Array) -> jax.Array:
        x, w = prior.mean + prior.sd * z[: layout.size], z[layout.size :]
        own = forward.hyper_values(layout, jnp.asarray(mode.v).at[jnp.array(places, int)].set(w))
        guess = forward.mean(layout, frame, x, own)
        return jnp.concatenate([(y - guess) / sd, z])

    slopes = jax.jit(jax.jacfwd(residuals))
    made = PeerProblem(
        lambda z: np.asarray(residuals(z)), len(answer), lambda z: np.asarray(slopes(z))
    )
    return made, answer


def warm(kind: str) -> dict[str, Any]:
    """All in one process, after each has run once.

    Raises:
        RuntimeError: the answers differ.
    """
    import bayescal as bc

    model, readings = case(kind)
    found = bc.fit(model, readings, bc.LeastSquares())
    problem, answer = problem_of(kind, found)
    timed = interleaved(
        {
            "bc.fit": lambda: bc.fit(model, readings, bc.LeastSquares()),
            "scipy, trf": lambda: by_scipy(problem, "trf"),
            "scipy, lm": lambda: by_scipy(problem, "lm"),
            "lmfit": lambda: by_lmfit(problem),
        },
        REPEATS,
    )
    best, found_by = clocks(timed), {n: one.made for n, one in timed.items()}
    exact = exactly(problem, answer)
    sd = np.sqrt(np.diag(found_by["scipy, trf"][1]))
    answers = {
        "bc.fit": answer,
        **{n: found_by[n][0] for n in ("scipy, trf", "scipy, lm", "lmfit")},
    }
    apart = {n: float(np.max(np.abs(z - exact) / sd)) for n, z in answers.items()}
    if not (apart["bc.fit"] <= NEAR and max(apart.values()) <= PEERS_NEAR):
        raise RuntimeError(f"{kind}: answers from the least sum of squares, sd: {apart}")
    peers = {"scipy": min(best["scipy, trf"], best["scipy, lm"]), "lmfit": best["lmfit"]}
    told = ", ".join(
        f"{n} {1e3 * s:.1f} ms = {s / best['bc.fit']:.2f} × bc.fit" for n, s in peers.items()
    )
    return {
        "readings": len(readings),
        "unknowns": problem.size,
        "seconds": best,
        "apart_sd": apart,
        "times_bc_fit": {n: s / best["bc.fit"] for n, s in peers.items()},
        "goal": GOAL,
        "told": f"bc.fit {1e3 * best['bc.fit']:.1f} ms, {told} "
        f"(goal {GOAL:.0f}); ours within {apart['bc.fit']:.1g} sd of the optimum, "
        f"the peers' within {max(apart.values()):.1g}",
    }
