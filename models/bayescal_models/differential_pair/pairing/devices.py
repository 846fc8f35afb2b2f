"""Posterior draws of each device's scale, sensitivity and environment over the record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

import bayescal as bc
from bayescal_models.differential_pair.environment import (
    DEPARTURE,
    DEPARTURE_SHARE_NAME,
    DISTURBANCE_UG,
    ORDERS,
    SENSITIVITY_NAME,
    SHARED,
    SHARED_ORDERS,
    evaluate_legendre_polynomials,
    list_order_names,
)

Array = NDArray[np.float64]

EFFECTS = ("scale.device", SHARED.name, DEPARTURE.name, "environment.temperature", "bias.device")


@dataclass(frozen=True)
class Devices:
    """Joint posterior draws (d) of all K devices, outer ones first, at T times.

    Attributes:
        names: names of the devices, (K,).
        outer: number of outer devices.
        time: times of the readings, s, (T,).
        scale: 1 + κ, (d, K).
        sensitivity: λd, (d, K).
        shared: u(t), with the temperature effect if it was fitted, averaged over devices, µg, (d, T).
        environment: λd·u + v, µg, (d, K, T).
        departure: rms of a device's departure v over a record, µg, (d,).
        bias: bias of each device, µg, (d, K).
        noise: standard deviation of the noise of a reading, µg, (d,).
        commanded: commanded acceleration a(t), µg, (T,).
        records: outputs, µg, (K, T).
        known: posterior mean of the outputs without the environment, µg, (K, T).
        others: names of the model's effects that the equation of a pair does not contain.
    """

    names: tuple[str, ...]
    outer: int
    time: Array
    scale: Array
    sensitivity: Array
    shared: Array
    environment: Array
    departure: Array
    bias: Array
    noise: Array
    commanded: Array
    records: Array
    known: Array
    others: tuple[str, ...] = ()

    @property
    def sign(self) -> Array:
        """Return the sign of each device's input axis: +1 outer, −1 inner, (K,)."""
        return np.where(np.arange(len(self.names)) < self.outer, 1.0, -1.0)

    def device_index(self, name: str, is_outer: bool) -> int:
        """Return the index of a device, given its name and whether it is outer.

        Raises:
            InputError: the group has no device of that name.
        """
        group = self.names[: self.outer] if is_outer else self.names[self.outer :]
        if name not in group:
            side = "outer" if is_outer else "inner"
            raise bc.InputError(f"no {side} device {name!r}: choose among {', '.join(group)}")
        return self.names.index(name)


def devices_of(calibration: bc.Calibration) -> Devices:
    """Collect the posterior draws of a calibration's devices.

    Raises:
        InputError: the readings cannot be paired (one group only, unequal times, several runs), or the model
            has no shared environment.
    """
    if SHARED.name not in calibration.model.names:
        raise bc.InputError(
            f"the model has no {SHARED.name!r} (it has: {', '.join(calibration.model.names)}), which the "
            "selection of pairs needs: fit the instrument's baseline"
        )
    names = [str(n) for n in calibration.tree["posterior"].to_dataset() if "reading" not in str(n)]
    samples = {n: calibration.samples(n) for n in names}
    samples |= {n: np.full(len(samples[SENSITIVITY_NAME]), v) for n, v in calibration.model.fixed}
    readings, reference = calibration.readings, cast("dict[str, float]", calibration.reference)
    records = _arrange_records(readings)
    sensitivity = np.asarray(samples[SENSITIVITY_NAME])[:, records.order]
    progress = (records.time - reference["time_mean"]) / reference["time_span"]
    basis = np.stack(evaluate_legendre_polynomials(progress, SHARED_ORDERS))
    terms = np.stack([samples[n] for n in list_order_names(SHARED)], axis=1)[:, :, None] * basis
    u, higher = terms[:, :ORDERS].sum(axis=1)[:, None], terms[:, ORDERS:].sum(axis=1)[:, None]
    if "environment.temperature" in samples:
        temperature_change = readings["temperature"][records.rows] - reference["T0"]
        u = u + np.asarray(samples["environment.temperature"])[:, None, None] * temperature_change
    departures, departure_rms = _collect_departures(samples, records, basis)
    environment = sensitivity[:, :, None] * u + higher + departures
    zeros = np.zeros_like(sensitivity)
    fitted_outputs = bc.predict(calibration, readings, new_groups=False).mean
    return Devices(
        records.names,
        records.outer,
        records.time,
        scale=1.0 + 1e-6 * np.asarray(samples.get("scale.device", zeros))[..., records.order],
        sensitivity=sensitivity,
        shared=(u + higher).mean(axis=1),
        environment=environment,
        departure=departure_rms,
        bias=np.asarray(samples.get("bias.device", zeros))[..., records.order],
        noise=np.asarray(samples["noise.white"]),
        commanded=readings["acceleration"][records.rows].mean(axis=0),
        records=readings["output"][records.rows],
        known=fitted_outputs[records.rows] - environment.mean(axis=0),
        others=tuple(n for n in calibration.model.names if n not in EFFECTS),
    )


