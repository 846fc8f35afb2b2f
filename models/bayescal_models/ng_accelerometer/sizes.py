"""Plausible sizes of the effects of a ng accelerometer on a tilted table: prior standard deviations, and units.

One entry an effect, by canonical name; where the coefficients of an effect differ, the entry is the first's.
Sizes are for a first calibration and ours unless a source is named; a user replaces them with data-sheet values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from bayescal_models.simulated import Size

DEGREE = math.pi / 180  # rad
ARCSEC = DEGREE / 3600  # rad
HOUR = 3600.0  # s


BASELINE_SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "bias.constant": Size(5000.0, "ug"),
        "bias.temperature": Size(50.0, "ug/degC"),
        "bias.cell": Size(10.0, "ug"),
        "scale.constant": Size(10000.0, "ppm"),
        "scale.temperature": Size(1000.0, "ppm/degC"),
        "scale.cell": Size(100.0, "ppm"),
        "fixture_tilt.constant": Size(291.0, "urad"),
        "fixture_tilt.cell": Size(5.0, "urad"),
        "base_tilt.constant": Size(1.0, "arcsec"),
        "base_tilt.cell": Size(1.0, "urad"),
        "rotation.constant": Size(0.1, "deg"),
        "tilt.setting": Size(1.0, "arcsec"),
    }
)

SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "bias.temperature_quadratic": Size(0.05, "ug/degC^2"),
        "bias.temperature_cubic": Size(0.003, "ug/degC^3"),
        "scale.temperature_quadratic": Size(1.0, "ppm/degC^2"),
        "scale.temperature_cubic": Size(0.1, "ppm/degC^3"),
        "bias.drift": Size(10.0, "ug"),
        "bias.warm_up": Size(10.0, "ug"),
        "bias.run": Size(10.0, "ug"),
        "scale.run": Size(100.0, "ppm"),
        "bias.rate": Size(2.0, "ug/(degC/h)"),
        "bias.thermal_lag": Size(10.0, "ug/degC"),
        "bias.hysteresis": Size(10.0, "ug"),
        "fixture_tilt.temperature": Size(5.0, "urad/degC"),
        "fixture_tilt.position": Size(0.3, "urad/degC"),
        "fixture_tilt.run": Size(20.0, "urad"),
        "fixture_tilt.run_temperature": Size(2.0, "urad/degC"),
        "base_tilt.lab_temperature": Size(5.0, "urad/degC"),
        "base_tilt.temperature": Size(1.0, "urad/degC"),
        "base_tilt.tide": Size(50.0, "nrad"),
        "base_tilt.drift": Size(5.0, "urad"),
        "second_order": Size(0.05, "ug/mg^2"),
        "third_order": Size(0.01, "ug/mg^3"),
        "cross_coupling": Size(1e-4, "1/g"),
        "cross_coupling.temperature": Size(1e-5, "1/g/degC"),
        "rotation.harmonic": Size(1.0, "arcsec"),
        "rotation.wobble": Size(1.0, "arcsec"),
    }
)
