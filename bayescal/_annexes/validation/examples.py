"""Worked examples of standards, computed by public functions; clauses.toml names function and inputs of each."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal import effects
from bayescal import workshop as ws
from bayescal._annexes.validation.regressions import evaluate, fit

DATA = Path(__file__).parent / "data"
DRAWS = 100_000  # Monte-Carlo draws: the standard uncertainty of a probability is below 0.0016


def pick(value: Any, path: str) -> Any:
    """Return the value at a path of attributes, keys and indices, such as "corrected.value.0"."""
    if isinstance(value, Mapping) and path in value:
        return value[path]
    key, _, tail = path.partition(".")
    if isinstance(value, Mapping) or key.isdigit():
        value = value[key if isinstance(value, Mapping) else int(key)]
    else:
        value = getattr(value, key)
    return pick(value, tail) if tail else value


def resolve(value: Any) -> Any:
    """Load the data that a text names, such as "iso28037/examples.json ex1_equal.x"; return other values unchanged."""
    file, _, path = str(value).partition(" ")
    if not isinstance(value, str) or not file.endswith((".csv", ".json")):
        return value
    if file.endswith(".csv"):
        return np.loadtxt(DATA / file, delimiter=",", skiprows=1)[:, int(path)]
    return pick(json.loads((DATA / file).read_text("utf-8")), path)


def fit_regression(
    y: Any,
    x: Any = None,
    u: Any = None,
    *,
    centre: float = 0.0,
    x_u: float = 0.0,
    at: float = 0.0,
    output: float | None = None,
    output_u: float = 0.0,
    limit: str = "",
    method: str = "",
    prior: Sequence[float] = (),
) -> dict[str, Any]:
    """Fit a constant, or a line in x − centre; evaluate it, or invert it for an output; decide on conformity.

    Args:
        y, x, u, x_u: readings y at x, and standard uncertainties of y and x.
        centre, at: origin of x; x − centre at which the line is evaluated.
        output, output_u: a reading for which x is computed, and its standard uncertainty.
        limit: limit on the line.
        method, prior: method of the fit; mean and standard deviation of a normal prior of the coefficients.

    Returns:
        b, u, covariance, r: coefficients, their standard uncertainties, covariance and correlation. corrected: value of
        the line, or x of the output. chi_squared. s: noise standard deviation, if u is not given. budget, type_b:
        uncertainty budget of the value, and its share of type B. decision: on the limit.
    """
    columns = {"x0": np.ones(len(y))} | ({} if x is None else {"x1": np.asarray(x) - centre})
    errors = [effects.uncertain_input("x1", x_u, source="stated")] if x_u else []
    fitter = bc.Marginal(draws=20_000) if method == "Marginal" else bc.LeastSquares(draws=DRAWS)
    stimulus = "value" if output is None else "x1"
    priors = bc.Normal(*prior) if prior else bc.Flat()
    settings: Any = {"prior": priors, "further_effects": errors, "method": fitter}
    fitted = fit(y, columns, u=u, stimulus=stimulus, **settings)
    draws = np.array([fitted.samples(f"line.b[{name}]") for name in columns])
    covariance = np.atleast_2d(np.cov(draws))
    sd, cross_covariance = np.sqrt(np.diag(covariance)), covariance[0, -1]
    inputs = {name: at if name == "x1" else 1.0 for name in columns if name != stimulus}
    reading: Any = {"output": output or 0.0, "output_uncertainty": output_u}
    options: Any = {"noise": output is not None, "method": "first order", "warn": False}
    results = {"b": draws.mean(axis=1), "u": sd, "covariance": cross_covariance}
    results |= {"r": cross_covariance / (sd[0] * sd[-1]), "chi_squared": fitted.chi_squared_test}
    results["corrected"] = bc.compensator(fitted)(**reading, **inputs, **options)
    if u is None:
        results["s"] = fitted.samples("noise.white")[0]
    if output is None:
        results["budget"] = bc.budget(fitted, {"value": 0.0, **inputs})
        results["type_b"] = sum(s.share for s in results["budget"].sources if s.kind == "B")
    return results | ({"decision": bc.decide(fitted, limit).decisions[0]} if limit else {})


def _fit_known(
    y: Any, u: float, columns: Mapping[str, Any], *arguments: Any, **options: Any
) -> bc.Calibration:
    """Fit each estimate y as two readings, y − u and y + u: their mean is y with standard uncertainty u."""
    repeats = {name: np.tile(values, 2) for name, values in columns.items()}
    pairs = np.concatenate([np.asarray(y) - u, np.asarray(y) + u])
    method = bc.LeastSquares(draws=DRAWS)
    return fit(pairs, repeats, *arguments, u=u * 2**0.5, method=method, **options)


def decide_conformity(mean: float, u: float, limit: str, **options: Any) -> Any:
    """Return the decision on the conformity of a quantity to a limit, given its mean and standard uncertainty."""
    calibration = _fit_known([mean], u, {"x0": np.ones(1)})
    return bc.decide(calibration, f"line.b[x0]: {limit}", **options).decisions[0]


def propagate(
    values: list[str],
    *,
    mean: Any = None,
    u: float = 1.0,
    r: float = 0.0,
    observations: Any = None,
    correlated: bool = True,
    method: Any = "draws",
) -> dict[str, Any]:
    """Propagate inputs b1, b2, … to output quantities.

    Correlations of the outputs follow from the standard uncertainties of their pairwise sums.

    Args:
        values: equations of the output quantities.
        mean, u, r: means, standard uncertainty and pairwise correlation of the inputs.
        observations: a row for each input, whose means and (if `correlated`) covariances are used instead.
        method: "draws" (JCGM 101) or "first order" (JCGM 100).

    Returns:
        y, u: values and standard uncertainties of the outputs, then of their pairwise sums. r: pairwise correlations.
    """
    if observations is not None:
        mean = np.mean(observations, axis=1)
        covariance = np.cov(observations) / len(observations[0])
        covariance = covariance if correlated else np.diag(np.diag(covariance))
    else:
        covariance = u**2 * (np.full((len(mean), len(mean)), r) + (1 - r) * np.eye(len(mean)))
    count = len(values)
    root = np.linalg.inv(np.linalg.cholesky(covariance))  # readings with unit variance
    columns = {f"x{i}": c for i, c in enumerate(root.T, 1)}
    expected = " + ".join(f"b{i}*{name}" for i, name in enumerate(columns, 1))
    columns |= {f"w{k}": np.zeros(len(mean)) for k in range(count)}
    value = " + ".join(f"w{k}*({text})" for k, text in enumerate(values))
    calibration = _fit_known(root @ mean, 1.0, columns, mean, expected, value=value)
    pairs = [(i, j) for i in range(count) for j in range(i)]
    weights = np.vstack([np.eye(count), *(np.eye(count)[[pair]].sum(axis=1) for pair in pairs)])
    inputs: Any = {f"w{k}": w for k, w in enumerate(weights.T)}
    inputs |= {"output": np.zeros(len(weights)), "noise": False, "warn": False}
    result = bc.compensator(calibration, draws=DRAWS)(**inputs, method=method)
    sd = result.uncertainty
    pair_sd = zip(sd[count:], pairs, strict=True)
    correlations = [(s**2 - sd[i] ** 2 - sd[j] ** 2) / (2 * sd[i] * sd[j]) for s, (i, j) in pair_sd]
    return {"y": result.value, "u": sd, "r": correlations}


def compare_first_order_with_draws(**inputs: Any) -> list[float]:
    """Return how far y − 2u and y + 2u by the law of propagation of uncertainty are from the Monte Carlo method's."""
    gum, monte_carlo = (propagate(**inputs, method=m) for m in ("first order", "draws"))
    y, u = (gum[key][0] - monte_carlo[key][0] for key in ("y", "u"))
    return [abs(y - 2 * u), abs(y + 2 * u)]


