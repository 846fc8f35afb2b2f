"""MEMS gyroscope: zero-rate drift over temperature."""

from bayescal_models.mems_gyro.campaign import Campaign as Campaign
from bayescal_models.mems_gyro.effects import RESONANCE as RESONANCE
from bayescal_models.mems_gyro.effects import RESONANCE_FORCE as RESONANCE_FORCE
from bayescal_models.mems_gyro.model import INSTRUMENT as INSTRUMENT
from bayescal_models.mems_gyro.model import simulate as simulate
from bayescal_models.mems_gyro.tables import TABLE as TABLE
from bayescal_models.mems_gyro.tables import TABLE_VOLTS as TABLE_VOLTS
