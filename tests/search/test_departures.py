"""Real laws depart a little from a catalogue's form: the law is found by its name, and its departure with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal._inference.linear_model import linear_model
from bayescal._inference.terms import ColumnsOf
from bayescal._model.frame import reference_of
from bayescal._search.departures import contribution, may_depart
from bayescal._search.discover import structures_over
from bayescal._search.library import Library
from bayescal._search.posterior import Posterior
from bayescal._search.structures import Structure, Structures
from bayescal._search.walk import walk
from bayescal_models import mems_gyro

INSTRUMENT = mems_gyro.INSTRUMENT
QUADRATIC = 1.5e-3  # °/s/°C²


def bent(share: float) -> bc.Measurements:
    """A quadratic in temperature that saturates: it departs from its form by about this share of it."""
    readings = mems_gyro.simulate(seed=5)
    warmer = readings["temperature"] - 55.0
    far = np.max(np.abs(warmer))
    law = QUADRATIC * warmer**2 * (1 - 4 * share * (np.abs(warmer) / far) ** 3)
    return readings.with_column("output", readings["output"] + law)


def structures(readings: bc.Measurements) -> Structures:
    return structures_over(INSTRUMENT.baseline(), readings, reference_of(readings))[0]


def test_a_law_that_departs_from_its_form_is_found_by_its_name() -> None:
    made = structures(bent(0.03))
    walk(Library(made), max_effects=5)
    posterior = Posterior.of(made)
    assert [f.effects for f in posterior.findings] == [("bias.temperature_quadratic",)]
    chosen = made.weigh(posterior.chosen)
    (departure,) = chosen.departures
    assert departure.name == "departure(bias.temperature_quadratic)"
    assert chosen.model.names[-1] == departure.name
    curve = made.weigh(Structure(frozenset(["unknown(temperature)"])))
    assert curve.total < chosen.total


def test_a_law_of_its_exact_form_has_no_departure() -> None:
    made = structures(bent(0.0))
    assert made.weigh(Structure(frozenset(["bias.temperature_quadratic"]))).departures == ()


def test_a_departure_is_told_and_saved(tmp_path: Path) -> None:
    readings = bent(0.03)
    line = bc.fit(INSTRUMENT.baseline(), readings, bc.LeastSquares())
    found = bc.discover(line)
    (told,) = found.departures
    assert told.effect == "bias.temperature_quadratic" and told.along == "temperature"
    assert 0.01 < told.share < 0.3
    assert str(told) in str(found)
    better = bc.fit(line.model + found.best, readings, bc.LeastSquares())
    assert better.model.names[-1] == "departure(bias.temperature_quadratic)"
    better.save(tmp_path / "bent.nc")
    again = bc.load(tmp_path / "bent.nc")
    assert again.model.names == better.model.names
    np.testing.assert_allclose(bc.predict(again).mean, bc.predict(better).mean)


def test_what_an_effect_contributes_is_what_the_rest_does_not_take_up() -> None:
    """Its columns regressed on all others, by their priors."""
    made = structures(mems_gyro.simulate({"bias.temperature_cubic": 4e-5}, seed=5))
    cubic = made.weigh(Structure(frozenset(["bias.temperature_cubic"])))
    line = linear_model(cubic.assembly, cubic.mode)
    warmer = np.asarray(made.record.frame.centred())
    basis = np.stack([np.ones_like(warmer), warmer], axis=1)
    left = warmer**3 - basis @ np.linalg.lstsq(basis, warmer**3, rcond=None)[0]
    own = np.array([owner == "bias.temperature_cubic" for owner in line.owners])
    x = own[: line.line.jacobian.shape[1]]
    size = abs(float((line.sd[: x.size] * line.z[: x.size])[x].item()))
    expected = size * np.sqrt(np.mean(left**2))
    assert contribution(line, "bias.temperature_cubic") == pytest.approx(expected, rel=1e-2)


def test_effects_without_a_covariate_of_their_own_do_not_depart() -> None:
    readings = mems_gyro.simulate(seed=5)
    made = structures(readings)
    assert reference_of(readings)  # what positions along a covariate are taken from
    can = {n for n, e in made.candidates.items() if may_depart(e, made.record, correlated=False)}
    named = {n for n in can if not n.startswith("unknown")}
    assert can == named and "bias.run" not in can and "bias.thermal_lag" not in can
    assert {"bias.temperature_quadratic", "bias.drift"} <= can
    beside_a_wander = {n for n, e in made.candidates.items() if may_depart(e, made.record, True)}
    assert can - beside_a_wander == {"bias.drift"}


def test_columns_of_a_departure_are_its_basis() -> None:
    """The engine puts them together on the host; samplers and programs take the basis."""
    made = structures(bent(0.03))
    (departure,) = made.weigh(Structure(frozenset(["bias.temperature_quadratic"]))).departures
    np.testing.assert_allclose(
        made.record.columns(ColumnsOf.of(departure), ()),
        np.asarray(departure.evaluate(made.record.frame, {})),
        atol=1e-12,
    )
