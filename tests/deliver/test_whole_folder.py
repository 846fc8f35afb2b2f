"""A folder of results is one run's, whole; what else stands in it stays; files of two runs are refused by name."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path

import pytest

import bayescal as bc
from bayescal.workshop import MANIFEST, read_hashes, replace_folder
from bayescal_models.mems_gyro import INSTRUMENT, TABLE
from tests.support.command_line import run
from tests.support.inside import identity_of, refuse_mixed

NAMES = {"result.json", "calibration.nc", "averaged.nc", "loop.png", MANIFEST}


def trail_of(seed: int) -> bc.SearchPath:
    readings = bc.read(TABLE, INSTRUMENT)
    return bc.calibrate(
        INSTRUMENT.baseline(), readings, method=bc.LeastSquares(draws=80), seed=seed
    )


@pytest.fixture(scope="module")
def trail() -> bc.SearchPath:
    return trail_of(1)


@pytest.fixture(scope="module")
def other() -> bc.SearchPath:
    return trail_of(2)


@pytest.fixture(scope="module")
def saved(trail, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("saved")
    trail.save(made)
    return made


@pytest.fixture
def folder(saved: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved, tmp_path / "result")


def state(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def write(folder: Path, text: str) -> None:
    with replace_folder(folder) as hidden:
        for name in ("a.json", "b.json"):
            (hidden / name).write_text(text)


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_everything_of_a_calibration_names_it(folder, trail) -> None:
    assert {p.name for p in folder.iterdir()} == NAMES
    own = identity_of(trail.final.calibration)
    manifest = json.loads((folder / MANIFEST).read_text("utf-8"))
    assert manifest["schema"] == "bayescal.manifest/2"
    assert set(manifest["files"]) == NAMES - {MANIFEST}
    assert json.loads((folder / "result.json").read_text("utf-8"))["calibration"] == own
    loaded = bc.load(folder / "calibration.nc")
    assert identity_of(loaded) == own
    compensator = bc.compensator(loaded)
    for suffix in (".h", ".py", ".json"):
        assert own in compensator.export(folder / f"made{suffix}").read_text("utf-8")
    assert own in bc.report(loaded, folder / "report.html").read_text("utf-8")


def test_what_else_stands_in_the_folder_stays(folder, other) -> None:
    (folder / "notes.txt").write_text("mine")
    (folder / "own" / "deep").mkdir(parents=True)
    (folder / "own" / "deep" / "data.csv").write_text("1,2")
    (folder / "link").symlink_to("notes.txt")
    node = (folder / "notes.txt").stat().st_ino
    os.chmod(folder, 0o750)
    other.save(folder)
    assert {p.name for p in folder.iterdir()} == NAMES | {"notes.txt", "own", "link"}
    assert (folder / "own" / "deep" / "data.csv").read_text() == "1,2"
    assert os.readlink(folder / "link") == "notes.txt"
    assert (folder / "notes.txt").stat().st_ino == node
    assert folder.stat().st_mode & 0o777 == 0o750
    assert read_hashes(folder)
    refuse_mixed(folder)
    assert [p.name for p in folder.parent.iterdir()] == ["result"]


def test_files_of_two_runs_are_refused(folder, other, tmp_path) -> None:
    second = tmp_path / "second"
    second.mkdir()
    other.save(second)
    shutil.copy(second / "calibration.nc", folder)
    for command in (
        ("report", folder, "-o", tmp_path / "r.html"),
        ("export", folder / "calibration.nc", "-o", tmp_path / "c.h"),
        ("budget", folder / "calibration.nc"),
    ):
        done = run(*command)
        assert done.status == 2
    (folder / MANIFEST).unlink()
    done = run("report", folder, "-o", tmp_path / "r.html")
    assert done.status == 2


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", '{"schema": "bayescal.manifest/2"}'),
        *('{"files": {"a": 1}}', "[" * 100_000, "\x00"),
    ],
)
def test_a_damaged_manifest_is_refused_until_another_is_written(text, tmp_path) -> None:
    (tmp_path / MANIFEST).write_text(text)
    for asks in (refuse_mixed, read_hashes):
        with pytest.raises(bc.InputError):
            asks(tmp_path)
    write(tmp_path, "1")
    refuse_mixed(tmp_path)


def test_a_failure_leaves_the_folder_as_it_was(folder) -> None:
    before = state(folder)

    def midway(hidden: Path) -> None:
        (hidden / "result.json").write_text("half")
        raise RuntimeError("midway")

    with pytest.raises(RuntimeError, match="midway"), replace_folder(folder) as hidden:
        midway(hidden)
    assert state(folder) == before
    assert os.listdir(folder.parent) == ["result"]


@pytest.mark.parametrize(
    "name", ["../kept.txt", "..", "", "/etc/hostname", "a/b.txt", "..\\kept.txt", "C:kept.txt"]
)
def test_a_manifest_that_lists_what_is_elsewhere_removes_nothing(name, tmp_path) -> None:
    """`../name` with its right hash was deleted by the next run into the folder."""
    folder, other = tmp_path / "out", tmp_path / "kept.txt"
    folder.mkdir()
    other.write_text("mine")
    write(folder, "first")
    manifest = json.loads((folder / MANIFEST).read_text("utf-8"))
    files = {**manifest["files"], name: hashlib.sha256(other.read_bytes()).hexdigest()}
    (folder / MANIFEST).write_text(json.dumps({**manifest, "files": files}))
    with pytest.raises(bc.InputError):
        refuse_mixed(folder)
    write(folder, "second")
    assert other.read_text() == "mine"
