"""What channels say of a shape that they share: against enumeration, and against refits with the shape held."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import bayescal as bc
from bayescal._search.discover import enumerate_structures
from bayescal._search.library import Library
from bayescal._search.shared_shape import (
    SHARES,
    CavityPrior,
    ShapeEvidence,
    SharedShape,
    evaluate_shape,
    log_mass,
)
from bayescal._search.structures import Structures
from bayescal._search.walk import explore
from bayescal_models import still_sensor
from tests.support.inside import constants_of

LAG = "bias.thermal_lag"


def three_channels(prior: float = 0.2) -> SharedShape:
    """A clear one, one that shows nothing, one in doubt."""
    v = np.arange(-3.0, 3.0, 0.1)
    says = {
        "clear": 8.0 - 0.5 * ((v - 0.5) / 0.2) ** 2,
        "nothing": -3.0 - 0.1 * v**2,
        "in doubt": 1.0 - 0.5 * ((v - 0.7) / 0.4) ** 2,
    }
    return SharedShape(LAG, bc.Shape("tau", "s", 60.0, 1200.0, shared=True), v, prior, says)


def enumerated(shared: SharedShape) -> dict[tuple[bool, ...], np.ndarray]:
    """Probability, by which channels show it, and by its shape; all False twice: the unit may not have it."""
    mass = np.exp(log_mass(shared.v))
    found = {}
    for shown in itertools.product((False, True), repeat=len(shared.log_ratios)):
        there = np.zeros(shared.v.size)
        for share in SHARES[:, 0]:
            one = shared.prior * mass / SHARES.size
            for log_ratio, holds in zip(shared.log_ratios.values(), shown, strict=True):
                one = one * (share * np.exp(log_ratio) if holds else 1 - share)
            there += one
        found[shown] = there
    return found


def test_probability_for_the_unit_equals_enumeration() -> None:
    shared, found = three_channels(), enumerated(three_channels())
    with_it = sum(one.sum() for one in found.values())
    expected = with_it / (with_it + 1 - shared.prior)
    assert shared.probability == pytest.approx(expected, rel=1e-9)
    weight = np.sum(list(found.values()), axis=0)
    mean = weight @ shared.v / weight.sum()
    assert shared.shape.prior.coordinate(shared.posterior[0]) == pytest.approx(mean, abs=1e-9)


def test_what_a_channel_concludes_alone_is_the_posterior_of_its_own_prior() -> None:
    shared = three_channels()
    log_ratio, shape = shared.log_ratios["in doubt"], shared.shape
    prior = CavityPrior(0.0, shape.low, shape.high)
    found = ShapeEvidence(shared.v, log_ratio).update(prior, shape)
    weight = np.exp(log_ratio - 0.5 * shared.v**2)
    ratio = weight.sum() * 0.1 / np.sqrt(2 * np.pi)
    mean = weight @ shared.v / weight.sum()
    assert found.probability == pytest.approx(ratio / (1 + ratio), rel=1e-3)
    assert found.v == pytest.approx(mean, abs=1e-3)
    assert found.sd**2 == pytest.approx(weight @ (shared.v - mean) ** 2 / weight.sum(), rel=1e-2)


def test_what_the_others_say_and_the_own_evidence_are_the_whole_posterior() -> None:
    """Prior odds from the others times a channel's own evidence over their range: what enumeration gives it."""
    shared, found = three_channels(), enumerated(three_channels())
    total = sum(one.sum() for one in found.values()) + 1 - shared.prior
    for i, name in enumerate(shared.log_ratios):
        expected = sum(one.sum() for shown, one in found.items() if shown[i]) / total
        told = shared.cavity_prior(name)
        low, high = (shared.shape.prior.coordinate(end) for end in (told.low, told.high))
        mass = log_mass(shared.v, (low + high) / 2, (high - low) / (2 * 1.959963984540054))
        own = np.logaddexp.reduce(mass + shared.log_ratios[name])
        here = 1 / (1 + np.exp(-(told.log_odds + own)))
        assert here == pytest.approx(expected, abs=0.02), name  # their range is taken as normal


def weighed(readings: bc.Measurements) -> Structures:
    model = still_sensor.INSTRUMENT.for_readings(readings).baseline()
    made, _ = enumerate_structures(model, readings, constants_of(readings))
    names = (LAG, "bias.temperature_quadratic", "bias.rate", "bias.drift")
    made.candidates = {n: made.candidates[n] for n in names}
    explore(Library(made), 3)
    return made


@pytest.mark.slow
def test_a_channel_says_what_refits_with_the_shape_held_say() -> None:
    readings = still_sensor.simulate({LAG: 8.0}, seed=3, runs=1, interval=20)
    made = weighed(readings)
    effect = made.candidates[LAG]
    assert effect.shared_shape is not None
    v, log_ratio = evaluate_shape(made, LAG, effect.shared_shape)
    assert LAG in made.best.structure.effects
    prior = effect.shared_shape.prior
    peak = v[int(np.argmax(log_ratio))]
    held = []
    for value in map(float, prior.value(np.array([peak - 0.3, peak, peak + 0.3]))):
        narrow = effect.with_ranges({"tau": (0.999 * value, 1.001 * value)})
        fixed = Structures(
            made.base, made.layout, made.record, {**made.candidates, LAG: narrow}, made.noise_laws
        )
        with_it = [fixed.evaluate(s) for s in made.visited if LAG in s.effects]
        without = [fixed.evaluate(s) for s in made.visited if LAG not in s.effects]
        totals = [np.logaddexp.reduce([w.log_posterior for w in ws]) for ws in (with_it, without)]
        held.append(totals[0] - fixed.log_odds[LAG] - totals[1])
    found = np.interp([peak - 0.3, peak, peak + 0.3], v, log_ratio)
    np.testing.assert_allclose(found, held, atol=0.7)
    assert found[1] > found[0] + 1 and found[1] > found[2] + 1  # it tells the shape
