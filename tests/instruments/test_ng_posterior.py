"""A ng accelerometer's posterior recovers the truth and keeps the width that nuisance angles leave."""

from __future__ import annotations

import numpy as np
import pytest

import bayescal as bc
from bayescal_models import ng_accelerometer as ng
from bayescal_models.ng_accelerometer import reference_problem
from tests.support import references

LINE = ("bias.constant", "bias.temperature", "scale.constant", "scale.temperature")


@pytest.fixture(scope="module")
def proved() -> bc.Calibration:
    return references.calibration("ng_accelerometer")


def test_the_line_is_recovered_within_its_uncertainty(proved: bc.Calibration) -> None:
    assert proved.verdict.ok
    for name in LINE:
        draws = proved.samples(name)
        assert abs(draws.mean() - reference_problem.CAMPAIGN.truth[name]) < 3 * draws.std(), name
    for name in ("bias.temperature", "scale.temperature"):
        sd = proved.model.effect(name).coefficients[0].size
        assert proved.samples(name).std() < 0.2 * sd, name  # learned, not the prior


def test_bias_keeps_the_width_that_the_fixture_tilt_leaves(proved: bc.Calibration) -> None:
    bias, tilt = proved.samples("bias.constant"), proved.samples("fixture_tilt.constant")
    # priors of 200 µg and 291 µg for what only adds up: 1/√(1/200² + 1/291²) = 165 µg
    assert bias.std() == pytest.approx(165.0, rel=0.1)
    assert np.std(bias + tilt) < 10.0
    scale = proved.samples("scale.constant").std()  # γ2⊥ and the setting, 617 ppm each
    assert np.sqrt(2) * 617 * 0.85 < scale < np.sqrt(2) * 617 * 1.15


def test_setting_and_base_tilt_are_told_apart_by_their_priors_alone(proved: bc.Calibration) -> None:
    setting, base = (proved.samples(n) for n in ("tilt.setting", "base_tilt.constant[perp]"))
    assert setting.std() == pytest.approx(1.0, rel=0.15)
    assert base.std() == pytest.approx(1.0, rel=0.15)


@pytest.fixture(scope="module")
def full() -> bc.Calibration:
    # Draws enough to know the ends of 99 % intervals: of 500, that of a coefficient moves by a third of its sd.
    many = bc.Marginal(draws=8000, proposals=20_000)
    return bc.fit(ng.INSTRUMENT.baseline(), ng.simulate(seed=2), many, seed=2)


@pytest.mark.slow
def test_one_factor_of_scale_times_fixture_tilt_is_promoted(full: bc.Calibration) -> None:
    for name in LINE:
        low, high = np.quantile(full.samples(name), [0.005, 0.995])
        assert low < ng.INSTRUMENT_A.truth[name] < high, name
