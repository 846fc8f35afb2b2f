"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from .campaign import Campaign as Campaign
from .model import INSTRUMENT as INSTRUMENT
from .model import of_circuit as of_circuit
from .model import of_frequency_sum as of_frequency_sum
from .model import reference_problem as reference_problem
from .model import simulate as simulate
from .model import two_thermometers as two_thermometers
from .model import with_rate as with_rate
from .simulator import true_values as true_values

COLUMNS: tuple[bc.Column, ...]
NOMINAL_SCALE: bc.NominalScale
SCALE_FACTOR: float
PER_G: float
