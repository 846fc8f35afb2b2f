"""Differential pair: two accelerometers of one type, mounted opposed, whose difference cancels the environment."""

from bayescal_models.differential_pair.batch import SimulatedBatch as SimulatedBatch
from bayescal_models.differential_pair.batch import simulate_batch as simulate_batch
from bayescal_models.differential_pair.campaign import Campaign as Campaign
from bayescal_models.differential_pair.model import INSTRUMENT as INSTRUMENT
from bayescal_models.differential_pair.model import simulate as simulate
from bayescal_models.differential_pair.pairing.devices import Devices as Devices
from bayescal_models.differential_pair.pairing.devices import devices_of as devices_of
from bayescal_models.differential_pair.pairing.measure import Measured as Measured
from bayescal_models.differential_pair.pairing.measure import measure as measure
from bayescal_models.differential_pair.pairing.pair_table import Pair as Pair
from bayescal_models.differential_pair.pairing.pair_table import PairTable as PairTable
from bayescal_models.differential_pair.pairing.selection import select as select
