"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from .campaign import Campaign as Campaign
from .model import INSTRUMENT as INSTRUMENT
from .model import RESONANCE as RESONANCE
from .model import RESONANCE_FORCE as RESONANCE_FORCE
from .model import reference_problem as reference_problem
from .model import simulate as simulate
from .tables import TABLE as TABLE

COLUMNS: tuple[bc.Column, ...]
NOMINAL_SCALE: bc.NominalScale
SENSITIVITY: float
VOLTAGE_STEP: float
THERMOMETER_SD: float
