"""Simulator of tests on the tilted table with hidden effects: one physical law per effect.

    test = simulate_arrays({"base_tilt.tide": 200.0, "second_order": 0.05}, seed=1)
    test.columns["output"], test.conditions, test.contributions["second_order"]

A law returns the contribution of one unit of an effect to its slot at each instant of the test. Laws use true
conditions, not the columns of the model's basis functions (set points, measured temperature, reading times), and most
differ slightly in form from the model, so that a fitted model is an approximation, as for real readings. The geometry
is computed by rotations of vectors, independently of the model's closed form.

An effect on the base tilt has the given size in both components; `name[parallel]` and `name[perp]` set one component.
The size of `base_tilt.tide` is the monthly peak of each component, nrad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bayescal_models import simulated
from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_A, Campaign
from bayescal_models.ng_accelerometer.world import Conditions
from bayescal_models.simulated import ARCSEC, DEGREE, Array, SimulatedTest

G = 1e6  # µg
RANDOM_STREAMS = ("noise", "thermometer", "chamber", "laboratory", "groups", "supply")
SATURATION_SCALE_DEGC = 40.0  # °C, temperature change at which higher powers of a law matter
BENDING_TEMPCO = 0.002  # 1/°C, relative increase of the fixture's bending with temperature
HARMONIC_AMPLITUDE = 0.1  # relative amplitude of the fourth and fifth rotation harmonics
UNIT_FACTORS = {
    **dict.fromkeys(("ug", "ug/mg^2", "ug/mg^3", "1/g"), 1.0),
    **{"ppm": 1e-6, "urad": 1e-6, "nrad": 1e-9, "arcsec": ARCSEC, "deg": DEGREE},
}
CELL_QUANTITIES = ("bias", "scale", "fixture_tilt", "base_tilt_parallel", "base_tilt_perp")
RUN_QUANTITIES = ("bias", "scale", "fixture_tilt", "fixture_tilt.temperature")


class Law(NamedTuple):
    """Law of an effect: its slot, its unit, and the contribution of one unit of it at each instant, (n, m)."""

    slot: str
    unit: str
    curve: Callable[[Conditions], Array]

    def contribution(self, size: float, test: Conditions) -> Array:
        """Return the contribution of an effect of this size, in the slot's unit, (n, m)."""
        return size * UNIT_FACTORS[self.unit] * self.curve(test)


def _change(test: Conditions) -> Array:
    return test.device - test.plan.T0


def _evaluate_quadratic(test: Conditions) -> Array:
    """Return 2w²(cosh(ΔT/w) − 1), slightly more than ΔT², with w = `SATURATION_SCALE_DEGC`, °C²."""
    return 2 * SATURATION_SCALE_DEGC**2 * (np.cosh(_change(test) / SATURATION_SCALE_DEGC) - 1)


def _evaluate_cubic(test: Conditions) -> Array:
    """Return 6w³(sinh(ΔT/w) − ΔT/w), slightly more than ΔT³, with w = `SATURATION_SCALE_DEGC`, °C³."""
    ratio = _change(test) / SATURATION_SCALE_DEGC
    return 6 * SATURATION_SCALE_DEGC**3 * (np.sinh(ratio) - ratio)


def _evaluate_expansion(test: Conditions) -> Array:
    """Return the fixture's thermal expansion as an equivalent temperature change, °C; it is slightly nonlinear."""
    change = test.fixture - test.plan.T0
    return change + BENDING_TEMPCO * change**2


def _harmonics(test: Conditions) -> Array:
    """Return the sum of the second and third harmonics of the rotation angle and weaker fourth and fifth ones."""
    waves = [wave(m * test.angle) for m in (2, 3) for wave in (np.cos, np.sin)]
    return sum(waves) + HARMONIC_AMPLITUDE * (np.cos(4 * test.angle) + np.sin(5 * test.angle))


def _evaluate_settlement(test: Conditions) -> Array:
    """Return the settlement of the base, exponential in time, from 0 to 1 over the test."""
    return np.expm1(-2 * test.elapsed_fraction) / np.expm1(-2.0)


def _evaluate_eccentricity_error(test: Conditions) -> Array:
    """Return the angle error of an eccentric divided circle, arcsec: the amplitude is √2″, the phase π/4."""
    eccentricity, angle = np.sqrt(2) * ARCSEC, test.angle + np.pi / 4
    return np.arctan2(eccentricity * np.sin(angle), 1 + eccentricity * np.cos(angle)) / ARCSEC


def _overvoltage(test: Conditions) -> Array:
    """Return the supply voltage minus its nominal value, V."""
    return test.supply - simulated.SUPPLY_V


def _ones(test: Conditions) -> Array:
    return np.ones_like(test.time)


