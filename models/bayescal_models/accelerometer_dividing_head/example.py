"""An accelerometer on a dividing head whose square and cube terms are hidden: test, fit, ask what is missing.

python example.py
"""

import bayescal as bc
from bayescal_models import accelerometer_dividing_head as head

hidden = {"second_order.constant": 15.0, "third_order.constant": 20.0}  # µg/g², µg/g³
readings = head.simulate(hidden, seed=1)

line = bc.fit(head.INSTRUMENT.baseline(), readings)
print(bc.check(line))  # where the model fails

found = bc.discover(line)  # which effect is missing
print(found)
print(bc.fit(line.model + ["second_order.constant", "third_order.constant"], readings))
