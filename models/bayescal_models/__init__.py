"""The instruments. A new one is a folder beside these and one line here.

Each instrument's module holds `INSTRUMENT`; its docstring is the data sheet.
"""

INSTRUMENTS = (
    "ng_accelerometer",
    "mems_gyro",
    "quartz_beam_accelerometer",
    "differential_pair",
    "inclinometer",
    "still_sensor",
    "accelerometer_triad",
    "magnetometer_triad",
)
