"""Optional column of the sensor's supply voltage, common to all instruments."""

import bayescal as bc

SUPPLY = bc.Column("supply_voltage", "V", "of the sensor's supply", required=False)
