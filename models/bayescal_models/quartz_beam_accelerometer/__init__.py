"""Quartz resonant beam accelerometer: bias and scale factor over temperature, with two thermometers."""

from bayescal_models.quartz_beam_accelerometer.campaign import Campaign as Campaign
from bayescal_models.quartz_beam_accelerometer.model import INSTRUMENT as INSTRUMENT
from bayescal_models.quartz_beam_accelerometer.model import of_circuit as of_circuit
from bayescal_models.quartz_beam_accelerometer.model import of_frequency_sum as of_frequency_sum
from bayescal_models.quartz_beam_accelerometer.model import simulate as simulate
from bayescal_models.quartz_beam_accelerometer.model import two_thermometers as two_thermometers
from bayescal_models.quartz_beam_accelerometer.model import with_rate as with_rate
from bayescal_models.quartz_beam_accelerometer.simulator import true_values as true_values
from bayescal_models.quartz_beam_accelerometer.tables import from_tables as from_tables
