"""Calibrations that tests look at and are not about: fitted once in a run, by whichever process asks first."""

from __future__ import annotations

import functools
import os
import pickle
from collections.abc import Callable
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import ParamSpec, TypeVar

import bayescal as bc

FOLDER = "BAYESCAL_TESTS_SHARED"  # names a folder that the processes of one run of the tests have in common

P = ParamSpec("P")
T = TypeVar("T")


def shared(make: Callable[P, T]) -> Callable[P, T]:
    """A function that makes a result, as one that all processes of a run of the tests take it from.

    What comes back has been pickled, also where it was made, so that no test sees which process made it. Two processes
    that ask at the same time both make it: either waits for the other as long.
    """

    kept: dict[Path, T] = {}

    @functools.wraps(make)
    def of(*args: P.args, **kwargs: P.kwargs) -> T:
        asked = sha256(repr((make.__module__, make.__qualname__, args, kwargs)).encode())
        file = Path(os.environ[FOLDER]) / f"{asked.hexdigest()[:16]}.pickle"
        if file not in kept:
            if not file.exists():
                whole = file.with_suffix(f".{os.getpid()}")
                whole.write_bytes(pickle.dumps(make(*args, **kwargs)))
                whole.replace(file)
            kept[file] = pickle.loads(file.read_bytes())
        return kept[file]

    return of


@shared
def calibration(instrument: str) -> bc.Calibration:
    """The reference problem of an instrument by least squares, seed 0."""
    problem = import_module(f"bayescal_models.{instrument}").reference_problem
    return bc.fit(problem.model(), problem.readings(seed=0), bc.LeastSquares())


@shared
def marginal(instrument: str) -> bc.Calibration:
    """The same by the default method."""
    problem = import_module(f"bayescal_models.{instrument}").reference_problem
    return bc.fit(problem.model(), problem.readings(seed=0))


@shared
def gyro_search() -> bc.SearchPath:
    """The loop on a simulated gyroscope (seed 1) with a thermal lag hidden in it, least squares."""
    from bayescal_models import mems_gyro

    readings = mems_gyro.simulate({"bias.thermal_lag": 0.03}, seed=1)
    return bc.calibrate(mems_gyro.INSTRUMENT.baseline(), readings, method=bc.LeastSquares())
