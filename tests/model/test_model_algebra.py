"""Models are added to, subtracted from, fixed and freed; what cannot be composed is refused with advice."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT
from tests.support.made_up.humid_gyro import BASELINE, HUMIDITY, readings

# Adding and taking away.


def test_adding_and_removing_effects_leaves_the_old_model_unchanged() -> None:
    larger = BASELINE + ["bias.drift", HUMIDITY]
    assert larger == BASELINE + INSTRUMENT.effect("bias.drift") + HUMIDITY
    assert larger.names == ("bias.constant", "bias.temperature", "bias.drift", "bias.humidity")
    assert (larger.instrument, larger.noise) == (BASELINE.instrument, BASELINE.noise)
    assert larger.effect("bias.humidity") is HUMIDITY
    assert larger - HUMIDITY - "bias.drift" == BASELINE == INSTRUMENT.baseline()
    assert BASELINE.names == ("bias.constant", "bias.temperature")
    assert hash(BASELINE + "bias.drift") == hash(INSTRUMENT.baseline() + "bias.drift")
    assert larger.fix({"bias.drift": 0.1}) != larger.fix({"bias.drift": 0.2})


@pytest.mark.parametrize(
    "change",
    [
        {"coefficients": ()},
        {"coefficients": (bc.Coefficient("deg/s"), bc.Coefficient("deg/s"))},
        {"basis": lambda: 1.0},
        {"basis": lambda r, width: 1.0},
        {"shapes": (bc.Shape("tau", "s", 1.0, 9.0),)},
    ],
    ids=["no coefficient", "equal parts", "takes nothing", "takes too much", "lacks a shape"],
)
def test_an_effect_that_cannot_work_is_refused_where_it_is_made(change) -> None:
    given = {
        "basis": lambda r: r["humidity"],
        "coefficients": (bc.Coefficient("deg/s/%"),),
        **change,
    }
    with pytest.raises(bc.ModelError):
        bc.Effect("bias.mine", "bias", **given)


def test_priors_and_shapes_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError):
        bc.Normal(0.0, 0.0)
    with pytest.raises(ValueError, match="low < high"):
        bc.Shape("tau", "s", 9.0, 1.0)
    with pytest.raises(ValueError):
        bc.Shape("tau", "s", -1.0, 1.0)
    with pytest.raises(ValueError, match="needs a group"):
        bc.Coefficient("deg/s", group_sd=bc.HalfNormal(1.0))
    with pytest.raises(ValueError):
        bc.Coefficient("deg/s", per="reading", group_sd=bc.HalfNormal(1.0))


def test_fixed_unknowns_keep_their_values() -> None:
    fixed = BASELINE.fix({"bias.temperature": 0.041, "noise.white": 0.1})
    found = bc.fit(fixed, readings(), bc.LeastSquares())
    posterior = found.tree["posterior"].to_dataset()
    assert set(posterior) == {"bias.constant"}
    # 20 + 0.05·T seen as 0.041·T: the constant at T0 = 55 takes up the rest.
    assert posterior["bias.constant"].mean() == pytest.approx(20 + 0.05 * 55, abs=0.01)
    slope = np.polyfit(readings()["temperature"], bc.predict(found).mean, 1)[0]
    assert slope == pytest.approx(0.041)


def test_freeing_undoes_fixing_one_or_all() -> None:
    fixed = BASELINE.fix({"bias.temperature": 0.041, "noise.white": 0.1})
    assert fixed.free("noise.white") == BASELINE.fix({"bias.temperature": 0.041})
    assert fixed.free() == BASELINE
    assert dict(fixed.fix({"noise.white": 0.0}).fixed)["noise.white"] == 0.0
    warm = (BASELINE + "bias.warm_up").fix({"bias.warm_up": 0.1, "bias.warm_up.tau": 600.0})
    assert (warm - "bias.warm_up") == BASELINE
    with pytest.raises(bc.ModelError):
        BASELINE.free("bias.drift")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("bias.drift", 0.0), ("bias.temperature", np.nan), ("noise.white", -0.1)),
        *(("bias.thermal_lag.tau", -5.0), ("bias.run.group_sd", -1.0)),
    ],
)
def test_fixing_an_unknown_name_or_invalid_value_is_refused(name: str, value: float) -> None:
    with pytest.raises(bc.ModelError):
        (BASELINE + "bias.thermal_lag" + "bias.run").fix({name: value})


@pytest.mark.parametrize("method", [bc.LeastSquares(), bc.Marginal()], ids=lambda m: m.name)
def test_calibration_with_all_unknowns_fixed_is_printed(method) -> None:
    # Everything but the noise, as when a published line is checked against a table.
    fixed = BASELINE.fix({"bias.constant": 22.75, "bias.temperature": 0.041})
    found = bc.fit(fixed, readings(), method)
    expected = 22.75 + 0.041 * (readings()["temperature"] - 55.0)
    np.testing.assert_allclose(bc.predict(found).mean, expected, rtol=1e-12)
    rms = np.sqrt(np.mean((readings()["output"] - expected) ** 2))
    assert found.samples("noise.white").mean() == pytest.approx(rms, rel=0.15)


def test_everything_can_be_fixed_the_noise_too() -> None:
    fixed = BASELINE.fix({"bias.constant": 22.75, "bias.temperature": 0.05, "noise.white": 0.1})
    found = bc.fit(fixed, readings())
    # No unknown is left: the evidence is the likelihood, exactly.
    assert found.log_evidence is not None
    residual = readings()["output"] - 22.75 - 0.05 * (readings()["temperature"] - 55.0)
    exact = np.sum(-0.5 * (residual / 0.1) ** 2 - np.log(0.1) - 0.5 * np.log(2 * np.pi))
    assert found.log_evidence[0] == pytest.approx(exact, abs=1e-9)
    np.testing.assert_allclose(bc.predict(found).sd, 0.1)


def test_another_plausible_size_scales_all_coefficients_and_is_saved(tmp_path) -> None:
    """The first has it exactly, the others keep their proportion; the group's is that of its spread."""
    readings = INSTRUMENT.simulate({}, seed=1)
    model = INSTRUMENT.baseline() + "bias.thermal_lag" + "bias.run"
    before = [c.size for c in model.effect("bias.thermal_lag").coefficients]
    model = model.resize("bias.thermal_lag", 0.1234567).resize("bias.run", 0.3)
    after = [c.size for c in model.effect("bias.thermal_lag").coefficients]
    assert after[0] == 0.1234567
    assert after[1] / before[1] == pytest.approx(after[0] / before[0])
    assert model.effect("bias.run").coefficients[0].size == 0.3
    model = model.resize("bias.thermal_lag", 0.7)
    fitted = bc.fit(model, readings, bc.LeastSquares(draws=500), strict=False)
    assert bc.load(fitted.save(tmp_path / "a.nc")).model == fitted.model
    with pytest.raises(bc.ModelError):
        model.resize("bias.run", -1.0)
    with pytest.raises(bc.ModelError):
        (model + "unknown(time)").resize("unknown(time)", 1.0)
