"""Pictures: each shows what it claims, with a unit on every axis, and leaves no window behind."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.colors import rgb_to_hsv, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

import bayescal as bc
from tests.support.inside import result_of
from tests.support.reported import HIDDEN, trail

OKABE_ITO = {"#0072b2", "#e69f00", "#009e73", "#d55e00", "#56b4e9", "#cc79a7"}
UNIT = re.compile(r"\[[^\[\]]+\]")


def every() -> dict[str, Figure]:
    found, final = trail(), trail().final.calibration
    assert found.steps[0].discovery is not None
    return {
        "residuals": bc.plot.residuals(final),
        "allan": bc.plot.allan(final),
        "trail": bc.plot.trail(found),
        "coefficients": bc.plot.coefficients(final),
        "missing": bc.plot.missing(found.steps[0].discovery),
        "predictive": bc.plot.predictive(final),
        "identifiability": bc.plot.identifiability(final),
        "pairs": bc.plot.pairs(final),
        "loop": bc.plot.loop(found),
    }


@pytest.fixture(scope="module")
def figures() -> dict[str, Figure]:
    return every()


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


def test_no_window_is_left(figures) -> None:
    assert all(isinstance(f, Figure) for f in figures.values())
    assert pyplot.get_fignums() == []


def test_the_trail_shows_the_fall_to_the_floor(figures) -> None:
    ax = figures["trail"].axes[0]
    widths = sorted(p.get_width() for p in ax.patches)
    errors = [s.rmse for s in trail().steps]
    assert all(any(np.isclose(w, e) for w in widths) for e in errors)
    (floor,) = [line for line in ax.lines if line.get_linestyle() == "--"]
    assert floor.get_xdata()[0] == pytest.approx(trail().final.noise_floor)
    told = " ".join(t.get_text() for t in ax.texts)
    assert f"+ {HIDDEN}   (−{100 * (1 - errors[1] / errors[0]):.0f} %)" in told


def test_a_trail_is_drawn_alike_from_its_result() -> None:
    found = trail()
    assert found.steps[0].discovery is not None
    for drawn, again in (
        (bc.plot.trail(found), bc.plot.trail(result_of(found))),
        (
            bc.plot.missing(found.steps[0].discovery),
            bc.plot.missing(result_of(found)["missing"][0]),
        ),
    ):
        bars = [[p for p in f.axes[0].patches if isinstance(p, Rectangle)] for f in (drawn, again)]
        widths = [[p.get_width() for p in own] for own in bars]
        assert widths[0] == pytest.approx(widths[1])


def test_the_finding_stands_out(figures) -> None:
    ax = figures["missing"].axes[0]
    names = [t.get_text() for t in ax.get_yticklabels()]
    bar = ax.patches[names.index(HIDDEN)]
    assert bar.get_width() == max(p.get_width() for p in ax.patches)
    assert np.allclose(bar.get_facecolor()[:3], (0xD5 / 255, 0x5E / 255, 0))


def test_coefficients_show_mean_and_credible_interval_unrounded(figures) -> None:
    draws = trail().final.calibration.samples("bias.constant")[::1]
    (ax,) = [a for a in figures["coefficients"].axes if a.get_title() == "bias.constant"]
    mean = next(line for line in ax.lines if line.get_marker() == "o")
    assert mean.get_xdata()[0] == pytest.approx(draws.mean(), abs=0.2 * draws.std())
    assert ax.get_xlabel() == "[°/s]"


def test_identifiability_is_the_root_of_what_is_left(figures) -> None:
    c = trail().final.calibration
    ax = figures["identifiability"].axes[0]
    names = [t.get_text() for t in ax.get_yticklabels()]
    width = ax.patches[names.index("bias.temperature")].get_width()
    prior = c.model.effect("bias.temperature").coefficients[0].size
    assert width == pytest.approx(c.samples("bias.temperature").std(ddof=1) / prior, rel=1e-6)


def test_members_of_a_group_are_drawn() -> None:
    figure = bc.plot.members(trail().final.calibration, f"{HIDDEN}[start]")
    assert f"{HIDDEN}[start] [°/s]" in [ax.get_xlabel() for ax in figure.axes]


@pytest.mark.parametrize(
    "draw",
    [
        lambda c: bc.plot.coefficients(c, ["bias.colour"]),
        lambda c: bc.plot.pairs(c, ["bias.constant"]),
        lambda c: bc.plot.members(c, "bias.constant"),
    ],
)
def test_what_cannot_be_drawn_is_refused(draw) -> None:
    with pytest.raises(bc.InputError):
        draw(trail().final.calibration)


def test_colours_are_those_that_the_colour_blind_tell_apart(figures) -> None:
    """Of lines and bars: the palette's, or without a hue."""
    shown = [a for f in figures.values() for ax in f.axes for a in (*ax.lines, *ax.patches)]
    used = {to_hex(a.get_color() if isinstance(a, Line2D) else a.get_facecolor()) for a in shown}
    coloured = {c for c in used if rgb_to_hsv(to_rgb(c))[1] > 0.05}
    assert len(coloured) > 2 and coloured <= OKABE_ITO


def test_saving_replaces_at_once(tmp_path, figures) -> None:
    path = bc.plot.save(figures["trail"], tmp_path / "trail.png")
    assert path.read_bytes().startswith(b"\x89PNG")
    assert list(tmp_path.iterdir()) == [path]
