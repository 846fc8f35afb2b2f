"""A damaged calibration or batch is refused in words: whatever byte was changed, and whatever piece."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import bayescal as bc
from bayescal_models.mems_gyro import INSTRUMENT, Campaign, simulate
from tests.support.resealed import LENGTH, described, resealed, write_sealed

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


# Pieces that were changed, in a file whose checksum is right.


def variable(group: str, name: str, change: Callable[[xr.DataArray], object]):
    """A change of one variable; None takes it out."""

    def changed(tree: xr.DataTree) -> None:
        data = tree[group].to_dataset()
        made = change(data[name])
        data = data.drop_vars(name) if made is None else data.assign({name: made})
        tree[group] = xr.DataTree(data)

    return changed


def first_is(value: float) -> Callable[[xr.DataArray], xr.DataArray]:
    def change(a: xr.DataArray) -> xr.DataArray:
        values = a.values.copy()
        values.flat[0] = value
        return a.copy(data=values)

    return change


def fewer_of(group: str, **which: slice):
    def change(tree: xr.DataTree) -> None:
        tree[group] = xr.DataTree(tree[group].to_dataset().isel(which))

    return change


def without(group: str):
    def change(tree: xr.DataTree) -> xr.DataTree:
        return xr.DataTree.from_dict(
            {"/": xr.Dataset(attrs=tree.attrs)}
            | {name: part.to_dataset() for name, part in tree.children.items() if name != group}
        )

    return change


CHANGES = {
    "no draws": (without("draws"), "it has no group draws"),
    "no mode": (without("mode"), "it has no group mode"),
    "no posterior": (without("posterior"), "it has no group posterior"),
    "no readings": (without("observed_data"), "it has no group observed_data"),
    "no x": (variable("draws", "x", lambda a: None), "its group draws has no variable x"),
    "no covariance": (
        variable("mode", "covariance", lambda a: None),
        "its group mode has no variable covariance",
    ),
    "NaN draws": (variable("draws", "x", first_is(np.nan)), "draws/x holds numbers that are not"),
    "infinite v": (variable("draws", "v", first_is(np.inf)), "draws/v holds numbers that are not"),
    "NaN mode": (variable("mode", "x", first_is(np.nan)), "mode/x holds numbers that are not"),
    "another draw": (variable("draws", "x", first_is(7.0)), "is not that of its draws"),
    "another posterior": (
        variable("posterior", "bias.constant", first_is(7.0)),
        "its posterior of bias.constant is not that of its draws",
    ),
    "single precision": (
        variable("draws", "v", lambda a: a.astype(np.float32)),
        "draws/v is of type float32, expected float64",
    ),
    "whole numbers": (
        variable("mode", "x", lambda a: a.astype(np.int64)),
        "mode/x is of type int64, expected float64",
    ),
    "text for numbers": (
        variable("draws", "x", lambda a: a.astype(str)),
        "draws/x is of type .*, expected float64",
    ),
    "a coefficient fewer": (
        fewer_of("draws", x_entry=slice(1, None)),
        r"draws/x has the shape \(4, 100, 4\), its model asks for \('any', 'any', 5\)",
    ),
    "no chains": (fewer_of("draws", chain=slice(0)), "it holds no draws"),
    "fewer readings": (
        fewer_of("observed_data", reading=slice(3, None)),
        "conflicting dimension sizes",
    ),
    "a smaller mode": (fewer_of("mode", x_0=slice(1, None)), "mode/x has the shape"),
    "another reading": (
        variable("observed_data", "output", first_is(7.0)),
        "its identity is not that of what it holds",
    ),
    "no output": (
        variable("observed_data", "output", lambda a: None),
        "its group observed_data has no variable output",
    ),
    "another seed": (described(seed=77), "its identity is not that of what it holds"),
    "wrong group sizes": (
        described(counts={"run": 4, "cell": 0, "axis": 1, "device": 1, "reading": 18}),
        "its group sizes are .*'run': 4.*, its readings have .*'run': 3",
    ),
    "wrong members": (described(levels={"run": ["1", "2", "9"]}), "its group members are"),
    "no sizes": (described(counts=None), "it lacks 'counts'"),
    "sizes of no use": (described(counts=3), "its group sizes are 3"),
    "strange promotion": (described(promoted=["bias.colour"]), "bias.colour is no coefficient"),
    "no verdict": (described(verdict=None), "it lacks 'verdict'"),
    "a verdict of no use": (described(verdict={"fine": True}), "it lacks 'ok'"),
    "no constants": (described(reference={}), "its constants are"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_piece_is_refused_though_the_checksum_is_right(
    name: str, saved: Path, tmp_path: Path
) -> None:
    change, _words = CHANGES[name]
    path = resealed(saved, tmp_path / "changed.nc", change)
    with pytest.raises(bc.InputError):
        bc.load(path)
