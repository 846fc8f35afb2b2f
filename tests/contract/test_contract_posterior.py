"""The contract of the posterior: three methods and a reference posterior agree on every instrument's problem.

The reference problem of an instrument is `reference_problem` of `bayescal_models.NAME`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from arviz_stats.base import array_stats  # pyright: ignore[reportPrivateImportUsage]

import bayescal as bc
from bayescal_models import INSTRUMENTS
from benchmarks.accuracy.ranks import drawn
from tests.support.contract_cases import Case, columns_of
from tests.support.tiers import slow_but

TRUTH = 4  # seed of the data set from which least squares has to recover its truth
FAR = 5.0  # posterior sds, which no estimate may be off by
# Least squares and the marginal method at the same scales: means apart in sds, log sds apart. The Gaussian about the
# mode of λd·u is not its posterior: NUTS at those scales gives the marginal method's sds within 4 %.
NEAR, NEAR_BENT = (0.2, 0.15), {"differential_pair": (0.5, 0.4)}

# Products of unknowns and many spreads: their default fit takes long to compile, or is left to chains.
HEAVY = ("ng_accelerometer", "differential_pair", "accelerometer_triad", "magnetometer_triad")


def _effective(calibration: bc.Calibration, values: np.ndarray) -> float:
    """Effective number of draws: chains are correlated, weighted draws are worth less than they are many."""
    if calibration.verdict.r_hat is None:
        worth = calibration.verdict.ess
        return values.size if worth is None else 1 / (1 / worth + 1 / values.size)
    of_chains: Any = array_stats.ess(values, chain_axis=0, draw_axis=1, method="mean")
    return float(of_chains)


def _spread_error(values: np.ndarray, effective: float) -> float:
    """Relative Monte-Carlo error of a standard deviation: Var(s)/s² = (kurtosis − 1)/(4 n)."""
    z = (values - values.mean()) / values.std()
    return float(np.sqrt((max(float(np.mean(z**4)), 3.0) - 1) / (4 * effective)))


@pytest.mark.parametrize("case", slow_but({*INSTRUMENTS} - {*HEAVY}, INSTRUMENTS), indirect=True)
def test_marginal_agrees_with_the_reference_posterior(request, case: Case) -> None:
    if case.name == "differential_pair":
        why = "its reference posterior is of another environment than the model's: to be made anew"
        request.applymarker(pytest.mark.xfail(strict=False, reason=why))
    made = case.reference
    assert made["max_r_hat"] < made["tolerances"]["r_hat"] <= 1.01
    own = columns_of(case.marginal)
    assert set(made["coefficients"]) == set(own), "make it anew: reference_posteriors"
    allowed = made["tolerances"]["agreement"]
    for name, reference in made["coefficients"].items():
        assert reference["mcse"] < 0.02 * reference["sd"], name
        draws = own[name]
        effective = _effective(case.marginal, draws)
        error = np.hypot(reference["mcse"], draws.std() / np.sqrt(effective))
        apart = abs(draws.mean() - reference["mean"])
        assert apart < allowed["mean"] * reference["sd"] + 4 * error, (name, apart, reference)
        ratio = np.log(draws.std() / reference["sd"])
        error = np.hypot(reference["mcse_sd"] / reference["sd"], _spread_error(draws, effective))
        assert abs(ratio) < allowed["sd"] + 4 * error, (name, ratio, reference)


@pytest.mark.slow
def test_least_squares_recovers_what_the_program_simulates(case: Case) -> None:
    data, truth = drawn(case.model, 1, case.readings, TRUTH)
    found = bc.fit(case.model, data[0], bc.LeastSquares())
    hypers = {h.name for h in found.layout.hypers}
    for name, draws in columns_of(found).items():
        if name in hypers:
            continue  # held at their estimate
        base, _, member = name.partition("(")
        actual = np.atleast_1d(truth[base][0])[int(member[:-1]) if member else 0]
        off = abs(draws.mean() - actual) / draws.std()
        assert off < FAR, f"{name}: {draws.mean():g} ± {draws.std():g}, true {actual:g}"


@pytest.mark.slow
def test_marginal_agrees_with_least_squares(case: Case) -> None:
    # Least squares holds noise and spreads at their estimate: held there too, the two agree whatever the model;
    # integrated over, as long as no spread is learned from a few members.
    held = columns_of(case.least_squares)
    scales = {h.name: float(held[h.name].mean()) for h in case.least_squares.layout.hypers}
    others = [bc.fit(case.model.fix(scales), case.readings)]
    if not any(name.endswith(".group_sd") for name in scales):
        others.append(case.marginal)
    means, sds = NEAR_BENT.get(case.name, NEAR)
    sds += 0.05  # of as few draws as weights that are uneven leave
    for full in map(columns_of, others):
        for name in set(held) - set(scales):
            one, other = full[name], held[name]
            assert abs(one.mean() - other.mean()) < means * one.std(), name
            assert abs(np.log(one.std() / other.std())) < sds, (name, one.std(), other.std())
