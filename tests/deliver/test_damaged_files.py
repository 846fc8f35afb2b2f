"""A damaged calibration or batch is refused in words: whatever byte was changed, and whatever piece."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate
from tests.support.resealed import LENGTH, write_sealed

DAMAGED = 1000


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a campaign with runs, so that groups have members."""
    data = simulate({"bias.run": 0.05}, seed=1, campaign=Campaign(average=300))
    found = bc.fit(INSTRUMENT.baseline() + "bias.run", data, bc.LeastSquares(draws=400))
    return found.save(tmp_path_factory.mktemp("saved") / "whole.nc")


def damaged(whole: bytes, kind: int, random: np.random.Generator) -> bytes:
    """One of eight ways in which storage and transport spoil a file."""
    data = bytearray(whole)
    at, length = int(random.integers(len(data))), int(random.integers(1, 4096))
    if kind == 0:  # one bit
        data[at] ^= 1 << int(random.integers(8))
    elif kind == 1:  # some bytes
        for place in random.integers(len(data), size=8):
            data[place] ^= int(random.integers(1, 256))
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        data += random.bytes(length)
    elif kind == 4:  # a block of zeros where there were none
        place = int(random.choice(np.flatnonzero(np.frombuffer(whole, np.uint8))))
        data[place : place + length] = bytes(len(data[place : place + length]))
    elif kind == 5:  # two blocks in each other's place
        half = len(data) // 2
        data = data[half:] + data[:half]
    elif kind == 6:  # a piece is lost
        del data[at : at + length]
    elif kind == 7:  # the end
        place = len(data) - 1 - int(random.integers(LENGTH))
        data[place] ^= int(random.integers(1, 256))
    return bytes(data)


def test_a_thousand_damaged_calibrations_are_refused(saved: Path, tmp_path: Path) -> None:
    random, whole, path = np.random.default_rng(20261122), saved.read_bytes(), tmp_path / "d.nc"
    for i in range(DAMAGED):
        spoilt = damaged(whole, i % 8, random)
        assert spoilt != whole
        path.write_bytes(spoilt)
        with pytest.raises(bc.InputError):
            bc.load(path)
    path.write_bytes(whole)
    bc.load(path)


def test_an_end_that_is_missing_doubled_or_of_another_file_is_refused(
    saved: Path, tmp_path: Path
) -> None:
    whole, path = saved.read_bytes(), tmp_path / "d.nc"
    content, end = whole[:-LENGTH], whole[-LENGTH:]
    for spoilt in (
        b"",
        content,
        whole[: len(whole) // 2],
        end,
        whole + end,
        whole[:-1],
        whole + b"\n",
        content + end[:20] + b"0" * 63 + b"\n",
    ):
        path.write_bytes(spoilt)
        with pytest.raises(bc.InputError):
            bc.load(path)
    write_sealed(whole, path)
    with pytest.raises(bc.InputError):
        bc.load(path)
