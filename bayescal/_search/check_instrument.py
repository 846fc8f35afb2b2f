"""Self-check of an instrument: recovery of parameters from readings simulated at its plausible sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from bayescal._calibration.fit import fit
from bayescal._calibration.judgement import check_scale
from bayescal._calibration.summary import null_directions
from bayescal._core.errors import BayescalError, ModelError
from bayescal._core.formatting import format_value, number
from bayescal._core.lazy_jax import jax, jnp
from bayescal._core.progress import track
from bayescal._core.result_table import Printed, ResultTable, TableColumn
from bayescal._data.measurements import Measurements
from bayescal._data.unit_conversion import ANY, unit_label
from bayescal._inference.least_squares import LeastSquares
from bayescal._model import forward
from bayescal._model.effect import Effect
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.instrument import Instrument
from bayescal._model.model import Model, why_untestable
from bayescal._model.parameters import Unknowns, bind
from bayescal._search.own_files import format_error

MAX_ERROR_SD = 4.0  # deviation from the true value beyond which a coefficient is not recovered
IDENTIFIABLE_CONTRACTION = 0.6  # not identifiable below it; two collinear ones have a half each
KINDS = ("candidate", "baseline")


class Recovery(NamedTuple):
    """True and estimated value of one unknown, in its unit; `adds`: its largest contribution, output unit."""

    name: str
    kind: str  # "baseline", or "candidate": fitted with the baseline
    unit: str
    adds: float | None = None
    truth: float | None = None
    mean: float | None = None  # posterior mean; None if it could not be fitted
    sd: float | None = None
    remark: str = ""  # empty if recovered


@dataclass(repr=False)
class InstrumentCheck(Printed):
    """True and recovered values of an instrument's unknowns, with errors: the result of `check_instrument`."""

    instrument: str
    unit: str  # unit of the output
    noise: float = 0.0  # simulated standard deviation, output unit
    rows: list[Recovery] = field(default_factory=list)  # one per unknown
    errors: list[str] = field(default_factory=list)  # one sentence each
    notes: list[str] = field(default_factory=list)  # one sentence each

    @property
    def ok(self) -> bool:
        """Return whether the check found no error."""
        return not self.errors

    def _list_parts(self) -> list[str | ResultTable]:
        def format_estimate(row: dict[str, Any]) -> str:
            return "–" if row["mean"] is None else format_value(row["mean"], row["sd"])

        unit = unit_label(self.unit)
        columns = (
            TableColumn("unknown", "name", name="name"),
            TableColumn("adds at most", "adds", number, unit or "1", name="adds"),
            TableColumn("simulated", "truth", number, name="truth"),
            TableColumn("estimated", format_estimate, name=""),
            *(TableColumn(name, format=None) for name in ("kind", "mean", "sd")),
            TableColumn("unit", "unit", unit_label),
            TableColumn("remark", "remark"),
        )
        tables = [ResultTable(columns, self.to_json_data()["rows"], width=24)] if self.rows else []
        messages = [f"error: {e}" for e in self.errors] + [f"note: {n}" for n in self.notes]
        error_text = f"{len(self.errors)} error(s)" if self.errors else "no error"
        summary = f"{self.instrument}, with noise of {number(self.noise)} {unit}".rstrip()
        return [*tables, *messages, f"{summary}: {error_text}"]

    def _format_summary(self) -> str:
        return f"{self.instrument}: {len(self.rows)} unknowns, {len(self.errors)} errors"

    def to_json_data(self) -> dict[str, Any]:
        """Return all results as JSON-serialisable data."""
        return {**vars(self), "rows": [row._asdict() for row in self.rows], "ok": self.ok}


def check_instrument(
    instrument: Instrument, readings: Measurements | None = None, *, seed: int = 0
) -> InstrumentCheck:
    """Check parameter recovery: simulate an instrument at its plausible sizes, fit it, and compare with true values.

    The baseline is simulated with the noise that its law expects and fitted, then the baseline with each candidate.

    Args:
        instrument: the instrument.
        readings: readings whose columns, except the output, are used; simulated by the instrument if not given.
        seed: seed of the random-number generator.

    Raises:
        ModelError: the instrument has no simulator, or takes its unit from readings, and none are given.
    """
    if readings is not None:
        instrument = instrument.for_readings(readings)
    elif instrument.unit == ANY or instrument.simulator is None:
        fault_text = (
            "has no simulator" if instrument.simulator is None else "takes its unit from readings"
        )
        cure = "give readings (--readings FILE, in Python readings=)"
        raise ModelError(f"instrument {instrument.name!r} {fault_text}: {cure}")
    check = InstrumentCheck(instrument.name, instrument.unit)
    readings = instrument.simulate({}, seed=seed) if readings is None else readings
    baseline = Model(instrument, instrument.effects, instrument.noise)
    trials = [(baseline, instrument.effects)]
    trials += [(baseline + e, (e,)) for e in instrument.candidates]
    with track(f"checking {instrument.name}"):
        for model, effects in trials:
            is_baseline, names = model is baseline, ", ".join(e.name for e in effects)
            if not is_baseline and (reason := why_untestable(effects[0], readings)) is not None:
                unit, remark = effects[0].coefficients[0].unit, f"not tested, {reason}"
                check.rows.append(Recovery(names, KINDS[False], unit, remark=remark))
                continue
            try:
                _fit_simulated(check, model, effects, readings, seed)
            except Exception as error:  # of an author's function: reported without a traceback
                is_author_error = not isinstance(error, BayescalError)
                message = f" fails: {format_error(error)}" if is_author_error else f": {error}"
                check.errors.append((names or "the response") + message)
                if is_baseline:
                    break
    check.errors, check.notes = [*dict.fromkeys(check.errors)], [*dict.fromkeys(check.notes)]
    return check


