"""What the project is for: an effect is hidden in a simulated campaign, found, added, and the error falls.

Campaigns are simulated by physics that no candidate's basis repeats (`mems_gyro/simulator.py`), at sizes drawn
at random: half to three times the plausible size, either sign, under seeds that nothing was tuned to.
"""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro

INSTRUMENT = mems_gyro.INSTRUMENT
CANDIDATES = (
    *("bias.temperature_quadratic", "bias.temperature_cubic", "bias.rate", "bias.thermal_lag"),
    *("bias.reference_voltage", "bias.warm_up", "bias.drift", "bias.run"),
    *("scale.temperature", "scale.constant"),
    *("bias.hysteresis", "bias.temperature_x_lag", "bias.supply"),
)
SAMPLE = ("bias.thermal_lag",)  # the fast tests; the slow ones hide every candidate
DETECTABLE = 8.0  # log Bayes factor of the true model against the baseline: the oracle


def campaign_for(name: str) -> mems_gyro.Campaign:
    rates = (0.0, 100.0, -100.0) if name.startswith("scale") else None
    return mems_gyro.Campaign(rate_input=rates)


def drawn_size(name: str, seed: int) -> float:
    random = np.random.default_rng([seed, CANDIDATES.index(name)])
    size = random.uniform(0.5, 3.0) * INSTRUMENT.effect(name).coefficients[0].size
    return size if name == "bias.run" else size * random.choice([-1.0, 1.0])


def search(effects: dict[str, float], seed: int, campaign: mems_gyro.Campaign) -> bc.SearchPath:
    readings = mems_gyro.simulate(effects, seed=seed, campaign=campaign)
    kept_apart = mems_gyro.simulate(effects, seed=seed + 1, campaign=campaign)
    return bc.calibrate(INSTRUMENT.baseline(), readings, holdout=kept_apart)


def oracle(effects: dict[str, float], trail: bc.SearchPath) -> tuple[float, float]:
    """Log Bayes factor of the true model against the baseline, and its held-out rms error."""
    first = trail.steps[0].calibration
    true = bc.fit(first.model + effects, first.readings, strict=False)
    assert true.log_evidence is not None
    assert first.log_evidence is not None
    assert trail.holdout is not None
    return true.log_evidence[0] - first.log_evidence[0], bc.predict(true, trail.holdout).rmse


def hidden_and_found(name: str, seed: int) -> None:
    size = drawn_size(name, seed)
    trail = search({name: size}, 1000 * seed + CANDIDATES.index(name), campaign_for(name))
    added = {step.added for step in trail.steps} - {None}
    factor, true_error = oracle({name: size}, trail)
    before, after = trail.steps[0].holdout_rmse, trail.final.holdout_rmse
    assert before is not None
    assert after is not None
    assert after <= 1.02 * before, (
        f"{name} = {size:g}: held-out error rose from {before:g} to {after:g}"
    )
    if factor < DETECTABLE:
        return  # too small to be seen here: only harm is forbidden
    final = [e.family_name for e in trail.final.calibration.model.effects]
    family = INSTRUMENT.effect(name).family_name  # a rate is the short end of a lag
    assert family in final, f"{name} = {size:g} (oracle {factor:.1f}): added {added or 'nothing'}"
    assert after <= 1.05 * true_error
    if name not in trail.final.calibration.model.names:
        return  # in another form, which has other coefficients
    found = trail.final.calibration.samples(name)
    middle, spread = float(np.mean(found)), float(np.std(found))
    if name != "bias.run":
        # Physics and basis differ by a few per cent (a package between thermometer and die, an ageing curve).
        assert abs(middle - size) < 4 * spread + 0.2 * abs(size)


@pytest.mark.parametrize("name", SAMPLE)
def test_a_hidden_effect_is_found_and_the_error_falls(name: str) -> None:
    hidden_and_found(name, seed=7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("name", CANDIDATES)
def test_every_candidate_hidden_in_turn(name: str, seed: int) -> None:
    hidden_and_found(name, seed)


def test_no_effect_is_added_where_none_is_hidden() -> None:
    trail = search({}, 21, mems_gyro.Campaign())
    assert [step.added for step in trail.steps] == [None]
    discovery = trail.final.discovery
    assert discovery is not None
    assert (discovery.nothing_missing or 0.0) > 0.5
    assert trail.gate.ok


def test_the_size_of_a_candidate_is_as_uncertain_as_in_a_fit_with_it() -> None:
    readings = mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=71)
    fit = bc.fit(INSTRUMENT.baseline() + "bias.thermal_lag", readings)
    (found,) = (c for c in bc.discover(fit).candidates if c.effect == "bias.reference_voltage")
    sizes = bc.fit(fit.model + found.effect, readings, strict=False).samples(found.effect)
    assert found.size_sd == pytest.approx(np.std(sizes), rel=0.3)


def test_effect_outside_the_catalogue_is_reported() -> None:
    """Humidity acts and is recorded, but no candidate knows it: the check must name it."""
    readings = mems_gyro.simulate({"unlisted.humidity": 0.04}, seed=51)
    first = bc.check(bc.fit(INSTRUMENT.baseline(), readings))
    assert first.entries[0].covariate == "humidity"
    assert first.entries[0].log_bayes_factor > 5


@pytest.mark.slow
def test_wandering_noise_is_not_reported_as_an_effect() -> None:
    """The same records under white noise and under the law that the loop chooses by itself."""
    readings = mems_gyro.simulate({}, seed=61, noise_law="ornstein_uhlenbeck")
    white = bc.calibrate(INSTRUMENT.baseline(), readings, widen_noise=False)
    chosen = bc.calibrate(INSTRUMENT.baseline(), readings)
    assert any(step.added for step in white.steps)  # what the assumption of white noise costs
    assert not any(step.added for step in chosen.steps)
    assert chosen.final.calibration.model.noise.law == "ornstein_uhlenbeck"
