"""What leaves a search is averaged over its structures: draws of each in proportion to its probability."""

from __future__ import annotations

import dataclasses
import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support import references
from tests.support.inside import result_of
from tests.support.made_up import split_search

CAMPAIGNS = 40


@pytest.fixture(scope="module")
def trail() -> bc.SearchPath:
    return split_search.trail()


@pytest.fixture(scope="module")
def average(trail) -> bc.Calibration:
    assert trail.average is not None
    return trail.average


def inclusion(calibration: bc.Calibration) -> dict[str, float]:
    """The share of draws in which some coefficient of an effect is not zero."""
    x, _ = calibration.draws()
    held = {}
    for b in calibration.layout.x_blocks:
        there = np.any(x[:, b.start : b.start + b.size] != 0, axis=1)
        held[b.effect.name] = held.get(b.effect.name, False) | there
    return {name: float(there.mean()) for name, there in held.items()}


def test_shares_are_the_probabilities_of_the_search(trail) -> None:
    assert sum(s.probability for s in trail.shares) == pytest.approx(1)
    found = [s.probability for s in trail.shares]
    assert found == sorted(found, reverse=True) and min(found) >= 0.0099
    weighed = {}
    for s in trail.search.structures:
        weighed[frozenset(s.effects)] = weighed.get(frozenset(s.effects), 0) + s.probability
    of = [weighed[frozenset(s.effects)] for s in trail.shares]
    np.testing.assert_allclose(found, np.array(of) / sum(of), rtol=0.05)  # the likeliest are kept


def test_what_stands_against_its_use_is_what_stands_against_the_last_model(trail, average) -> None:
    last = trail.final.calibration.verdict
    assert last.checked and average.verdict.checked  # else each use would check it anew, otherwise
    assert average.verdict.against == last.against


def test_a_prediction_counts_that_the_model_may_lack_what_has_no_formula(
    trail, average, tmp_path
) -> None:
    complete = trail.final.discovery.nothing_missing or 0.0
    factor = np.sqrt(complete + (1 - complete) * 2.5**2)
    assert average.form_factor == pytest.approx(factor) and factor > 1
    plain = dataclasses.replace(average, form_factor=1.0)
    for coefficient in ("bias.constant", "bias.temperature"):
        assert np.array_equal(average.samples(coefficient), plain.samples(coefficient))
    wider, own = (bc.predict(c, new_groups=False).model_sd for c in (average, plain))
    np.testing.assert_allclose(wider, factor * own)
    assert bc.load(average.save(tmp_path / "c.nc")).form_factor == average.form_factor


def test_new_runs_have_the_deviations_that_so_few_runs_leave_open(average, tmp_path) -> None:
    plain = dataclasses.replace(average, unfound_spreads={})
    size, readings = average.unfound_spreads["bias.run"], average.readings
    assert 0.001 < size < 0.05
    both = [bc.predict(c, readings).model_sd for c in (average, plain)]
    np.testing.assert_allclose(both[0] ** 2 - both[1] ** 2, size**2, rtol=1e-9)
    known = [bc.predict(c, readings, new_groups=False).model_sd for c in (average, plain)]
    np.testing.assert_array_equal(*known)
    assert bc.load(average.save(tmp_path / "c.nc")).unfound_spreads == average.unfound_spreads
    in_use = [bc.compensator(c) for c in (average, plain)]
    given = {i.name: i.low for i in in_use[0].inputs}
    found, plain = (c(output=[20.5, 21.5], **given, warn=False) for c in in_use)
    wide, narrow = found.uncertainty[0], plain.uncertainty[0]
    slope = np.diff(found.value)[0]
    assert wide**2 - narrow**2 == pytest.approx((slope * size) ** 2, rel=0.02)
    budget = bc.budget(in_use[0])
    (row,) = (s for s in budget.sources if "bias.run of a new run" in s.name)
    assert row.contribution == pytest.approx(slope * size, rel=0.02) and row.kind == ""
    (note,) = (n for n in budget.notes if getattr(n, "code", "") == "budget.new_run")
    p, tau = note.numbers["p"], note.numbers["tau"]
    assert (1 - p) ** 0.5 * tau == pytest.approx(size)  # the equation that the note states
    assert p == average.inclusion.get("bias.run", 0.0) and note.numbers["plausible"] == 0.05


def test_what_a_discovery_fits_is_what_calibrate_uses() -> None:
    used = references.gyro_search().calibration
    line, quick = mems_gyro.INSTRUMENT.baseline(), bc.LeastSquares()
    discovery = bc.discover(bc.fit(line, used.readings, quick))
    sent = pickle.loads(pickle.dumps(discovery))
    assert sent == discovery
    with pytest.raises(bc.ModelError, match=r"discovery\.best"):
        sent.fit()
    found = discovery.fit(quick)
    assert found.form_factor == pytest.approx(used.form_factor, rel=0.02)
    np.testing.assert_allclose(bc.predict(found).model_sd, bc.predict(used).model_sd, rtol=0.1)


def test_draws_have_each_effect_as_often_as_it_is_probable(trail, average) -> None:
    shares = inclusion(average)
    for name in average.model.names[2:]:
        probable = sum(s.probability for s in trail.shares if name in s.effects)
        assert shares[name] == pytest.approx(probable, abs=0.002)
    assert shares["bias.constant"] == 1


