"""The column of a supply's voltage, which every instrument's files may hold."""

import bayescal as bc

SUPPLY = bc.Column("supply_voltage", "V", "of the sensor's supply", required=False)
