"""Simulated campaigns of a MEMS gyro in a stepped chamber.

    sim = simulate_arrays(Campaign(), {"bias.thermal_lag": 0.05}, seed=1)
    sim.columns["output"], sim.noise_free, sim.contributions["bias.thermal_lag"]

The world is made second by second (`chamber.py`), each hidden effect is a physical law in that
world (`laws.py`), and the logger's samples are averaged into readings at the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayescal_models import simulated
from bayescal_models.mems_gyro.campaign import GRID, Campaign
from bayescal_models.mems_gyro.chamber import World, make_world
from bayescal_models.mems_gyro.laws import LAWS
from bayescal_models.simulated import Array

NOISE_LAWS = ("white", "student_t", "ornstein_uhlenbeck")


def simulated_columns(
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    campaign: Campaign | None = None,
    noise_law: str = "white",
) -> dict[str, NDArray[Any]]:
    """A stepped-chamber campaign with these effects hidden in it: its columns, by name, of which readings are made.

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficient.
        seed: of every random number.
        campaign: plan of the test; the default has three runs between 30 and 80 °C.
        noise_law: "white", "student_t" or "ornstein_uhlenbeck"; see `simulate_arrays`.

    Raises:
        ValueError: an unknown effect or noise law, or a size that is not finite.
    """
    made = simulate_arrays(campaign or Campaign(), effects, seed=seed, noise_law=noise_law)
    headers = {"humidity": "humidity [%]"}  # no column of the instrument's own
    return {headers.get(name, name): values for name, values in made.columns.items()}


@dataclass(frozen=True)
class SimulatedCampaign:
    """Readings of a simulated campaign, and everything that made them.

    Attributes:
        columns: one array per column, of the same length; `run` is text, the others float64.
        noise_free: the output without noise and rounding, °/s.
        contributions: parts of `noise_free` in °/s, which is their sum: "baseline", "rate_input"
            where there is one, and each hidden effect.
    """

    columns: dict[str, NDArray[Any]]
    noise_free: Array
    contributions: dict[str, Array]


def simulate_arrays(
    campaign: Campaign,
    effects: Mapping[str, float] | None = None,
    *,
    seed: int,
    noise_law: str = "white",
) -> SimulatedCampaign:
    """Simulate a campaign with effects hidden in it.

    The same seed gives the same noise, the same turn-on offsets and the same humidity whatever
    the effects, so two simulations differ by the effects alone. The number of rows depends on the
    campaign only.

    Args:
        campaign: the plan of the test and the world it is made in.
        effects: canonical name → size, in the unit of `laws.SIZES` or `laws.UNLISTED_SIZES`. The baseline's
            constant and slope are options of the campaign.
        seed: seed of every random number.
        noise_law: "white"; "student_t" (same standard deviation, heavier tails);
            "ornstein_uhlenbeck" (the white noise, and the campaign's correlated part, `wander`).

    Raises:
        ValueError: an effect or a noise law of an unknown name, or a size that is not finite.
    """
    effects = dict(effects or {})
    _check(effects, noise_law)
    names = ("noise", "wander", "thermometer", "run", "humidity")
    generators = simulated.generators(names, seed)
    world = make_world(campaign, generators)

    contributions = {"baseline": world.average(_baseline(campaign, world))}
    if campaign.rate_input is not None:
        contributions["rate_input"] = world.average(world.rate)
    for name, size in effects.items():
        contributions[name] = world.average(size * LAWS[name](campaign, world))
    noise_free = np.sum(list(contributions.values()), axis=0)
    output = _rounded(noise_free + _noise(campaign, world, generators, noise_law), campaign)

    error = campaign.thermometer_noise * generators["thermometer"].standard_normal(len(output))
    columns: dict[str, NDArray[Any]] = {
        "run": np.array([str(k + 1) for k in world.run]),
        "time": world.average(world.time),
        "temperature": world.average(world.ambient) + campaign.thermometer_offset + error,
        "board_temperature": world.average(world.board),
    }
    if campaign.rate_input is not None:
        columns["rate_input"] = contributions["rate_input"].copy()
    if "unlisted.humidity" in effects:
        columns["humidity"] = world.average(world.humidity)
    columns["output"] = output
    return SimulatedCampaign(columns, noise_free, contributions)


def _check(effects: Mapping[str, float], noise_law: str) -> None:
    """Refuse names that are not known here, and sizes that are no numbers."""
    if noise_law not in NOISE_LAWS:
        raise ValueError(
            f"simulate_arrays(noise_law={noise_law!r}): known are {', '.join(NOISE_LAWS)}; "
            "choose one of them."
        )
    for name in effects:
        if name in ("bias.temperature", "bias.constant"):
            option = "slope" if name == "bias.temperature" else "constant"
            raise ValueError(
                f"simulate_arrays: {name!r} belongs to the baseline, not to the hidden effects; "
                f"set Campaign({option}=…) instead."
            )
    simulated.refuse_effects(effects, LAWS, "a gyro campaign")


def _baseline(campaign: Campaign, world: World) -> Array:
    """Zero-rate output on the grid, °/s: the line, or the two resonances."""
    if campaign.law == "resonance":
        return campaign.resonance.zero_rate(world.ambient, campaign.T0, campaign.constant)
    return campaign.constant + campaign.slope * (world.ambient - campaign.T0)


def _noise(
    campaign: Campaign,
    world: World,
    generators: Mapping[str, np.random.Generator],
    noise_law: str,
) -> Array:
    """Noise of each averaged reading, °/s."""
    generator, readings = generators["noise"], len(world.run)
    if noise_law == "student_t":
        degrees = campaign.noise_degrees
        unit_variance = np.sqrt((degrees - 2.0) / degrees)
        return campaign.noise * unit_variance * generator.standard_t(degrees, readings)
    white = campaign.noise * generator.standard_normal(readings)
    if noise_law == "white":
        return white
    slow = np.empty(readings)
    for k in range(campaign.runs):  # the correlated noise starts anew at each power-on
        record = simulated.correlated(
            generators["wander"], len(world.time), campaign.wander_time, GRID
        )
        slow[world.run == k] = world.average(record)[world.run == k]
    return white + campaign.wander * slow


def _rounded(output: Array, campaign: Campaign) -> Array:
    """Output in °/s after its voltage was rounded to the converter's step, where there is one."""
    if campaign.converter_step is None:
        return output
    volts = campaign.null_voltage + campaign.sensitivity * output
    volts = campaign.converter_step * np.rint(volts / campaign.converter_step)
    return (volts - campaign.null_voltage) / campaign.sensitivity
