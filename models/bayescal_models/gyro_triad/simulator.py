"""Readings of a simulated rate-table test: a unit of three gyroscopes, mounted with one axis up after the other.

Each mounting is off by a small rotation of its own, by which rate and gravity both stand beside their nominal axis. All
of it is computed reading by reading in NumPy, independently of the instrument's equation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bayescal_models.gyro_triad.campaign import Campaign
from bayescal_models.triad.simulator import BODY, REFERENCE, matrix_of, members_of

MOUNTING_SD = 1e-3  # rad, of the mounting's rotation about each axis
# The unit that is there unless effects say otherwise: bias °/s, scale ppm, misalignment mrad.
BASELINE = {
    "bias.constant": (0.5, -0.8, 0.3),
    "scale.constant": (4000.0, -3000.0, 6000.0),
    "misalignment.constant": (3.0, -5.0, 2.0, 4.0, -2.0, 6.0),
}
COUNTS = {
    "bias.constant": 3,
    "bias.temperature": 3,
    "bias.temperature_quadratic": 3,
    "bias.g_sensitivity": 9,
    "bias.thermal_lag": 3,
    "bias.drift": 3,
    "bias.run": 3,
    "scale.constant": 3,
    "scale.temperature": 3,
    "misalignment.constant": 6,
    "misalignment.temperature": 6,
    "square.constant": 3,
}


def simulated_columns(
    effects: Mapping[str, Any] | None = None, *, seed: int, campaign: Campaign | None = None
) -> dict[str, Any]:
    """Simulate columns of readings with hidden effects, by name.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, whose members come at their own
            `SHARES` of it; or a size for each member; bias, scale and misalignment are there unless
            given otherwise.
        seed: of every random number.
        campaign: the readings; six mountings at five rates if not given.

    Raises:
        ValueError: an unknown effect, or a size that is no number.
    """
    plan, sizes = campaign or Campaign(), members_of(effects, COUNTS, BASELINE)
    rng = np.random.default_rng(seed)
    of_run = rng.standard_normal((plan.runs, 3))
    rows: list[dict[str, Any]] = []
    clock, die = 0.0, plan.temperatures[0]
    for run in range(plan.runs):
        clock += 3600.0 * (run > 0)
        die = plan.temperatures[0]
        for place, mounting in enumerate(plan.mountings):
            up = np.zeros(3)
            up["xyz".index(mounting[-1])] = -1.0 if mounting.startswith("-") else 1.0
            true = up + np.cross(MOUNTING_SD * rng.standard_normal(3), up)
            for temperature in plan.temperatures:
                for i, rate in enumerate(plan.rates):
                    pause = plan.soak if i == 0 else plan.interval
                    die = temperature + (die - temperature) * math.exp(-pause / BODY)
                    clock += pause
                    row = {"run": str(run + 1), "time": clock, "temperature": temperature}
                    row |= {"rate": rate, "mounting": f"{run + 1}.{place + 1}", "die": die}
                    rows.append(row | {"up": up, "true": true})
    noise = rng.standard_normal((len(rows), 3))
    middle, span = rows[len(rows) // 2]["time"], max(rows[-1]["time"] - rows[0]["time"], 1.0)
    output = np.empty((len(rows), 3))
    for i, row in enumerate(rows):
        warm, omega = row["temperature"] - REFERENCE, row["rate"] * row["true"]
        scale = 1e-6 * (sizes["scale.constant"] + sizes["scale.temperature"] * warm)
        angles = sizes["misalignment.constant"] + sizes["misalignment.temperature"] * warm
        matrix = matrix_of(scale, 1e-3 * angles)
        bias = sizes["bias.constant"] + sizes["bias.temperature"] * warm
        bias = bias + sizes["bias.temperature_quadratic"] * warm**2
        bias = bias + sizes["bias.g_sensitivity"].reshape(3, 3) @ row["true"]
        bias = bias + sizes["bias.thermal_lag"] * (row["die"] - row["temperature"])
        bias = bias + sizes["bias.drift"] * (row["time"] - middle) / span
        bias = bias + sizes["bias.run"] * of_run[int(row["run"]) - 1]
        output[i] = matrix @ omega + bias + 1e-6 * sizes["square.constant"] * omega**2
    output += plan.noise * noise
    names = ("run", "time", "temperature", "rate", "mounting")
    cols: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in names}
    cols["pose_uncertainty"] = np.full(len(rows), MOUNTING_SD)
    for i, a in enumerate("xyz"):
        cols[f"output_{a}"] = output[:, i]
        cols[f"direction_{a}"] = cols[f"gravity_{a}"] = np.array([row["up"][i] for row in rows])
    return cols
