"""What the page is made of, without a browser: readings that are drawn, text, the tree of steps, names of files."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bokeh.models import NoOverlap, PlainText

import bayescal as bc
from bayescal._annexes.workbench.app import Workbench
from bayescal._annexes.workbench.kept import path_to
from bayescal._annexes.workbench.panes.fails import (
    DRAWN_READINGS,
    PIXELS,
    CutAxis,
    drawn_rows,
    sentence,
)
from bayescal._annexes.workbench.panes.missing import candidate_rows
from bayescal._annexes.workbench.panes.tabs import ERROR, in_order, safe_name
from bayescal._annexes.workbench.parts.pieces import Rows, new_figure, words
from bayescal._annexes.workbench.session import Session
from bayescal._search.candidate import Candidate
from bayescal._search.posterior import Found

COUNT = 100_000


@pytest.fixture
def many() -> tuple[dict[str, np.ndarray], np.ndarray]:
    rng = np.random.default_rng(1)
    columns = {"time": np.arange(float(COUNT)), "temperature": rng.uniform(-20, 60, COUNT)}
    residual = rng.standard_normal(COUNT)
    residual[41_234] = 40.0  # one reading far off, which no thinning may lose
    return columns, residual


def test_extremes_of_every_column_of_pixels_are_drawn(many) -> None:
    columns, residual = many
    rows = drawn_rows(columns, [residual])
    assert rows.size <= DRAWN_READINGS + len(columns) * 2 * PIXELS
    assert 41_234 in rows
    for values in columns.values():
        place = (values - values.min()) / np.ptp(values)
        pixel = np.minimum((place * PIXELS).astype(int), PIXELS - 1)
        for which in (0, 150, PIXELS - 1):
            inside = np.flatnonzero(pixel == which)
            assert inside[np.argmin(residual[inside])] in rows
            assert inside[np.argmax(residual[inside])] in rows
    assert f"{rows.size:,} of 100,000" in sentence(rows.size, COUNT)


def test_of_few_readings_all_are_drawn(many) -> None:
    columns, residual = many
    few = {name: values[:DRAWN_READINGS] for name, values in columns.items()}
    assert drawn_rows(few, [residual[:DRAWN_READINGS]]).size == DRAWN_READINGS
    assert sentence(DRAWN_READINGS, DRAWN_READINGS) == ""


def test_a_view_of_a_part_draws_more_of_it(many) -> None:
    columns, residual = many
    near = drawn_rows(columns, [residual], {"time": (1000.0, 1500.0)})
    inside = (columns["time"][near] >= 1000) & (columns["time"][near] <= 1500)
    assert inside.sum() == 501, "all readings in view are drawn where they are few"


def test_text_is_never_markup() -> None:
    shown = words("<b>run</b>")._transform_object("<b>run</b>")["object"]
    assert "<b>" not in shown and "&amp;lt;b" in shown


def test_a_label_is_never_a_formula() -> None:
    from bokeh.embed.bundle import _use_mathjax

    name = r"$$\href{javascript:alert(1)}{x}$$"
    made = new_figure(name, name)
    assert isinstance(made.xaxis[0].axis_label, PlainText) and made.xaxis[0].axis_label.text == name
    assert not _use_mathjax({made})


def test_labels_of_ticks_give_way_to_each_other() -> None:
    figure = new_figure("time [s]", "output [°/s]")
    assert all(isinstance(axis.major_label_policy, NoOverlap) for axis in figure.axis)


def test_a_press_that_the_page_does_not_offer_is_not_taken() -> None:
    pressed: list[tuple[str, str]] = []
    actions = [{"id": "add"}, {"id": "shut", "off": True}, {"id": "compare", "reads": True}]
    shown = {"id": "a", "cells": [], "actions": actions}
    rows = Rows(lambda *press: pressed.append(press), rows=[shown])
    for message in ({"row": "b", "action": "add"}, {"row": "a", "action": "shut"}, "add", {}):
        rows._handle_msg(message)
    rows.busy = True
    for action in ("add", "compare"):  # which waits for nothing
        rows._handle_msg({"row": "a", "action": action})
    rows.busy = False
    rows._handle_msg({"row": "a", "action": "add"})
    assert pressed == [("a", "compare"), ("a", "add")]


def test_steps_stand_after_their_parents_and_branches_are_set_in() -> None:
    parents = {0: None, 1: 0, 2: 1, 3: 0, 4: 3, 5: 1}
    states: Any = {n: SimpleNamespace(parent=parent) for n, parent in parents.items()}
    order = [(0, ""), (3, "├ "), (4, "│ "), (1, ""), (5, "├ "), (2, "")]
    assert in_order(states) == order
    assert path_to(states, 5) == [0, 1, 5]


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("../../etc/passwd", "readings-passwd"),
        ("C:\\data\\run 1.csv", "run 1.csv"),
        ("<img src=x>.csv", "_img src_x_.csv"),
        ("..", "readings-without-name"),
        ("", "readings-without-name"),
    ],
)
def test_a_dropped_file_keeps_a_harmless_name(name: str, kept: str) -> None:
    assert safe_name(name) == kept


def test_substitutes_stand_together_and_what_cannot_be_tested_last() -> None:
    found = bc.Discovery(
        nothing_missing=0.01,
        sets=(Found(("bias.lag", "bias.rate"), 0.97),),
        candidates=(
            Candidate("scale", kind="not testable", reason="needs the column rate"),
            Candidate("bias.rate", 0.5, kind="finding"),
            Candidate("bias.cubic", 0.02),
            Candidate("bias.lag", 0.47, kind="finding"),
        ),
        best=(),
    )
    rows = candidate_rows(found)
    assert [r["id"] for r in rows] == ["bias.lag", "bias.rate", "bias.cubic", "scale"]
    assert rows[0]["group"] == rows[1]["group"]
    assert not rows[-1]["actions"]


@pytest.mark.slow
def test_every_pane_is_made_without_a_browser(session: Session) -> None:
    """Of each state, on either ground; a dropped file gets a form for its columns."""
    bench = Workbench(session)
    session.look()
    bench.refresh()
    for name in (*bench.tabs.which.options, ERROR):
        bench.tabs.open(name)
        assert bench.view.get_root()
    session.add(bench.missing.rows.rows[0]["id"])
    bench.refresh()
    bench.browser.param.update(dark=True, wide=True, seen=True)
    bench.fails.when.value = "both"
    bench.fails.select(np.arange(30))
    file = bench.tabs.file
    file.receive("few.csv", b"temperature [degC],output [deg/s]\n20,1\n30,2\n40,3\n")
    bench.work.close(wait=True)
    assert "3 readings" in file.told.object and file.use.visible
    file.given()
    assert bench.view.get_root()
    assert "dark" in bench.view.css_classes


def test_panels_stay_from_step_to_step_and_go_with_their_readings(session: Session) -> None:
    """Of another step they have its residuals, noise and worst region; a zoomed view stays."""
    fails = Workbench(session).fails
    panel = fails.panels[0]
    made = fails._made[fails.choice.value[0]]
    made.x_range.update(start=30.0, end=40.0)
    before = fails.source.data["residual"]
    session.add("bias.thermal_lag")
    fails.show(session.current, session.states[0])
    shown = session.current.step.check
    assert fails.panels[0] is panel and (made.x_range.start, made.x_range.end) == (30.0, 40.0)
    assert np.array_equal(fails.source.data["residual"], shown.residuals)
    assert not np.array_equal(fails.source.data["residual"], before)
    assert made._noise.top == shown.noise and made._worst.visible == (
        fails.shown.worst(fails.choice.value[0]) is not None
    )
    fails.select(np.arange(30))
    few = session.with_readings(session.readings.select(np.arange(len(session.readings)) % 2 == 0))
    fails.show(few.current)
    assert fails.panels[0] is not panel and not fails.selected.size
    assert len(fails.source.data["residual"]) == len(few.readings)


def test_long_gaps_between_runs_are_left_out_of_the_time_axis() -> None:
    """Three hours of readings, a day apart."""
    times = np.concatenate([np.arange(0.0, 3600, 30) + day * 86_400 for day in range(3)])
    cut = CutAxis.of(times[::-1])
    assert cut.starts.tolist() == [0, 86_400, 172_800]
    at = cut.place(times)
    assert np.all(np.diff(at) > 0), "the order of readings stays"
    assert np.ptp(at) < 1.5 * 3 * 3600
    assert np.allclose(np.diff(at)[np.diff(times) == 30], 30), "stretches stay as they are"
    assert np.all(cut.taken % 1000 == 0), "marks of the axis stay round numbers"


@pytest.mark.parametrize("times", [np.arange(10.0), np.array([3.0]), np.array([0.0, 1, 2, 7])])
def test_a_time_axis_without_long_gaps_is_left_as_it_is(times) -> None:
    assert CutAxis.of(times).place(times).tolist() == times.tolist()


@pytest.mark.slow
def test_a_page_that_fails_costs_no_step(session: Session, monkeypatch) -> None:
    """What a pane cannot show is on the disk before: the session goes on with it."""
    page = Workbench(session)

    def failing(*_: Any) -> None:
        raise RuntimeError("this pane fails")

    monkeypatch.setattr(page.fails, "show", failing)
    with pytest.raises(RuntimeError):
        session.add("bias.drift")
    again = Session.resume(session.folder)
    assert again.current.number == 1
    assert "bias.drift" in again.current.calibration.model.names


@pytest.mark.slow
def test_a_picture_that_fails_costs_no_export(session: Session, monkeypatch) -> None:
    from bayescal._report import plots

    def failing(*_: Any) -> None:
        raise RuntimeError("this picture fails")

    monkeypatch.setattr(plots, "loop", failing)
    written = session.export("json")
    assert written.is_file() and (written.parent / "calibration.nc").is_file()
