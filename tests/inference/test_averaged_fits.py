"""Fits of means beside fits of all readings: the same coefficients, the same uncertainties, and intervals that hold."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

import bayescal as bc
from bayescal_models.still_sensor.model import instrument

ROWS, STEP, NOISE = 3000, 0.1, 20.0  # 5 min at ten readings a second; µg
TRUTH = {"bias.constant": 300.0, "bias.temperature": 12.0}  # µg, µg/°C about 25 °C
SENSOR = instrument("ug", size=30.0, constant=1000.0, span=3.0, pace=1.0)


def uneven_log(seed: int, correlated: float = 0.0) -> bc.Measurements:
    """A slow ramp at 25 °C; after half of it every fifth reading is kept, and a few are lost anywhere."""
    rng = np.random.default_rng(seed)
    time = STEP * np.arange(ROWS)
    kept = (np.arange(ROWS) < ROWS // 2) | (np.arange(ROWS) % 5 == 0)
    kept &= rng.uniform(size=ROWS) > 0.03
    temperature = 25 + 3 * np.sin(time / 60.0)
    output = TRUTH["bias.constant"] + TRUTH["bias.temperature"] * (temperature - 25)
    output += rng.normal(0.0, NOISE, ROWS)
    if correlated:
        share = np.exp(-STEP / 30.0)  # of correlation time 30 s
        push = rng.normal(0.0, correlated * np.sqrt(1 - share**2), ROWS)
        push[0] = rng.normal(0.0, correlated)
        output += lfilter([1.0], [1.0, -share], push)
    return bc.Measurements.from_arrays(
        SENSOR, time=time[kept], temperature=temperature[kept], output=output[kept]
    )


def fitted(data: bc.Measurements, noise: bc.Noise | None = None) -> dict[str, np.ndarray]:
    """Draws of the coefficients about 25 °C, and of the noise."""
    model = SENSOR.baseline()
    model = model if noise is None else model.with_noise(noise)
    found = bc.fit(model, data, strict=False, reference={"T0": 25.0})
    return {name: np.asarray(found.samples(name)) for name in (*TRUTH, "noise.white")}


def test_means_give_the_coefficients_of_all_readings() -> None:
    data = uneven_log(1)
    means = data.average("1 s")
    assert len(means) < len(data) / 5
    raw, short = fitted(data), fitted(means)
    for name in TRUTH:
        sd = np.std(raw[name])
        assert abs(np.mean(short[name]) - np.mean(raw[name])) < 0.3 * sd
        assert np.std(short[name]) == pytest.approx(sd, rel=0.15)
    # Of a mean of ten.
    assert np.mean(short["noise.white"]) == pytest.approx(NOISE / np.sqrt(10), rel=0.15)


@pytest.mark.slow
def test_correlated_noise_survives_averaging() -> None:
    data = uneven_log(2, correlated=30.0)
    law = bc.OrnsteinUhlenbeck(1.0, 300.0, bc.HalfCauchy(30.0), bc.HalfCauchy(30.0))
    raw, short = fitted(data, law), fitted(data.average("1 s"), law)
    white = np.std(fitted(data)["bias.constant"])
    for name in TRUTH:
        sd = np.std(raw[name])
        assert abs(np.mean(short[name]) - np.mean(raw[name])) < 0.3 * sd
        assert np.std(short[name]) == pytest.approx(sd, rel=0.25)
    assert np.std(short["bias.constant"]) > 5 * white
