"""NIST's linear sets through the public API: an instrument whose one effect is the set's columns, flat priors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import bayescal as bc
from benchmarks.accuracy.nist import FOLDER, Estimate, certificate, digits

# (centre, half-width) where powers of x are too nearly parallel for a double: Legendre polynomials
# of u = (x − centre)/half-width span the same and are not.
CENTRED = {"filip": (-6.0, 3.0), **{f"wampler{i}": (10.0, 10.0) for i in range(1, 6)}}
LINEAR = (
    "norris",
    "pontius",
    "noint1",
    "noint2",
    "filip",
    "longley",
    *(f"wampler{i}" for i in range(1, 6)),
)


def line_model(
    columns: dict[str, np.ndarray], powers: tuple[int, ...], place: tuple[float, float] | None
) -> bc.Model:
    """A model whose effect is powers of x, or Legendre polynomials of (x − centre)/half-width, or
    (without `powers`) the columns themselves with a constant."""

    def basis(r: bc.Frame):
        if place:
            u = (r["x"] - place[0]) / place[1]
            terms = [jnp.ones(r.size), u]
            for k in powers[1:-1]:
                terms.append(((2 * k + 1) * u * terms[k] - k * terms[k - 1]) / (k + 1))
            return jnp.stack(terms, axis=1)
        if powers:
            return jnp.stack([r["x"] ** k for k in powers], axis=1)
        return jnp.stack([jnp.ones(r.size), *(r[name] for name in columns)], axis=1)

    count = len(powers) or len(columns) + 1
    effect = bc.Effect(
        "value.line",
        "value",
        basis=basis,
        coefficients=tuple(bc.Coefficient("1", bc.Flat(), part=f"b{i}") for i in range(count)),
        columns=tuple(columns),
        source="NIST StRD, linear regression",
    )
    instrument = bc.Instrument(
        "line",
        "a linear regression",
        columns=(bc.Column("output", "1"), *(bc.Column(name, "1") for name in columns)),
        slots=(bc.Slot("value", "1"),),
        response=lambda slots, readings: slots["value"],
        effects=(effect,),
        noise=bc.White(bc.Flat()),
    )
    return instrument.baseline()


def expand(degree: int, centre: float, half: float) -> np.ndarray:
    """Return T such that β = T·γ: from Legendre polynomials of (x − centre)/half to powers of x."""
    size = degree + 1
    shifted, powers = np.zeros((size, size)), np.zeros((size, size))
    for k in range(size):
        powers[: k + 1, k] = np.polynomial.legendre.leg2poly(np.eye(size)[k, : k + 1])
        for j in range(k + 1):
            shifted[j, k] = math.comb(k, j) * (-centre) ** (k - j) / half**k
    return shifted @ powers


def fit_linear(
    columns: dict[str, np.ndarray],
    y: np.ndarray,
    powers: tuple[int, ...] = (),
    place: tuple[float, float] | None = None,
) -> Estimate:
    """Fit a polynomial in `x`, or all columns and a constant, by `bc.fit` with `LeastSquares`."""
    model = line_model(columns, powers, place)
    arrays: dict[str, Any] = {"output": y, **columns}
    readings = bc.Measurements.from_arrays(model.instrument, **arrays)
    fit = bc.fit(model, readings, bc.LeastSquares(), strict=False)
    names = model.effects[0].coefficients
    draws = np.stack([fit.samples(f"value.line[{c.part}]") for c in names], axis=1)
    best = fit.mode.x + fit.layout.origin_of_x  # the mean of the draws but for their rounding
    if place:
        matrix = expand(powers[-1], *place)
        best, draws = matrix @ best, draws @ matrix.T
    noise = float(fit.samples("noise.white")[0])
    return Estimate(best, draws.std(axis=0, ddof=1), noise, fit.verdict.ok)


def linear_digits(name: str, centred: bool = True, folder: Path = FOLDER) -> dict[str, Any]:
    """Return the agreeing digits of parameters, standard deviations and residual standard deviation."""
    exact_values, table = certificate(folder, "linear", name)
    powers = tuple(int(t[2:]) for t in exact_values["terms"] if t.startswith("x^"))
    labels = ["x"] if powers else [t for t in exact_values["terms"] if t != "1"]
    columns = dict(zip(labels, table[:, 1:].T, strict=True))
    place = CENTRED.get(name) if centred else None
    fit = fit_linear(columns, table[:, 0], powers, place)
    exact = float(exact_values["residual_sd_exact"]) == 0
    return {
        "set": name,
        "basis": "Legendre" if place else "as given",
        "parameters": round(
            digits(fit.parameters, [float(b) for b in exact_values["beta_exact"]]), 2
        ),
        "sd": None
        if exact
        else round(digits(fit.sd, [float(s) for s in exact_values["sd_exact"]]), 2),
        "residual_sd": None
        if exact
        else round(digits(fit.residual_sd, exact_values["residual_sd_exact"]), 2),
        "converged": fit.converged,
    }
