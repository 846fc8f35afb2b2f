"""Units: what is understood and refused, and that numbers survive there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest

import bayescal as bc
from bayescal.workshop import base_unit, convert, parse, same_dimension
from tests.support.inside import coefficient_factor, format_unit

ARCSEC = math.pi / 648000


def entries(table: str) -> list[list[str]]:
    """Return the words of each entry of a table, parted by semicolons and ends of lines."""
    return [entry.split() for entry in table.replace("\n", ";").split(";") if entry.strip()]


# a coefficient's unit, its slot's, and the factor between them
FACTORS = f"""
ppm/degC 1 1e-6; deg/s/degC deg/s 1; deg/s/(degC/min) deg/s 60; ug/mg^2 ug 1e-6; ug/degC ug 1; ug/degF ug 1.8
arcsec/deg^2 rad {ARCSEC / (math.pi / 180) ** 2!r}; urad/degC rad 1e-6; 1/g 1 1e-6; Hz/g Hz 1e-6
arcsec rad {ARCSEC!r}; degC delta_degC 1; 1 1 1
"""
# a value, its unit, another unit, and the value in that
VALUES = f"""
25 degC K 298.15; 0 K degC -273.15; 212 degF degC 100; -40 degC degF -40; 1 degC/min K/s {1 / 60!r}
9 degF/h degC/h 5; 9.80665 m/s^2 g 1; 1 mg ug 1000; 180 deg rad {math.pi!r}; 3600 arcsec deg 1; 980.665 Gal g 1
1 mGal uGal 1000; 7 ppm/K 1/degC 7e-6; 1 µrad nrad 1000; 1 dps deg/h 3600; 50 % 1 0.5; 1 h s 3600
"""


@pytest.mark.parametrize(("unit", "slot", "factor"), entries(FACTORS))
def test_a_coefficient_in_its_reported_unit_becomes_internal(unit, slot, factor):
    assert coefficient_factor(unit, slot) == pytest.approx(float(factor), rel=1e-14)


@pytest.mark.parametrize(("value", "old", "new", "expected"), entries(VALUES))
def test_values_convert(value, old, new, expected):
    found = convert(float(value), old, new)
    assert found == pytest.approx(float(expected), rel=1e-14, abs=1e-12)


def test_local_gravity_divides_what_comes_in_as_metres_per_second_squared():
    assert convert([9.81], "m/s^2", "g", local_gravity=9.81) == pytest.approx(1, rel=1e-15)
    assert convert(2.0, "V/g", "V/(m/s^2)", local_gravity=9.8) == pytest.approx(2 / 9.8, rel=1e-14)
    with pytest.raises(bc.InputError):
        convert(1.0, "m/s^2", "g", local_gravity=980.665)


def test_a_temperature_is_absolute_and_a_difference_is_not():
    assert convert(1.0, "degF", "degC", difference=True) == pytest.approx(5 / 9)
    assert convert(3.0, "degC", "delta_degC") == 3
    assert convert(3.0, "K", "delta_degC") == 3
    with pytest.raises(bc.InputError):
        convert(1.0, "delta_degC", "degC")


@pytest.mark.parametrize(
    "spellings",
    [
        ("degC", "°C", "℃", "celsius", " degC "),
        ("deg/s", "°/s", "º/s", "dps", "deg·s⁻¹", "degrees/second", "deg*s^-1", "deg s^-1"),
        ("ug", "µg", "μg"),
        ("m/s^2", "m/s²", "m/s**2", "m/s2", "m·s^-2", "m*s^(-2)"),
        ("ug/Hz^0.5", "µg/√Hz", "ug/sqrt(Hz)"),
        ("1", "-", "V/V"),
        ("arcsec", "″", '"', "''", "arcseconds"),
        ("arcmin", "′", "'"),
        ("mGal", "mgal"),
        ("µGal", "uGal"),
        ("deg/h", "°/h", "dph"),
        ("deg/h^0.5", "°/√h", "deg/sqrt(h)"),
        ("ppm/degC", "ppm/°C", "ppm*degC^-1"),
    ],
)
def test_alternative_spellings_of_units_are_parsed(spellings):
    for spelling in spellings:
        parse(spelling)
        assert same_dimension(spelling, spellings[0])
        assert convert(7.0, spelling, spellings[0]) == pytest.approx(7.0, rel=1e-14)


SHOWN = """
deg/s/degC °/s/°C; ug µg; ug/mg^2 µg/mg²; ppm/degC ppm/°C; deg/s/(degC/min) °/s/(°C/min); arcsec/deg^2 arcsec/°²
ug/Hz^0.5 µg/√Hz; mV*s^-1 mV·s⁻¹; dps °/s; delta_degC °C; % %; 1 1
"""


@pytest.mark.parametrize(("unit", "shown"), entries(SHOWN))
def test_units_are_shown_as_people_write_them(unit, shown):
    assert format_unit(unit) == shown
    assert same_dimension(shown, unit)


BASES = """
min s; degF degC; delta_degF delta_degC; deg/s rad/s; mg ug; m/s^2 ug; V/g V/ug; K/min degC/s; % 1; 1/degC^2 1/degC^2
"""


@pytest.mark.parametrize(("unit", "base"), entries(BASES))
def test_what_no_instrument_prescribes_is_kept_in_base_units(unit, base):
    assert base_unit(unit) == base
    parse(base)


SIZES = f"""
gram 1e-3 kg; lb 0.45359237 kg; kN 1e3 N; kgf 9.80665 N; L/min {1e-3 / 60!r} m^3/s; ml/h {1e-6 / 3600!r} m^3/s
sccm {1e-6 / 60!r} m^3/s; mmol/L 1 mol/m^3; psi 6894.757293168 Pa; mmHg 133.322387415 Pa; Nm 1 N*m
mgram/m^3 1e-6 kg/m^3
"""


@pytest.mark.parametrize(("unit", "size", "base"), entries(SIZES))
def test_units_of_mass_force_volume_amount_pressure_and_flow(unit, size, base) -> None:
    assert base_unit(unit) == base
    assert np.isclose(convert(1.0, unit, base), float(size), rtol=1e-9)
