"""Pictures: each shows what it claims, with a unit on every axis, and leaves no window behind."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import bayescal as bc
from tests.support.inside import MANIFEST, read_hashes, refuse_mixed
from tests.support.reported import HIDDEN, trail

UNIT = re.compile(r"\[[^\[\]]+\]")


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    found, final = trail(), trail().final.calibration
    assert found.steps[0].discovery is not None
    return {
        "residuals": bc.plot.residuals(final),
        "allan": bc.plot.allan(bc.allan_deviation(final.readings)),
        "trail": bc.plot.trail(found),
        "missing": bc.plot.missing(found.steps[0].discovery),
        "loop": bc.plot.loop(found),
    }


def test_every_axis_has_a_unit(figures) -> None:
    """On axes that measure: those with names or nothing on them have none."""
    lacking = []
    for name, figure in figures.items():
        for ax in figure.axes:
            for axis in (ax.xaxis, ax.yaxis):
                shown = axis.get_visible() and ax.get_visible() and axis.get_ticklabels()
                label = axis.get_label().get_text()
                if shown and label and not UNIT.search(label):
                    lacking.append((name, label))
        labels = [a.get_label().get_text() for ax in figure.axes for a in (ax.xaxis, ax.yaxis)]
        assert any(UNIT.search(label) for label in labels), name
    assert not lacking


def test_the_trail_shows_the_fall_to_the_floor(figures) -> None:
    ax = figures["trail"].axes[0]
    widths = sorted(p.get_width() for p in ax.patches)
    errors = [s.rmse_fitted for s in trail().steps]
    assert all(any(np.isclose(w, e) for w in widths) for e in errors)
    (floor,) = [line for line in ax.lines if line.get_linestyle() == "--"]
    assert floor.get_xdata()[0] == pytest.approx(trail().final.noise_floor)
    told = " ".join(t.get_text() for t in ax.texts)
    assert f"+ {HIDDEN}   (−{100 * (1 - errors[1] / errors[0]):.0f} %)" in told


# A picture that fails never costs the result, which is on the disk before anything is drawn.


KEPT = {"result.json", "calibration.nc", "averaged.nc"}


def results_of(folder: Path) -> set[str]:
    refuse_mixed(folder)
    assert bc.load(folder / "calibration.nc").model.names == trail().final.calibration.model.names
    assert {p.name for p in folder.iterdir() if p.suffix != ".partial"} == {
        *read_hashes(folder),
        MANIFEST,
    }
    return set(read_hashes(folder))


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
