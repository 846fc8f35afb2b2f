"""The self-check of an instrument: simulated at its own plausible sizes, fitted, and what came back.

It finds what an author cannot see in the file: a basis that is zero, an output that no slot changes, a size that is
lost in the noise, coefficients that no readings could tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayescal._calibration.fit import fit
from bayescal._calibration.judgement import off_scale
from bayescal._calibration.summary import null_directions
from bayescal._core.errors import BayescalError, ModelError
from bayescal._core.formatting import number, with_error
from bayescal._core.lazy_jax import jax, jnp
from bayescal._core.progress import stage
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY, unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._model import forward
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, testable
from bayescal._model.parameters import bind
from bayescal._model.unknowns import Unknowns
from bayescal._search.own_files import in_one_line

BACK_SD = 4.0  # from its true value, beyond which a coefficient has not come back
IDENTIFIABLE_CONTRACTION = 0.6  # below it is not identifiable; two that are one have a half each


@dataclass(frozen=True)
class Recovery:
    """One unknown as it was simulated and as it was found.

    Attributes:
        kind: "baseline", or "candidate": fitted beside the baseline.
        name, unit: of the unknown.
        adds: the most that it adds to the output at its plausible size, output unit.
        truth: that was simulated.
        mean, sd: of its posterior; None where it could not be fitted.
        remark: what is to be known of it; empty where it came back.
    """

    kind: str
    name: str
    unit: str
    adds: float | None = None
    truth: float | None = None
    mean: float | None = None
    sd: float | None = None
    remark: str = ""


@dataclass(repr=False)
class InstrumentCheck(Printed):
    """What `check_instrument` finds.

    Attributes:
        instrument: its name.
        unit: of the output.
        noise: that was simulated, output unit.
        rows: each unknown.
        errors: what is wrong with the instrument, a sentence each.
        notes: what is to be known of it.
    """

    instrument: str
    unit: str
    noise: float = 0.0
    rows: list[Recovery] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.errors

    def _parts(self) -> list[str | ResultTable]:
        def came_back(row: Mapping[str, Any]) -> str:
            return "–" if row["mean"] is None else with_error(row["mean"], row["sd"] or 0.0)

        unit = unit_label(self.unit)
        columns = (
            TableColumn("unknown", "name"),
            TableColumn("adds at most", "adds", number, unit or "1"),
            TableColumn("simulated", "truth", number),
            TableColumn("came back", came_back),
            TableColumn("unit", "unit", unit_label),
            TableColumn("remark", "remark"),
        )
        shown = [ResultTable(columns, [vars(r) for r in self.rows], fold=24)] if self.rows else []
        said = [f"error: {e}" for e in self.errors] + [f"note: {n}" for n in self.notes]
        many = f"{len(self.errors)} error(s)" if self.errors else "no error"
        end = f"{self.instrument}, with noise of {number(self.noise)} {unit}".rstrip()
        return [*shown, *said, f"{end}: {many}"]

    def _brief(self) -> str:
        return f"{self.instrument}: {len(self.rows)} unknowns, {len(self.errors)} errors"

    def _columns(self) -> dict[str, list[Any]]:
        names = ("name", "kind", "unit", "adds", "truth", "mean", "sd", "remark")
        return {name: [getattr(row, name) for row in self.rows] for name in names}

    def data(self) -> dict[str, Any]:
        """As JSON."""
        return {**vars(self), "rows": [vars(row) for row in self.rows], "ok": self.ok}


def check_instrument(
    instrument: Instrument, readings: Measurements | None = None, *, seed: int = 0
) -> InstrumentCheck:
    """Simulate an instrument at its own plausible sizes, fit it by least squares, and say what came back.

    The baseline is fitted with the noise that its law expects, then each candidate beside it.

    Args:
        instrument: the instrument.
        readings: of which the columns are taken, the output aside; those of its simulator, if not given.
        seed: of every random number.

    Raises:
        ModelError: the instrument has no simulator, or takes its unit from readings, and there are none.
    """
    if readings is not None:
        instrument = instrument.for_readings(readings)
    elif instrument.unit == ANY or instrument.simulator is None:
        raise ModelError(
            f"instrument {instrument.name!r} has no simulator, or takes its unit from readings: give some (--readings "
            "FILE, in Python readings=)"
        )
    found = InstrumentCheck(instrument.name, instrument.unit)
    readings = instrument.simulate({}, seed=seed) if readings is None else readings
    baseline = Model(instrument, instrument.effects, instrument.noise)
    trials = [("baseline", baseline, instrument.effects)]
    trials += [("candidate", baseline + e, (e,)) for e in instrument.candidates]
    with stage(f"checking {instrument.name}"):
        for kind, model, of in trials:
            names = ", ".join(e.name for e in of)
            if kind == "candidate" and (reason := testable(of[0], readings)) is not None:
                unit, remark = of[0].coefficients[0].unit, f"not tested, {reason}"
                found.rows.append(Recovery(kind, names, unit, remark=remark))
                continue
            try:
                _recover(found, model, {e.name for e in of}, kind, readings, seed)
                continue
            except BayescalError as error:
                found.errors.append(f"{names or 'the response'}: {error}")
            except Exception as error:  # of the author's functions: said, not shown as a traceback
                found.errors.append(f"{names or 'the response'} fails: {in_one_line(error)}")
            if kind == "baseline":
                break
    found.errors, found.notes = ([*dict.fromkeys(one)] for one in (found.errors, found.notes))
    return found


def _recover(
    found: InstrumentCheck,
    model: Model,
    mine: set[str],
    kind: str,
    readings: Measurements,
    seed: int,
) -> None:
    """Simulate coefficients one plausible size from their means, up and down in turn, those of groups drawn; fit them.

    Raises:
        BayescalError: it cannot be simulated or fitted.
    """
    model.require(readings)
    reference = reference_of(readings)
    frame, (layout, levels) = build_frame(readings, reference), bind(model, readings)
    v = jnp.zeros(len(layout.hypers))
    hyper = forward.hyper_values(layout, v)
    random, signs = np.random.default_rng(seed + 1), np.ones(layout.size)
    for n, b in enumerate(layout.x_blocks):
        alone = b.coefficient.per is None
        signs[b.start : b.start + b.size] = (
            1 - 2 * (n % 2) if alone else random.standard_normal(b.size)
        )
    x = forward.prior_mean(layout) + forward.prior_sd(layout, hyper) * signs
    # The second of two: a seed stands for the readings that it always gave.
    key = jax.random.split(jax.random.fold_in(jax.random.key(seed), len(found.rows)))[1]
    output = np.asarray(forward.draw_readings(layout, frame, x, v, key))
    found.noise = float(np.median(np.sqrt(np.asarray(model.noise.variance(hyper, frame)))))
    if kind == "baseline":
        slopes = forward.slopes_by_slot(layout, frame, x, hyper)
        unused = [s.name for s in model.instrument.slots if not np.any(np.asarray(slopes[s.name]))]
        if len(unused) == len(model.instrument.slots):
            raise ModelError(
                f"instrument {found.instrument!r}: the output is the same whatever its slots are "
                f"({', '.join(unused)}): its response must take them, as slots['bias']"
            )
        found.notes += [f"slot {name!r} changes no output of these readings" for name in unused]
    if bad := int((~np.isfinite(output)).sum()):
        raise ModelError(
            f"the output is not finite in {bad} of {output.size} readings: is a logarithm, root or quotient out of its "
            "range?"
        )
    how: dict[str, Any] = {"seed": seed, "reference": reference, "strict": False}
    fitted = fit(model, readings.with_column("output", output), LeastSquares(draws=300), **how)
    jacobian = np.asarray(forward.linearise(layout, frame, x, hyper).jacobian)
    unknowns = Unknowns.of(layout, levels)
    values = unknowns.values(np.asarray(x), np.asarray(v))
    for name, at in unknowns.by_key.items():
        u, *others = unknowns.rows[at]
        if u.effect not in mine or u.kind == "group_sd":
            continue
        truth, draws = unknowns.select(values, name), fitted.samples(name)
        adds, remark = None, ""
        if (b := u.block) is not None and b.place == "x":
            adds = b.coefficient.size * np.abs(jacobian[:, b.start : b.start + b.size])
            adds = float(np.max(adds, initial=0.0))
            shapes = {s.name: hyper[b.effect.shape_name(s)] for s in b.effect.shapes}
            if not np.any(np.asarray(b.effect.evaluate(frame, shapes))[:, b.index]):
                remark = "its basis is zero"
                found.errors.append(
                    f"{name}: its basis is zero in every reading (its columns: "
                    f"{', '.join(b.effect.columns) or 'none'}). Is a label written as in the file, and declared, "
                    "allowed=(…)? Can the condition that it asks for occur?"
                )
            else:
                found.errors += off_scale(b.effect, adds, found.noise, found.unit)
        if u.group is not None:
            truth, draws = np.std(truth), np.std(draws, axis=1)
            name, remark = f"{name}, one a {u.group}", f"{1 + len(others)} of them"
        truth, mean, sd = float(truth), float(draws.mean()), float(draws.std())
        if b is not None and u.group is None and not remark:
            if (
                not b.coefficient.flat
                and 1 - (sd / b.coefficient.size) ** 2 < IDENTIFIABLE_CONTRACTION
            ):
                remark = "not identifiable here"
            elif abs(mean - truth) > BACK_SD * sd:
                remark = "did not come back"
                came = f"{number(truth)} simulated, {with_error(mean, sd)} found"
                found.errors.append(f"{name} {remark}: {came}")
        found.rows.append(Recovery(kind, name, u.unit, adds, truth, mean, sd, remark))
    if not fitted.verdict.ok:
        found.notes.append(f"{', '.join(sorted(mine))}: {' '.join(fitted.verdict.reasons)}")
    if kind == "baseline":
        found.notes += [f"baseline: {one}" for one in null_directions(fitted)]
