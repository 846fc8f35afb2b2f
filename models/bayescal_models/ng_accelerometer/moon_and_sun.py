"""Tidal tilt of the plumb line by the Moon and the Sun, from their positions.

A body of mass M at distance d and zenith distance z causes the horizontal tidal acceleration ³⁄₂·(GM·r/d³)·sin 2z
towards itself, r the Earth's radius; divided by g it is the tilt of the plumb line. The low-precision ephemerides
are good to a few arcminutes. The tilt response of a laboratory is less well known: sizes are given as monthly peaks.

Source: J. Meeus, Astronomical Algorithms, ch. 25 and 47, leading terms; the peak of ±200 nrad: source 0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

EARTH_RADIUS_M = 6.371e6  # m
GRAVITY_M_S2 = 9.81  # m/s²
GM_MOON, GM_SUN = 4.9028e12, 1.32712e20  # GM, m³/s²
ASTRONOMICAL_UNIT_M = 1.495979e11  # m
OBLIQUITY_RAD = np.radians(23.439)
DAY_S = 86400.0
TEST_START_DAY = 7730.0  # days since 2000-01-01 12:00 UT at the start of a test
LATITUDE_DEG, LONGITUDE_DEG = 30.5, 114.4  # degrees north and east (source 0: Wuhan)
PEAK_PERIOD_DAYS = 30.0  # days over which the peak of a tide is computed


def plumb_line_tilt(days: ArrayLike) -> tuple[Array, Array]:
    """Return the plumb line's tidal tilts to east and north, rad, on a rigid Earth; days since 2000-01-01 12 h UT."""
    days, phi = np.asarray(days, dtype=float), np.radians(LATITUDE_DEG)
    sidereal_angle = np.radians(280.46062 + 360.98564737 * days + LONGITUDE_DEG)
    tilt = [np.zeros_like(days), np.zeros_like(days)]
    for gm, (longitude, latitude, distance) in (
        (GM_MOON, _locate_moon(days)),
        (GM_SUN, _locate_sun(days)),
    ):
        x = np.cos(latitude) * np.cos(longitude)
        ecliptic_y = np.cos(latitude) * np.sin(longitude)
        y = np.cos(OBLIQUITY_RAD) * ecliptic_y - np.sin(OBLIQUITY_RAD) * np.sin(latitude)
        z = np.sin(OBLIQUITY_RAD) * ecliptic_y + np.cos(OBLIQUITY_RAD) * np.sin(latitude)
        hour_angle = sidereal_angle - np.arctan2(y, x)
        equatorial_distance = np.hypot(x, y)
        to_east = -equatorial_distance * np.sin(hour_angle)
        to_north = np.cos(phi) * z - np.sin(phi) * equatorial_distance * np.cos(hour_angle)
        to_zenith = np.sin(phi) * z + np.cos(phi) * equatorial_distance * np.cos(hour_angle)
        tilt_scale = 3.0 * gm * EARTH_RADIUS_M / distance**3 / GRAVITY_M_S2 * to_zenith
        tilt[0] += tilt_scale * to_east
        tilt[1] += tilt_scale * to_north
    return tilt[0], tilt[1]


def compute_tide(time: ArrayLike) -> tuple[Array, Array]:
    """Return the east and north tilts of the plumb line relative to their monthly peaks; time in s from test start."""
    east, north = plumb_line_tilt(TEST_START_DAY + np.asarray(time, dtype=float) / DAY_S)
    peak = _compute_monthly_peak()
    return east / peak[0], north / peak[1]


@cache
def _compute_monthly_peak() -> tuple[float, float]:
    east, north = plumb_line_tilt(TEST_START_DAY + np.arange(0.0, PEAK_PERIOD_DAYS, 600.0 / DAY_S))
    return float(np.abs(east).max()), float(np.abs(north).max())


def _locate_moon(days: Array) -> tuple[Array, Array, Array]:
    """Return ecliptic longitude and latitude, rad, and distance, m, of the Moon."""
    mean_longitude = np.radians(218.316 + 13.17639648 * days)
    mean_anomaly = np.radians(134.963 + 13.06499295 * days)
    elongation = np.radians(297.850 + 12.19074912 * days)
    argument = np.radians(93.272 + 13.22935024 * days)
    correction = (
        6.289 * np.sin(mean_anomaly)
        + 1.274 * np.sin(2 * elongation - mean_anomaly)
        + 0.658 * np.sin(2 * elongation)
    )
    distance = 1e3 * (
        385001.0
        - 20905.0 * np.cos(mean_anomaly)
        - 3699.0 * np.cos(2 * elongation - mean_anomaly)
        - 2956.0 * np.cos(2 * elongation)
    )
    return mean_longitude + np.radians(correction), np.radians(5.128 * np.sin(argument)), distance


def _locate_sun(days: Array) -> tuple[Array, Array, Array]:
    """Return ecliptic longitude and latitude, rad, and distance, m, of the Sun."""
    anomaly = np.radians(357.529 + 0.98560028 * days)
    longitude = 280.459 + 0.98564736 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly)
    distance = ASTRONOMICAL_UNIT_M * (1.00014 - 0.01671 * np.cos(anomaly))
    return np.radians(longitude), np.zeros_like(days), distance
