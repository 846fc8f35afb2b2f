"""A saved calibration comes back whole, or is refused with advice; a broken write spoils nothing."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import bayescal as bc
from bayescal import effects
from bayescal._core.atomic_file import TRAILER_BYTES
from bayescal_models.mems_gyro import INSTRUMENT, TABLE, Campaign, simulate
from bayescal_models.mems_gyro.model import THERMOMETER
from tests.support.inside import identity_of

SQUARE = bc.Effect(
    "bias.square",
    slot="bias",
    columns=("temperature",),
    basis=lambda r: (r.centred() / 10) ** 2,
    coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 0.1)),),
    equation="c·((T − T0)/10)²",
)


@pytest.fixture(scope="module")
def line() -> bc.Calibration:
    return bc.fit(INSTRUMENT.baseline(), bc.read(TABLE, INSTRUMENT), seed=3)


@pytest.fixture(scope="module")
def own() -> bc.Calibration:
    """With an effect of the user's own, a coefficient fixed and thermometer errors; by least squares."""
    model = (INSTRUMENT.baseline() + SQUARE + THERMOMETER).fix({"bias.temperature": 0.05})
    return bc.fit(
        model, bc.read(TABLE, INSTRUMENT), bc.LeastSquares(draws=400), reference={"T0": 50.0}
    )


@pytest.fixture(scope="module")
def found() -> bc.Calibration:
    """Of a campaign with runs, so that groups have members."""
    data = simulate({"bias.run": 0.05}, seed=1, campaign=Campaign(average=300))
    return bc.fit(INSTRUMENT.baseline() + "bias.run", data, bc.LeastSquares(draws=400))


def same(one: bc.Calibration, other: bc.Calibration) -> None:
    """Everything that a calibration says of itself."""
    assert set(one.tree.children) == set(other.tree.children)
    for group in one.tree.children:
        a, b = one.tree[group].to_dataset(), other.tree[group].to_dataset()
        assert set(a) == set(b), group
        for name in a:
            assert a[name].dims == b[name].dims, (group, name)
            np.testing.assert_array_equal(a[name].values, b[name].values)
            assert a[name].attrs == b[name].attrs, (group, name)
    assert one.verdict == other.verdict
    assert one.reference == other.reference
    assert one.levels == other.levels
    assert one.model == other.model
    assert one.layout == other.layout
    assert (one.method, one.seed, one.log_evidence) == (
        other.method,
        other.seed,
        other.log_evidence,
    )
    for name, value in one.mode._asdict().items():
        if name == "point":
            np.testing.assert_array_equal(value.x, other.mode.x)
        else:
            np.testing.assert_array_equal(value, getattr(other.mode, name))
    assert one.readings.sources == other.readings.sources
    assert one.readings.flags == other.readings.flags
    assert one.readings.columns == other.readings.columns
    for name in one.readings.columns:
        np.testing.assert_array_equal(one.readings[name], other.readings[name])
        assert one.readings.unit(name) == other.readings.unit(name)


def test_a_calibration_comes_back_as_it_was(line, tmp_path) -> None:
    path = line.save(tmp_path / "line.nc")
    loaded = bc.load(path)
    same(line, loaded)
    one, other = bc.predict(line), bc.predict(loaded)
    for field in ("mean", "model_sd", "sd", "residual"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
    assert str(line) == str(loaded)
    assert identity_of(line) == identity_of(loaded)


def test_other_programs_open_a_sealed_file(line, tmp_path) -> None:
    with xr.open_datatree(line.save(tmp_path / "line.nc"), engine="h5netcdf") as opened:
        np.testing.assert_array_equal(opened["draws/x"], line.joint.x)
        np.testing.assert_array_equal(opened["observed_data/output"], line.readings["output"])
        assert opened.attrs["bayescal_identity"] == identity_of(line)


def test_effects_of_ones_own_come_back_when_they_are_given(own, tmp_path) -> None:
    path = own.save(tmp_path / "own.nc")
    same(own, bc.load(path, effects=[SQUARE]))


def test_groups_come_back_with_their_members_and_starts(found, tmp_path) -> None:
    data, loaded = found.readings, bc.load(found.save(tmp_path / "runs.nc"))
    same(found, loaded)
    assert list(loaded.tree["posterior"].to_dataset()["run"].values) == ["1", "2", "3"]
    later = data.select(data["run"] == "2")
    old, new = found.frame_of(later), loaded.frame_of(later)
    np.testing.assert_array_equal(old.elapsed, new.elapsed)
    np.testing.assert_array_equal(old.codes["run"], new.codes["run"])
    one, other = (bc.predict(c, later, new_groups=False) for c in (found, loaded))
    np.testing.assert_array_equal(one.mean, other.mean)


@pytest.mark.parametrize(
    "noise",
    [
        bc.StudentT(bc.HalfNormal(0.2)),
        bc.Quantised(0.12, bc.HalfCauchy(0.3)),
        bc.White(bc.Flat(0.5)),
        bc.OrnsteinUhlenbeck(30.0, 3000.0, bc.HalfCauchy(0.1), bc.HalfNormal(0.2)),
    ],
    ids=lambda n: type(n).__name__,
)
def test_every_noise_law_comes_back(noise, tmp_path) -> None:
    data = simulate(seed=1, campaign=Campaign(average=300))
    model = INSTRUMENT.baseline().with_noise(noise)
    found = bc.fit(model, data, bc.LeastSquares(draws=100), strict=False)
    assert bc.load(found.save(tmp_path / "noise.nc")).model.noise == noise


def test_an_effect_of_the_same_name_but_another_prior_is_refused(tmp_path) -> None:
    narrow = effects.linear("bias", 0.001, "deg/s/degC", source="mine")
    model = INSTRUMENT.baseline() - "bias.temperature" + narrow
    found = bc.fit(model, bc.read(TABLE, INSTRUMENT), bc.LeastSquares(draws=400))
    path = found.save(tmp_path / "narrow.nc")
    with pytest.raises(bc.InputError):
        bc.load(path)
    same(found, bc.load(path, effects=[narrow]))


def test_a_broken_write_leaves_the_old_file_whole(line, tmp_path, monkeypatch) -> None:
    path = line.save(tmp_path / "line.nc")
    before = path.read_bytes()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(bc.InputError):
        line.save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["line.nc"]


def test_saved_file_holds_the_draws_once(line, tmp_path) -> None:
    size = line.joint.x.nbytes + line.joint.v.nbytes
    assert line.save(tmp_path / "line.nc").stat().st_size < size + 60_000


# A damaged calibration or batch is refused in words: whatever byte was changed, and whatever piece.


DAMAGED = 1000


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
        place = len(data) - 1 - int(random.integers(TRAILER_BYTES))
        data[place] ^= int(random.integers(1, 256))
    return bytes(data)


def test_a_thousand_damaged_calibrations_are_refused(found, tmp_path: Path) -> None:
    random, path = np.random.default_rng(20261122), tmp_path / "d.nc"
    whole = found.save(path).read_bytes()
    for i in range(DAMAGED):
        spoilt = damaged(whole, i % 8, random)
        assert spoilt != whole
        path.write_bytes(spoilt)
        with pytest.raises(bc.InputError):
            bc.load(path)
    path.write_bytes(whole)
    bc.load(path)
