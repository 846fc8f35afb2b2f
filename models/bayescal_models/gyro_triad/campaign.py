"""Plan of rates about the axes of a table with a mounted unit, and of moves by hand."""

from __future__ import annotations

from dataclasses import dataclass

MOUNTINGS = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class Campaign:
    """Rates about a vertical axis, in successive mountings, each at successive temperatures.

    Attributes:
        mountings: body axes that point up, such as "x" or "-z".
        rates: rates of the table at each temperature, °/s; 0 is at rest.
        temperatures: °C.
        noise: standard deviation of an averaged output, °/s.
        interval: time between readings, s.
        soak: time before the first reading at a temperature, s.
        runs: number of sessions, each the whole plan.
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
    """A unit of gyroscopes and accelerometers turned by hand between poses at rest, and logged throughout.

    Attributes:
        poses: number of poses.
        still: time at rest in each, s.
        move: duration of a move between poses, s.
        angle: mean rotation angle of a move, rad.
        rate: sampling rate, 1/s.
        gyro_noise: white noise of gyroscopes, °/s/√Hz.
        force_noise: white noise of accelerometers, g/√Hz.
        latitude: latitude for the Earth's rotation, °; None: without it.
    """

    poses: int = 24
    still: float = 4.0
    move: float = 3.0
    angle: float = 2.0
    rate: float = 100.0
    gyro_noise: float = 7e-3
    force_noise: float = 1.5e-4
    latitude: float | None = 48.0
