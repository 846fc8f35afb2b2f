"""Three magnetometers in a constant field: hard iron, soft iron and misalignments over temperature.

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
            f"output_{a}", "uT", f"of axis {a}, averaged in a pose", also=(f"mag_{a}", f"m{a}")
        )
        for a in "xyz"
    ),
    bc.Column("magnitude", "uT", "of the local field", default=50.0, low=1.0, high=1000.0),
    *(
        bc.Column(
            f"direction_{a}", "1", f"of the field, along axis {a}, where known", required=False
        )
        for a in "xyz"
    ),
    bc.Column(
        "pose_uncertainty",
        "rad",
        "standard uncertainty of that direction",
        required=False,
        low=0.0,
        high=1.0,
    ),
    *(
        bc.Column(f"across_{a}", "1", "of a reading that is a projection", required=False)
        for a in "xyz"
    ),
    bc.Column("axis", None, "which reading of a pose it is", required=False),
    bc.Column("output", "uT", "magnitude or projection, made of the three outputs", required=False),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
