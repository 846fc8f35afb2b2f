"""The posterior over structures: its prior, its evidence, its walk against enumeration, and what it calls a finding."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest

import bayescal as bc
from bayescal._core.null_space import Spans
from bayescal._inference.density import Density
from bayescal._inference.laplace import find_mode
from bayescal._inference.linear_model import linearise_model
from bayescal._inference.problem import Problem
from bayescal._search import library
from bayescal._search.discover import enumerate_structures
from bayescal._search.library import Library
from bayescal._search.noise_laws import fit_to_residuals
from bayescal._search.posterior import Posterior
from bayescal._search.scores import Scorer, log_mean_bayes_factor
from bayescal._search.structures import SIZE_FACTORS, Structure, Structures
from bayescal._search.walk import explore
from bayescal_models import mems_gyro, still_sensor
from tests.support.inside import constants_of

INSTRUMENT = mems_gyro.INSTRUMENT
WANDER = "ornstein_uhlenbeck"
FEW = (
    "bias.temperature_quadratic",
    "bias.thermal_lag",
    "bias.reference_voltage",
    "bias.run",
    "bias.warm_up",
)


def structures(readings: bc.Measurements, names: tuple[str, ...] = (), **kwargs) -> Structures:
    model = INSTRUMENT.baseline()
    made, _ = enumerate_structures(model, readings, constants_of(readings), **kwargs)
    if names:
        made.candidates = {n: made.candidates[n] for n in names}
    return made


def hidden(seed: int = 1, **kwargs: float) -> bc.Measurements:
    return mems_gyro.simulate({f"bias.{n}": size for n, size in kwargs.items()}, seed=seed)


def test_half_of_the_prior_says_nothing_and_a_tenth_of_the_rest_has_no_name() -> None:
    made = structures(hidden())
    odds = np.array([sum(np.exp(made.log_odds[n]) for n in own) for own in made.forms.values()])
    assert np.prod(1 / (1 + odds)) == pytest.approx(0.5)
    unknown = [made.candidates[own[0]].is_placeholder for own in made.forms.values()]
    share = np.log1p(odds)
    assert share[unknown].sum() / share.sum() == pytest.approx(0.1)


SEVERAL = {"run": 0.03, "temperature_quadratic": 1e-4}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("truth", "few"), [({}, FEW), ({"thermal_lag": 0.02}, FEW), (SEVERAL, FEW[:4])]
)
def test_beam_search_finds_what_enumeration_finds(
    truth: dict[str, float], few: tuple[str, ...]
) -> None:
    readings = hidden(7, **truth)
    walked = structures(readings, few)
    explore(Library(walked), max_effects=5)
    whole = structures(readings, few)
    root = whole.evaluate(Structure())
    for count in range(len(few) + 1):
        for names in itertools.combinations(few, count):
            for law in ("", *whole.noise_laws):
                whole.evaluate(Structure(frozenset(names), law), root)
    found, exact = Posterior.from_structures(walked), Posterior.from_structures(whole)
    assert found.best == exact.best
    assert len(walked.visited) < len(whole.visited)
    assert found.completeness() == pytest.approx(exact.completeness(), abs=0.05)
    found_p, exact_p = ([x.inclusion_probability(n) for n in few] for x in (found, exact))
    assert found_p == pytest.approx(exact_p, abs=0.05)


def test_evidence_is_averaged_over_the_plausible_sizes() -> None:
    made = structures(hidden(2), ("bias.temperature_quadratic",))
    structure = Structure(frozenset(made.candidates))
    layout = made.evaluate(structure).problem.layout
    each = [
        math.log(share)
        + find_mode(
            Problem(layout, made.record, {"bias.temperature_quadratic": factor})
        ).log_evidence
        for factor, share in SIZE_FACTORS.items()
    ]
    found = made.visited[structure].log_evidence
    assert found == pytest.approx(np.logaddexp.reduce(each), abs=0.02)


def test_confounded_effects_are_one_finding() -> None:
    readings = hidden(5, thermal_lag=0.03)
    twin = dataclasses.replace(INSTRUMENT.effect("bias.thermal_lag"), name="bias.twin")
    made = structures(readings, effects=(twin,))
    made.candidates = {n: made.candidates[n] for n in ("bias.thermal_lag", "bias.twin")}
    explore(Library(made), max_effects=3)
    posterior = Posterior.from_structures(made)
    (found,) = posterior.findings
    assert set(found.effects) == {"bias.thermal_lag", "bias.twin"}
    assert found.probability >= bc.Settings().found_probability
    assert len(posterior.median_structure.effects) == 1


def test_an_effect_latent_in_the_model_takes_no_other_effect_s_place() -> None:
    made, lag, run = structures(hidden(), FEW), "bias.thermal_lag", "bias.run"
    held = tuple(Structure(frozenset(names)) for names in ((lag,), (run,), ()))
    mass = np.array([0.8, 0.16, 0.04])
    options = np.log(mass), mass, dict.fromkeys(held[:1])
    posterior = Posterior(made, frozenset(), held, *options)
    assert [len(f.effects) for f in posterior.findings] == [2]
    # What readings cannot separate from the model's own effects is in the model, hence not missing.
    made.spans = Spans({}, {run: ("bias.constant",)})
    assert not Posterior(made, frozenset(), held, *options).findings


def test_a_long_record_is_looked_over_by_means(monkeypatch: pytest.MonkeyPatch) -> None:
    n, rng = 20_000, np.random.default_rng(4)
    t = np.arange(n) * 0.324
    temperature = 25 + 20 * np.sin(9 * t / t[-1])
    supply = 5 + 0.1 * (-1.0) ** np.arange(n)  # toggles: no mean of two shows it
    output = 0.3 + 4e-5 * (temperature - 25) ** 2 + 0.01 * rng.standard_normal(n)
    columns = {"time": np.round(t, 1), "temperature": temperature, "supply_voltage": supply}
    made = structures(bc.Measurements.from_arrays(INSTRUMENT, columns, output=output))
    toggle = {n for n in made.candidates if "supply" in n}
    for law in ("", WANDER):  # on an even clock, though written to a third of a step
        at, gains = made.evaluate(Structure(noise=law)), []
        assert made.record.nodes(made.noise_law(at.structure)) is not None
        for most in (library.MEANS_COUNT, n):
            monkeypatch.setattr(library, "MEANS_COUNT", most)
            view = Scorer(known := Library(made), at)
            assert known.unaveraged >= (toggle if most < n else set())
            found = view.reduced_model().score_candidates([*known.points])
            gains.append(np.array([log_mean_bayes_factor(points) for points in found.values()]))
        assert np.argmax(gains[0]) == np.argmax(gains[1])
        np.testing.assert_allclose(gains[0], gains[1], rtol=0.01, atol=0.2)


@pytest.mark.slow
def test_of_a_hundred_empty_campaigns_hardly_any_gains_an_effect() -> None:
    reported = 0
    for seed in range(500, 600):
        made = structures(hidden(seed))
        explore(Library(made), max_effects=5)
        reported += bool(Posterior.from_structures(made).median_structure.effects)
    assert reported <= 3


def test_a_free_curve_in_time_stands_beside_no_wander() -> None:
    made = structures(hidden())
    assert "unknown(time)" in made.candidates_for(Structure())
    assert "unknown(time)" not in made.candidates_for(Structure(noise=WANDER))
    assert "unknown(time, jump)" in made.candidates_for(Structure(noise=WANDER))


def with_noise(seed: int, law: str) -> bc.Measurements:
    """An ordinary record with heavy tails, or scatter that follows the temperature."""
    readings, random = hidden(seed, thermal_lag=0.1), np.random.default_rng([seed, 1])
    if law == "student_t":
        more = 0.05 * random.standard_t(1.5, len(readings))
    else:
        warm = readings["temperature"] > np.quantile(readings["temperature"], 0.67)
        more = np.where(warm, 0.4, 0.0) * random.standard_normal(len(readings))
    return readings.with_column("output", readings["output"] + more)


@pytest.mark.parametrize("law", ["student_t", "heteroscedastic(temperature)"])
@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_the_noise_law_is_found_beside_the_effect(law: str, seed: int) -> None:
    made = structures(with_noise(seed, law), FEW)
    explore(Library(made), max_effects=3)
    posterior, kind = Posterior.from_structures(made), made.noise_laws[law].law
    assert made.noise_law(posterior.best).law == kind
    of_kind = [n for n, other in made.noise_laws.items() if other.law == kind]
    assert sum(posterior.law_probability(n) for n in of_kind) > bc.Settings().found_probability
    assert any("bias.thermal_lag" in found.effects for found in posterior.findings)


def test_evidence_gain_of_a_law_on_residuals_equals_that_of_a_refit() -> None:
    for seed in (5, 6):
        made = structures(hidden(seed))
        base = made.evaluate(Structure())
        left = linearise_model(base.problem, base.mode).residual
        own = fit_to_residuals(made.base.noise, made.record.residual_record(left)).log_evidence
        for name, law in made.noise_laws.items():
            if law.independent:
                found = fit_to_residuals(law, made.record.residual_record(left))
                refit = made.evaluate(Structure(noise=name), base, (found.start,))
                gain = refit.log_evidence - base.log_evidence
                assert found.log_evidence - own == pytest.approx(gain, abs=0.4), name


@pytest.mark.slow
def test_white_noise_is_rarely_taken_for_another_and_no_law_is_refitted_in_vain() -> None:
    taken = 0
    for seed in range(40, 48):
        made = structures(hidden(seed), FEW)
        explore(Library(made), max_effects=3)
        if Posterior.from_structures(made).law_probability("") < 0.5:
            taken += 1
        else:
            tried = [s for s in made.visited if s.noise not in ("", WANDER)]
            assert len(tried) <= 0.5 * len(made.visited)
    assert taken <= 2


def test_the_given_law_has_half_of_the_prior_and_the_other_kinds_share_the_rest() -> None:
    made = structures(hidden())
    kinds = {law.law for law in made.noise_laws.values()}
    shares = dict.fromkeys(kinds, 0.0)
    for name, law in made.noise_laws.items():
        shares[law.law] += math.exp(made.log_prior(Structure(noise=name)))
    assert kinds == {"student_t", "ornstein_uhlenbeck", "heteroscedastic"}
    assert all(share == pytest.approx(1 / 3) for share in shares.values())


@pytest.mark.parametrize("of", [mems_gyro, still_sensor])
def test_evidence_of_random_structures_is_that_of_readings(monkeypatch, of: Any) -> None:
    readings = of.simulate({}, seed=1)
    model = of.INSTRUMENT.for_readings(readings).baseline()
    made = enumerate_structures(model, readings, constants_of(readings))[0]
    random = np.random.default_rng(1)
    laws = ["", *(n for n, law in made.noise_laws.items() if made.record.nodes(law) is not None)]
    for _ in range(3):
        structure = Structure()
        for _ in range(2):
            structure = structure.with_effects(str(random.choice(made.candidates_for(structure))))
        structure = structure.with_noise(str(random.choice(laws)))
        made.visited.clear()
        found = made.evaluate(structure.without_effects(*made.excluded_candidates(structure)))
        with monkeypatch.context() as patched:
            patched.setattr(Density, "tabulated", None)
            mode, problem = found.mode, found.problem
            again = find_mode(problem, [mode.v], mode.x)
        assert mode.log_evidence == pytest.approx(again.log_evidence, abs=5e-3)


def test_columns_at_each_draw_are_those_of_the_table(monkeypatch) -> None:
    sensor, law = mems_gyro.INSTRUMENT, bc.Heteroscedastic("temperature", bc.HalfCauchy(0.1))
    model = (sensor.baseline() + "bias.thermal_lag.body" + "bias.hysteresis").with_noise(law)
    fit = bc.fit(model, mems_gyro.simulate({"bias.thermal_lag": 0.05}, seed=1), bc.LeastSquares())
    density = Density(fit.problem, fit.mode.x, fit.mode.flat, fit.mode.v)
    vs = fit.mode.v + 0.1 * np.random.default_rng(0).standard_normal((6, len(fit.mode.v)))
    assert density.tabulated.is_direct
    at_each = density.values(vs)
    monkeypatch.setattr(density.tabulated, "is_direct", False)
    np.testing.assert_allclose(at_each, density.values(vs), atol=1e-6)
