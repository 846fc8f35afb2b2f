"""Plans of the zero test and of the verification, and the simulated accelerometers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from bayescal_models.inclinometer.geometry import possible
from bayescal_models.simulated import refuse


@dataclass(frozen=True)
class Accelerometer:
    """Errors of one accelerometer; angles in arcsec unless stated.

    Attributes:
        constant: zero at ω = 0 about the flange axis (S_p at ω = 0, or the constant of a line).
        slope: its change with the placement angle, arcsec/deg; 0 if given by the projections.
        electrical: S_e, which does not tilt with the axis.
        pendulum, door: S_p and S_d.
        scale: κ, ppm.
        share: factor of the sizes of hidden effects on this accelerometer.
    """

    constant: float = 0.0
    slope: float = 0.0
    electrical: float = 0.0
    pendulum: float = 0.0
    door: float = 0.0
    scale: float = 0.0
    share: float = 1.0

    def mechanical(self, angle: np.ndarray) -> np.ndarray:
        """Return the mechanical zero at a placement angle in rad, arcsec."""
        line = self.constant + self.slope * np.rad2deg(angle)
        return line + self.pendulum * np.cos(angle) + self.door * np.sin(angle)


X = Accelerometer(constant=62.6211, slope=0.72105)  # source 4: Sx
Y = Accelerometer(constant=96.3284, slope=0.06818, share=-0.6)  # source 4: Sy


@dataclass(frozen=True)
class Campaign:
    """A zero test on a dividing table or, with a `grid`, a verification on a two-axis one.

    The defaults are source 4's zero test, ±45° by 5°, forward and backward in each of two mountings
    of each axis: 152 readings. Sizes are ours unless stated.

    Attributes:
        axes: accelerometers by label.
        devices: number of inclinometers, which differ.
        angles: placement angles of a sweep, deg.
        runs: mountings of each axis.
        backward: whether each sweep is repeated backward.
        grid: tilts of a verification, deg: all pairs that a body can take; empty for a zero test.
        exact: whether a verification has the exact geometry; otherwise the document's ω = y.
        interval: time between readings, s.
        pause: time between runs, s.
        noise: standard deviation of a reading, arcsec (source 4 has only the table's 2″).
        repeatability: standard deviation between mountings, arcsec.
        swing: amplitude of the laboratory's temperature, °C.
        period: period of that temperature, s.

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
        refuse(
            len(self.grid) and {label for label, _ in self.axes} != {"x", "y"},
            "Campaign(grid=…): a verification needs the axes x and y.",
        )

    def pairs(self) -> np.ndarray:
        """Return the tilts (x, y) of a verification in test order, rad, (points, 2)."""
        points = np.deg2rad(list(product(self.grid, self.grid)))
        return points[possible(points[:, 0], points[:, 1])]


VERIFICATION = Campaign(grid=tuple(float(a) for a in range(-45, 46, 15)), runs=1)
