"""What a certificate states beside the numbers, as its TOML file."""

from __future__ import annotations

STATED = """
[certificate]
number = "2026-0117"
issued = 2026-11-24
[device]
name = "six-axis unit <IMU>"
manufacturer = "A & B"
model = "X1"
serial = 4711
[calibration]
begin = 2026-11-20
end = 2026-11-21
place = "chamber 3"
operator = "R. Weiss"
[laboratory]
name = "Laboratory for inertial sensors"
city = "Braunschweig"
country = "DE"
responsible = "M. Kern"
[customer]
name = "C. Ltd"
city = "Leeds"
country = "GB"
[conditions]
temperature = "(23.0 ± 0.5) °C"
[[standards]]
name = "platinum thermometer"
serial = 90125
certificate = "PTB-2025-33"
[[standards]]
name = "levelled table"
"""
