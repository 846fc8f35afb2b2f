"""Sixty candidate effects on 2000 readings: one scan, beside sixty refits by lmfit and one fit by `Marginal`.

The scan is `bc.discover` without its verifying refits: scores of all candidates (and of the instrument's own three
more), and sets of what cannot be told apart. One candidate is hidden in the readings; the scan must lead with it, and
its log Bayes factor must be the exact one, which is an integral over the noise alone here.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from bayescal_models import mems_gyro
from benchmarks.speed.timing import clocks, interleaved

READINGS, CANDIDATES, SEED = 2000, 60, 7
HIDDEN, SIZE, PRIOR, NOISE = 17, 0.05, 0.05, 0.2  # which cosine; °/s
LOW, HIGH, T0 = -40.0, 80.0, 20.0  # °C
REPEATS = 5
GOALS = {"lmfit": 20.0, "Marginal": 1.0}


def _basis(temperature: Any, k: int, module: Any) -> Any:
    return module.cos(k * module.pi * (temperature - LOW) / (HIGH - LOW))


def effects() -> list[bc.Effect]:
    """Cosines of the temperature; made once, for a new function is a new program."""
    return [
        bc.Effect(
            f"bias.cosine_{k:02d}",
            "bias",
            basis=lambda r, k=k: _basis(r["temperature"], k, jnp),
            coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, PRIOR)),),
            columns=("temperature",),
            varies=("temperature",),
        )
        for k in range(2, CANDIDATES + 2)
    ]


def arrays() -> tuple[np.ndarray, np.ndarray]:
    """Temperature, °C, and output, °/s."""
    rng = np.random.default_rng(SEED)
    temperature = rng.uniform(LOW, HIGH, READINGS)
    temperature += T0 - temperature.mean()  # so that the reference temperature is T0
    output = 2.0 + 0.03 * (temperature - T0) + SIZE * _basis(temperature, HIDDEN, np)
    return temperature, output + rng.normal(0.0, NOISE, READINGS)


def by_lmfit(columns: list[np.ndarray], y: np.ndarray) -> list[Any]:
    """Offset, slope and one candidate, as often as there are columns: results of lmfit."""
    import lmfit  # pyright: ignore[reportMissingImports]

    temperature, found = columns[0], []
    for column in columns[1:]:

        def residuals(p: Any, c: np.ndarray = column) -> np.ndarray:
            x = p.valuesdict()
            return y - x["offset"] - x["slope"] * temperature - x["size"] * c

        start = lmfit.Parameters()
        for name in ("offset", "slope", "size"):
            start.add(name, value=0.0)
        found.append(lmfit.minimize(residuals, start))
    return found


def by_lstsq(columns: list[np.ndarray], y: np.ndarray) -> list[np.ndarray]:
    """The same in closed form, by `numpy.linalg.lstsq`: what sixty refits cost at the least."""
    ones = np.ones_like(y)
    return [
        np.linalg.lstsq(np.column_stack([ones, columns[0], c]), y, rcond=None)[0]
        for c in columns[1:]
    ]


def log_evidence(jacobian: np.ndarray, sd: np.ndarray, y: np.ndarray) -> float:
    """log p(y) of a linear model, coefficients in closed form and the noise (half-Cauchy, 0.1 °/s) by quadrature."""
    v = np.log(NOISE / 0.1) + np.linspace(-0.3, 0.3, 6001)
    sigma = 0.1 * np.exp(v)
    scaled = jacobian * sd
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    pull = vectors.T @ (scaled.T @ y)
    s2 = sigma[:, None] ** 2
    inner = np.sum(np.log1p(values / s2), axis=1)
    rest = (y @ y - np.sum(pull**2 / (values + s2), axis=1)) / sigma**2
    density = -0.5 * (len(y) * np.log(2 * np.pi * sigma**2) + inner + rest)
    density += np.log(2 / np.pi) - np.logaddexp(0.0, 2 * v) + v
    top = density.max()
    return float(top + np.log(np.trapezoid(np.exp(density - top), v)))


def scan() -> dict[str, Any]:
    """The row.

    Raises:
        RuntimeError: the scan does not lead with what is hidden, or its log Bayes factor or sizes are wrong.
    """
    temperature, y = arrays()
    readings = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, temperature=temperature, output=y)
    model, candidates = mems_gyro.INSTRUMENT.baseline(), effects()
    fitted = bc.fit(model, readings)
    columns = [temperature - T0]
    columns += [_basis(temperature, k, np) for k in range(2, CANDIDATES + 2)]

    def look() -> bc.Discovery:
        return bc.discover(fitted, effects=candidates)

    look()
    timed = interleaved(
        {
            "scan": look,
            "Marginal": lambda: bc.fit(model, readings),
            "lmfit": lambda: by_lmfit(columns, y),
            "lstsq": lambda: by_lstsq(columns, y),
        },
        REPEATS,
    )
    best = clocks(timed)
    told = {c.effect: c for c in timed["scan"].made.candidates}
    named = [told[e.name] for e in candidates]
    place = int(np.argmax([c.log_bayes_factor or -np.inf for c in named]))
    lead, refits = named[place], timed["lmfit"].made
    if place != HIDDEN - 2 or place != int(np.argmin([r.chisqr for r in refits])):
        raise RuntimeError(f"bias.cosine_{HIDDEN:02d} is hidden; the scan leads with {lead}")
    sd = np.array([e.coefficients[0].size for e in model.effects])
    base = np.column_stack([np.ones(READINGS), columns[0]])
    more = np.column_stack([base, columns[place + 1]])
    exact = log_evidence(more, np.append(sd, PRIOR), y) - log_evidence(base, sd, y)
    by_score = float(lead.log_bayes_factor or np.nan)
    size = refits[place].params["size"]
    apart = abs(lead.size / (1 - (size.stderr / PRIOR) ** 2) - size.value) / size.stderr
    if not (abs(by_score - exact) < max(0.5, 0.05 * exact) and apart < 0.2):
        raise RuntimeError(f"log BF {by_score} by score, exactly {exact}; sizes {apart} sd apart")
    ratio = {name: best[name] / best["scan"] for name in ("lmfit", "lstsq", "Marginal")}
    return {
        "candidates": len([c for c in told.values() if c.log_bayes_factor is not None]),
        "seconds": best,
        "log_bayes_factor": {"score": by_score, "exact": exact},
        "size_apart_sd": float(apart),
        "lmfit_over_scan": ratio["lmfit"],
        "lstsq_over_scan": ratio["lstsq"],
        "scan_over_marginal": 1 / ratio["Marginal"],
        "goals": GOALS,
        "told": f"scan {1e3 * best['scan']:.0f} ms; lmfit's refits {ratio['lmfit']:.1f} × that (goal "
        f"{GOALS['lmfit']:.0f}), numpy's lstsq {ratio['lstsq']:.2f} ×; scan {1 / ratio['Marginal']:.2f} of a Marginal "
        f"fit of {1e3 * best['Marginal']:.0f} ms (goal below 1); log Bayes factor {by_score:.2f}, exactly {exact:.2f}",
    }
