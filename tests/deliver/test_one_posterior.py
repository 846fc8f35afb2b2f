"""Of one quantity one value and one uncertainty, wherever it stands.

All are of the average over structures, where several are probable: on the screen, in result.json, report, certificate,
budget, decision and export.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

import bayescal as bc
from bayescal.workshop import format_value, number, summary, unit_label
from bayescal_models import accelerometer_triad, gyro_triad, magnetometer_triad
from tests.support.contract_cases import Case
from tests.support.inside import Triad, dcc_of, find_d_si, result_of, screen_of, text_of
from tests.support.stated import STATED
from tests.support.tiers import slow_but

# An effect of which three draws in ten are, that needs a column which nothing else does where there is one.
SOMETIMES = {
    "mems_gyro": "bias.drift", "still_sensor": "bias.drift",
    "quartz_beam_accelerometer": "bias.drift", "inclinometer": "zero.temperature",
    "ng_accelerometer": "bias.drift", "differential_pair": "bias.drift",
}  # fmt: skip
SHARE = 0.3
DCC, SI = "{https://ptb.de/dcc}", "{https://ptb.de/si}"


class Stated(NamedTuple):
    """A value and its standard uncertainty."""

    value: float
    u: float


@cache
def trail(name: str) -> bc.SearchPath:
    """A search that ended with two structures: without the effect, and with it."""
    case, effect = Case(name), SOMETIMES[name]
    model, method = case.model, bc.LeastSquares(draws=400)
    best = bc.calibrate(model, case.readings, method=method, max_effects=0, widen_noise=False)
    whole = bc.fit(model + effect, case.readings, method)
    x = whole.joint.x.copy()
    for block in (b for b in whole.layout.x_blocks if b.effect.name == effect):
        absent = int((1 - SHARE) * x.shape[1])
        x[:, :absent, block.start : block.start + block.size] = 0.0
    average = replace(whole, joint=replace(whole.joint, x=x), verdict=best.calibration.verdict)
    return replace(best, average=average)


def on_the_page(text: str) -> dict[str, tuple[str, str]]:
    """Of each unknown of the table of coefficients: "value ± U", and its unit."""
    table = text.partition("shapes, noise</caption>")[2].partition("</table>")[0]
    head = r'<tr><th scope="row" class="t">(.*?)</th>'
    cells = head + r'<td class="t">(.*?)</td><td class="n">(.*?)</td>'
    rows = re.findall(cells, html.unescape(table))
    return {n: (value.replace("−", "-"), unit) for n, unit, value in rows}


def in_the_certificate(text: str) -> dict[str, Stated]:
    """Of each coefficient with an expanded uncertainty, value and U/2 in SI."""
    found = {}
    for quantity in ElementTree.fromstring(text).iterfind(f".//{DCC}result//{DCC}quantity"):
        name = quantity.findtext(f"{DCC}name/{DCC}content", "")
        u = quantity.findtext(f".//{SI}expandedUnc/{SI}uncertainty")
        if u is not None:
            value = float(quantity.findtext(f".//{SI}value", "nan"))
            found[name.partition(", determined by")[0]] = Stated(value, float(u) / 2)
    return found


def on_screen(trail: bc.SearchPath) -> dict[str, str]:
    """Name → mean ± standard uncertainty, as the table of coefficients shows it."""
    rows = (re.split(r"  +", line) for line in screen_of(trail, verbose=True).splitlines())
    return {row[0].removesuffix(" *"): row[1] for row in rows if len(row) > 3}


def in_result(trail: bc.SearchPath) -> dict[str, str]:
    """What result.json says that is used."""
    data = json.loads(json.dumps(result_of(trail)))
    rows = (*data["coefficients"], *data["hyperparameters"])
    used = ((row["name"], row["averaged"] or row) for row in rows)
    return {name: format_value(row["mean"], row["sd"]) for name, row in used}


@pytest.mark.parametrize("name", slow_but(["mems_gyro"], SOMETIMES))
@pytest.mark.usefixtures("unpainted")
def test_one_value_and_one_uncertainty_of_each_quantity(name: str, tmp_path: Path) -> None:
    found, stated = trail(name), tmp_path / "stated.toml"
    average = found.calibration
    stated.write_text(STATED, "utf-8")
    page = on_the_page(bc.report(found, tmp_path / "report.html").read_text("utf-8"))
    screen, data = on_screen(found), in_result(found)
    certificate = in_the_certificate(dcc_of(average, stated))
    use = average.model.instrument.use is not None
    budget = {c.name: c for c in bc.budget(average).coefficients} if use else {}
    program = bc.compensator(average).program if use else None
    exported = {} if program is None else {u.name: i for i, u in enumerate(program.unknowns)}
    assert data.keys() & screen.keys()
    for row in summary(average)[0]:
        unknown, unit = row["name"], row["unit"]
        one, given = Stated(row["mean"], row["sd"]), Stated(*[*row["given"].values()][:2])
        said, shown = format_value(*one), format_value(*given)  # if it is there
        # What only rivals of the final model have is not in its own tables; a large group is one line of the page.
        assert data.get(unknown, said) == said
        assert screen.get(unknown, shown) == shown or "skewed" in screen[unknown]
        if unknown in page and "95 %" not in page[unknown][0]:
            assert page[unknown] == (format_value(given.value, 2 * given.u), unit_label(unit))
        factor, _ = find_d_si(unit)
        rounding = 0.1 * factor * one.u  # to two digits of U
        assert certificate[unknown] == pytest.approx([factor * v for v in one], abs=rounding)
        limit = f"{unknown}: ≤ {one.value + 100 * one.u!r} {unit if unit != '1' else ''}"
        (decided,) = bc.decide(average, limit).decisions
        assert (decided.estimate[0], decided.uncertainty) == pytest.approx(one, rel=1e-9)
        if unknown in budget:
            b = budget[unknown]
            assert (b.value, b.uncertainty) == pytest.approx(one, rel=1e-9)
        if program is not None and unknown in exported:
            i = exported[unknown]
            assert program.unknowns[i].mean == pytest.approx(one.value, rel=1e-9)
            assert program.covariance[i][i] ** 0.5 == pytest.approx(one.u, rel=1e-9)
            line = f"{unknown} = {program.unknowns[i].mean:.9g} +- {one.u:.3g}"
            assert all(line in text_of(program, language) for language in ("c", "python"))
    assert any(unknown.startswith(SOMETIMES[name]) for unknown in screen)


@pytest.mark.parametrize(
    "name", slow_but(["mems_gyro"], [n for n in SOMETIMES if n != "differential_pair"])
)
@pytest.mark.usefixtures("unpainted")
def test_a_compensated_value_has_one_uncertainty(name: str, tmp_path: Path) -> None:
    """At the operating point that nobody names: budget, decision, report, compensator and export."""
    found = trail(name)
    average = found.calibration
    budget, chosen = bc.budget(average), bc.compensator(average)
    assert chosen.equation is not None
    (decided,) = bc.decide(average, f"corrected mean: ±1 {budget.unit}").decisions
    assert decided.uncertainty == pytest.approx(budget.uncertainty, rel=2e-3)
    assert {n: low for n, (low, _, _) in decided.at.items() if n in budget.at} == budget.at
    given: dict[str, Any] = {n: v for n, v in budget.at.items() if n != budget.stimulus}
    value = chosen(output=budget.reading, noise=False, method="first order", **given)
    assert value.uncertainty[0] == pytest.approx(budget.uncertainty, rel=1e-9)
    # The equation may bend within the uncertainty.
    drawn = chosen(output=budget.reading, noise=False, method="draws", **given)
    assert drawn.value[0] == pytest.approx(value.value[0], abs=0.02 * budget.uncertainty)
    assert drawn.uncertainty[0] == pytest.approx(budget.uncertainty, rel=0.01)
    text = bc.report(found, tmp_path / "report.html").read_text("utf-8")
    shown = budget.in_output_unit()
    assert f"U = {number(shown.expanded, 3)}" in text


def searched(module: Any, hidden: dict[str, Any] | None = None) -> bc.SearchPath:
    readings = module.simulate(hidden, seed=3)
    model = module.INSTRUMENT.for_readings(readings).baseline()
    return bc.calibrate(model, readings, method=bc.LeastSquares(draws=400))


@cache
def triad_trail() -> bc.SearchPath:
    """Of accelerometers whose second order is hardly visible: structures with and without it share the probability."""
    campaign = accelerometer_triad.Campaign(poses=14, temperatures=(-20.0, 0.0, 25.0, 50.0, 70.0))
    readings = accelerometer_triad.simulate({"square.constant": 1.2}, seed=3, campaign=campaign)
    return bc.calibrate(accelerometer_triad.INSTRUMENT.baseline(), readings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "made",
    [
        pytest.param(triad_trail, id="averaged over structures"),
        pytest.param(partial(searched, gyro_triad, {"bias.g_sensitivity": 0.003}), id="gyroscopes"),
        pytest.param(partial(searched, magnetometer_triad), id="magnetometers"),
    ],
)
def test_of_three_axes(made: Callable[[], bc.SearchPath]) -> None:
    trail = made()
    correct = bc.vector_correction(trail.calibration)
    text = str(Triad(trail, correct, trail.calibration.readings))
    screen = dict(re.split("  +", line)[:2] for line in text.splitlines() if "  " in line)
    data = (vector := json.loads(json.dumps(result_of(trail)))["vector"])["averaged"] or vector
    assert data["terms"] == correct.terms.tolist()
    assert np.allclose(data["uncertainty"], correct.uncertainty, rtol=1e-12)
    c, python, json_ = (text_of(correct, f) for f in ("c", "python", "json"))
    assert json.loads(json_)["terms"] == data["terms"]
    assert json.loads(json_)["covariance"] == data["covariance"]
    for row in correct.rows:
        if row.order < 2 or abs(row.value) > 0.5 * row.uncertainty:
            assert screen[row.name] == format_value(row.value, row.uncertainty)
        words = f"{row.value:.9g} +- {row.uncertainty:.3g}"
        assert words in c and words in python and repr(row.value) in c and repr(row.value) in python
    # Coefficients are the correction in other words, where a new run brings nothing; u of the form is the correction's.
    coefficients, form = on_screen(trail), trail.calibration.form_factor
    for i, a in enumerate("xyz"):
        factor = 1e-3 if correct.unit == "g" else 1.0  # mg
        offset = correct.offset[i] / factor, correct.uncertainty[0, i] / (factor * form)
        assert format_value(*offset) == coefficients[f"bias.constant[{a}]"]
    # Where nothing acts, what is corrected is the offset.
    found = correct(correct.offset[None], correct.reference, noise=0.0)
    assert found.vector == pytest.approx(0.0, abs=1e-12)
    spread = correct.matrix @ found.covariance[0] @ correct.matrix.T
    assert np.sqrt(np.diag(spread)) == pytest.approx(correct.uncertainty[0, :3], rel=1e-6)
