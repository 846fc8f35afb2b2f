"""Evidence and modes under laws that are not white, against quadrature: of one level."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import logsumexp

import bayescal as bc
from bayescal import effects
from bayescal_models.mems_gyro import INSTRUMENT

LEVEL = effects.constant("bias", 1.0, "deg/s", source="none")
SCALE = bc.HalfCauchy(0.1)


def level(law: bc.Noise, noise: np.ndarray) -> tuple[bc.Model, bc.Measurements]:
    temperature = np.linspace(30.0, 80.0, len(noise))
    made = bc.Measurements.from_arrays(INSTRUMENT, temperature=temperature, output=0.3 + noise)
    return bc.Model(INSTRUMENT, (LEVEL,), law), made


def summed(joint: Any, law: bc.Noise, axes: list[np.ndarray]) -> float:
    """Log evidence: the joint density of readings, level and the law's values, summed over a box of coordinates."""
    at, *v = np.meshgrid(*axes, indexing="ij")
    priors = law.parameters()
    values = {n: p.value(x)[..., None] for (n, p), x in zip(priors.items(), v, strict=True)}
    total = joint(at, values) + sum(
        p.log_density(x) for p, x in zip(priors.values(), v, strict=True)
    )
    volume = sum(np.log(a[1] - a[0]) for a in axes if a.size > 1)
    return float(logsumexp(total) + volume)  # pyright: ignore[reportOperatorIssue]


def around(centre: np.ndarray, reach: Iterable[float]) -> list[np.ndarray]:
    return [c + r * np.linspace(-1, 1, 41) for c, r in zip(centre, reach, strict=True)]


def exact_student_t(fit: bc.Calibration, y: np.ndarray) -> float:
    def joint(at, values):
        scale = values["noise.white"]
        each = stats.t.logpdf((y - at[..., None]) / scale, values["noise.freedom"]) - np.log(scale)
        return each.sum(axis=-1) + stats.norm.logpdf(at)

    reach = 7 * np.sqrt(np.diag(fit.mode.covariance))
    return summed(
        joint, bc.StudentT(SCALE), [*around(fit.mode.x, [0.15]), *around(fit.mode.v, reach)]
    )


def exact_scatter(fit: bc.Calibration, y: np.ndarray) -> float:
    z = np.linspace(-1, 1, len(y))

    def joint(at, values):  # the level, N(0, 1), integrated out: Σ + 1·1ᵀ
        bend = values["noise.slope"] * z + values["noise.curvature"] * (1.5 * z**2 - 0.5)
        variance = (values["noise.white"] * np.exp(bend)) ** 2
        whole = 1 + (1 / variance).sum(axis=-1)
        squares = (y**2 / variance).sum(axis=-1) - (y / variance).sum(axis=-1) ** 2 / whole
        volume = np.log(2 * np.pi * variance).sum(axis=-1) + np.log(whole)
        return -0.5 * (squares + volume)

    reach = 7 * np.sqrt(np.diag(fit.mode.covariance))
    law = bc.Heteroscedastic("temperature", SCALE)
    return summed(joint, law, [np.zeros(1), *around(fit.mode.v, reach)])


LAWS = {
    "student_t": (bc.StudentT(SCALE), exact_student_t),
    "heteroscedastic": (bc.Heteroscedastic("temperature", SCALE), exact_scatter),
}


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("heavy", [False, True])
def test_evidence_under_other_laws_is_that_of_quadrature(law: str, heavy: bool, rng) -> None:
    noise = 0.1 * (rng.standard_t(2.0, 40) if heavy else rng.standard_normal(40))
    made, by_quadrature = LAWS[law]
    model, readings = level(made, noise)
    fit = bc.fit(model, readings, bc.Marginal(), strict=False)
    assert fit.log_evidence is not None
    sampled, error = fit.log_evidence
    assert error is not None
    exact = by_quadrature(fit, readings["output"])
    assert sampled == pytest.approx(exact, abs=4 * error + 0.02)
    assert float(fit.mode.log_evidence) == pytest.approx(exact, abs=0.2)


def test_a_heavy_tailed_mode_is_the_maximum_of_the_joint_density(rng) -> None:
    model, readings = level(bc.StudentT(SCALE), 0.1 * rng.standard_t(1.5, 60))
    fit = bc.fit(model, readings, bc.LeastSquares(draws=200), strict=False)
    hyper, y = fit.problem.hyper(fit.mode.v), readings["output"]

    def negative(at: float) -> float:
        each = stats.t.logpdf(y, hyper["noise.freedom"], at, hyper["noise.white"])
        return -float(each.sum() + stats.norm.logpdf(at))

    found: Any = optimize.minimize_scalar(
        negative, bounds=(0.0, 0.6), method="bounded", options={"xatol": 1e-9}
    )
    bend = (negative(found.x + 1e-3) + negative(found.x - 1e-3) - 2 * found.fun) / 1e-6
    level_of = fit.samples("bias.constant")
    assert level_of.mean() == pytest.approx(found.x, abs=1e-5)
    assert level_of.std() == pytest.approx(bend**-0.5, rel=0.02)
