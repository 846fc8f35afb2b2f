"""A plan of rates about the axes of a table, and the unit that is mounted on it."""

from __future__ import annotations

from dataclasses import dataclass

MOUNTINGS = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class Campaign:
    """Rates about a vertical axis, in one mounting after the other, in each at one temperature after the other.

    Attributes:
        mountings: axes of the body that point up, such as "x" or "-z".
        rates: of the table, °/s, at each temperature; 0 is at rest.
        temperatures: °C.
        noise: standard deviation of an averaged output, °/s.
        interval: between readings, s.
        soak: before the first reading at a temperature, s.
        runs: sessions, through all of it each.
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
    """A unit of gyroscopes and accelerometers that is turned from one pose at rest to the next, and logged throughout.

    Attributes:
        poses: how many.
        still: in each, s.
        move: from each to the next, s.
        angle: mean turn of a move, rad.
        rate: samples, 1/s.
        gyro_noise: of gyroscopes, white, °/s/√Hz.
        force_noise: of accelerometers, white, g/√Hz.
        latitude: by which the Earth turns the unit, °; None where it does not turn.
    """

    poses: int = 24
    still: float = 4.0
    move: float = 3.0
    angle: float = 2.0
    rate: float = 100.0
    gyro_noise: float = 7e-3
    force_noise: float = 1.5e-4
    latitude: float | None = 48.0
