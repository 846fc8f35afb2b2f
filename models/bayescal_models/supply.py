"""The column of the supply voltage, which files of every instrument may have."""

import bayescal as bc

SUPPLY = bc.Column("supply_voltage", "V", "of the sensor's supply", required=False)
