"""The contract of the output's zero: adding a constant to the output moves the bias constant and nothing else.

The constant's prior admits the offset, as the message asks where it does not: what is tested is the arithmetic. Outputs
at 10¹² times their noise hold four digits of it; the readings at every offset are those that are left of it there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS, still_sensor
from tests.support.contract_cases import Case, columns_of
from tests.support.inside import why_untestable
from tests.support.tiers import slow_but

ACROSS = ("across_x", "across_y", "across_z")

LS = bc.LeastSquares(draws=400)
CONSTANTS = dict.fromkeys(INSTRUMENTS, "bias.constant") | {
    "inclinometer": "zero.constant",
    "quartz_beam_accelerometer": "bias.constant_head",
}
del CONSTANTS["differential_pair"]  # a pair has no bias: its devices' deviate from none
MOST = 1e12  # of the noise
OFFSETS = [
    *(pytest.param(k, marks=pytest.mark.slow, id=f"{k:.0e}") for k in (1e3, 1e6, 1e9)),
    pytest.param(MOST, id=f"{MOST:.0e}"),
]
NATS, SD = 0.01, 0.01
QUICK = ("mems_gyro", "inclinometer", "quartz_beam_accelerometer", "still_sensor")


@pytest.fixture(scope="module")
def offset(case: Case) -> Offset:
    return Offset(case)


class Offset:
    """The reference problem of an instrument, a constant added to its outputs."""

    def __init__(self, case: Case) -> None:
        self.instrument, self.readings = case.instrument, case.readings
        self.outputs = self.instrument.outputs or ("output",)
        self.constant = CONSTANTS[case.name]
        noise = float(np.median(np.sqrt(case.least_squares.linear.variance)))
        self.unit = 2.0 ** round(np.log2(noise))  # so that adding multiples of it rounds alike
        # Sizes are in the coefficient's unit, which may be a thousandth of the output's.
        self.model = case.model.resize(self.constant, 1e5 * MOST * self.unit)

    def at(self, offset: float) -> bc.Measurements:
        """The readings with so many times the noise added to each output."""
        top = 2.0 ** round(np.log2(MOST)) * self.unit
        own = 2.0 ** round(np.log2(offset)) * self.unit if offset else 0.0
        made = self.readings
        for name in self.outputs:
            made = made.with_column(name, (made[name] + top - top) + own)
        if self.outputs == ("output",):
            return made
        y = np.array([made[name] for name in self.outputs])
        across = np.array([made[n] if made.has(n) else 0 * y[0] for n in ACROSS])
        along, length = np.sum(across * y, axis=0), np.linalg.norm(y, axis=0)
        return made.with_column("output", np.where(np.any(across != 0, axis=0), along, length))

    def fits(self, offset: float) -> tuple[bc.Calibration, ...]:
        """By least squares: of the model, and with one effect more."""
        readings = self.at(offset)
        candidates = self.instrument.candidates
        more = next(e for e in candidates if why_untestable(e, readings) is None)
        models = (self.model, self.model + more)
        return tuple(bc.fit(m, readings, LS, strict=False) for m in models)

    def rest(self, calibration: bc.Calibration) -> dict[str, np.ndarray]:
        """Draws of every unknown but the constant."""
        found = columns_of(calibration)
        return {n: d for n, d in found.items() if not n.startswith(self.constant)}


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for name in one:
        a, b = one[name], other[name]
        if a.std() > 1e-9 * abs(a.mean()):  # least squares holds the others
            assert max(abs(a.mean() - b.mean()), abs(a.std() - b.std())) <= SD * a.std(), name


@pytest.mark.parametrize("case", slow_but(QUICK, CONSTANTS), indirect=True)
@pytest.mark.parametrize("far", OFFSETS)
def test_evidence_and_coefficients_are_the_same(offset: Offset, far: float) -> None:
    for here, there in zip(offset.fits(0.0), offset.fits(far), strict=True):
        assert here.log_evidence and there.log_evidence
        assert there.verdict.ok == here.verdict.ok
        assert there.log_evidence[0] == pytest.approx(here.log_evidence[0], abs=NATS)
        assert_same(offset.rest(here), offset.rest(there))


LAWS = {
    "ornstein_uhlenbeck": bc.OrnsteinUhlenbeck(60, 7200, bc.HalfCauchy(100), bc.HalfCauchy(100)),
    "student_t": bc.StudentT(bc.HalfCauchy(100)),
    "sum": bc.SummedNoise(60, 7200, ("correlated", "quantisation"), bc.HalfCauchy(100)),
    "heteroscedastic": bc.Heteroscedastic("temperature", bc.HalfCauchy(100)),
}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_under_every_noise_law(law: str) -> None:
    hidden, noise_law = {"bias.temperature_quadratic": 0.3}, "ornstein_uhlenbeck"
    readings = still_sensor.simulate(hidden, seed=1, interval=120, runs=1, noise_law=noise_law)
    top = 2.0**44  # µg, 10¹² times the noise
    instrument = still_sensor.instrument("ug", size=2000, constant=100 * top, span=40, pace=3)
    added = ("bias.temperature_quadratic", "bias.thermal_lag")
    made = instrument.baseline().with_noise(LAWS[law]) + added
    y = readings["output"] + top - top
    near, far = (bc.fit(made, readings.with_column("output", y + k), LS) for k in (0.0, top))
    assert near.log_evidence and far.log_evidence
    assert far.log_evidence[0] == pytest.approx(near.log_evidence[0], abs=NATS)
    rest = [columns_of(c) for c in (near, far)]
    assert_same(*({n: d for n, d in one.items() if n != "bias.constant"} for one in rest))
    assert far.samples("bias.constant").mean() == pytest.approx(top, abs=3000)


@pytest.mark.slow
def test_offset_of_10_MHz_with_noise_of_2_mHz(tmp_path: Path) -> None:
    """Sampled, saved, loaded, predicted and compensated, in the readings' own numbers."""
    readings = still_sensor.simulate({"bias.temperature_quadratic": 0.3}, seed=1, interval=120)
    near = readings["output"] * 1e-4  # noise 2 mHz
    calibrations = []
    for offset in (0.0, 1e7):
        made = readings.with_column("output", near + offset)
        sized = still_sensor.instrument("Hz", size=0.2, constant=1e11, span=40, pace=3)
        columns: dict[str, Any] = {n: made[n] for n in ("run", "time", "temperature", "output")}
        made = bc.Measurements.from_arrays(sized, **columns)
        model = sized.baseline() + "bias.temperature_quadratic"
        calibrations.append(bc.fit(model, made, bc.Marginal(draws=400)))
    here, there = calibrations
    assert here.log_evidence and there.log_evidence
    assert there.log_evidence[0] == pytest.approx(here.log_evidence[0], abs=NATS)
    constants = [c.samples("bias.constant") for c in calibrations]
    assert constants[1].mean() - 1e7 == pytest.approx(constants[0].mean(), abs=1e-6)
    again = bc.load(there.save(tmp_path / "far.nc"))
    assert again.log_evidence == there.log_evidence
    np.testing.assert_array_equal(again.samples("bias.constant"), constants[1])
    later = there.readings.select(np.arange(0, 40)).with_column("run", np.full(40, "later"))
    for c in (there, again):
        for made in (bc.predict(c), bc.predict(c, later)):
            assert made.rmse < 0.0022
            np.testing.assert_allclose(made.mean, 1e7, atol=1.0)
    predictive = again.tree["posterior_predictive"]["output"].values
    assert abs(predictive - there.readings["output"]).max() < 0.02
    used = [bc.compensator(c)(c.readings).value for c in calibrations]
    np.testing.assert_allclose(used[1], used[0], atol=1e-6)
    assert str(bc.check(there)) == str(bc.check(here))
