"""Six reference posteriors of posteriordb, as models of the public API fitted by `Marginal`.

All models are linear in their coefficients: an instrument with one slot, and an effect whose basis functions are the
regressors, with the reference's priors. The eight schools are readings of known standard uncertainty, with a common
effect and a deviation for each school of estimated standard deviation.
Source: M. Magnusson et al., posteriordb (github.com/stan-dev/posteriordb), with Stan's reference draws.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import bayescal as bc
from benchmarks.record import CERTIFIED_DATA

FOLDER = CERTIFIED_DATA / "posteriordb"
SCHOOLS = "eight_schools-eight_schools_noncentered"
NO_NOISE = 1e-9  # where every reading's uncertainty is known; beside 10 it is nothing
# So that its Monte-Carlo error is below the reference's.
METHOD = bc.Marginal(draws=16_000, proposals=32_768)


class Problem(NamedTuple):
    """A model, its readings, and the position of each unknown of the reference in a calibration."""

    model: bc.Model
    readings: bc.Measurements
    draws: Callable[[bc.Calibration], dict[str, np.ndarray]]


class Row(NamedTuple):
    """Comparison of one unknown: shift of its mean in reference sd, ratio of its sd to the reference's."""

    name: str
    shift: float
    ratio: float
    ratio_allowed: float  # 3 % plus three combined Monte-Carlo errors


def regression(
    y: np.ndarray, columns: dict[str, np.ndarray], priors: list, noise: Any, names: list[str]
) -> Problem:
    """Build y ~ N(X·β, σ²). An intercept is a column of ones among `columns`.

    Args:
        y: response.
        columns: regressors by name.
        priors: priors of the coefficients.
        noise: prior of σ.
        names: names of the coefficients and of σ in the reference.
    """
    effect = bc.Effect(
        "value.regression",
        "value",
        basis=lambda r: jnp.stack([r[name] for name in columns], axis=1),
        coefficients=tuple(
            bc.Coefficient("1", p, part=n) for n, p in zip(names, priors, strict=False)
        ),
        columns=tuple(columns),
    )
    model = _instrument((effect,), tuple(columns), bc.White(noise)).baseline()
    arrays: dict[str, Any] = {"output": y, **columns}
    readings = bc.Measurements.from_arrays(model.instrument, **arrays)

    def draws(fit: bc.Calibration) -> dict[str, np.ndarray]:
        samples = {n: fit.samples(f"value.regression[{n}]") for n in names[:-1]}
        return {**samples, names[-1]: fit.samples("noise.white")}

    return Problem(model, readings, draws)


def schools(
    y: np.ndarray, sigma: np.ndarray, centre_sd: float = 5.0, spread: float = 5.0
) -> Problem:
    """Build y_j ~ N(θ_j, σ_j), θ_j ~ N(µ, τ), µ ~ N(0, centre_sd), τ ~ half-Cauchy(0, spread)."""
    common = bc.Effect(
        "value.common", "value", _ones, (bc.Coefficient("1", bc.Normal(0.0, centre_sd)),)
    )
    school_effect = bc.Effect(
        "value.school",
        "value",
        _ones,
        (bc.Coefficient("1", per="device", group_sd=bc.HalfCauchy(spread)),),
    )
    model = _instrument((common, school_effect), (), bc.White(), groups=("device",)).baseline()
    model = model.fix({"noise.white": NO_NOISE})
    readings = bc.Measurements.from_arrays(
        model.instrument,
        output=y,
        output_uncertainty=sigma,
        device=[f"school {j}" for j in range(1, len(y) + 1)],
    )

    def draws(fit: bc.Calibration) -> dict[str, np.ndarray]:
        mu, tau = fit.samples("value.common"), fit.samples("value.school.group_sd")
        theta = mu[:, None] + fit.samples("value.school")
        samples = {f"theta[{j + 1}]": theta[:, j] for j in range(theta.shape[1])}
        return {**samples, "mu": mu, "tau": tau}

    return Problem(model, readings, draws)


def _instrument(effects, columns, noise, groups=()) -> bc.Instrument:
    return bc.Instrument(
        "regression",
        "a regression of posteriordb",
        columns=(
            bc.Column("output", "1"),
            *(bc.Column(name, "1") for name in columns),
            *(bc.Column(name, None) for name in groups),
        ),
        slots=(bc.Slot("value", "1"),),
        response=_value,
        effects=effects,
        noise=noise,
    )