def _make_random(
    name: str, group: str, factor: Callable[[Conditions], Array] = _ones
) -> Callable[[Conditions], Array]:
    """Return a law: standard normal deviate of `name` in each cell or run (`group`) times `factor`."""

    def curve(test: Conditions) -> Array:
        deviates = test.cell_deviates if group == "cell" else test.run_deviates
        return deviates[name] * factor(test)

    return curve


_LAWS = {
    "bias.constant": Law("bias", "ug", _ones),
    "bias.temperature": Law("bias", "ug", _change),
    "bias.cell": Law("bias", "ug", _make_random("bias", "cell")),
    "scale.constant": Law("scale", "ppm", _ones),
    "scale.temperature": Law("scale", "ppm", _change),
    "scale.cell": Law("scale", "ppm", _make_random("scale", "cell")),
    "fixture_tilt.constant": Law("fixture_tilt", "urad", _ones),
    "fixture_tilt.cell": Law("fixture_tilt", "urad", _make_random("fixture_tilt", "cell")),
    "rotation.constant": Law("rotation", "deg", _ones),
    "tilt.setting": Law("base_tilt_perp", "arcsec", _ones),
    "bias.temperature_quadratic": Law("bias", "ug", _evaluate_quadratic),
    "bias.temperature_cubic": Law("bias", "ug", _evaluate_cubic),
    "scale.temperature_quadratic": Law("scale", "ppm", _evaluate_quadratic),
    "scale.temperature_cubic": Law("scale", "ppm", _evaluate_cubic),
    "bias.drift": Law("bias", "ug", lambda test: np.log2(1 + test.elapsed_fraction)),  # ageing
    "bias.warm_up": Law("bias", "ug", lambda test: test.warm_up_deficit),
    "bias.run": Law("bias", "ug", _make_random("bias", "run")),
    "scale.run": Law("scale", "ppm", _make_random("scale", "run")),
    "bias.rate": Law("bias", "ug", lambda test: test.temperature_rate),
    "bias.thermal_lag": Law("bias", "ug", lambda test: test.element - test.device),
    "bias.temperature_x_lag": Law(
        "bias", "ug", lambda test: _change(test) * (test.element - test.device)
    ),
    "bias.supply": Law("bias", "ug", _overvoltage),
    "bias.temperature_x_supply": Law("bias", "ug", lambda test: _change(test) * _overvoltage(test)),
    "bias.hysteresis": Law("bias", "ug", lambda test: test.hysteresis),
    "fixture_tilt.temperature": Law("fixture_tilt", "urad", _evaluate_expansion),
    "fixture_tilt.run": Law("fixture_tilt", "urad", _make_random("fixture_tilt", "run")),
    "fixture_tilt.run_temperature": Law(
        "fixture_tilt", "urad", _make_random("fixture_tilt.temperature", "run", _evaluate_expansion)
    ),
    "fixture_tilt.position": Law(
        "fixture_tilt", "urad", lambda test: (test.fixture - test.plan.T0) * _harmonics(test)
    ),
    "second_order": Law("second_order", "ug/mg^2", _ones),
    "third_order": Law("third_order", "ug/mg^3", _ones),
    "cross_coupling": Law("cross_coupling", "1/g", _ones),
    "cross_coupling.temperature": Law("cross_coupling", "1/g", _change),
    "rotation.harmonic": Law("rotation", "arcsec", _evaluate_eccentricity_error),
    "rotation.wobble": Law("fixture_tilt", "arcsec", lambda test: _harmonics(test) + 0 * test.time),
}
# Unit and laws of the base tilt components parallel and perp.
_BASE_TILT_LAWS = {
    "base_tilt.constant": ("arcsec", (_ones, _ones)),
    "base_tilt.lab_temperature": (
        "urad",
        2 * (lambda test: test.foundation - test.plan.laboratory,),
    ),
    "base_tilt.temperature": ("urad", 2 * (lambda test: test.base - test.plan.T0,)),
    "base_tilt.tide": ("nrad", (lambda test: test.tide[0], lambda test: test.tide[1])),
    "base_tilt.drift": ("urad", (_evaluate_settlement, _evaluate_settlement)),
    "base_tilt.cell": (
        "urad",
        (_make_random("base_tilt_parallel", "cell"), _make_random("base_tilt_perp", "cell")),
    ),
}


def _collect_laws() -> dict[str, tuple[Law, ...]]:
    laws = {name: (law,) for name, law in _LAWS.items()}
    for name, (unit, curves) in _BASE_TILT_LAWS.items():
        parallel, perp = base_tilts = tuple(
            Law(f"base_tilt_{component}", unit, curve)
            for component, curve in zip(("parallel", "perp"), curves, strict=True)
        )
        laws |= {name: base_tilts, f"{name}[parallel]": (parallel,), f"{name}[perp]": (perp,)}
    return laws


LAWS: Mapping[str, tuple[Law, ...]] = MappingProxyType(_collect_laws())
"""Laws of all effects of a simulated test, baseline and hidden, by canonical name."""


