"""Settings from before JAX and NumPy start, and the fixtures that several files use."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from datetime import date
from typing import TYPE_CHECKING

# Two test processes on two cores: threads of a linear-algebra library would be in each other's way.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ["COLUMNS"] = "80"  # what is printed, and shown in the docs, is folded to a terminal

import hypothesis
import pytest

import bayescal  # noqa: F401  before JAX
from bayescal._core.lazy_jax import configure_jax, find_cache_folder, free_memory_maps
from tests.support import references, tiers

if TYPE_CHECKING:
    import jax
    import numpy as np

# Compiled programs are kept between test runs, apart from the user's own.
if "BAYESCAL_CACHE" not in os.environ:
    user = find_cache_folder()
    os.environ["BAYESCAL_CACHE"] = str(user / "tests") if user else ""
configure_jax()

# The same examples at every run; no deadline, because the first example may compile.
hypothesis.settings.register_profile("bayescal", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("bayescal")

SEED = 20261121
# What the processes of this run share: made by the first, whose environment the others have.
FIRST = "PYTEST_XDIST_WORKER" not in os.environ
if FIRST:
    os.environ[references.FOLDER] = tempfile.mkdtemp(prefix="bayescal-tests-")

BEGAN = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("a day's part of the tests")
    group.addoption(
        "--day",
        type=date.fromisoformat,
        metavar="2026-11-26",
        help=f"only the tests that have their turn on this day, as each has once in {tiers.DAYS}",
    )
    group.addoption(
        "--within", type=float, metavar="SECONDS", help="skip tests that would begin later"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    day = config.getoption("--day")
    if day is None:
        return
    chosen = [item for item in items if tiers.has_its_turn(item.nodeid, day)]
    config.hook.pytest_deselected(items=list({*items} - {*chosen}))
    items[:] = sorted(chosen, key=lambda item: tiers.place(item.nodeid.partition("::")[0], day))


def pytest_unconfigure() -> None:
    if FIRST:
        shutil.rmtree(os.environ[references.FOLDER], ignore_errors=True)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    within = item.config.getoption("--within")
    if within is not None and time.monotonic() - BEGAN > within:
        pytest.skip("the time given was over; another day begins with another test")


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_go() -> Iterator[None]:
    """Compiled programs are dropped before a process holds more memory maps than it may."""
    yield
    free_memory_maps()


@pytest.fixture
def unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of reports are made and not painted, a third of their time: for what `deliver/test_report.py` is not."""
    from tests.support.reported import unpaint

    unpaint(monkeypatch)


@pytest.fixture
def key() -> jax.Array:
    """A JAX random key, the same in every test and every run."""
    import jax

    return jax.random.key(SEED)


@pytest.fixture
def rng() -> np.random.Generator:
    """A NumPy random generator, the same in every test and every run."""
    import numpy as np

    return np.random.default_rng(SEED)
