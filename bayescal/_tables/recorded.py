"""What a log holds, whatever its format: sensors with channels, each sampled at times of its own."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from bayescal._core.errors import InputError

RATE, ACCELERATION = "rad/s", "m/s^2"  # units in which all these formats log
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Sensor:
    """Channels of one sensor that are sampled together.

    Attributes:
        time: of the samples, s, (n,).
        channels: name, such as "gyro_x", and "gyro_x_1" of a second one → values, (n,), and their unit.
        temperature: °C, (m,); None where the log has none for this sensor.
        temperature_time: when the temperature was sampled, s, (m,); None where with the channels.
        device: identifier of the device, as the log states it.
    """

    time: np.ndarray
    channels: dict[str, tuple[np.ndarray, str]]
    temperature: np.ndarray | None = None
    temperature_time: np.ndarray | None = None
    device: str | None = None


def triad(
    kind: str, unit: str, values: Iterable[np.ndarray], instance: int
) -> dict[str, tuple[np.ndarray, str]]:
    """Channels of three axes.

    Args:
        kind: "gyro", "acc" or "mag".
        unit: of all three.
        values: of x, y and z, (n,) each.
        instance: which sensor of its kind, from 0; the first has no number in its names.
    """
    number = f"_{instance}" if instance else ""
    return {
        f"{kind}_{axis}{number}": (np.asarray(own, float), unit)
        for axis, own in zip(AXES, values, strict=True)
    }


def columns_of(
    sensors: Collection[Sensor], chosen: Collection[str], file: str
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The chosen channels as columns, with time, temperature and what they are of.

    The rows are the samples of the chosen sensor that is sampled most slowly. Other sensors give
    their sample nearest in time, so that noise stays as it is; the temperature, where it was
    sampled at other times, is interpolated between its own.

    Args:
        sensors: of the log.
        chosen: names of channels; what else is named here is left to the caller.
        file: its name in messages.

    Returns:
        Header, such as "gyro_x [rad/s]" → one value per sample, numbers or labels; and what was done to make them so,
        each a sentence.

    Raises:
        InputError: no channel is chosen that the log has, or no row has all that is asked for.
    """
    holder = {name: sensor for sensor in sensors for name in sensor.channels}
    wanted = [name for name in dict.fromkeys(chosen) if name in holder]
    if not wanted:
        listed = ", ".join(holder) or "none of a sensor that is read"
        raise InputError(
            f"{file!r} is a log, and which of its channels to read is not said. It has: {listed}. "
            "Choose one: --columns output=gyro_x (in Python columns={'output': 'gyro_x'})"
        )
    used = list({id(holder[name]): holder[name] for name in wanted}.values())
    base = max(used, key=lambda sensor: _step(sensor.time))
    kept, notes = _common(base, used, file), []
    time = base.time[kept]
    columns: dict[str, np.ndarray] = {"time [s]": time}
    if base.temperature is not None and (known := base.temperature_time) is not None:
        columns["temperature [degC]"] = np.interp(time, known, base.temperature)
        notes.append(
            f"{file}: the temperature was sampled every {_step(known):.3g} s, and is "
            f"interpolated to the times of {wanted[0]} (every {_step(base.time):.3g} s)"
        )
    elif base.temperature is not None:
        columns["temperature [degC]"] = base.temperature[kept]
    if lost := len(base.time) - len(time):
        notes.append(f"{file}: {lost} samples left out: not all that was asked for was logged then")
    for name in wanted:
        sensor = holder[name]
        halfway = 0.5 * (sensor.time[1:] + sensor.time[:-1])  # from one sample to the next
        at = kept if sensor is base else np.searchsorted(halfway, time)
        values, unit = sensor.channels[name]
        columns[f"{name} [{unit}]"] = values[at]
    if len(used) > 1:
        notes.append(f"{file}: rows at the times of {next(n for n in wanted if holder[n] is base)}")
    if len(wanted) == 1:
        labels = {"axis": wanted[0], "device": base.device}
        columns |= {k: np.full(len(time), v, object) for k, v in labels.items() if v is not None}
    return columns, notes


def _step(time: np.ndarray) -> float:
    """The usual time between samples, s."""
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _common(base: Sensor, used: Collection[Sensor], file: str) -> np.ndarray:
    """Which samples of `base` lie where everything was logged."""
    spans = [sensor.time for sensor in used]
    if base.temperature_time is not None:
        spans.append(base.temperature_time)
    low, high = (
        max(t.min(initial=np.inf) for t in spans),
        min(t.max(initial=-np.inf) for t in spans),
    )
    kept = np.flatnonzero((base.time >= low) & (base.time <= high))
    if not len(kept):
        raise InputError(
            f"{file!r}: the channels chosen and their temperature were not logged at one time: "
            "choose others, or log them together"
        )
    return kept
