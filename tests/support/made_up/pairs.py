"""Made-up devices of a differential pair, with no fit: what the tests of pairs share."""

from __future__ import annotations

import numpy as np

import bayescal as bc
from bayescal_models import differential_pair as dp
from bayescal_models.differential_pair.simulator import Truth, simulate_batch

SMALL = dp.Campaign(samples=20)


def simulated_batch(plan: dp.Campaign, seed: int, **hidden: float) -> tuple[Truth, bc.Measurements]:
    columns, truth = simulate_batch(hidden, seed=seed, campaign=plan)
    return truth, bc.Measurements.from_arrays(dp.INSTRUMENT, **columns)


def made_up(
    seed: int = 0, outer: int = 3, inner: int = 4, draws: int = 400, **changed
) -> dp.Devices:
    """Devices with draws about random truths; no fit."""
    random = np.random.default_rng(seed)
    count, time = outer + inner, np.linspace(0.0, 600.0, 30)
    u = 1000.0 * (0.6 + np.sin(time / 170.0 + random.uniform(0, 6)))
    typical = 1 + 0.2 * random.standard_normal(count)
    sensitivity = typical + 0.02 * random.standard_normal((draws, count))
    drift = np.stack([np.ones(30), time / 300 - 1], axis=0)
    own = 30.0 * random.standard_normal((count, 2)) + 8.0 * random.standard_normal(
        (draws, count, 2)
    )
    environment = sensitivity[:, :, None] * u + own @ drift
    scale = 1 + 2e-3 * random.standard_normal(count) + np.zeros((draws, 1))
    sign = np.repeat([1.0, -1.0], [outer, inner])
    known = sign[:, None] * 1e6 * np.linspace(1, 5, 30) * scale[0][:, None]
    values = {
        "names": tuple(
            f"{side} {i + 1}" for side, n in (("o", outer), ("i", inner)) for i in range(n)
        ),
        "outer": outer,
        "time": time,
        "scale": scale,
        "sensitivity": sensitivity,
        "shared": u + np.zeros((draws, 1)),
        "environment": environment,
        "departure": np.full(draws, 40.0),
        "bias": np.zeros((draws, count)),
        "noise": np.full(draws, 20.0),
        "commanded": 1e6 * np.linspace(1, 5, 30),
        "records": known + environment[0],
        "known": known,
    }
    return dp.Devices(**{**values, **changed})