def _fit_simulated(
    check: InstrumentCheck,
    model: Model,
    effects: Sequence[Effect],
    readings: Measurements,
    seed: int,
) -> None:
    """Simulate readings, with coefficients at mean ± plausible size in turn and random group members, and fit them."""
    model.require(readings)
    reference, is_baseline = reference_of(readings), len(effects) == len(model.effects)
    frame, (layout, levels) = build_frame(readings, reference), bind(model, readings)
    v = jnp.zeros(len(layout.hypers))
    hyper, rng, signs = layout.hyper(v), np.random.default_rng(seed + 1), np.ones(layout.size)
    for n, b in enumerate(layout.x_blocks):
        is_single = b.coefficient.per is None
        signs[b.x_slice] = 1 - 2 * (n % 2) if is_single else rng.standard_normal(b.size)
    x = layout.mean_of_x + forward.prior_sd(layout, hyper) * signs
    random_key = jax.random.fold_in(jax.random.key(seed), len(check.rows))
    output = np.asarray(forward.draw_readings(layout, frame, x, v, random_key))
    check.noise = float(np.median(np.sqrt(np.asarray(model.noise.variance(hyper, frame)))))
    if count := int((~np.isfinite(output)).sum()):
        cause = "a logarithm, root or quotient is outside its domain"
        raise ModelError(f"the output is not finite in {count} of {output.size} readings: {cause}")
    options: dict[str, Any] = {"seed": seed, "reference": reference, "strict": False}
    fitted = fit(model, readings.with_column("output", output), LeastSquares(draws=300), **options)
    slopes = np.abs(forward.linearise(layout, frame, x, hyper).jacobian)
    unknowns = Unknowns.of(layout, levels)
    values, names = unknowns.values(np.asarray(x), np.asarray(v)), {e.name for e in effects}
    for name, rows in unknowns.by_key.items():
        (u, *other_members), contribution, remark = unknowns.rows[rows], None, ""
        if u.effect not in names or u.kind == "group_sd":
            continue
        truth, draws = unknowns.select(values, name), fitted.samples(name)
        if u.group is not None:
            truth, draws = np.std(truth), np.std(draws, axis=1)
            remark = f"{1 + len(other_members)} members"
        truth, mean, sd = float(truth), float(draws.mean()), float(draws.std())
        if (b := u.block) is not None:
            c, contribution = b.coefficient, float(slopes[:, b.x_slice].max(initial=0.0))
            contribution *= c.size
            check.errors += check_scale(b.effect, contribution, check.noise, check.unit)
            if contribution == 0.0:
                remark = "changes no reading"
                check.errors.append(
                    f"{name} {remark}: its basis is zero (a label is absent from the file, or not declared by "
                    f"allowed=(…); columns: {', '.join(b.effect.columns) or 'none'}), or the response does not use "
                    f"slots[{b.slot!r}]"
                )
            elif remark == "" and not c.flat and 1 - (sd / c.size) ** 2 < IDENTIFIABLE_CONTRACTION:
                remark = "not identifiable here"
            elif remark == "" and abs(mean - truth) > MAX_ERROR_SD * sd:
                remark = "not recovered"
                values_text = f"{number(truth)} simulated, {format_value(mean, sd)} estimated"
                check.errors.append(f"{name} {remark}: {values_text}")
        name, kind = name + f", one per {u.group}" * (u.group is not None), KINDS[is_baseline]
        check.rows.append(Recovery(name, kind, u.unit, contribution, truth, mean, sd, remark))
    if not fitted.verdict.ok:
        check.notes.append(f"{', '.join(sorted(names))}: {' '.join(fitted.verdict.reasons)}")
    if is_baseline:
        check.notes += [f"baseline, not measured: {claim}" for claim in null_directions(fitted)]
