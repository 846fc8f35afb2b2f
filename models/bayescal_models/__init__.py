"""Instruments, one package each. To add one, add a package here and its name to `INSTRUMENTS`.

An instrument's `__init__.py` declares the columns of its files; its public names, listed in `__init__.pyi`, are loaded
on first use. Its module `model` defines `INSTRUMENT`; the docstring of `model` is the data sheet. Its
`reference_problem` has few readings and proper priors; on it the coverage of intervals and the agreement of methods
are tested:

    model, readings = reference_problem.model(), reference_problem.readings()

`reference_posterior.json` contains the posterior for `readings(seed=0)` from long NUTS runs. Some problems also have
`simulate_effects(effects, seed)`, which simulates readings of a larger test with hidden effects, as `simulate` does.
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
