"""One core: what reads as the model is what runs.

Every function of the core is reached by the main commands; broken, it breaks them.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from types import CodeType, ModuleType

import jax
import pytest

import bayescal as bc
from bayescal._inference import (
    gaussian,
    laplace,
    least_squares,
    products,
    programs,
    record,
    sampling,
)
from bayescal._model.summed_noise import over_record
from bayescal_models import mems_gyro, still_sensor

GYRO = mems_gyro.INSTRUMENT
CORE = (
    "gaussian chebyshev programs column_products record problem noise_on_record products density laplace "
    "linear_model joint sampling least_squares"
)
LAWS = "terms composition independent_noise summed_noise"
# What only a named option or a kind of model needs, by that: each has tests of its own.
NEEDED_BY = {
    "noise in a column of the readings": "composition.variance_of_inputs "
    "record.Record.moved_columns_of_draws programs.moved_columns_along",
    "a flat prior": "gaussian.column_scale",
    "a nonlinear response": "record.Record.response record.Record.responses "
    "programs.responses programs.slopes_of_draws density.Density.squares "
    "laplace.mode_of_x laplace.mode_of_x.<locals>.look laplace._about_x "
    "least_squares._Refinement.from_afar",
    'LeastSquares(curvature="hessian"), or a law that is not Gaussian': "least_squares._Refinement.curved "
    "least_squares._Refinement.curved.<locals>.slope",
    "a basis that cannot be computed": "programs.columns_or_refusal",
    "a density that is nowhere": "gaussian._factors",
    "the module's own making": "programs.program",
    "log likelihoods of single readings, for ArviZ": "noise_on_record._densities "
    "noise_on_record._densities.<locals>.of noise_on_record.log_densities",
    "a term that something added stands for": "linear_model.LinearModel.uncertainty linear_model.LinearModel.beyond",
    "NUTS where weights fail": "independent_noise.StudentT.amplitudes",
    "what a source of columns is": "composition.ColumnSource.columns composition.ColumnSource.response "
    "composition.ColumnSource.slopes",
    "a fleet in closed form, and slopes in a program": "composition.Traced.slopes composition._in_one_product",
    "a correction that is held": "composition.Traced.read",
    "a correction of three axes": "problem.Problem.value",
    "a look, and a fleet by least squares": "least_squares.solution_on",
    "JSON of a result": "summed_noise.SumOfTerms.derived",
}


class Broken(Exception):
    """In place of what a function computes."""


def readings(seed: int = 1, lag: float = 0.0) -> bc.Measurements:
    return mems_gyro.simulate({"bias.thermal_lag": lag} if lag else {}, seed=seed)


@pytest.mark.slow
def test_every_function_of_the_core_is_reached_by_the_main_commands() -> None:
    jax.clear_caches()  # what was traced or kept before would not be seen again
    for member in (m for name in modules() for m in vars(name).values()):
        getattr(member, "cache_clear", lambda: None)()
    seen: set[CodeType] = set()

    def note(frame, event, argument) -> None:
        if event == "call":
            seen.add(frame.f_code)

    import threading

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        main_commands()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # pyright: ignore[reportArgumentType]
    spared = set(" ".join(NEEDED_BY.values()).split())
    never = sorted(name for name, code in core() if code not in seen and name not in spared)
    assert not never, f"nothing but their own tests runs {', '.join(never)}: delete them"


def main_commands() -> None:
    """fit, predict, calibrate and fit_batch, on white, correlated, heavy-tailed, uneven and rounded noise."""
    data = readings(lag=0.05)
    model = GYRO.baseline() + "bias.thermal_lag"
    scale = bc.HalfCauchy(0.1)
    laws = [
        bc.White(scale),
        over_record(scale, 30.0, 3000.0),
        bc.StudentT(scale),
        bc.Heteroscedastic("temperature", scale),
        bc.Quantised(0.01, scale),
    ]
    for law in laws:
        fitted = bc.fit(model.with_noise(law), data, strict=False)
        bc.predict(fitted, readings(2))
        bc.predict(fitted, data, same_record=True)
        bc.check(fitted)
        _ = fitted.tree
        bc.fit(model.with_noise(law), data, bc.LeastSquares())
    bc.fit(model + "bias.run", data, bc.LeastSquares())
    held = model.fix({"bias.temperature": 0.05}) + "unknown(time, jump)"
    bc.fit(held, data, strict=False)
    bc.calibrate(GYRO.baseline(), data, max_effects=1, holdout=readings(2))
    still = still_sensor.simulate({}, seed=1, noise_law="ornstein_uhlenbeck")
    bc.calibrate(still_sensor.INSTRUMENT.for_readings(still).baseline(), still, max_effects=1)
    bc.fit_batch(GYRO.baseline(), {"a": data, "b": readings(2)}, method=bc.Marginal(draws=400))


def modules() -> list[ModuleType]:
    names = [("_inference", m) for m in CORE.split()] + [("_model", m) for m in LAWS.split()]
    return [import_module(f"bayescal.{room}.{name}") for room, name in names]


def core() -> Iterator[tuple[str, CodeType]]:
    """Every function of the core's modules and of the noise laws, by its name there."""
    for module in modules():
        name = module.__name__.rpartition(".")[2]
        for owner in (module, *classes(module)):
            for member in vars(owner).values():
                for code in codes_of(member):
                    if code.co_filename == module.__file__ and not code.co_qualname.endswith(
                        "<lambda>"
                    ):
                        yield f"{name}.{code.co_qualname}", code


