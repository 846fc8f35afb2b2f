"""Any sensor at rest: one output, temperature and time."""

from bayescal_models.still_sensor.model import INSTRUMENT as INSTRUMENT
from bayescal_models.still_sensor.model import instrument as instrument
from bayescal_models.still_sensor.model import simulate as simulate
