"""The plan of a simulated sensor at rest: temperature ramps, gone through once in each run, and times of its laws."""

RAMPS = ((0.0, 25.0), (10.0, -15.0), (25.0, 65.0), (40.0, 25.0))  # min, °C: cooled, heated, cooled
PAUSE = 3600.0  # s between runs
CHAMBER_TIME, LAG_TIME, SLOW_TIME = 60.0, 300.0, 2400.0  # s
REVERSAL_TIME = 30.0  # s, in which hysteresis follows a change of direction
WARM_UP_TIME, WANDER_TIME = 600.0, 300.0  # s
