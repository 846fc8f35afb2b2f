"""Three accelerometers in poses at rest: bias, scale factors and misalignments over temperature."""

import lazy_loader

import bayescal as bc
from bayescal_models.local_gravity import ASSUMED_GRAVITY
from bayescal_models.triad.columns import OUTPUTS as OUTPUTS
from bayescal_models.triad.columns import SESSION, declare_pose_columns, triple

COLUMNS = (
    *SESSION,
    *triple(
        "output",
        "g",
        "output of axis {axis}, averaged in a pose",
        ("accel_{axis}", "acc_{axis}", "a{axis}"),
    ),
    bc.Column(
        "magnitude", "g", "local gravity in the unit of the outputs", default=1.0, low=0.9, high=1.1
    ),
    *triple(
        "direction", "1", "specific force at rest (up) along axis {axis}, if known", required=False
    ),
    *declare_pose_columns("g"),
    ASSUMED_GRAVITY,
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
