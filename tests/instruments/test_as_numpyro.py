"""The models written out in NumPyro are those that `bc.fit` fits: the same density, and draws that agree."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import Any

import jax
import numpy as np
import pytest
from numpyro import handlers
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, NUTS
from numpyro.infer.util import log_density

import bayescal as bc
from bayescal_models import INSTRUMENTS
from bayescal_models.mems_gyro import as_numpyro as mems_gyro
from tests.support.tiers import slow_but

# Of the others the latent quantities are not the framework's own: nothing but draws compares.
SAME_LATENTS = (
    *("mems_gyro", "inclinometer", "ng_accelerometer", "quartz_beam_accelerometer"),
    *("still_sensor", "gyro_triad", "accelerometer_dividing_head"),
)


def written_out(instrument: str) -> tuple[ModuleType, bc.Measurements]:
    module = import_module(f"bayescal_models.{instrument}.as_numpyro")
    problem = import_module(f"bayescal_models.{instrument}").reference_problem
    return module, problem.readings(0)


@pytest.mark.parametrize("instrument", slow_but(("mems_gyro",), SAME_LATENTS))
def test_numpyro_model_has_the_density_of_the_equivalent_model(instrument: str) -> None:
    """Differences between any two points, so that what is constant does not count."""
    module, readings = written_out(instrument)
    own = module.model_arguments(readings)
    program = bc.numpyro_program(module.equivalent_model(), readings)
    with jax.enable_x64(True):
        seeded = handlers.seed(module.model, 0)
        sites = handlers.trace(seeded).get_trace(**{**own, "output": None})
        free = {n: s for n, s in sites.items() if s["type"] == "sample" and n != "output"}
        mode = bc.fit(module.equivalent_model(), readings, bc.LeastSquares())
        random, found = np.random.default_rng(1), []
        for _ in range(4):
            at = {n: near(mode, n, site, random) for n, site in free.items()}
            here, _ = log_density(module.model, (), own, at)
            theirs = {n: standard(n, value, free[n]) for n, value in at.items()}
            there, _ = log_density(program, (readings["output"],), {}, dict(theirs.values()))
            found.append((float(here), float(there)))
    ours, theirs = np.array(found).T
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=1e-7, atol=1e-5)


def near(mode: bc.Calibration, name: str, site: dict[str, Any], random: np.random.Generator) -> Any:
    """A value near the posterior, where densities are neither all prior nor of no number."""
    size = np.shape(site["value"])
    if name in mode.posterior:
        drawn = mode.samples(name)
        return drawn[random.integers(len(drawn))].reshape(size)
    return 0.3 * random.standard_normal(size)


def standard(name: str, value: Any, site: dict[str, Any]) -> tuple[str, Any]:
    """The site of the framework's program and its value: coefficients in units of their prior's size."""
    law = site["fn"]
    if name.endswith((".standard", ".group_sd")) or name.startswith("noise."):
        return name, value
    z = (value - np.asarray(law.mean)) / np.sqrt(np.asarray(law.variance))
    return f"{name}.standard", np.atleast_1d(z)


def draws(module: ModuleType, readings: bc.Measurements) -> dict[str, np.ndarray]:
    """Draws of every site, of one chain of NUTS, by the lines that `as_numpyro.py` prints."""
    said = module if "nuts = " in str(module.__doc__) else mems_gyro
    lines = [line.strip() for line in str(said.__doc__).splitlines()]
    at = next(i for i, line in enumerate(lines) if line.startswith("nuts = "))
    names: dict[str, Any] = {**vars(module), "NUTS": NUTS, "MCMC": MCMC, "readings": readings}
    with jax.enable_x64(True):
        names["key"] = jax.random.key(0)
        exec(lines[at], names)
        made, run = lines[at + 1].split(".run", 1)
        chain = eval(made.replace(")", ", progress_bar=False)"), names)
        eval(f"chain.run{run}", {**names, "chain": chain})
    return {name: np.asarray(values) for name, values in chain.get_samples().items()}


@pytest.mark.nightly
@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_nuts_on_the_numpyro_model_agrees(instrument: str) -> None:
    """Means within a tenth of a standard deviation, widths within a tenth, beside what draws of both scatter by.

    Widths are from the 16 % to the 84 % quantile: beside three runs of unknown spread a constant has a kurtosis of 20,
    and the standard deviation of a thousand draws is that of its tails' luck. Of n draws of a Gaussian such a width
    scatters by 0.96/√n.
    """

    def effective(draws: np.ndarray) -> float:
        return float(effective_sample_size(draws[None]))

    def width(draws: np.ndarray) -> float:
        return float(np.subtract(*np.quantile(draws, [0.84, 0.16])))

    module, readings = written_out(instrument)
    fitted = bc.fit(module.equivalent_model(), readings)
    drawn = draws(module, readings)
    compared = [name for name in map(str, fitted.posterior) if name in drawn]
    assert len(compared) >= 3
    for name in compared:
        theirs, ours = fitted.samples(name), drawn[name].reshape(len(drawn[name]), -1).T
        for one, other in zip(ours, theirs.reshape(len(theirs), -1).T, strict=True):
            assert effective(one) > 100, name
            scatter = (1 / effective(one) + 1 / effective(other)) ** 0.5
            away = abs(one.mean() - other.mean()) / other.std()
            assert away < 0.1 + 2.5 * scatter, name
            assert abs(np.log(width(one) / width(other))) < 0.1 + 2.5 * 0.96 * scatter, name
