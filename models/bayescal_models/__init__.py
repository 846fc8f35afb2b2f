"""The instruments. To add one, add a folder beside these and a line here.

Each instrument's folder says in `__init__.py` what its files hold; the public names, in `__init__.pyi`, load
on first use. Its `model` holds `INSTRUMENT`, its docstring is the data sheet. Its
`reference_problem` is small, with proper priors; intervals must cover on it, and methods agree:

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` holds its posterior for `readings(seed=0)`, by long NUTS. Where there is one,
`hidden(effects, seed)` makes readings of a fuller test with effects hidden in them, as `simulate` takes them.
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
    "gyro_triad",
    "accelerometer_dividing_head",
)
