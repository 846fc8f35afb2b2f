"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from .campaign import VERIFICATION as VERIFICATION
from .campaign import Accelerometer as Accelerometer
from .campaign import Campaign as Campaign
from .compensation import Compensated as Compensated
from .compensation import CompensatedTilts as CompensatedTilts
from .compensation import compensate as compensate
from .model import INSTRUMENT as INSTRUMENT
from .model import reference_problem as reference_problem
from .model import simulate as simulate

COLUMNS: tuple[bc.Column, ...]
