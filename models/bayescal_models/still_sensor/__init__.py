"""Any sensor at rest: one output, temperature and time."""

import lazy_loader

import bayescal as bc
from bayescal_models.supply import SUPPLY

COLUMNS = (
    bc.Column("run", None, "label of the run", required=False),
    bc.Column("time", "s", "one origin over all runs"),
    bc.Column(
        "temperature", "degC", "any thermometer near by", required=False, low=-273.15, high=250.0
    ),
    SUPPLY,
    bc.Column("output", "any", "the logged channel"),
)

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
