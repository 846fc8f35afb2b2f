"""A picture, a report or a page that fails never costs the result, which is on the disk before anything is drawn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal._cli.output import ConsoleReporter
from bayescal._report import plots, report
from bayescal._report.save_search import draw_search, write_results
from tests.support.command_line import GYRO, TABLE, needs_installation, run
from tests.support.inside import MANIFEST, files_of, refuse_mixed, whole_folder
from tests.support.reported import trail

KEPT = {"result.json", "calibration.nc", "averaged.nc"}
WHY = "Failed to process string with tex because latex could not be found"


def failing(*_: object, **__: object) -> None:
    raise RuntimeError(WHY)


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that was made before, in place of each."""
    monkeypatch.setattr(bc, "calibrate", lambda *_, follow=ConsoleReporter, **__: trail())


def results_of(folder: Path) -> set[str]:
    refuse_mixed(folder)
    assert bc.load(folder / "calibration.nc").model.names == trail().final.calibration.model.names
    assert {p.name for p in folder.iterdir()} == {*files_of(folder), MANIFEST}
    return set(files_of(folder))


def test_a_result_is_on_the_disk_before_its_picture_is_drawn(tmp_path, monkeypatch) -> None:
    seen: list[set[str]] = []

    def looking(found: bc.SearchPath):
        seen.append(results_of(tmp_path))
        return loop(found)

    loop = plots.loop
    monkeypatch.setattr(plots, "loop", looking)
    trail().save(tmp_path)
    assert seen == [KEPT]
    assert results_of(tmp_path) == {*KEPT, "loop.png"}


@pytest.mark.parametrize("part", ["loop", "save"])
def test_a_saved_search_keeps_its_result_where_its_picture_fails(part, tmp_path, monkeypatch):
    monkeypatch.setattr(plots, part, failing)
    with pytest.raises(bc.NotDrawn):
        trail().save(tmp_path)
    assert results_of(tmp_path) == KEPT


@needs_installation
@pytest.mark.usefixtures("no_search")
def test_calibrate_prints_and_keeps_its_result_where_its_picture_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "loop", failing)
    done = run("calibrate", TABLE, *GYRO, "--out", tmp_path / "out")
    assert done.status == 1
    assert WHY in done.err
    assert results_of(tmp_path / "out") == KEPT


@pytest.mark.slow
@needs_installation
def test_a_report_is_written_without_the_pictures_that_fail(tmp_path, monkeypatch) -> None:
    trail().final.calibration.save(tmp_path / "calibration.nc")
    monkeypatch.setattr(report, "as_svg", failing)
    done = run("report", tmp_path / "calibration.nc", "-o", tmp_path / "report.html")
    assert done.status == 1
    assert WHY in done.err
    page = (tmp_path / "report.html").read_text("utf-8")
    assert page.rstrip().endswith("</html>") and "<svg" not in page
    assert page.count("could not be drawn (RuntimeError: Failed") > 5


@needs_installation
def test_noise_keeps_its_numbers_where_its_picture_fails(tmp_path, monkeypatch) -> None:
    still = np.random.default_rng(3).normal(0, 0.1, 400)
    rows = "\n".join(f"{i / 10},{v}" for i, v in enumerate(still))
    (tmp_path / "still.csv").write_text(f"time [s],gyro_x [deg/s]\n{rows}\n", "utf-8")
    monkeypatch.setattr(plots, "noise", failing)
    monkeypatch.setattr(bc.plot, "noise", failing)
    done = run(
        *("noise", tmp_path / "still.csv", "--columns", "output=gyro_x"),
        *("--yaml", tmp_path / "imu.yaml", "--out", tmp_path / "pictures"),
    )
    assert done.status == 1, done.err
    assert WHY in done.err
    assert (tmp_path / "imu.yaml").is_file()


@needs_installation
@pytest.mark.slow
@pytest.mark.parametrize("part", ["loop", "report"])
def test_a_triad_keeps_its_correction_where_what_is_drawn_fails(
    part: str, tmp_path, monkeypatch
) -> None:
    from bayescal_models import accelerometer_triad

    accelerometer_triad.simulate(seed=4).write(tmp_path / "poses.csv")
    monkeypatch.setattr(*((plots, "loop") if part == "loop" else (bc, "report")), failing)
    command = ("triad", tmp_path / "poses.csv", "--poses", "--baseline")
    done = run(*command, "--out", tmp_path / "out")
    assert done.status == 1
    there = files_of(tmp_path / "out")
    assert {"correction.h", "correction.json", "calibration.nc", "result.json"} <= {*there}
    assert ("report.html" in there) == (part == "loop")
    assert ("loop.png" in there) == (part == "report")


def test_what_is_drawn_obeys_no_settings_of_matplotlibs_files(tmp_path) -> None:
    import matplotlib

    def drawn() -> tuple[bytes, str]:
        draw_search({"": trail()}, tmp_path)
        picture = report.Pictures().draw(lambda: plots.trail(trail()), "", "")
        return (tmp_path / "loop.png").read_bytes(), picture.body

    write_results(trail(), tmp_path)
    with matplotlib.rc_context({"text.usetex": True, "font.size": 40, "lines.linewidth": 9}):
        theirs = drawn()
    assert drawn() == theirs


def test_more_files_join_the_results_that_stand(tmp_path: Path) -> None:
    """What is drawn later belongs to the results, in one step; what failed leaves no trace, the user's own stays."""

    def write(place: Path, **files: str) -> None:
        place.mkdir(exist_ok=True)
        for name, text in files.items():
            (place / name).write_text(text)

    def add(more: bool, change: Callable[[Path], None]) -> None:
        with whole_folder(tmp_path / "out", "of one calibration", more=more) as hidden:
            change(hidden)

    (tmp_path / "out").mkdir()
    add(False, lambda h: write(h, a="1", b="1"))
    write(tmp_path / "out", mine="mine")
    add(True, lambda h: write(h, c="2"))
    assert {*files_of(tmp_path / "out")} == {"a", "b", "c"}
    with pytest.raises(RuntimeError):
        add(True, failing)
    assert {*files_of(tmp_path / "out")} == {"a", "b", "c"}
    add(False, lambda h: write(h, a="3"))
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"a", "mine", MANIFEST}
    refuse_mixed(tmp_path / "out")