def test_mean_and_variance_of_a_prediction_are_those_of_a_mixture(trail, average) -> None:
    """Σp·m and Σp·(s² + m²) − (Σp·m)², over fits of the structures by themselves."""
    weights, means, squares = [], [], []
    for share in trail.shares:
        model = trail.steps[0].calibration.model
        for name in share.effects:
            model = model + name
        fit = bc.fit(model, trail.final.calibration.readings, strict=False)
        found = bc.predict(fit, new_groups=False, draws=4000)
        weights.append(share.probability)
        means.append(found.mean)
        squares.append(found.mean**2 + found.model_sd**2)
    p = np.array(weights)[:, None]
    mean = np.sum(p * means, axis=0)
    sd = np.sqrt(np.sum(p * squares, axis=0) - mean**2)
    found = bc.predict(average, new_groups=False, draws=4000)
    assert np.max(np.abs(found.mean - mean) / sd) < 0.2
    np.testing.assert_allclose(found.model_sd, average.form_factor * sd, rtol=0.15)


def test_it_is_saved_beside_the_structure_that_is_shown_and_commands_use_it(
    trail, average, tmp_path
) -> None:
    trail.save(tmp_path)
    loaded = bc.load(tmp_path / "averaged.nc")
    assert inclusion(loaded) == inclusion(average)
    one, other = bc.compensator(loaded), bc.compensator(average)
    given: dict[str, Any] = {i.name: np.array([i.low, i.high]) for i in other.inputs}
    reading = np.array([20.0, 22.0])
    for of in ("value", "uncertainty"):
        np.testing.assert_allclose(
            getattr(one(output=reading, **given), of),
            getattr(other(output=reading, **given), of),
            rtol=1e-12,
        )


def test_a_file_without_the_column_of_an_improbable_effect_is_predicted(average) -> None:
    assert "bias.reference_voltage" in average.model.names
    whole = average.readings
    columns: dict[str, Any] = {n: whole[n] for n in ("run", "time", "temperature", "output")}
    left = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, **columns)
    found, known = bc.predict(average, left), bc.predict(average, whole)
    assert np.max(np.abs(found.mean - known.mean) / known.model_sd) < 0.5


@pytest.mark.slow
def test_where_the_search_is_split_the_average_covers_and_one_structure_does_not() -> None:
    """95 % intervals of the true noise-free curve over the readings; sizes too small for a certain answer."""
    sizes = np.random.default_rng(11).uniform(0.003, 0.012, CAMPAIGNS)
    best, averaged = [], []
    for seed, size in enumerate(sizes):
        hidden = {"bias.thermal_lag": float(size)}
        readings = mems_gyro.simulate(hidden, seed=seed)
        quiet = mems_gyro.simulate(hidden, seed=seed, campaign=mems_gyro.Campaign(noise=1e-9))
        trail = bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings)
        if trail.average is None or trail.shares[0].probability > 0.8:
            continue
        shares = []
        for one in (trail.final.calibration, trail.average):
            found = bc.predict(one, new_groups=False)
            shares.append(np.mean(np.abs(quiet["output"] - found.mean) < 1.96 * found.model_sd))
        best.append(shares[0])
        averaged.append(shares[1])
    assert len(best) >= 8
    assert np.mean(averaged) > np.mean(best) and np.mean(averaged) > 0.88


# Mean, standard uncertainty and interval of a coefficient are of one distribution, wherever they are stated.


@cache
def searched(size: float, seed: int) -> bc.SearchPath:
    readings = mems_gyro.simulate({"bias.thermal_lag": size}, seed=seed)
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings)


CASES = [(0.014, 8), (0.018, 8)]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "seed"), CASES)
def test_mean_uncertainty_and_interval_agree(size, seed) -> None:
    found = searched(size, seed).calibration
    rows: Any = found.to_pandas().reset_index().itertuples()
    for row in rows:
        draws = found.samples(row.unknown.partition("(")[0])
        if draws.ndim > 1 or row.effect not in searched(size, seed).final.calibration.model.names:
            continue
        assert row.low <= row.mean <= row.high, row.unknown
        assert 2.0 < (row.high - row.low) / row.sd < 6.0, row.unknown  # 3.9 of a normal one
        if row.unknown.endswith(".tau"):  # a shape has a value where its effect is
            draws = draws[found.inclusion_masks[row.effect]]
        assert row.mean == pytest.approx(draws.mean())
        np.testing.assert_allclose([row.low, row.high], np.quantile(draws, [0.025, 0.975]))


# Numbers that a user may change can be seen and changed, and what was changed is written into the result.


def line_of(*temperatures: float) -> bc.Measurements:
    count = len(temperatures)
    columns = {"temperature": [*temperatures], "time": [float(i) for i in range(count)]}
    output = [1.0 + 0.1 * i for i in range(count)]
    return bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, output=output, **columns)


def test_a_record_is_judged_by_them_inside_and_no_further() -> None:
    with bc.use_settings(bc.Settings(temperature_span=0.5)), pytest.raises(bc.InputError):
        line_of(20.0, 20.3)
    assert len(line_of(20.0, 20.3)) == 2


@pytest.mark.slow
def test_a_search_goes_by_them_and_the_result_says_so() -> None:
    readings, first = split_search.readings(), split_search.trail().steps[0].discovery
    assert first is not None and first.findings
    with bc.use_settings(bc.Settings(found_probability=0.9999)):
        trail = bc.calibrate(split_search.trail().steps[0].calibration.model, readings)
        assert result_of(trail)["settings"] == {"found_probability": 0.9999}
    other = trail.steps[0].discovery
    assert other is not None
    assert [s.effects for s in other.findings] != [s.effects for s in first.findings]