def classes(module: ModuleType) -> list[type]:
    return [
        c for c in vars(module).values() if inspect.isclass(c) and c.__module__ == module.__name__
    ]


def codes_of(member: object) -> Iterator[CodeType]:
    """A function's code, and that of the functions within it."""
    plain = getattr(member, "__wrapped__", None) or getattr(member, "func", None) or member
    plain = getattr(plain, "fget", None) or getattr(plain, "__func__", plain)
    code = getattr(plain, "__code__", None)
    if code is None:
        return
    waiting = [code]
    while waiting:
        one = waiting.pop()
        yield one
        waiting += [
            c for c in one.co_consts if isinstance(c, CodeType) and not c.co_name.startswith("<")
        ]


BROKEN: list[tuple[object, str]] = [
    (gaussian, "condition"),
    (products.Products, "gram"),
    (products.Products, "slopes"),
    (laplace, "climb"),
    (least_squares, "qr"),
    (record.Record, "columns"),
    (programs, "fixed_columns"),
    (bc.White, "shared_variance"),
]
SAMPLED: list[tuple[object, str]] = [
    (bc.White, "variance"),
    (gaussian, "draw"),
    (products.Products, "grams"),
    (sampling, "weighted_draws"),
    (bc.OrnsteinUhlenbeck, "whiten"),
    (bc.StudentT, "log_density"),
    (bc.Heteroscedastic, "variance"),
]


def everywhere(monkeypatch, owner: object, name: str) -> None:
    """Break a function wherever it is known by its name."""
    old = getattr(owner, name)

    def broken(*args, **kwargs):
        raise Broken(name)

    monkeypatch.setattr(owner, name, broken)
    for module in [m for n, m in sys.modules.items() if n.startswith("bayescal.")]:
        if vars(module).get(name) is old:
            monkeypatch.setattr(module, name, broken)
    jax.clear_caches()


COMMANDS: dict[str, Callable[[], object]] = {
    "fit": lambda: bc.fit(GYRO.baseline(), readings(), bc.LeastSquares(draws=400)),
    "calibrate": lambda: bc.calibrate(GYRO.baseline(), readings(), max_effects=1),
    "fit_batch": lambda: bc.fit_batch(
        GYRO.baseline() + "bias.thermal_lag", {"a": readings()}, method=bc.LeastSquares()
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("owner", "name"), BROKEN, ids=lambda v: v if isinstance(v, str) else "")
def test_a_broken_core_breaks_what_runs_on_it(monkeypatch, owner, name, command) -> None:
    everywhere(monkeypatch, owner, name)
    with pytest.raises(Broken):
        COMMANDS[command]()
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.parametrize(("owner", "name"), SAMPLED, ids=lambda v: v if isinstance(v, str) else "")
def test_a_broken_law_or_sampler_breaks_the_calibration(monkeypatch, owner, name) -> None:
    everywhere(monkeypatch, owner, name)
    with pytest.raises(Broken):
        COMMANDS["calibrate"]()
    jax.clear_caches()
