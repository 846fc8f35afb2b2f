"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from . import reference_problem as reference_problem
from .campaign import INSTRUMENT_A as INSTRUMENT_A
from .campaign import Campaign as Campaign
from .campaign import fixed_point_heating as fixed_point_heating
from .classical import classical_estimates as classical_estimates
from .model import INSTRUMENT as INSTRUMENT
from .model import simulate as simulate

COLUMNS: tuple[bc.Column, ...]
NOMINAL_SCALE: bc.NominalScale
VOLTS: float
