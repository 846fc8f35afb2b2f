"""One campaign with two hidden effects, as files, and a session on it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.inside import Origin, Session

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
