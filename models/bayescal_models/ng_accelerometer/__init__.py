"""ng accelerometer on a tilted table: bias and scale factor over temperature."""

from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_A as INSTRUMENT_A
from bayescal_models.ng_accelerometer.campaign import INSTRUMENT_B as INSTRUMENT_B
from bayescal_models.ng_accelerometer.campaign import Campaign as Campaign
from bayescal_models.ng_accelerometer.campaign import fixed_point_heating as fixed_point_heating
from bayescal_models.ng_accelerometer.classical import classical_estimates as classical_estimates
from bayescal_models.ng_accelerometer.classical import fixed_point_tempcos as fixed_point_tempcos
from bayescal_models.ng_accelerometer.model import INSTRUMENT as INSTRUMENT
from bayescal_models.ng_accelerometer.model import simulate as simulate