def _collect_departures(
    samples: Mapping[str, Array], records: _Records, basis: Array
) -> tuple[Array, Array]:
    """Return draws of each device's departure v(t), µg, (d, K, T), and of the rms of v over a record, µg, (d,)."""
    if DEPARTURE_SHARE_NAME not in samples:
        zeros = np.zeros(len(samples[SENSITIVITY_NAME]))
        return zeros[:, None, None], zeros
    relative_rms = np.asarray(samples[DEPARTURE_SHARE_NAME])
    orders = np.stack([samples[n][:, records.order] for n in list_order_names(DEPARTURE)], axis=-1)
    return orders @ basis[:ORDERS], relative_rms * DISTURBANCE_UG


@dataclass(frozen=True)
class _Records:
    """Records of K devices at T common times, outer first: rows of the readings (K, T), order in the draws (K,)."""

    names: tuple[str, ...]
    outer: int
    time: Array
    rows: NDArray[np.int64]
    order: NDArray[np.int64]


def _arrange_records(readings: bc.Measurements) -> _Records:
    """Arrange the readings as one record per device at common times.

    Raises:
        InputError: devices have different times, a group is missing, or there are several runs.
    """
    names, codes = readings.groups("device")
    groups, runs = readings["group"], readings.groups("run")[0]
    sides_by_device = [np.unique(groups[codes == i]).tolist() for i in range(len(names))]
    if len(runs) > 1 or set(map(len, sides_by_device)) != {1} or len(np.unique(groups)) < 2:
        raise bc.InputError(
            f"{readings.file}, column 'group': pairs need one run, outer and inner devices, and each device in one "
            f"group; there are {len(runs)} runs, and the groups {dict(zip(names, sides_by_device, strict=True))}"
        )
    sides = {i: side for i, (side,) in enumerate(sides_by_device)}
    order = np.array(sorted(sides, key=lambda i: sides[i] == "inner"))
    rows = [np.flatnonzero(codes == i) for i in order]
    rows = [r[np.argsort(readings["time"][r], kind="stable")] for r in rows]
    time = readings["time"][rows[0]]
    for i, indices in zip(order, rows, strict=True):
        if len(indices) != len(time) or not np.allclose(readings["time"][indices], time, atol=1e-3):
            raise bc.InputError(
                f"{readings.file}, column 'time': the reading times of devices {names[i]!r} and {names[order[0]]!r} "
                f"differ ({len(indices)} and {len(time)} readings), but devices are compared reading by reading: "
                "interpolate the records to common times"
            )
    outer = sum(side == "outer" for side in sides.values())
    return _Records(tuple(names[i] for i in order), outer, time, np.stack(rows), order=order)
