"""Plans of tests of a gyro triad: on a rate table, and rotated by hand between poses."""

from __future__ import annotations

from dataclasses import dataclass

MOUNTINGS = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class Campaign:
    """Plan of a rate-table test: rates about the vertical in successive mountings, at successive temperatures.

    Attributes:
        mountings: body axis that points up in each mounting, such as "x" or "-z".
        rates: rates of the table at each temperature, °/s; 0: at rest.
        temperatures: temperatures in test order, °C.
        noise: standard deviation of an averaged output, °/s.
        interval: time between readings, s.
        soak: time before the first reading at a temperature, s.
        runs: number of sessions; each repeats the whole plan.
    """

    mountings: tuple[str, ...] = MOUNTINGS
    rates: tuple[float, ...] = (0.0, 50.0, -50.0, 100.0, -100.0)
    temperatures: tuple[float, ...] = (25.0,)
    noise: float = 5e-3
    interval: float = 30.0
    soak: float = 60.0
    runs: int = 1


@dataclass(frozen=True)
class MovesByHand:
    """Plan of a continuous log of gyroscopes and accelerometers, rotated by hand between poses at rest.

    Attributes:
        poses: number of poses.
        still: time at rest in each pose, s.
        move: duration of a rotation between poses, s.
        angle: mean rotation angle between poses, rad.
        rate: sampling rate, 1/s.
        gyro_noise: white noise density of the gyroscopes, °/s/√Hz.
        force_noise: white noise density of the accelerometers, g/√Hz.
        latitude: latitude, °, for the Earth's rotation; None: no Earth rotation.
    """

    poses: int = 24
    still: float = 4.0
    move: float = 3.0
    angle: float = 2.0
    rate: float = 100.0
    gyro_noise: float = 7e-3
    force_noise: float = 1.5e-4
    latitude: float | None = 48.0
