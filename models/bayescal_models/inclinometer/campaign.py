"""Plans of zero tests and verifications of an inclinometer, and its simulated accelerometers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from bayescal_models.inclinometer.geometry import are_compatible_tilts
from bayescal_models.simulated import raise_if


@dataclass(frozen=True)
class Accelerometer:
    """True errors of one accelerometer of an inclinometer, arcsec unless stated.

    The zero at the placement angle ω is electrical + constant + slope·ω + pendulum·cos ω + door·sin ω.

    Attributes:
        constant, slope: mechanical zero at ω = 0, and its slope, arcsec/deg.
        electrical: electrical zero S_e, which does not depend on the tilt.
        pendulum, door: projections S_p and S_d of the sensing axis.
        scale: scale factor deviation κ, ppm.
        share: factor that multiplies the sizes of hidden effects on this accelerometer.
    """

    constant: float = 0.0
    slope: float = 0.0
    electrical: float = 0.0
    pendulum: float = 0.0
    door: float = 0.0
    scale: float = 0.0
    share: float = 1.0

    def mechanical(self, angle: np.ndarray) -> np.ndarray:
        """Return the mechanical zero, arcsec, at placement angles in rad."""
        line = self.constant + self.slope * np.rad2deg(angle)
        return line + self.pendulum * np.cos(angle) + self.door * np.sin(angle)


X = Accelerometer(constant=62.6211, slope=0.72105)  # source 4: Sx
Y = Accelerometer(constant=96.3284, slope=0.06818, share=-0.6)  # source 4: Sy


@dataclass(frozen=True)
class Campaign:
    """Plan of a zero test on a dividing table or, with `grid`, of a verification on a two-axis table.

    The defaults are source 4's zero test: ±45° in 5° steps, forward and backward in each of two mountings of each
    axis, 152 readings. Values are our assumptions unless a source is stated.

    Attributes:
        axes: label and true errors of each accelerometer.
        devices: number of inclinometers, with different errors.
        angles: placement angles of a sweep, deg.
        runs: number of mountings of each axis.
        backward: whether each sweep is repeated in reverse order.
        grid: tilts of a verification, deg, of which all geometrically possible pairs are set; empty: zero test.
        exact: whether a verification is simulated with the exact placement angle; otherwise ω = y, as in source 4.
        interval: time between readings, s.
        pause: time between runs, s.
        noise: standard deviation of a reading, arcsec (source 4 states only the table's 2″).
        repeatability: standard deviation of the zero between mountings, arcsec.
        swing: amplitude of the laboratory temperature's oscillation, °C.
        period: period of this oscillation, s.

    Raises:
        ValueError: a verification with other axes than x and y.
    """

    axes: tuple[tuple[str, Accelerometer], ...] = (("x", X), ("y", Y))
    devices: int = 1
    angles: tuple[float, ...] = tuple(float(a) for a in range(-45, 46, 5))
    runs: int = 2
    backward: bool = True
    grid: tuple[float, ...] = ()
    exact: bool = False
    interval: float = 120.0
    pause: float = 1800.0
    noise: float = 2.0
    repeatability: float = 0.5
    swing: float = 2.0
    period: float = 4 * 3600.0

    def __post_init__(self) -> None:
        raise_if(
            len(self.grid) and {label for label, _ in self.axes} != {"x", "y"},
            "Campaign(grid=…): a verification needs the axes x and y.",
        )

    def pairs(self) -> np.ndarray:
        """Return the tilts (x, y) of a verification in test order, rad, (points, 2)."""
        points = np.deg2rad(list(product(self.grid, self.grid)))
        return points[are_compatible_tilts(points[:, 0], points[:, 1])]


VERIFICATION = Campaign(grid=tuple(float(a) for a in range(-45, 46, 15)), runs=1)
