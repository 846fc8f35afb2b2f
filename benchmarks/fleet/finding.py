"""Each device's missing effects searched on a cluster: devices per core-second, what was found of what was hidden."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

import bayescal as bc
from bayescal._annexes.fleet.engine import open_cluster
from bayescal_models import mems_gyro

DEVICES, EVERY, SEED = 10_000, 5, 4000  # every fifth reading of a campaign of 330
HIDDEN = {  # size, °/s per °C and °/s per °C², and in what share of the fleet
    "bias.thermal_lag": (0.05, 0.3),
    "bias.temperature_quadratic": (2e-4, 0.1),
}
MODEL = mems_gyro.INSTRUMENT.baseline()


def measured(work: Path) -> dict[str, Any]:
    """A fleet of simulated campaigns, some with an effect; shares, false effects, speed."""
    folder, out = work / "find", work / "find_out"
    shutil.rmtree(out, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    rng, truth = np.random.default_rng(SEED), {}
    for i in range(DEVICES):
        hidden = {n: size for n, (size, share) in HIDDEN.items() if rng.random() < share}
        made = mems_gyro.simulate(hidden, seed=SEED + i)
        made.select(np.arange(0, len(made), EVERY)).write(folder / f"unit-{i:04d}.csv")
        truth[f"unit-{i:04d}"] = set(hidden)
    with open_cluster(2) as client:
        found = bc.fit_batch(MODEL, folder, out=out, find=True, client=client, partition_rows=5000)
    rows = found.rows()
    own = set(MODEL.names) | {"noise.white"}
    added = {
        name: {_effect(c) for c in part.coefficient if _effect(c) not in own and _is_effect(c)}
        for name, part in rows[rows.coefficient.notna()].groupby("device")
    }
    # A substitute that stands for what is hidden is wrongly named; where nothing is hidden, an effect is false.
    false = sum(bool(added.get(name)) for name, hidden in truth.items() if not hidden)
    named = sum(bool(added.get(name, set()) - hidden) for name, hidden in truth.items() if hidden)
    table = found.effects.set_index("effect")
    effects = []
    for name, (size, share) in HIDDEN.items():
        held = sum(name in hidden for hidden in truth.values())
        seen = sum(name in added.get(device, set()) for device in truth)
        row = table.loc[name]
        effects.append(
            {
                "effect": name,
                "size": size,
                "hidden_share": share,
                "hidden": held,
                "found": seen,
                **{
                    key: float(row[key]) for key in ("possible", "in fleet", "share", "low", "high")
                },
                "expected": float(row["expected"]),
            }
        )
    return {
        "devices": DEVICES,
        "readings": found.readings // DEVICES,
        "trusted": found.fitted,
        "processor_s": found.about["processor_seconds"],
        "devices_per_core_second": found.devices / found.about["processor_seconds"],
        "effects": effects,
        "false": false,
        "empty": sum(not hidden for hidden in truth.values()),
        "wrongly_named": named,
        "table": found.effects.head(6).to_dict("records"),
    }


def _is_effect(coefficient: str) -> bool:
    return not coefficient.startswith("noise.")


def _effect(coefficient: str) -> str:
    """The effect that a coefficient or a shape belongs to: slot.cause."""
    return ".".join(coefficient.partition("[")[0].split(".")[:2])
