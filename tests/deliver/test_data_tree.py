"""A calibration is an ArviZ DataTree: its groups, units and members are there, and ArviZ can work with it."""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from arviz_stats import loo, summary
from scipy import stats

import bayescal as bc
from bayescal import effects
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate

MODEL = INSTRUMENT.baseline() + "bias.run"


@pytest.fixture(scope="module")
def readings() -> bc.Measurements:
    return simulate({"bias.run": 0.05}, seed=2, campaign=Campaign(average=300, runs=4))


@pytest.fixture(scope="module")
def found(readings) -> bc.Calibration:
    return bc.fit(MODEL, readings)


def test_every_unknown_has_its_unit_and_its_members(found) -> None:
    posterior = found.tree["posterior"].to_dataset()
    units = {name: posterior[name].attrs["units"] for name in posterior}
    assert units == {
        "bias.constant": "deg/s",
        "bias.temperature": "deg/s/degC",
        "bias.run": "deg/s",
        "bias.run.group_sd": "deg/s",
        "noise.white": "deg/s",
    }
    assert posterior["bias.run"].dims == ("chain", "draw", "run")
    assert list(posterior["run"].values) == ["1", "2", "3", "4"]
    prior = found.tree["prior"].to_dataset()
    assert {name: prior[name].attrs["units"] for name in prior} == units
    assert found.tree["observed_data"]["output"].attrs["units"] == "deg/s"
    assert found.tree["posterior_predictive"]["output"].attrs["units"] == "deg/s"
    constant = found.tree["constant_data"].to_dataset()
    assert constant["temperature"].attrs["units"] == "degC"
    assert constant["time"].attrs["units"] == "s"
    assert "output" not in constant


def test_prior_draws_follow_the_stated_priors(found) -> None:
    prior = found.tree["prior"].to_dataset()
    for name, exact in {
        "bias.constant": stats.norm(0, 50),
        "bias.temperature": stats.norm(0, 0.05),
        "bias.run.group_sd": stats.halfnorm(scale=0.05),
        "noise.white": stats.halfcauchy(scale=0.1),
    }.items():
        assert stats.kstest(prior[name].values.ravel(), exact.cdf).pvalue > 1e-3, name


def test_replicated_readings_scatter_as_the_readings_do(found, readings) -> None:
    made = found.tree["posterior_predictive"]["output"]
    assert made.dims == ("chain", "draw", "reading")
    residual = readings["output"] - made.mean(("chain", "draw")).values
    z = residual / made.std(("chain", "draw")).values
    assert stats.kstest(z, "norm").pvalue > 1e-3


def test_arviz_summarises_it(found) -> None:
    table = summary(found.tree, round_to="none")  # pyright: ignore[reportArgumentType]
    assert {"bias.constant", "bias.temperature", "bias.run[1]", "noise.white"} <= set(table.index)
    for name in ("bias.constant", "noise.white"):
        assert table.loc[name, "mean"] == pytest.approx(found.samples(name).mean())
        assert table.loc[name, "ess_bulk"] > 1500
        assert table.loc[name, "r_hat"] < 1.01


def test_arviz_leaves_one_reading_out(found) -> None:
    tree = found.with_log_likelihood()
    result: Any = loo(tree)  # declared as a tuple there
    predicted = bc.predict(found, new_groups=False)
    exact = stats.norm.logpdf(predicted.residual, 0, predicted.sd).sum()
    assert result.elpd == pytest.approx(exact, abs=2 + result.se)
    assert "log_likelihood" not in found.tree.children


@pytest.mark.slow
def test_a_thermometers_noise_widens_predictions_by_the_slope(readings) -> None:
    found = bc.fit(INSTRUMENT.baseline() + effects.thermometer(1.0, source="made up"), readings)
    assert "temperature.reading" not in found.posterior
    slope, white = (found.samples(n) for n in ("bias.temperature", "noise.white"))
    share, predicted = np.sqrt(np.mean(white**2 + slope**2)), bc.predict(found).sd
    assert share > 1.1 * np.sqrt(np.mean(white**2))  # else nothing would be seen
    assert np.all((share < predicted) & (predicted < 1.06 * share))  # and what the line is known to
    replicated = found.tree["posterior_predictive"]["output"]
    assert replicated.std(("chain", "draw")).mean() == pytest.approx(share, rel=0.05)
