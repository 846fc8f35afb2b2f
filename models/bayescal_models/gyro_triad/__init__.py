"""Three gyroscopes on a rate table, or in moves between poses, and at rest: bias, scale factors and misalignments."""

import lazy_loader

import bayescal as bc
from bayescal_models.triad.columns import OUTPUTS as OUTPUTS
from bayescal_models.triad.columns import SESSION, declare_move_columns, derived_columns, triple

COLUMNS = (
    *SESSION,
    *triple(
        "output",
        "deg/s",
        "output of axis {axis}, averaged at a steady rate",
        ("gyro_{axis}", "gyr_{axis}", "g{axis}", "w{axis}"),
    ),
    bc.Column("rate", "deg/s", "rate of the table; 0 at rest", default=0.0),
    *triple("direction", "1", "table axis along axis {axis} of the body", required=False),
    bc.Column(
        "pose_uncertainty",
        "rad",
        "standard uncertainty of the mounting about each axis; 1 mrad unless given",
        default=1e-3,
        low=0.0,
        high=1.0,
    ),
    bc.Column("mounting", None, "readings with the same mounting error", required=False),
    *triple(
        "gravity", "g", "specific force at rest (up), along axis {axis} of the body", required=False
    ),
    *triple("earth", "deg/s", "Earth's rotation along axis {axis}", required=False),
    *derived_columns(
        "deg/s",
        "sensing axis of a computed reading",
        "axis of a computed reading",
        "one of the three outputs, or a mean over a move",
    ),
    *declare_move_columns("deg/s"),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
