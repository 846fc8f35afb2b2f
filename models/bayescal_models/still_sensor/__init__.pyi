"""The public names. `lazy_loader` reads this file when the package is imported."""

import bayescal as bc

from . import reference_problem as reference_problem
from .model import INSTRUMENT as INSTRUMENT
from .model import instrument as instrument
from .model import simulate as simulate

COLUMNS: tuple[bc.Column, ...]
