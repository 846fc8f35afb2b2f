"""The contract of an effect: whatever makes it, it is fitted, printed, checked, kept, reported and exported."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal import effects
from bayescal_models import still_sensor
from tests.contract.every_effect import EFFECTS, MADE
from tests.support.command_line import QUICK, run

OWN_FILE = Path(__file__).parent / "every_effect.py"
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


def test_every_maker_is_here() -> None:
    makers = {name for name, made in vars(effects).items() if callable(made)}
    assert makers - {"__loader__"} == set(MADE), "give an effect of each maker in every_effect.py"


@pytest.mark.parametrize("maker", MADE)
def test_it_is_fitted_printed_checked_saved_and_loaded(maker: str, tmp_path: Path) -> None:
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
def test_it_is_compared_reported_and_exported(maker: str, tmp_path: Path) -> None:
    c = fitted(maker)
    assert str(bc.compare({"line": fitted("constant"), "with it": c}))
    assert MADE[maker].name in bc.report(c, tmp_path / "report.html").read_text("utf-8")
    used, budget = bc.compensator(c), bc.budget(c)
    assert str(budget) and np.isfinite(used(c.readings).value).all()
    for format in ("h", "py", "json"):
        assert used.export(tmp_path / f"used.{format}").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("maker", MADE)
def test_commands_take_it(maker: str, tmp_path: Path) -> None:
    file, effect, made = tmp_path / "readings.csv", MADE[maker], readings()
    units = {"run": "run", "time": "time [s]", "temperature": "temperature [degC]"}
    table = pd.DataFrame({head: made[name] for name, head in units.items()})
    table.assign(**{"output [ug]": made["output"]}).to_csv(file, index=False)
    asked = [file, "--instrument", "still_sensor", "--effects", OWN_FILE, *QUICK]
    if effect.name in INSTRUMENT.baseline().names:
        pytest.skip("the baseline has one of that name")
    ran = run("fit", *asked, "--add", effect.name, "--out", tmp_path)
    assert ran.status == 0, ran.err
    saved = (tmp_path / "calibration.nc", "--effects", OWN_FILE)
    for command in ("check", "budget"):
        ran = run(command, *saved)
        assert ran.status in (0, 1), (
            ran.err
        )  # 1: what is not there has two places, or no measured size
    for suffix in ("h", "py", "json"):
        ran = run("export", *saved, "--out", tmp_path / f"used.{suffix}")
        assert ran.status in (0, 1), ran.err


@pytest.mark.slow
@pytest.mark.parametrize("maker", MADE)
def test_a_search_takes_it_or_says_why_not(maker: str) -> None:
    effect, line = MADE[maker], fitted("linear")
    if effect.name in line.model.names:
        pytest.skip("the baseline has one of that name")
    found = bc.discover(line, effects=[effect], max_effects=1)
    (candidate,) = (c for c in found.candidates if c.effect == effect.reported)
    if maker.startswith(("thermometer", "uncertain_input")):
        assert candidate.kind == "not testable"
    else:
        assert candidate.probability is not None
    assert str(found)
