"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from . import reference_problem as reference_problem
from .campaign import Campaign as Campaign
from .model import INSTRUMENT as INSTRUMENT
from .model import simulate as simulate
from .pairing.devices import Devices as Devices
from .pairing.devices import devices_of as devices_of
from .pairing.measure import Measured as Measured
from .pairing.measure import PairMeasurement as PairMeasurement
from .pairing.measure import measure as measure
from .pairing.pair_table import Pair as Pair
from .pairing.pair_table import PairTable as PairTable
from .pairing.selection import select as select

COLUMNS: tuple[bc.Column, ...]
NOMINAL_SCALE: bc.NominalScale
