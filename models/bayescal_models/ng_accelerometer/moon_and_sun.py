"""Tilt of the plumb line by the Moon and the Sun, from their positions.

The horizontal tidal acceleration of a body at zenith distance z is ³⁄₂·(GM·r/d³)·sin 2z, towards it; over g it is
the tilt of the plumb line. Positions are low-precision ephemerides (a few arc minutes), which is far better than a
laboratory's tilt response is known: sizes are therefore given as a peak.

Source: J. Meeus, Astronomical Algorithms, ch. 25 and 47, leading terms; the peak of ±200 nrad: source 0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

EARTH_RADIUS = 6.371e6  # m
GRAVITY = 9.81  # m/s²
MOON, SUN = 4.9028e12, 1.32712e20  # GM, m³/s²
ASTRONOMICAL_UNIT = 1.495979e11  # m
OBLIQUITY = np.radians(23.439)
DAY = 86400.0
BEGIN = 7730.0  # days since 2000-01-01 12:00 UT, of a test
LATITUDE, LONGITUDE = 30.5, 114.4  # degrees north and east (source 0: Wuhan)
MONTH = 30.0  # days over which the peak of a tide is computed


def plumb_line(days: ArrayLike) -> tuple[Array, Array]:
    """Return the tilt of the plumb line towards east and north, rad, days since 2000-01-01 12:00 UT; a rigid Earth."""
    days = np.asarray(days, dtype=float)
    north = np.radians(LATITUDE)
    hour_angle_of = np.radians(280.46062 + 360.98564737 * days + LONGITUDE)
    total = [np.zeros_like(days), np.zeros_like(days)]
    for mass, (ecliptic, latitude_of, distance) in ((MOON, _moon(days)), (SUN, _sun(days))):
        x = np.cos(latitude_of) * np.cos(ecliptic)
        across = np.cos(latitude_of) * np.sin(ecliptic)
        y = np.cos(OBLIQUITY) * across - np.sin(OBLIQUITY) * np.sin(latitude_of)
        z = np.sin(OBLIQUITY) * across + np.cos(OBLIQUITY) * np.sin(latitude_of)
        angle = hour_angle_of - np.arctan2(y, x)
        equatorial = np.hypot(x, y)
        to_east = -equatorial * np.sin(angle)
        to_north = np.cos(north) * z - np.sin(north) * equatorial * np.cos(angle)
        to_zenith = np.sin(north) * z + np.cos(north) * equatorial * np.cos(angle)
        strength = 3.0 * mass * EARTH_RADIUS / distance**3 / GRAVITY * to_zenith
        total[0] += strength * to_east
        total[1] += strength * to_north
    return total[0], total[1]


def tide(time: ArrayLike) -> tuple[Array, Array]:
    """Return the tilt of the plumb line at times since `BEGIN`, s, each component relative to its month's maximum."""
    east, north = plumb_line(BEGIN + np.asarray(time, dtype=float) / DAY)
    peak = _peak()
    return east / peak[0], north / peak[1]


@cache
def _peak() -> tuple[float, float]:
    east, north = plumb_line(BEGIN + np.arange(0.0, MONTH, 600.0 / DAY))
    return float(np.abs(east).max()), float(np.abs(north).max())


def _moon(days: Array) -> tuple[Array, Array, Array]:
    """Return ecliptic longitude and latitude, rad, and distance, m."""
    mean = np.radians(218.316 + 13.17639648 * days)
    anomaly = np.radians(134.963 + 13.06499295 * days)
    elongation = np.radians(297.850 + 12.19074912 * days)
    from_node = np.radians(93.272 + 13.22935024 * days)
    along = (
        6.289 * np.sin(anomaly)
        + 1.274 * np.sin(2 * elongation - anomaly)
        + 0.658 * np.sin(2 * elongation)
    )
    distance = 1e3 * (
        385001.0
        - 20905.0 * np.cos(anomaly)
        - 3699.0 * np.cos(2 * elongation - anomaly)
        - 2956.0 * np.cos(2 * elongation)
    )
    return mean + np.radians(along), np.radians(5.128 * np.sin(from_node)), distance


def _sun(days: Array) -> tuple[Array, Array, Array]:
    """Return ecliptic longitude and latitude, rad, and distance, m."""
    anomaly = np.radians(357.529 + 0.98560028 * days)
    ecliptic = 280.459 + 0.98564736 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    distance = ASTRONOMICAL_UNIT * (1.00014 - 0.01671 * np.cos(anomaly))
    return np.radians(ecliptic), np.zeros_like(days), distance
