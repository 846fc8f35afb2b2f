"""The time and size of correlated noise cannot run away, and what it takes is told between readings alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import still_sensor

FAST = bc.LeastSquares(draws=200)
SENSOR = still_sensor.instrument("ug", size=30.0, constant=300.0, span=20.0)
WHITE, DIFFUSION, STEP = 1.0, 0.5, 10.0  # µg, µg/√s, s


def readings_of(instrument: bc.Instrument, runs: list[np.ndarray], **columns: Any):
    """Readings with one array of times for each run."""
    time = np.concatenate(runs)
    labels = np.repeat([str(k) for k in range(len(runs))], [len(t) for t in runs])
    more = {"temperature": np.linspace(10.0, 50.0, time.size), "output": np.zeros(time.size)}
    return bc.Measurements.from_arrays(instrument, run=labels, time=time, **{**more, **columns})


# The limit of a random walk, where readings know the diffusion and nothing of the time.


def walks(seed: int, lengths: list[int]) -> bc.Measurements:
    """A line over temperature, white noise, and a random walk in each run."""
    random = np.random.default_rng(seed)
    runs = [1e5 * k + STEP * np.arange(n) for k, n in enumerate(lengths)]
    slow = [np.cumsum(np.sqrt(STEP) * DIFFUSION * random.standard_normal(n)) for n in lengths]
    temperature = np.concatenate(
        [30 + 20 * np.sin(2 * np.pi * np.arange(n) / max(n, 20)) for n in lengths]
    )
    output = np.concatenate(slow) + 3 + 0.8 * (temperature - 30)
    output += WHITE * random.standard_normal(output.size)
    return readings_of(SENSOR, runs, temperature=temperature, output=output)


def law_of(data: bc.Measurements) -> bc.OrnsteinUhlenbeck:
    """Bounds as `calibrate` takes them from a record."""
    span = max(float(np.ptp(data["time"][data["run"] == r])) for r in np.unique(data["run"]))
    return bc.OrnsteinUhlenbeck(STEP, max(span, 10 * STEP), bc.HalfCauchy(3.0), bc.HalfCauchy(3.0))


WALKS = {
    "one run": [300],
    "many runs": [60] * 8,
    "short runs": [5] * 40,
    "runs of unlike length": [200, 40, 12, 3, 1, 90],
}


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, bc.Marginal(draws=1000)], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("lengths", WALKS.values(), ids=WALKS)
def test_a_random_walk_does_not_run_away(lengths, method) -> None:
    data = walks(5, lengths)
    law = law_of(data)
    found = bc.fit(SENSOR.baseline().with_noise(law), data, method, strict=False)
    tau, diffusion = (found.samples(n) for n in ("noise.correlated.time", "noise.diffusion"))
    assert ((tau >= law.shortest) & (tau <= law.longest)).all()
    assert DIFFUSION / 1.5 < np.median(diffusion) < 1.5 * DIFFUSION
    size = diffusion * np.sqrt(tau / 2)
    assert np.median(size) < np.ptp(data["output"])
    slope = found.samples("bias.temperature")
    assert abs(slope.mean() - 0.8) < 4 * slope.std() + 0.02
    # From runs of five readings a short correlation time is hardly told from white noise.
    assert found.samples("noise.white").mean() == pytest.approx(WHITE, rel=0.6)
