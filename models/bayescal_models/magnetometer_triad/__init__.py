"""Three magnetometers in a constant field: hard iron, soft iron and misalignments over temperature."""

import lazy_loader

import bayescal as bc
from bayescal_models.triad.columns import OUTPUTS as OUTPUTS
from bayescal_models.triad.columns import SESSION, declare_pose_columns, triple

COLUMNS = (
    *SESSION,
    *triple("output", "uT", "output of axis {axis}, averaged in a pose", ("mag_{axis}", "m{axis}")),
    bc.Column("magnitude", "uT", "of the local field", required=False, low=1.0, high=1000.0),
    bc.Column(
        "magnitude_read",
        "uT",
        "magnitude of the field computed from the outputs, if no reference magnitude is known",
        required=False,
    ),
    *triple("direction", "1", "field direction along axis {axis}, if known", required=False),
    *declare_pose_columns("uT"),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
