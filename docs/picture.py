"""Draw docs/error_falls.png, the whole loop on a simulated campaign: python docs/picture.py."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal_models import mems_gyro

HIDDEN = {"bias.thermal_lag": 0.05, "bias.warm_up": 0.5}  # °/s/°C, °/s
SEED, SEED_KEPT_APART = 1, 2


def main() -> None:
    instrument = mems_gyro.INSTRUMENT
    readings = mems_gyro.simulate(HIDDEN, seed=SEED)
    kept_apart = mems_gyro.simulate(HIDDEN, seed=SEED_KEPT_APART)
    trail = bc.calibrate(instrument.baseline(), readings, holdout=kept_apart)
    print(trail)
    figure = bc.plot.loop(trail)
    hidden = " and ".join(HIDDEN)
    figure.suptitle(f"A simulated gyroscope (seed {SEED}) with {hidden} hidden in it", fontsize=11)
    print(bc.plot.save(figure, Path(__file__).parent / "error_falls.png"))


if __name__ == "__main__":
    main()
