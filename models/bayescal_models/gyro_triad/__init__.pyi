"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from .campaign import Campaign as Campaign
from .campaign import MovesByHand as MovesByHand
from .log_simulator import simulate_log as simulate_log
from .model import INSTRUMENT as INSTRUMENT
from .model import moved as moved
from .model import reference_problem as reference_problem
from .model import simulate as simulate

COLUMNS: tuple[bc.Column, ...]
OUTPUTS: tuple[str, str, str]
