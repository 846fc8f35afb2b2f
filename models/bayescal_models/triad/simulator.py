"""Simulator of three dies, each with its own input axis, in poses at rest.

An axis senses the specific force along its own direction, a row of the sensor's matrix; quadratic terms are those of
its equation. Everything is computed pose by pose in NumPy, independently of the instrument's equation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayescal_models.simulated import refuse
from bayescal_models.triad.campaign import Campaign

BODY = 200.0  # s, time constant of the dies
REFERENCE = 25.0  # °C, reference temperature of bias, scale and misalignment
# Factors of a hidden effect's size for the members of its family.
SHARES = np.array([1.0, -0.6, 0.8, -1.0, 0.5, 0.9, -0.7, 1.0, -0.4])
PAIRS = ((0, 1), (0, 2), (1, 2))
OFF_DIAGONAL = (*PAIRS, (1, 0), (2, 0), (2, 1))
# Effects, and their numbers of coefficients.
COUNTS = {
    **dict.fromkeys(("bias.constant", "bias.temperature", "bias.temperature_quadratic"), 3),
    **dict.fromkeys(("bias.thermal_lag", "bias.drift", "bias.run"), 3),
    **dict.fromkeys(("scale.constant", "scale.temperature"), 3),
    **dict.fromkeys(("misalignment.constant", "misalignment.temperature"), 3),
    **dict.fromkeys(("misalignment.frame", "square.constant", "cube.constant"), 3),
    "cross.constant": 9,
}


def members_of(
    effects: Mapping[str, Any] | None,
    counts: Mapping[str, int],
    baseline: Mapping[str, Any],
    names: Collection[str] | None = None,
) -> dict[str, np.ndarray]:
    """Return sizes of the members of every family, by canonical name.

    Args:
        effects: canonical name → size, multiplied by `SHARES` for the members; or one for each member.
        counts: number of members of each family; others are zero.
        baseline: baseline effects, present unless overridden.
        names: effects that can be given; all of `counts` if not given.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    requested, names = dict(effects or {}), counts if names is None else names
    for name, size in requested.items():
        refuse(name not in names, f"no effect {name}: choose among {', '.join(names)}")
        refuse(not np.all(np.isfinite(size)), f"{name}: its size {size!r} is not finite")
    sizes = {name: np.zeros(count) for name, count in counts.items()}
    sizes |= {name: np.asarray(members, float) for name, members in baseline.items()}
    for name, size in requested.items():
        sizes[name] = size * SHARES[: counts[name]] if np.ndim(size) == 0 else np.asarray(size)
    return sizes


def matrix_of(scale: Any, angles: Any) -> np.ndarray:
    """Return sensor matrices (…, 3, 3) of scale factor deviations (…, 3) and three or six angles (…, k), rad."""
    matrix = np.eye(3) * (1 + np.asarray(scale)[..., None])
    for k in range(np.shape(angles)[-1]):
        matrix[..., *OFF_DIAGONAL[k]] = np.asarray(angles)[..., k]
    return matrix


def bias_of(
    sizes: Mapping[str, np.ndarray],
    temperature: np.ndarray,
    progress: np.ndarray,
    lag: np.ndarray,
    run_deviates: np.ndarray,
) -> np.ndarray:
    """Return the bias of each axis (n, 3), in the unit of its effects.

    Args:
        sizes: effect → its true value on each axis (3,).
        temperature, progress, lag: °C, (t − t̄)/duration of the test, °C of the body behind the thermometer, (n,) each.
        run_deviates: standard normal deviates (n, 3), constant within a run.
    """
    warm = (temperature - REFERENCE)[:, None]
    bias = sizes["bias.constant"] + sizes["bias.temperature"] * warm
    bias = bias + sizes["bias.temperature_quadratic"] * warm**2
    bias = bias + sizes["bias.thermal_lag"] * lag[:, None]
    return bias + sizes["bias.drift"] * progress[:, None] + sizes["bias.run"] * run_deviates


def simulator_of(
    baseline: Mapping[str, Any], names: Sequence[str], small: float, plan: type[Campaign]
) -> Callable[..., dict[str, Any]]:
    """Build a simulator of poses.

    Args:
        baseline: baseline effects, present unless overridden, by its canonical name: sizes of its three members.
        names: effects of the instrument.
        small: unit of biases and second-order terms in output units, such as 10⁻³ for mg.
        plan: class of its campaigns; an instance without options is the default.
    """

    def simulated_columns(
        effects: Mapping[str, Any] | None = None, *, seed: int, campaign: Campaign | None = None
    ) -> dict[str, Any]:
        """Simulate columns of poses with hidden effects, by name.

        Args:
            effects: canonical name → true size, in the unit of the effect's coefficients, multiplied by
                `SHARES` for its members; bias, scale and misalignment are present unless given.
            seed: seed of the random-number generator.
            campaign: the poses; random ones if not given.

        Raises:
            ValueError: an unknown effect, or a size that is not a finite number.
        """
        sizes = members_of(effects, COUNTS, baseline, names)
        return _poses(sizes, small, seed, campaign or plan())

    return simulated_columns


