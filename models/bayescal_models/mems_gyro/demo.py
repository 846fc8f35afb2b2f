"""The demonstration: a real table against its published line, then a hidden effect found and added."""

from __future__ import annotations

import textwrap
from pathlib import Path

import bayescal as bc
from bayescal_models.mems_gyro.model import INSTRUMENT
from bayescal_models.mems_gyro.tables import TABLE

# Source 1, as printed: 0.041·T + 19.80.
PUBLISHED = {"bias.constant": 19.80, "bias.temperature": 0.041}
HIDDEN = {"bias.thermal_lag": 0.05}  # °/s per °C between die and thermometer


def run(out: Path, seed: int) -> None:
    """Run the demonstration and write its results and pictures to a folder: a picture, and the trail's files.

    Args:
        out: an existing folder.
        seed: of the simulated campaign and of every fit.
    """
    readings = bc.read(TABLE, INSTRUMENT)
    print(
        f"1. A MEMS GYROSCOPE'S TABLE ({len(readings)} rows, source 1) AGAINST THE LINE ITS PAPER PRINTS\n"
    )
    print("   rate = 0.041·T + 19.80\n")
    published = bc.fit(
        INSTRUMENT.baseline().fix(PUBLISHED), readings, seed=seed, reference={"T0": 0.0}
    )
    checked = bc.check(published)
    print(checked)
    bc.plot.save(bc.plot.residuals(published, checked), out / "published_line.png")

    print("\n2. THE SAME TABLE AGAINST A FITTED LINE\n")
    line = bc.fit(INSTRUMENT.baseline(), readings, seed=seed)
    print(line, "\n")
    print(bc.check(line))
    print("\nWhat is missing from the line?\n")
    print(bc.discover(line))

    hidden = ", ".join(f"{k} = {v}" for k, v in HIDDEN.items())
    print(f"\n3. A SIMULATED CAMPAIGN WITH ONE HIDDEN EFFECT ({hidden}, seed {seed})\n")
    campaign = INSTRUMENT.simulate(HIDDEN, seed=seed + 1)
    kept = INSTRUMENT.simulate(HIDDEN, seed=seed + 2)
    trail = bc.calibrate(INSTRUMENT.baseline(), campaign, holdout=kept, seed=seed)
    for step in trail.steps:
        print(f"{step.title}:")
        print(step.discovery, "\n")
    print(trail)
    before, after = trail.steps[0].holdout_rmse, trail.final.holdout_rmse
    print(
        f"\nhold-out data: rms error {before:.3f} °/s before, {after:.3f} °/s after, "
        f"noise floor {trail.final.noise_floor:.3f} °/s"
    )
    print(f"\n{textwrap.fill(trail.in_short, 110)}")
    trail.save(out)