def simulate_arrays(
    effects: Mapping[str, float] | None = None, *, seed: int, campaign: Campaign = INSTRUMENT_A
) -> SimulatedTest:
    """Simulate a test with hidden effects.

    The same seed gives the same noise, temperatures and random deviations for any effects, so that two simulations
    differ by the effects alone. Each contribution is a tuple of pairs (slot, array (n, m) in the slot's unit).

    Args:
        effects: canonical name → true size, in the unit of the effect's coefficients, which all have this size (base
            tilt and tide: see the module's docstring). Baseline effects have the sizes in `campaign.truth` unless
            given here.
        seed: seed of the random-number generator.
        campaign: plan of the test.

    Raises:
        ValueError: an unknown effect, or a size that is not a finite number.
    """
    sizes = {**campaign.truth, **(effects or {})}
    simulated.validate_effects(sizes, LAWS, "a test of the ng accelerometer")
    generators = simulated.spawn_generators(RANDOM_STREAMS, seed)
    test = Conditions(campaign, generators, CELL_QUANTITIES, RUN_QUANTITIES)
    contributions = {
        name: tuple((law.slot, law.contribution(size, test)) for law in LAWS[name])
        for name, size in sizes.items()
    }
    noise_free = outputs(test, contributions).mean(axis=1)
    noise = campaign.noise * generators["noise"].standard_normal(len(noise_free))
    errors = generators["thermometer"].standard_normal((2, len(noise_free)))
    columns = {
        "run": np.array([str(k + 1) for k in test.run]),
        "temperature_point": test.point,
        "time": test.time.mean(axis=1),
        "temperature": test.device.mean(axis=1) + campaign.thermometer_noise * errors[0],
        "lab_temperature": test.laboratory.mean(axis=1) + campaign.thermometer_noise * errors[1],
        "position_angle": test.angle[:, 0],
        "tilt": test.tilt[:, 0],
        "output": noise_free + noise,
    }
    if simulated.needs_supply_column(sizes):
        columns["supply_voltage"] = test.supply.mean(axis=1)
    return SimulatedTest(columns, test, contributions, noise_free)


simulate_columns = simulated.column_simulator(simulate_arrays)


def outputs(test: Conditions, contributions: Mapping[str, tuple[tuple[str, Array], ...]]) -> Array:
    """Return the noise-free output at each instant, µg, (n, m); `contributions`: see `simulate_arrays`."""
    slots: dict[str, Array] = {}
    for name in contributions:
        for slot, contribution in contributions[name]:
            slots[slot] = slots.get(slot, 0.0) + contribution
    zeros = np.zeros_like(test.time)
    a, ap = gravity(
        test.tilt + slots.get("base_tilt_perp", zeros),
        slots.get("base_tilt_parallel", zeros),
        test.angle + slots.get("rotation", zeros),
        slots.get("fixture_tilt", zeros),
    )
    return (
        slots.get("bias", zeros)
        + (1 + slots.get("scale", zeros)) * a
        + slots.get("second_order", zeros) * (a / 1e3) ** 2
        + slots.get("third_order", zeros) * (a / 1e3) ** 3
        + slots.get("cross_coupling", zeros) * a * ap
    )


def gravity(tilt: Array, parallel: Array, angle: Array, fixture_tilt: Array) -> tuple[Array, Array]:
    """Compute the specific force along the input axis, µg, and along the table's normal, g, by successive rotations.

    The vertical (0, 0, 1) is rotated into the frame of the face by the tilt about e0 and the base tilt about e90; the
    input axis is tilted by the fixture and then rotated with the table.

    Args:
        tilt, parallel: tilt of the face about e0, and of the base about e90, rad.
        angle: rotation angle of the table, rad.
        fixture_tilt: tilt of the input axis out of the face, rad.
    """
    zeros = np.zeros_like(angle + tilt)
    up = _rotate(_rotate((zeros, zeros, zeros + 1.0), 1, parallel), 0, -tilt)
    axis = _rotate(_rotate((zeros + 1.0, zeros, zeros), 1, -fixture_tilt), 2, angle)
    axial_force = sum((u * s for u, s in zip(up, axis, strict=True)), start=zeros)
    return G * axial_force, up[2]


def _rotate(vector: tuple[Array, ...], axis_index: int, angle: Array) -> tuple[Array, ...]:
    """Rotate a vector counter-clockwise about coordinate axis `axis_index` by `angle`, rad."""
    first_axis, second_axis = (axis_index + 1) % 3, (axis_index + 2) % 3
    rotated = list(vector)
    rotated[first_axis] = np.cos(angle) * vector[first_axis] - np.sin(angle) * vector[second_axis]
    rotated[second_axis] = np.sin(angle) * vector[first_axis] + np.cos(angle) * vector[second_axis]
    return tuple(rotated)
