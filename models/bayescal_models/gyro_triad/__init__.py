"""Three gyroscopes on a rate table and at rest: bias, scale factors and misalignments over temperature.

What its files hold stands here, at hand before the instrument is loaded; the public names, in `__init__.pyi`, load
on first use.
"""

import lazy_loader

import bayescal as bc

OUTPUTS = ("output_x", "output_y", "output_z")
COLUMNS = (
    bc.Column("run", None, "label of the session", required=False),
    bc.Column("time", "s", "one origin over all runs", required=False),
    bc.Column("temperature", "degC", "of the unit", required=False, low=-273.15, high=250.0),
    *(
        bc.Column(
            f"output_{a}",
            "deg/s",
            f"of axis {a}, averaged while the rate is steady",
            also=(f"gyro_{a}", f"gyr_{a}", f"g{a}", f"w{a}"),
        )
        for a in "xyz"
    ),
    bc.Column("rate", "deg/s", "of the table; 0 at rest", default=0.0),
    *(
        bc.Column(
            f"direction_{a}",
            "1",
            f"of the table's axis, along axis {a} of the body",
            required=False,
        )
        for a in "xyz"
    ),
    bc.Column(
        "pose_uncertainty",
        "rad",
        "standard uncertainty of the mounting about each axis; 1 mrad unless given",
        default=1e-3,
        low=0.0,
        high=1.0,
    ),
    bc.Column("mounting", None, "readings that share that error", required=False),
    *(
        bc.Column(
            f"gravity_{a}",
            "g",
            f"specific force at rest (up), along axis {a} of the body",
            required=False,
        )
        for a in "xyz"
    ),
    *(
        bc.Column(f"earth_{a}", "deg/s", f"rotation of the Earth, along axis {a}", required=False)
        for a in "xyz"
    ),
    *(bc.Column(f"across_{a}", "1", "which output a reading is of", required=False) for a in "xyz"),
    bc.Column("axis", None, "which output a reading is of", required=False),
    bc.Column("output", "deg/s", "one of the three outputs", required=False),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
