"""The contract of an effect: whatever makes it, it is fitted, printed, checked, kept, reported and exported."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import still_sensor
from tests.contract.every_effect import EFFECTS, MADE
from tests.support.tiers import slow_but

# One of each way through a fit: of a group, of a body, of an uncertain and a corrected column, of one's own prior.
FAST = (
    "deviation",
    "quadratic",
    "temperature_x_lag",
    "thermometer",
    "thermometer_offset",
    "unknown",
    "jump",
)
INSTRUMENT = still_sensor.instrument("ug", size=2000.0, span=40.0, pace=3.0)


@cache
def readings() -> bc.Measurements:
    return still_sensor.simulate(seed=1, interval=120, runs=2)


@cache
def fitted(maker: str) -> bc.Calibration:
    """The line with the effect; in place of its own where it has one of that name."""
    effect, model = MADE[maker], INSTRUMENT.baseline()
    model = model - effect.name if effect.name in model.names else model
    return bc.fit(model + effect, readings(), bc.LeastSquares(draws=200))


def test_every_effect_factory_is_tested() -> None:
    makers = {name for name, made in vars(effects).items() if callable(made)}
    assert makers - {"__loader__"} == set(MADE), "give an effect of each maker in every_effect.py"


@pytest.mark.parametrize("maker", slow_but(FAST, MADE))
def test_effect_is_fitted_printed_checked_saved_and_loaded(maker: str, tmp_path: Path) -> None:
    c = fitted(maker)
    assert c.verdict.ok
    again = bc.load(c.save(tmp_path / "c.nc"), effects=EFFECTS)
    for one in (c, again):
        assert all(str(claim) for claim in one.conflicts)
        # Coefficients of single readings are not printed one by one.
        name = MADE[maker].name
        assert name in repr(one) and (
            name in str(one) or maker in ("thermometer", "uncertain_input")
        )
        assert one._repr_html_()
    assert str(again) == str(c) and again.conflicts == c.conflicts
    assert str(bc.check(again)) == str(bc.check(c)) != ""
    np.testing.assert_array_equal(bc.predict(again).mean, bc.predict(c).mean)
    assert np.isfinite(bc.predict(c, readings().select(np.arange(20))).sd).all()


@pytest.mark.slow
@pytest.mark.parametrize("maker", MADE)
def test_effect_is_compared_reported_and_exported(maker: str, tmp_path: Path) -> None:
    c = fitted(maker)
    assert str(bc.compare({"line": fitted("constant"), "with it": c}))
    assert MADE[maker].name in bc.report(c, tmp_path / "report.html").read_text("utf-8")
    used, budget = bc.compensator(c), bc.budget(c)
    assert str(budget) and np.isfinite(used(c.readings).value).all()
    for format in ("h", "py", "json"):
        assert used.export(tmp_path / f"used.{format}").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("maker", MADE)
def test_search_includes_the_effect_or_states_why_not(maker: str) -> None:
    effect, line = MADE[maker], fitted("linear")
    if effect.name in line.model.names:
        pytest.skip("the baseline has one of that name")
    found = bc.discover(line, effects=[effect], max_effects=1)
    (candidate,) = (c for c in found.candidates if c.effect == effect.family_name)
    if maker.startswith(("thermometer", "uncertain_input")):
        assert candidate.kind == "not testable"
    else:
        assert candidate.probability is not None
    assert str(found)
