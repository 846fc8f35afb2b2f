"""The self-check of an instrument: simulated at its own plausible sizes, fitted, and what came back.

It finds what an author cannot see in the file: a basis that is zero, an output that no slot changes, a size that is
lost in the noise, coefficients that no readings could tell apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._calibration.calibration import Calibration
from bayescal._calibration.fit import fit
from bayescal._calibration.guards import off_scale
from bayescal._calibration.summary import null_directions
from bayescal._core.errors import BayescalError, ModelError
from bayescal._core.formatting import number, with_error
from bayescal._core.progress import stage
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.column import Column
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY, unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._model import forward
from bayescal._model.effect import Effect
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, testable
from bayescal._model.parameters import bind
from bayescal._search.own_files import in_one_line

# Standard deviations from what was simulated, beyond which a coefficient has not come back.
BACK_SD = 4.0
# Contraction below which a coefficient is not identifiable; two that are one have a half each.
IDENTIFIABLE_CONTRACTION = 0.6

RUNS, ROWS = 4, 60  # of the readings that are made up, where the instrument has no simulator
SPANS = 5.0  # times the longest median time of an effect, that a run lasts at the least


@dataclass(frozen=True)
class Returned:
    """What came back of one coefficient, or of the spread of a group's.

    Attributes:
        kind: "baseline", or "candidate": fitted beside the baseline.
        name: of the unknown.
        unit: its own.
        adds: the most that it adds to the output at its plausible size, output unit.
        truth: that was simulated.
        mean, sd: of its posterior; None where it could not be fitted.
        remark: what is to be known of it; empty where it came back.
    """

    kind: str
    name: str
    unit: str
    adds: float | None
    truth: float | None
    mean: float | None
    sd: float | None
    remark: str = ""


@dataclass(frozen=True, repr=False)
class InstrumentCheck(Printed):
    """What `check_instrument` finds.

    Attributes:
        instrument: its name.
        unit: of the output.
        noise: that was simulated, output unit.
        rows: each coefficient.
        errors: what is wrong with the instrument, a sentence each.
        notes: what is to be known of it.
    """

    instrument: str
    unit: str
    noise: float
    rows: tuple[Returned, ...]
    errors: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.errors

    def _parts(self) -> list[str | ResultTable]:
        unit = unit_label(self.unit)
        columns = (
            TableColumn("unknown", "name"),
            TableColumn("adds at most", "adds", number, unit or "1"),
            TableColumn("simulated", "truth", number),
            TableColumn("came back", lambda r: (r["mean"], r["sd"]), _came_back),
            TableColumn("unit", "unit", unit_label),
            TableColumn("remark", "remark"),
        )
        shown = [ResultTable(columns, [vars(r) for r in self.rows], fold=24)] if self.rows else []
        said = [f"error: {e}" for e in self.errors] + [f"note: {n}" for n in self.notes]
        many = f"{len(self.errors)} error(s)" if self.errors else "no error"
        end = f"{self.instrument}, with noise of {number(self.noise)} {unit}".rstrip() + f": {many}"
        return [*shown, *said, end]

    def _brief(self) -> str:
        return f"{self.instrument}: {len(self.rows)} unknowns, {len(self.errors)} errors"

    def _columns(self) -> dict[str, list[Any]]:
        names = ("name", "kind", "unit", "adds", "truth", "mean", "sd", "remark")
        return {name: [getattr(row, name) for row in self.rows] for name in names}

    def data(self) -> dict[str, Any]:
        """As JSON."""
        return {**vars(self), "rows": [vars(row) for row in self.rows], "ok": self.ok}


def _came_back(found: tuple[float | None, float | None]) -> str:
    mean, sd = found
    return "–" if mean is None else with_error(mean, sd or 0.0)


def check_instrument(
    instrument: Instrument, readings: Measurements | None = None, *, seed: int = 0
) -> InstrumentCheck:
    """Simulate an instrument at its own plausible sizes, fit it by least squares, and say what came back.

    The baseline is fitted with the noise that its law expects, then each candidate beside it. Nothing is judged here
    but the instrument: the readings are made by its own equation.

    Args:
        instrument: the instrument.
        readings: of which the columns are taken, the output aside; those of its simulator, or made up within `low` and
            `high` of each column, if not given.
        seed: of every random number.

    Raises:
        ModelError: the instrument takes its unit from readings, and there are none.
    """
    if readings is not None:
        instrument = instrument.for_readings(readings)
    if instrument.unit == ANY:
        raise ModelError(
            f"instrument {instrument.name!r} takes its unit and sizes from readings: give some (readings=)"
        )
    return _CheckedInstrument(instrument, readings, seed).result()


class _CheckedInstrument:
    """One check under way: what it finds is added to `rows`, `errors` and `notes`."""

    def __init__(self, instrument: Instrument, readings: Measurements | None, seed: int) -> None:
        self.instrument, self.seed = instrument, seed
        self.rows, self.errors, self.notes = list[Returned](), list[str](), list[str]()
        self.noise, self.made_labels = 0.0, set[str]()
        self.readings = self._columns() if readings is None else readings

    def result(self) -> InstrumentCheck:
        i = self.instrument
        baseline = Model(i, i.effects, i.noise)
        with stage(f"checking {i.name}"):
            if self._fitted(baseline, i.effects, "baseline"):
                for effect in i.candidates:
                    reason = testable(effect, self.readings)
                    if reason is not None:
                        unit, said = effect.coefficients[0].unit, f"not tested, {reason}"
                        row = Returned("candidate", effect.name, unit, None, None, None, None, said)
                        self.rows.append(row)
                        continue
                    self._fitted(baseline + effect, (effect,), "candidate")
        found = tuple(dict.fromkeys(self.errors)), tuple(dict.fromkeys(self.notes))
        return InstrumentCheck(i.name, i.unit, self.noise, tuple(self.rows), *found)

    def _columns(self) -> Measurements:
        """Readings of every column: by the instrument's own simulator, or made up within what it declares."""
        i = self.instrument
        if i.simulator is not None:
            return i.simulate({}, seed=self.seed)
        random, rows = np.random.default_rng(self.seed), RUNS * ROWS
        run = np.repeat(np.arange(RUNS), ROWS)
        # Runs last several of the longest time constants, and readings stand closer than these: either side of a lag
        # or a warm-up is in the record.
        shapes = [s for e in (*i.effects, *i.candidates) for s in e.shapes]
        times = [float(s.prior.value(0.0)) for s in shapes if s.unit == "s" and not s.open]
        step = max(10.0, SPANS * max(times, default=0.0) / ROWS)
        made: dict[str, Any] = {}
        for column in i.columns:
            if column.name == "time":
                made["time"] = step * (np.arange(rows) + ROWS * run)
            elif column.name == "run":
                made["run"] = [f"run {n + 1}" for n in run]
            elif column.unit is None:
                self.made_labels |= set() if column.allowed else {column.name}
                members = column.allowed or ("a", "b", "c")
                made[column.name] = [members[n] for n in random.integers(len(members), size=rows)]
            elif column.name == "temperature_point":
                made[column.name] = np.full(rows, np.nan)
            elif column.name not in ("output", "output_uncertainty"):
                made[column.name] = self._made_up(column, random, run)
        made["output"] = random.standard_normal(rows)
        return Measurements.from_arrays(i, **made)

    def _made_up(self, column: Column, random: np.random.Generator, run: np.ndarray) -> np.ndarray:
        """Values of a column within its limits: a temperature goes up and down in each run, another is drawn."""
        usual = (10.0, 50.0) if column.unit == "degC" else (-1.0, 1.0)
        low, high, wide = column.low, column.high, usual[1] - usual[0]
        if low is None:
            low = usual[0] if high is None else high - wide
        high = low + wide if high is None else high
        if column.unit == "degC":
            low, high = max(low, usual[0]), min(high, usual[1])
            phase = 2 * np.pi * np.arange(run.size) / ROWS + run
            return 0.5 * (low + high) + 0.5 * (high - low) * np.sin(phase)
        if column.low is None or column.high is None:
            self.notes.append(
                f"column {column.name!r} declares no low and high: made up between {low:g} and {high:g} "
                f"{unit_label(column.unit or '1')}".rstrip()
                + ". Declare them, or give readings, if its range is another"
            )
        return random.uniform(low, high, run.size)

    def _fitted(self, model: Model, of: Sequence[Effect], kind: str) -> bool:
        """Simulate a model, fit it, and note what came back of some of its effects; whether it could be done."""
        names = ", ".join(e.name for e in of)
        try:
            self._round(model, of, kind)
        except BayescalError as error:
            self.errors.append(str(error) if names in str(error) else f"{names}: {error}")
        except Exception as error:  # of the author's functions: said, not shown as a traceback
            self.errors.append(f"{names or 'the response'} fails: {in_one_line(error)}")
        else:
            return True
        return False

    def _round(self, model: Model, of: Sequence[Effect], kind: str) -> None:
        model.require(self.readings)
        one = _Simulated(model, self.readings, of, self.seed)
        # The second of two: a seed stands for the readings that it always gave.
        key = jax.random.split(jax.random.fold_in(jax.random.key(self.seed), len(self.rows)))[1]
        drawn = forward.draw_readings(one.layout, one.frame, one.x, one.v, key)
        output, names = np.asarray(drawn), ", ".join(one.mine)
        variance = np.asarray(model.noise.variance(one.hyper, one.frame))
        self.noise = float(np.median(np.sqrt(variance)))
        if kind == "baseline":
            self._of_response(one)
        if not np.isfinite(output).all():
            raise ModelError(
                f"{names}: the output is not finite in {int((~np.isfinite(output)).sum())} of "
                f"{output.size} readings: is a logarithm, root or quotient out of its range?"
            )
        zero = self._zero_bases(one)
        made = self.readings.with_column("output", output)
        how: dict[str, Any] = {"seed": self.seed, "reference": one.reference, "strict": False}
        fitted = fit(model, made, LeastSquares(draws=300), **how)
        self._came_back(one, fitted, zero, kind)
        if kind == "baseline":
            self.notes += [f"baseline: {one}" for one in null_directions(fitted)]

    def _of_response(self, one: _Simulated) -> None:
        """Say which slots change no output.

        Raises:
            ModelError: none does.
        """
        by_slot = forward.slopes_by_slot(one.layout, one.frame, one.x, one.hyper)
        still = [s.name for s in self.instrument.slots if not np.any(np.asarray(by_slot[s.name]))]
        if len(still) == len(self.instrument.slots):
            raise ModelError(
                f"instrument {self.instrument.name!r}: the output is the same whatever its slots are "
                f"({', '.join(still)}): its response must take them, as slots['bias']"
            )
        self.notes += [f"slot {name!r} changes no output of these readings" for name in still]

    def _zero_bases(self, one: _Simulated) -> set[str]:
        """Coefficients whose basis is zero in every reading, each an error."""
        found = set()
        for b in (b for b in one.layout.blocks if b.effect.name in one.mine):
            shapes = {s.name: one.hyper[b.effect.shape_name(s)] for s in b.effect.shapes}
            if np.any(np.asarray(b.effect.evaluate(one.frame, shapes))[:, b.index]):
                continue
            found.add(b.name)
            columns = ", ".join(b.effect.columns) or "none"
            said = f"{b.name}: its basis is zero in every reading (its columns: {columns}). "
            if free := self.made_labels.intersection(b.effect.columns):
                made = ", ".join(sorted(free))
                self.notes.append(
                    f"{said}The labels of {made} are made up: declare them, allowed=(…), or give readings"
                )
            else:
                self.errors.append(
                    f"{said}Is a label written as in the file, and can the condition that it asks for occur?"
                )
        return found

    def _came_back(self, one: _Simulated, fitted: Calibration, zero: set[str], kind: str) -> None:
        """Note what came back of each coefficient, spread and shape."""
        x, jacobian = np.asarray(one.x), np.asarray(one.line.jacobian)

        def note(name: str, unit: str, adds, truth, draws, remark: str = "") -> None:
            mean, sd = float(draws.mean()), float(draws.std())
            self.rows.append(Returned(kind, name, unit, adds, truth, mean, sd, remark))

        for b in (b for b in one.layout.x_blocks if b.effect.name in one.mine):
            at, c, draws = slice(b.start, b.start + b.size), b.coefficient, fitted.samples(b.name)
            adds = float(np.max(c.size * np.abs(jacobian[:, at]), initial=0.0))
            if c.per is None:
                truth, remark = float(x[b.start]), self._remark(b.name, float(x[b.start]), draws)
                if b.name in zero:
                    remark = "its basis is zero"
                elif not c.flat and 1 - (draws.std() / c.size) ** 2 < IDENTIFIABLE_CONTRACTION:
                    remark = "not identifiable here"
                elif remark:
                    self.errors.append(remark)
                    remark = "did not come back"
                note(b.name, c.unit, adds, truth, draws, remark)
            else:
                spread = b.group_sd_name if c.group_sd is not None else None
                draws = fitted.samples(spread) if spread else draws.std(axis=1)
                truth = float(np.std(x[at] - c.mean)) if b.size > 1 else None
                name = spread or f"{b.name}, one a {c.per}"
                note(name, c.unit, adds, truth, draws, f"{b.size} of them")
            if b.name not in zero:
                found = off_scale(b.effect, adds, self.noise, self.instrument.unit)
                self.errors += map(str, found)
        for effect in (e for e in one.layout.model.effects if e.name in one.mine):
            for shape in effect.shapes:
                name, truth = effect.shape_name(shape), float(shape.prior.value(0.0))
                note(name, shape.unit, None, truth, fitted.samples(name))
        if not fitted.verdict.ok:
            self.notes.append(f"{', '.join(sorted(one.mine))}: {' '.join(fitted.verdict.reasons)}")

    def _remark(self, name: str, truth: float, draws: np.ndarray) -> str:
        """Return why a coefficient has not come back; empty where it has."""
        mean, sd = float(draws.mean()), float(draws.std())
        if abs(mean - truth) <= BACK_SD * sd:
            return ""
        return f"{name} did not come back: {number(truth)} simulated, {with_error(mean, sd)} found"


class _Simulated:
    """A model on readings, its coefficients one plausible size from their means, up and down in turn; of groups, drawn.

    Attributes:
        mine: names of the effects in question.
        x, v, hyper: coefficients, φ at the middle of its priors.
        line: the output linearised there.
    """

    def __init__(self, model: Model, readings: Measurements, of: Sequence[Effect], seed: int):
        self.mine, self.reference = {e.name for e in of}, reference_of(readings)
        self.frame = frame = build_frame(readings, self.reference)
        self.layout = layout = bind(model, readings)[0]
        self.v = jnp.zeros(len(layout.hypers))
        self.hyper = hyper = forward.hyper_values(layout, self.v)
        random, signs = np.random.default_rng(seed + 1), np.ones(layout.size)
        for n, b in enumerate(layout.x_blocks):
            one = b.coefficient.per is None
            drawn = 1 - 2 * (n % 2) if one else random.standard_normal(b.size)
            signs[b.start : b.start + b.size] = drawn
        self.x = x = forward.prior_mean(layout) + forward.prior_sd(layout, hyper) * signs
        self.line = forward.linearise(layout, frame, x, hyper)
