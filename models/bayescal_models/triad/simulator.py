"""Simulator of a triad of three dies, each with its own input axis, in poses at rest.

An axis senses the input along its own direction, a row of the sensor matrix, plus second- and third-order terms.
Outputs are computed pose by pose in NumPy, independently of the implementation of the instrument's equation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bayescal_models.simulated import raise_if
from bayescal_models.triad.campaign import Campaign

DIE_TAU_S = 200.0  # s, time constant of the dies
T0_DEGC = 25.0  # °C, reference temperature of bias, scale and misalignment
# Factors that multiply a hidden effect's size for the effect's coefficients.
FACTORS = np.array([1.0, -0.6, 0.8, -1.0, 0.5, 0.9, -0.7, 1.0, -0.4])
AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))
OFF_DIAGONAL_INDICES = (*AXIS_PAIRS, (1, 0), (2, 0), (2, 1))
# Effect name → number of coefficients.
MEMBER_COUNTS = {
    **dict.fromkeys(("bias.constant", "bias.temperature", "bias.temperature_quadratic"), 3),
    **dict.fromkeys(("bias.thermal_lag", "bias.drift", "bias.run"), 3),
    **dict.fromkeys(("scale.constant", "scale.temperature"), 3),
    **dict.fromkeys(("misalignment.constant", "misalignment.temperature"), 3),
    **dict.fromkeys(("misalignment.frame", "square.constant", "cube.constant"), 3),
    "cross.constant": 9,
}


def expand_sizes(
    effects: Mapping[str, Any] | None,
    counts: Mapping[str, int],
    baseline: Mapping[str, Any],
    names: Collection[str] | None = None,
) -> dict[str, np.ndarray]:
    """Return the true coefficients of every effect, by canonical name; those of absent effects are zero.

    Args:
        effects: canonical name → size: a number, which `FACTORS` scales for each coefficient, or one per coefficient.
        counts: number of coefficients of each effect.
        baseline: coefficients of baseline effects, replaced by those in `effects`.
        names: names of the effects that the simulator accepts; None: all of `counts`.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    true_sizes, names = dict(effects or {}), counts if names is None else names
    for name, size in true_sizes.items():
        raise_if(name not in names, f"unknown effect {name!r}: choose among {', '.join(names)}")
        raise_if(not np.all(np.isfinite(size)), f"{name}: its size {size!r} is not finite")
    sizes = {name: np.zeros(count) for name, count in counts.items()}
    sizes |= {name: np.asarray(coefficients, float) for name, coefficients in baseline.items()}
    for name, size in true_sizes.items():
        sizes[name] = size * FACTORS[: counts[name]] if np.ndim(size) == 0 else np.asarray(size)
    return sizes


def axis_matrix(scale: Any, angles: Any) -> np.ndarray:
    """Return sensor matrices (…, 3, 3) from scale factor deviations (…, 3) and three or six angles (…, k), rad."""
    matrix = np.eye(3) * (1 + np.asarray(scale)[..., None])
    for k in range(np.shape(angles)[-1]):
        matrix[..., *OFF_DIAGONAL_INDICES[k]] = np.asarray(angles)[..., k]
    return matrix


def axis_bias(
    sizes: Mapping[str, np.ndarray],
    temperature: np.ndarray,
    progress: np.ndarray,
    lag: np.ndarray,
    run_deviates: np.ndarray,
) -> np.ndarray:
    """Return the bias of each axis at each reading, (n, 3), in the unit of `bias.constant`.

    Args:
        sizes: effect name → true coefficient of each axis, (3,).
        temperature, lag: temperature, and temperature of the dies minus that of the thermometer, °C, (n,).
        progress: (t − t̄)/duration of the test, (n,).
        run_deviates: standard normal deviates (n, 3), constant within a run.
    """
    departure = (temperature - T0_DEGC)[:, None]
    bias = sizes["bias.constant"] + sizes["bias.temperature"] * departure
    bias = bias + sizes["bias.temperature_quadratic"] * departure**2
    bias = bias + sizes["bias.thermal_lag"] * lag[:, None]
    return bias + sizes["bias.drift"] * progress[:, None] + sizes["bias.run"] * run_deviates


def make_pose_simulator(
    baseline: Mapping[str, Any], names: Sequence[str], bias_unit: float, plan: type[Campaign]
) -> Callable[..., dict[str, Any]]:
    """Return a simulator of poses for one kind of triad.

    Args:
        baseline: true coefficients of baseline effects, by canonical name.
        names: names of the effects that the simulator accepts.
        bias_unit: unit of biases and higher-order coefficients in output units, such as 10⁻³ for mg.
        plan: class of campaigns; without options, it gives the default campaign.
    """

    def simulate_columns(
        effects: Mapping[str, Any] | None = None, *, seed: int, campaign: Campaign | None = None
    ) -> dict[str, Any]:
        """Simulate poses with hidden effects; return columns by name.

        Args:
            effects: canonical name → true size in the unit of the effect's coefficients: a number, which `FACTORS`
                scales for each coefficient, or one per coefficient. Bias, scale, misalignment have default sizes.
            seed: seed of the random-number generator.
            campaign: plan of the poses; None: the default campaign.

        Raises:
            ValueError: an unknown effect, or a size that is not a finite number.
        """
        sizes = expand_sizes(effects, MEMBER_COUNTS, baseline, names)
        return _simulate_poses(sizes, bias_unit, seed, campaign or plan())

    return simulate_columns


