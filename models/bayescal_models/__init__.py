"""The instruments. A new one is a folder beside these and one line here.

Each instrument's module holds `INSTRUMENT`; its docstring is the data sheet.
"""

INSTRUMENTS = ("mems_gyro", "still_sensor")