# Functions of the module, not of a call: models made twice are equal, and compiled once.
def _ones(readings: bc.Frame) -> jax.Array:
    return jnp.ones(readings.size)


def _value(slots, readings):
    return slots["value"]


def _betas(count: int) -> list[str]:
    return [*(f"beta[{i}]" for i in range(1, count + 1)), "sigma"]


def _earnings(d: dict) -> Problem:
    y = np.log(d["earn"])
    columns = {"one": np.ones_like(y), "height": d["height"], "male": d["male"]}
    columns["product"] = d["height"] * d["male"]
    return regression(y, columns, [bc.Flat()] * 4, bc.Flat(), _betas(4))


def _kidiq(d: dict) -> Problem:
    columns = {"one": np.ones(d["N"]), "mom_iq": d["mom_iq"]}
    return regression(d["kid_score"], columns, [bc.Flat()] * 2, bc.HalfCauchy(2.5), _betas(2))


def _kilpisjarvi(d: dict) -> Problem:
    columns = {"one": np.ones(d["N"]), "year": d["x"]}
    priors = [bc.Normal(d["pmualpha"], d["psalpha"]), bc.Normal(d["pmubeta"], d["psbeta"])]
    return regression(d["y"], columns, priors, bc.Flat(), ["alpha", "beta", "sigma"])


def _mesquite(d: dict) -> Problem:
    logged = ("diam1", "diam2", "canopy_height", "total_height", "density")
    columns = {"one": np.ones(d["N"]), **{name: np.log(d[name]) for name in logged}}
    columns["shrub_group"] = d["group"]
    return regression(np.log(d["weight"]), columns, [bc.Flat()] * 7, bc.Flat(), _betas(7))


def _sblri(d: dict) -> Problem:
    columns = {f"x{i}": column for i, column in enumerate(d["X"].T, 1)}
    return regression(d["y"], columns, [bc.Normal(0.0, 10.0)] * 5, bc.HalfNormal(10.0), _betas(5))


PROBLEMS: dict[str, Callable[[dict], Problem]] = {
    "earnings-logearn_interaction": _earnings,
    "kidiq-kidscore_momiq": _kidiq,
    "kilpisjarvi_mod-kilpisjarvi": _kilpisjarvi,
    "mesquite-logmesquite": _mesquite,
    "sblri-blr": _sblri,
    SCHOOLS: lambda d: schools(d["y"], d["sigma"]),
}


def problem(name: str, folder: Path = FOLDER) -> tuple[Problem, dict[str, dict[str, float]]]:
    """Return a problem and the reference's summary."""
    raw = json.loads((folder / name / "data.json").read_text("utf-8"))
    data = {k: np.asarray(v, float) if isinstance(v, list) else v for k, v in raw.items()}
    reference = json.loads((folder / name / "summary.json").read_text("utf-8"))
    return PROBLEMS[name](data), reference


def sd_error(draws: np.ndarray, batches: int = 20) -> float:
    """Estimate the relative Monte-Carlo error of the draws' standard deviation from batches."""
    batch_sds = [part.std(ddof=1) for part in np.array_split(draws, batches)]
    return float(np.std(batch_sds, ddof=1) / np.sqrt(batches) / draws.std(ddof=1))


def compare(name: str, folder: Path = FOLDER, seed: int = 0) -> tuple[bc.Calibration, list[Row]]:
    """Fit by `Marginal` and compare each unknown with the reference."""
    posterior, reference = problem(name, folder)
    fit = bc.fit(posterior.model, posterior.readings, METHOD, seed=seed)
    rows = []
    for unknown, draws in posterior.draws(fit).items():
        reference_draws = reference[unknown]
        combined = float(np.hypot(reference_draws["sd_relative_error"], sd_error(draws)))
        rows.append(
            Row(
                name=unknown,
                shift=float(draws.mean() - reference_draws["mean"]) / reference_draws["sd"],
                ratio=float(draws.std(ddof=1)) / reference_draws["sd"],
                ratio_allowed=0.03 + 3 * combined,
            )
        )
    return fit, rows