def _simulate_poses(
    sizes: Mapping[str, np.ndarray], bias_unit: float, seed: int, campaign: Campaign
) -> dict[str, Any]:
    rng, rows_per_run = np.random.default_rng(seed), len(campaign.temperatures) * campaign.poses
    count = campaign.runs * rows_per_run
    kind, set_indices = campaign.kind, range(campaign.runs * len(campaign.temperatures))
    nominal = np.concatenate([draw_directions(kind, campaign.poses, rng) for _ in set_indices])
    pose_sd = campaign.pose_uncertainty or 0.0
    force = campaign.magnitude * perturb_directions(nominal, pose_sd, rng)
    temperature = np.tile(np.repeat(campaign.temperatures, campaign.poses), campaign.runs)
    run = np.repeat(np.arange(campaign.runs), rows_per_run)
    time = campaign.interval * np.arange(count) + 3600.0 * run
    run_deviates, noise = rng.standard_normal((campaign.runs, 3)), rng.standard_normal((count, 3))
    departure = (temperature - T0_DEGC)[:, None]
    progress = (time - time.mean()) / max(float(np.ptp(time)), 1.0)
    lag = die_lag(temperature, run, np.full(count, campaign.interval))
    bias = axis_bias(sizes, temperature, progress, lag, run_deviates[run])
    scale = 1e-6 * (sizes["scale.constant"] + sizes["scale.temperature"] * departure)
    upper = 1e-3 * (sizes["misalignment.constant"] + sizes["misalignment.temperature"] * departure)
    frame_angles = np.tile(1e-3 * sizes["misalignment.frame"], (count, 1))
    products = np.stack([force[:, i] * force[:, j] for i, j in AXIS_PAIRS], axis=1)
    higher_order = sizes["square.constant"] * force**2 + sizes["cube.constant"] * force**3
    higher_order = higher_order + products @ sizes["cross.constant"].reshape(3, 3).T
    matrix = axis_matrix(scale, np.hstack([upper, frame_angles]))
    output = np.einsum("nij,nj->ni", matrix, force) + bias_unit * (bias + higher_order)
    output += campaign.noise * noise
    table: dict[str, Any] = {"run": (run + 1).astype(str), "time": time, "temperature": temperature}
    table["magnitude"] = np.full(count, campaign.magnitude)
    table |= {f"output_{a}": output[:, i] for i, a in enumerate("xyz")}
    if campaign.pose_uncertainty is not None:
        table |= {f"direction_{a}": nominal[:, i] for i, a in enumerate("xyz")}
        table["pose_uncertainty"] = np.full(count, pose_sd)
    return table


def die_lag(temperature: np.ndarray, run: np.ndarray, interval: np.ndarray) -> np.ndarray:
    """Return the temperature of the dies minus that of the thermometer, °C, (n,); zero at the start of each run.

    Args:
        temperature: temperature of each reading, °C, (n,).
        run: run index of each reading, (n,).
        interval: time since the previous reading, s, (n,).
    """
    lag, decay = np.zeros(len(temperature)), np.exp(-interval / DIE_TAU_S)
    for i in range(1, len(lag)):
        if run[i] == run[i - 1]:
            lag[i] = (lag[i - 1] + temperature[i - 1] - temperature[i]) * decay[i]
    return lag


def draw_directions(kind: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the directions of poses, unit vectors (count, 3).

    Args:
        kind: "random": uniform on the sphere; "six": each axis up and down, in turn; "twelve": halfway between two
            axes, in turn; "planar": at random angles about the y axis; "level": within 10° of z up.
        count: number of poses.
        rng: random-number generator.
    """
    if kind == "random":
        vectors = rng.standard_normal((count, 3))
    elif kind == "six":
        vectors = np.resize(np.concatenate([np.eye(3), -np.eye(3)]), (count, 3))
    elif kind == "twelve":
        axis_pairs = [
            (i, j, s, t) for i, j in ((0, 1), (0, 2), (1, 2)) for s in (1, -1) for t in (1, -1)
        ]
        vectors = np.zeros((12, 3))
        for row, (i, j, s, t) in zip(vectors, axis_pairs, strict=True):
            row[i], row[j] = s, t
        vectors = np.resize(vectors, (count, 3))
    elif kind == "planar":
        angle = rng.uniform(0, 2 * np.pi, count)
        vectors = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    else:
        tilt = np.deg2rad(10) * np.sqrt(rng.uniform(size=count))
        angle, radius = rng.uniform(0, 2 * np.pi, count), np.sin(tilt)
        vectors = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.cos(tilt)])
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def perturb_directions(direction: np.ndarray, angle: float, rng: np.random.Generator) -> np.ndarray:
    """Return directions (n, 3) rotated by random angles with standard deviation `angle`, rad, about each cross axis."""
    vectors = direction + angle * rng.standard_normal(direction.shape)
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]