def _at_rest(output: np.ndarray, step: float) -> bc.Measurements:
    time, sensor = step * np.arange(len(output)), ws.instrument_named("still_sensor")
    return bc.Measurements.from_arrays(sensor, units={"output": "deg/s"}, time=time, output=output)


def estimate_noise(seed: int, n: int, step: float, true: Mapping[str, float]) -> dict[str, float]:
    """Simulate n readings with noise coefficients `true` (N, K, B; `angle`: quantum, °); return the estimates."""
    rng, sizes = (np.random.default_rng(seed), dict.fromkeys(("K", "angle"), 0.0) | dict(true))
    rate = sizes["N"] / step**0.5 * rng.standard_normal(n)
    rate += sizes["K"] * step**0.5 * np.cumsum(rng.standard_normal(n))
    rate += np.diff(sizes["angle"] * rng.uniform(-0.5, 0.5, n + 1)) / step
    if "B" in true:  # flicker noise of spectrum B²/(2πf)
        size = true["B"] * np.sqrt(n / (2 * np.pi * np.fft.rfftfreq(2 * n)[1:]))
        normals = rng.standard_normal((n, 2)) @ [1, 1j]
        rate += np.fft.irfft(np.append(0.0, size * normals), 2 * n)[:n]
    return {f.symbol: f.value for f in bc.noise(_at_rest(rate, step)).figures}


def compute_allan_deviation(seed: int, n: int) -> bc.AllanDeviation:
    """Compute the Allan deviation of the pseudo-random sequence in NIST SP 1065, section 12."""
    values = [seed]
    while len(values) < n:
        values.append(16807 * values[-1] % 2147483647)
    return bc.allan_deviation(_at_rest(np.array(values) / 2147483647, 1.0))


def fit_instrument(
    name: str, grid: Any, output: str, true: Any, u: float, add: Any = ()
) -> dict[str, float]:
    """Fit an installed instrument, with effects `add`, to exact outputs on a grid; return effect → estimate."""
    sensor = ws.instrument_named(name)
    columns: dict[str, Any] = dict(
        zip(grid, (m.ravel() for m in np.meshgrid(*grid.values())), strict=True)
    )
    y = evaluate(output, columns | true)
    columns["output_uncertainty"] = np.full(len(y), u)
    readings = bc.Measurements.from_arrays(sensor, output=y, **columns)
    model = (sensor.baseline() + list(add)).fix({"noise.white": 0.0})
    calibration = bc.fit(model, readings, bc.LeastSquares(), strict=False, reference={"T0": 25.0})
    return {n: float(calibration.samples(n).mean()) for n in model.names}
