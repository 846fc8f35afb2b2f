"""One campaign with two hidden effects, as files, and a session on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.browser import chromium
from tests.support.command_line import GYRO
from tests.support.inside import Origin, Session
from tests.workbench.real_page import Bench, bench, write_campaign

HIDDEN = {"bias.thermal_lag": 0.05, "bias.warm_up": 0.3}
SEED = 1


class Campaign(NamedTuple):
    """Readings and hold-out data of one simulated gyroscope, and their files."""

    readings: bc.Measurements
    holdout: bc.Measurements
    file: Path
    holdout_file: Path


@pytest.fixture(scope="session")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("campaign")
    instrument = mems_gyro.INSTRUMENT
    files = [folder / "readings.csv", folder / "later.csv"]
    for seed, file in enumerate(files, start=SEED):
        instrument.simulate(HIDDEN, seed=seed).write(file)
    readings, holdout = (bc.read(file, instrument) for file in files)
    return Campaign(readings, holdout, *files)


@pytest.fixture
def session(campaign: Campaign, tmp_path: Path) -> Session:
    return Session.open(
        mems_gyro.INSTRUMENT.baseline(),
        campaign.readings,
        holdout=campaign.holdout,
        folder=tmp_path / "out",
        origin=Origin.of("mems_gyro", [campaign.file], [campaign.holdout_file]),
    )


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A workbench over one campaign with hold-out data, for a browser."""
    chromium()
    pytest.importorskip("playwright.sync_api", reason="Playwright for Python is not here")
    folder = tmp_path_factory.mktemp("workbench")
    test, later = write_campaign(folder)
    with bench(test, *GYRO, "--holdout", later, "--out", folder / "kept") as running:
        yield running
