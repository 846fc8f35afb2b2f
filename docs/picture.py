"""Draw docs/error_falls.png: a simulated campaign with two hidden effects, and the error step by step.

    python docs/picture.py
"""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal_models import mems_gyro

HIDDEN = {"bias.thermal_lag": 0.05, "bias.temperature_quadratic": 5e-4}  # °/s/°C, °/s/°C²
SEED, SEED_KEPT_APART = 1, 2


def main() -> None:
    instrument = mems_gyro.INSTRUMENT
    readings = mems_gyro.simulate(HIDDEN, seed=SEED)
    kept_apart = mems_gyro.simulate(HIDDEN, seed=SEED_KEPT_APART)
    trail = bc.calibrate(instrument.baseline(), readings, holdout=kept_apart)
    print(trail)
    figure = bc.plot.trail(trail)
    figure.axes[0].set_title(f"simulated gyroscope, seed {SEED}: the error falls to the noise", fontsize=10)
    print(bc.plot.save(figure, Path(__file__).parent / "error_falls.png"))


if __name__ == "__main__":
    main()
