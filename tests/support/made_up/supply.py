"""A frame's reference that has the supply's voltage count from where the simulators have it count from."""

from bayescal_models.simulated import SUPPLY_V

AT_SUPPLY = {f"supply_voltage_{end}": SUPPLY_V for end in ("low", "high")}