def _poses(
    sizes: Mapping[str, np.ndarray], small: float, seed: int, campaign: Campaign
) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    rows_per_run = len(campaign.temperatures) * campaign.poses
    count = campaign.runs * rows_per_run
    nominal = np.concatenate(
        [
            directions(campaign.kind, campaign.poses, rng)
            for _ in range(campaign.runs * len(campaign.temperatures))
        ]
    )
    angle = campaign.pose_uncertainty or 0.0
    force = campaign.magnitude * perturbed(nominal, angle, rng)
    temperature = np.tile(np.repeat(campaign.temperatures, campaign.poses), campaign.runs)
    run = np.repeat(np.arange(campaign.runs), rows_per_run)
    time = campaign.interval * np.arange(count) + 3600.0 * run
    of_run, noise = rng.standard_normal((campaign.runs, 3)), rng.standard_normal((count, 3))
    warm = (temperature - REFERENCE)[:, None]
    progress = (time - time.mean()) / max(float(np.ptp(time)), 1.0)
    lag = lag_of(temperature, run, np.full(count, campaign.interval))
    bias = bias_of(sizes, temperature, progress, lag, of_run[run])
    scale = 1e-6 * (sizes["scale.constant"] + sizes["scale.temperature"] * warm)
    upper = 1e-3 * (sizes["misalignment.constant"] + sizes["misalignment.temperature"] * warm)
    lower = np.tile(1e-3 * sizes["misalignment.frame"], (count, 1))
    products = np.stack([force[:, i] * force[:, j] for i, j in PAIRS], axis=1)
    higher = sizes["square.constant"] * force**2 + sizes["cube.constant"] * force**3
    higher = higher + products @ sizes["cross.constant"].reshape(3, 3).T
    matrix = matrix_of(scale, np.hstack([upper, lower]))
    output = np.einsum("nij,nj->ni", matrix, force) + small * (bias + higher)
    output += campaign.noise * noise
    table: dict[str, Any] = {"run": (run + 1).astype(str), "time": time, "temperature": temperature}
    table["magnitude"] = np.full(count, campaign.magnitude)
    table |= {f"output_{a}": output[:, i] for i, a in enumerate("xyz")}
    if campaign.pose_uncertainty is not None:
        table |= {f"direction_{a}": nominal[:, i] for i, a in enumerate("xyz")}
        table["pose_uncertainty"] = np.full(count, angle)
    return table


def lag_of(temperature: np.ndarray, run: np.ndarray, pause: np.ndarray) -> np.ndarray:
    """Return the lag of the dies behind the thermometer, °C, with time constant `BODY`; zero at the start of each run.

    Args:
        temperature, run, pause: of each reading, °C, from 0, and s since the reading before.
    """
    lag, kept = np.zeros(len(temperature)), np.exp(-pause / BODY)
    for i in range(1, len(lag)):
        if run[i] == run[i - 1]:
            lag[i] = (lag[i - 1] + temperature[i - 1] - temperature[i]) * kept[i]
    return lag


def directions(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors (count, 3).

    Args:
        kind: "random" over the sphere; "six" each axis up and down, in turn; "twelve" halfway between two axes, in
            turn; "planar" at random angles about the y axis; "level" within 10° of z up.
        count: number of poses.
        rng: random-number generator.
    """
    if kind == "random":
        vectors = rng.standard_normal((count, 3))
    elif kind == "six":
        vectors = np.resize(np.concatenate([np.eye(3), -np.eye(3)]), (count, 3))
    elif kind == "twelve":
        pairs = [
            (i, j, s, t) for i, j in ((0, 1), (0, 2), (1, 2)) for s in (1, -1) for t in (1, -1)
        ]
        vectors = np.zeros((12, 3))
        for row, (i, j, s, t) in zip(vectors, pairs, strict=True):
            row[i], row[j] = s, t
        vectors = np.resize(vectors, (count, 3))
    elif kind == "planar":
        angle = rng.uniform(0, 2 * np.pi, count)
        vectors = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    else:
        tilt = np.deg2rad(10) * np.sqrt(rng.uniform(size=count))
        way = rng.uniform(0, 2 * np.pi, count)
        across = np.sin(tilt)
        vectors = np.column_stack([across * np.cos(way), across * np.sin(way), np.cos(tilt)])
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def perturbed(direction: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Perturb directions by a random angle of this standard deviation about each cross axis, rad."""
    perturbed = direction + angle * rng.standard_normal(direction.shape)
    return perturbed / np.linalg.norm(perturbed, axis=1)[:, None]
