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
    DEPARTURE_SHARE,
    DISTURBANCE,
    ORDERS,
    SENSITIVITY,
    SHARED,
    SHARED_ORDERS,
    order_names,
    polynomials,
)

Array = NDArray[np.float64]

MEASURABLE = ("scale.device", SHARED.name, DEPARTURE.name, "environment.temperature", "bias.device")


@dataclass(frozen=True)
class Devices:
    """Joint draws of every device, outer ones first.

    Attributes:
        names: names of the devices, (K,).
        outer: number of outer devices.
        time: times of the readings, s, (T,).
        scale: 1 + κ, (d, K).
        sensitivity: λd, (d, K).
        shared: u(t), µg, (d, T).
        environment: λd·u + v, µg, (d, K, T).
        departure: rms of a device's own departure over a record, µg, (d,).
        bias: µg, (d, K).
        noise: standard deviation of one reading, µg, (d,).
        commanded: a(t), µg, (T,).
        records: outputs, µg, (K, T).
        known: records without environment and noise, posterior mean, µg, (K, T).
        others: effects of the model that the equation of a pair does not contain.
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
        """Return +1 for outer devices, −1 for inner ones, (K,)."""
        return np.where(np.arange(len(self.names)) < self.outer, 1.0, -1.0)

    def place(self, name: str, outer: bool) -> int:
        """Return the index of a device by name.

        Raises:
            InputError: the group has no device of that name.
        """
        group = self.names[: self.outer] if outer else self.names[self.outer :]
        if name not in group:
            side = "outer" if outer else "inner"
            raise bc.InputError(f"{name!r} is not an {side} device; these are: {', '.join(group)}")
        return self.names.index(name)


def devices_of(calibration: bc.Calibration) -> Devices:
    """Collect the posterior draws of a calibration's devices.

    Raises:
        InputError: the readings cannot be paired (one group only, unequal times, several runs), or the model
            has no shared environment.
    """
    if SHARED.name not in calibration.model.names:
        raise bc.InputError(
            f"the model has no {SHARED.name!r} (it has: {', '.join(calibration.model.names)}): pairs are chosen "
            "by that effect. Fit the instrument's baseline"
        )
    names = [str(n) for n in calibration.tree["posterior"].to_dataset() if "reading" not in str(n)]
    samples = {n: calibration.samples(n) for n in names}
    samples |= {n: np.full(len(samples[SENSITIVITY]), v) for n, v in calibration.model.fixed}
    readings, reference = calibration.readings, cast("dict[str, float]", calibration.reference)
    table = _table(readings)
    sensitivity = np.asarray(samples[SENSITIVITY])[:, table.order]
    progress = (table.time - reference["time_mean"]) / reference["time_span"]
    basis = np.stack(polynomials(progress, SHARED_ORDERS))
    parts = np.stack([samples[n] for n in order_names(SHARED)], axis=1)[:, :, None] * basis
    u, fine = parts[:, :ORDERS].sum(axis=1)[:, None], parts[:, ORDERS:].sum(axis=1)[:, None]
    if "environment.temperature" in samples:
        warmth = readings["temperature"][table.rows] - reference["T0"]
        u = u + np.asarray(samples["environment.temperature"])[:, None, None] * warmth
    departures, departure = _departures(samples, table, basis)
    environment = sensitivity[:, :, None] * u + fine + departures
    zero = np.zeros_like(sensitivity)
    fitted = bc.predict(calibration, readings, new_groups=False).mean
    return Devices(
        table.names,
        table.outer,
        table.time,
        scale=1.0 + 1e-6 * np.asarray(samples.get("scale.device", zero))[..., table.order],
        sensitivity=sensitivity,
        shared=(u + fine).mean(axis=1),
        environment=environment,
        departure=departure,
        bias=np.asarray(samples.get("bias.device", zero))[..., table.order],
        noise=np.asarray(samples["noise.white"]),
        commanded=readings["acceleration"][table.rows].mean(axis=0),
        records=readings["output"][table.rows],
        known=fitted[table.rows] - environment.mean(axis=0),
        others=tuple(n for n in calibration.model.names if n not in MEASURABLE),
    )


def _departures(samples: Mapping[str, Array], table: _Table, basis: Array) -> tuple[Array, Array]:
    """Return each device's v(t), µg, (d, K, T), and its rms over a record, µg, (d,); zero without departures."""
    if DEPARTURE_SHARE not in samples:
        zero = np.zeros(len(samples[SENSITIVITY]))
        return zero[:, None, None], zero
    share = np.asarray(samples[DEPARTURE_SHARE])
    orders = np.stack([samples[n][:, table.order] for n in order_names(DEPARTURE)], axis=-1)
    return orders @ basis[:ORDERS], share * DISTURBANCE


@dataclass(frozen=True)
class _Table:
    """Records of K devices at T common times: names, outer ones first; rows of readings (K, T); index in the draws."""

    names: tuple[str, ...]
    outer: int
    time: Array
    rows: NDArray[np.int64]
    order: NDArray[np.int64]


def _table(readings: bc.Measurements) -> _Table:
    """Arrange one record per device, over the same times.

    Raises:
        InputError: the times of a device differ, or groups are missing.
    """
    names, codes = readings.groups("device")
    groups, runs = readings["group"], readings.groups("run")[0]
    of_device = [np.unique(groups[codes == i]).tolist() for i in range(len(names))]
    if len(runs) > 1 or set(map(len, of_device)) != {1} or len(np.unique(groups)) < 2:
        raise bc.InputError(
            f"{readings.file}, column 'group': pairs are of one outer and one inner device, each in one place, in one "
            f"run; here are {len(runs)} runs and {dict(zip(names, of_device, strict=True))}"
        )
    sides = {i: side for i, (side,) in enumerate(of_device)}
    order = np.array(sorted(sides, key=lambda i: sides[i] == "inner"))
    rows = [np.flatnonzero(codes == i) for i in order]
    rows = [r[np.argsort(readings["time"][r], kind="stable")] for r in rows]
    time = readings["time"][rows[0]]
    for i, row in zip(order, rows, strict=True):
        if len(row) != len(time) or not np.allclose(readings["time"][row], time, atol=1e-3):
            raise bc.InputError(
                f"{readings.file}, column 'time': device {names[i]!r} has other reading times than "
                f"{names[order[0]]!r} ({len(row)} and {len(time)} readings); devices are compared reading by "
                "reading: interpolate the records to common times"
            )
    outer = sum(side == "outer" for side in sides.values())
    return _Table(tuple(names[i] for i in order), outer, time, np.stack(rows), order=order)
