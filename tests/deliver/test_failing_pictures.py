"""A picture that fails never costs the result, which is on the disk before anything is drawn."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

import bayescal as bc
from tests.support.inside import MANIFEST, files_of, refuse_mixed
from tests.support.reported import trail

KEPT = {"result.json", "calibration.nc", "averaged.nc"}


def results_of(folder: Path) -> set[str]:
    refuse_mixed(folder)
    assert bc.load(folder / "calibration.nc").model.names == trail().final.calibration.model.names
    assert {p.name for p in folder.iterdir() if p.suffix != ".partial"} == {
        *files_of(folder),
        MANIFEST,
    }
    return set(files_of(folder))


def test_a_saved_search_keeps_its_result_where_its_picture_fails(tmp_path, monkeypatch) -> None:
    seen: list[set[str]] = []

    def failing(*_: object, **__: object) -> None:
        seen.append(results_of(tmp_path))
        raise RuntimeError("latex could not be found")

    monkeypatch.setattr(FigureCanvasAgg, "print_png", failing)
    with pytest.raises(bc.NotDrawn):
        trail().save(tmp_path)
    assert seen == [KEPT]
    assert results_of(tmp_path) == KEPT
    monkeypatch.undo()
    trail().save(tmp_path)
    assert results_of(tmp_path) == {*KEPT, "loop.png"}
