"""Frames, the arguments of basis functions: readings as arrays, with group codes and quantities derived from time.

A frame is built once from measurements and a reference. The reference holds the constants of basis functions (T0, mean
time, time span), which are stored at the fit and never recomputed on new readings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bayescal._core.errors import ModelError
from bayescal._core.lazy_jax import Array, jax, on_import
from bayescal._core.renamed import renamed
from bayescal._core.xp import is_traced, xp
from bayescal._data.column import UNCERTAINTY
from bayescal._data.measurements import Measurements
from bayescal._data.pose_rows import ACROSS
from bayescal._data.records import solve_recursion

# groups of every data set; label columns of an instrument are further groups
GROUPS = ("run", "cell", "axis", "device")
NEVER_STEPPED = ("output", UNCERTAINTY, "time", "temperature_point")  # not set in steps
ROW_FIELDS = ("columns", "labels", "rates", "codes", "record", "path")  # dictionaries of arrays
PATH = " path"  # suffix of a column replaced as a whole time series, as temperature by that of a lagging body
Reference = dict[str, float | dict[str, float]]


@renamed(only="select_columns", moved="shift_columns", reordered="reorder", silence="max_gap")
@renamed(behind="recorded_lag", in_time="sort_by_time")
@dataclass(frozen=True, eq=False)
class Frame:
    """Readings as the argument of basis functions, with all columns in the instrument's fixed units.

    Arrays are JAX arrays in a compiled program, NumPy arrays otherwise.

    Attributes:
        columns: measured columns, (n,) each; outputs are relative to their origin.
        labels: indicator (n,) of each label of a text column that is not a group, by "column=label": 1 or 0.
        rates: causal slope of each temperature column, °C/s, (n,) each.
        codes: index of each reading's member of a group (n,), by group; −1 where it belongs to none.
        reference: reference constants of basis functions, such as T0, by name.
        order: permutation that sorts the readings by run and time.
        step: time since the previous reading of the same run, in sorted order, s; −1 at the first of a run.
        record: the columns as measured, without corrections.
        max_gap: longest time between readings over which a temperature is interpolated, s.
        path: time series that replace a measured column, such as a body's temperature, (*s, n) each.
    """

    columns: dict[str, Float[Any, "n"]]
    labels: dict[str, Float[Any, "n"]]
    rates: dict[str, Float[Any, "n"]]
    codes: dict[str, Int[Any, "n"]]
    reference: dict[str, Float[Any, ""]]
    order: Int[Any, "n"]
    step: Float[Any, "n"]
    record: dict[str, Float[Any, "n"]]
    max_gap: Float[Any, ""]
    path: dict[str, Float[Any, "*s n"]] = field(default_factory=dict)

    @property
    def size(self) -> int:
        return self.order.shape[-1]

    def __getitem__(self, name: str) -> Float[Array, "n"]:
        return self.columns[name]

    def centred(self, name: str = "temperature") -> Float[Array, "n"]:
        """Return a column minus its reference value (T0, or the middle of its range); raise ModelError without one."""
        constant, low, high = name_reference(name), f"{name}_low", f"{name}_high"
        if constant in self.reference:
            return self.columns[name] - self.reference[constant]
        if low not in self.reference:
            raise ModelError(f"column {name!r} is not numeric; numeric: {', '.join(self.columns)}")
        return self.columns[name] - 0.5 * (self.reference[low] + self.reference[high])

    def has_label(self, name: str, label: str) -> Float[Array, "n"]:
        """Return the indicator (n,) of `label` in the text column `name`: 1 where it has this label, 0 elsewhere.

        Raises:
            ModelError: the column is numeric, or a group of every instrument ("run", "device", …).
        """
        if name in GROUPS or name in self.columns:
            reason = "is a group" if name in GROUPS else "holds numbers"
            raise ModelError(
                f"has_label({name!r}, {label!r}): {name!r} {reason}; only other label columns have indicators. Give "
                f"the coefficient per={name!r} for one value per member, or record the label in a separate column"
            )
        return self.labels.get(f"{name}={label}", np.zeros(self.size))

    def position(self, name: str) -> Float[Array, "n"]:
        """Return a covariate (a column, or "temperature rate") scaled to 0 … 1 over its range at the fit (n,)."""
        values = self.columns[name] if name in self.columns else self.rates[strip_rate(name)]
        low, high = self.reference[f"{name}_low"], self.reference[f"{name}_high"]
        span = high - low
        return (values - low) / (span + (span <= 0))  # span 1 where it does not vary

    def rate(self, name: str = "temperature") -> Float[Array, "n"]:
        """Return dT/dt, the causal least-squares slope within the run, °C/s; raise ModelError if it has none."""
        if name not in self.rates:
            raise ModelError(
                f"the column {name!r} has no rate: columns in [degC] have one if there is a time column (here: "
                f"{', '.join(self.rates) or 'none'})"
            )
        return self.rates[name]

    @property
    def elapsed(self) -> Float[Array, "n"]:
        """Return the time since the start of the run, s."""
        return self.columns["elapsed"]

    @property
    def progress(self) -> Float[Array, "n"]:
        """Return the time (t − t̄)/(tmax − tmin), relative to the readings of the fit."""
        return (self.columns["time"] - self.reference["time_mean"]) / self.reference["time_span"]

    def lag(self, tau: Float[Array, ""], name: str = "temperature") -> Float[Array, "n"]:
        """Return T̃ − T, °C, where τ·dT̃/dt = T − T̃ and T̃ equals T at the first reading of each run.

        T is linear between readings, or constant from each to the next if set in steps (reference constant "…_held"
        is 1); the recursion is exact for both. In a gap longer than `max_gap` (a soak before a tumble) T is assumed
        to change at the gap's start; after a ramp over the gap, T̃ would lag by the rate times τ instead. T̃ is computed
        from the recorded column: a correction (the thermometer's error) changes T at its reading only.
        """
        return self.recorded_lag(tau, name) + (self.record[name] - self.columns[name])

    def recorded_lag(self, tau: Float[Array, ""], name: str = "temperature") -> Float[Array, "n"]:
        """Return the lag T̃ − T, °C, of the recorded column without corrections; equation as in `lag`."""
        values = self.record[name][self.order]
        changes = xp.diff(values, prepend=values[:1])
        is_held = xp.asarray(self.reference.get(name_hold_flag(name), 0.0)) > 0
        step, step_index = (self.step, None) if is_traced(self.step) else self._distinct_steps
        is_first, no_step = step < 0, step == 0
        ratio = xp.where(is_first | no_step, 1.0, step / tau)
        decay = xp.where(is_first, 0.0, xp.where(no_step, 1.0, xp.exp(-ratio)))
        linear_gain = xp.where(step > self.max_gap, -decay, xp.expm1(-ratio) / ratio)
        gain = xp.where(is_first, 0.0, xp.where(no_step | is_held, -1.0, linear_gain))
        if step_index is not None:
            decay, gain = (xp.take(a, step_index, axis=-1) for a in (decay, gain))
        return xp.scatter(self.order, run_recursion(decay, changes * gain))

    @cached_property
    def _distinct_steps(self) -> tuple[Float[np.ndarray, "u"], Any]:
        """Return the distinct time steps and each reading's index among them, or all steps and None if most differ."""
        steps, index = np.unique(self.step, return_inverse=True)
        return (steps, index) if 2 * len(steps) < self.size else (self.step, None)

    def direction(
        self, width: Float[Array, ""], name: str = "temperature"
    ) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
        """Return a column's direction of change, −1 … 1, which reverses within `width`, and the initial state's decay.

        Dahl's hysteresis, dD/dT = (sign(dT) − D)/width from 0 at a run's first reading, exact between readings and
        independent of the rate of change. Its input is the recorded column, or a lagging body's temperature.
        Source: P. Dahl, A solid friction model (The Aerospace Corporation, TOR-0158(3107-18)-1, 1968).
        """
        values, is_first = self.path.get(name, self.record[name])[..., self.order], self.step < 0
        change = xp.where(is_first, 0.0, xp.diff(values, prepend=values[..., :1]))
        decay = xp.where(is_first, 0.0, xp.exp(-xp.abs(change) / width))
        direction = run_recursion(decay, xp.where(is_first, 0.0, (1.0 - decay) * xp.sign(change)))
        initial_state_decay = run_recursion(decay, xp.where(is_first, 1.0, 0.0))
        return xp.scatter(self.order, direction), xp.scatter(self.order, initial_state_decay)

    def select_columns(self, names: Sequence[str]) -> Frame:
        """Return a frame of named columns and known uncertainty, with rates and constants; "time" adds "elapsed"."""
        columns = {*names, UNCERTAINTY} | ({"elapsed"} if "time" in names else set())
        arrays = {
            field: {n: values for n, values in getattr(self, field).items() if n in columns}
            for field in ("columns", "rates", "record")
        }
        prefixes = (*columns, *map(name_reference, columns))
        reference = {n: value for n, value in self.reference.items() if n.startswith(prefixes)}
        return replace(self, **arrays, labels={}, codes={}, reference=reference)

    def reorder(self, rows: Any, order: Any, step: Any) -> Frame:
        """Return a frame of selected rows; `order` and `step` are those of the frame returned."""
        sorted_arrays = {n: {k: a[rows] for k, a in getattr(self, n).items()} for n in ROW_FIELDS}
        return replace(self, **sorted_arrays, order=order, step=step)

    def sort_by_time(self) -> Frame:
        """Return a frame with the readings sorted by time within runs."""
        order = self.order
        identity = xp.arange(self.size, dtype=order.dtype)
        return self.reorder(order, identity, self.step)

    def shift_columns(self, shifts: Mapping[str, Float[Array, "n"]]) -> Frame:
        """Return a frame with corrections added to columns; a name with suffix `PATH` also replaces the time series."""
        columns, path = dict(self.columns), dict(self.path)
        for name, shift in shifts.items():
            column = name.removesuffix(PATH)
            columns[column] = columns[column] + shift
            if column != name:
                path[column] = self.record[column] + shift
        return replace(self, columns=columns, path=path) if shifts else self


on_import(lambda: jax.tree_util.register_dataclass(Frame, [f.name for f in fields(Frame)], []))


def run_recursion(decay: Float[Any, "*s n"], forcing: Float[Any, "*s n"]) -> Float[Any, "*s n"]:
    """Return the states x of the linear recursion x ← decay·x + forcing over the readings, from x = 0 (*s, n)."""
    if is_traced((decay, forcing)):

        def advance(state, row):
            state = row[0] * state + row[1]
            return state, state

        # One small loop rather than an associative scan, which takes ten times as long to compile.
        return xp.scan(advance, xp.zeros_like(decay[0]), (decay, forcing))
    return solve_recursion(decay, forcing)


def list_covariates(readings: Measurements, include_all: bool = False) -> dict[str, np.ndarray]:
    """Return possible covariates by name: numeric columns except the output, time in the run, temperature rates.

    Columns that are declared not to be causes are omitted unless `include_all`.
    """
    exclusions = {"output", "output_uncertainty", "temperature_point"}
    exclusions |= set() if include_all else readings.no_causes
    columns = {n: readings[n] for n in readings.columns if readings.unit(n) and n not in exclusions}
    if readings.has("time"):
        columns |= {f"{n} rate": rate for n, rate in readings.rates.items() if n not in exclusions}
        if len(readings.records.names) > 1:
            columns["elapsed"] = readings.records.elapsed()
    return columns


def strip_rate(covariate: str) -> str:
    """Return the column of a covariate: "temperature" for "temperature rate", otherwise the covariate itself."""
    return covariate.removesuffix(" rate")


def list_covariate_columns(covariate: str) -> tuple[str, ...]:
    """Return the columns of the readings that a covariate is computed from: a column, "elapsed" or a rate."""
    if covariate == "elapsed":
        return ("time",)
    column = strip_rate(covariate)
    return (column,) if column == covariate else (column, "time")


def name_reference(column: str) -> str:
    names = {"temperature": "T0", "lab_temperature": "L0", "supply_voltage": "V0"}
    return names.get(column, f"{column}_0")


def name_hold_flag(column: str) -> str:
    return f"{column}_held"


def reference_of(readings: Measurements) -> Reference:
    """Return the reference constants of basis functions on these readings: T0, L0, mean time, time span, ranges."""
    scalars: Reference = {}
    for name in readings.columns:
        if readings.unit(name) == "degC" and name != "temperature_point":
            scalars[name_reference(name)] = _round_mean(readings[name])
    for name, values in list_covariates(readings, include_all=True).items():
        scalars[f"{name}_low"], scalars[f"{name}_high"] = float(values.min()), float(values.max())
    if readings.has("time"):
        time = readings["time"]
        scalars["time_mean"] = float(np.mean(time))
        scalars["time_span"] = float(np.ptp(time)) or 1.0
        for name in (n for n in readings.columns if readings.unit(n) and n not in NEVER_STEPPED):
            is_temperature = readings.unit(name) == "degC"  # a temperature varies between readings
            is_held = not is_temperature and readings.records.is_set_in_steps(readings[name])
            scalars[name_hold_flag(name)] = float(is_held)
    return scalars


def list_constant_names(readings: Measurements) -> set[str]:
    """Return the names of all reference constants that basis functions can use on these readings."""
    names = {name_reference(n) for n in readings.columns if readings.unit(n)}
    return names | {n for n, value in reference_of(readings).items() if not isinstance(value, dict)}


def _round_mean(values: np.ndarray) -> float:
    """Return the mean, rounded to the fewest decimal places with an error below 0.1 standard deviations."""
    low, high, limit = values.min(), values.max(), 0.1 * values.std()
    mean = np.clip(values.mean(), low, high)
    candidates = (np.round(mean, places) for places in range(16))
    return float(next((r for r in candidates if abs(r - mean) <= limit and low <= r <= high), mean))


def build_frame(
    readings: Measurements,
    reference: Reference,
    levels: Mapping[str, tuple[str, ...]] | None = None,
    record: Measurements | None = None,
) -> Frame:
    """Build the frame of readings with the reference constants of the fit.

    levels: members of each group at the fit, others get the code −1; None: the members in these readings.
    record: the fitted readings, whose runs these readings may continue.
    """
    units = {name: readings.unit(name) for name in readings.columns if name != "temperature_point"}
    columns = {name: np.asarray(readings[name]) for name in units if units[name] is not None}
    columns, scalars = _subtract_origins(columns, reference)
    label_pairs = ((n, label) for n in label_groups(readings) for label in readings.groups(n)[0])
    labels = {f"{n}={label}": np.asarray(readings[n] == label, float) for n, label in label_pairs}
    records = readings.records
    if readings.has("time"):
        columns["elapsed"] = records.elapsed(None if record is None else record.records)
    groups = dict.fromkeys((*GROUPS, *label_groups(readings), *(levels or ())))
    return Frame(
        columns=columns,
        labels=labels,
        rates=dict(readings.rates),
        codes={group: _encode_members(readings, group, levels) for group in groups},
        reference={k: np.asarray(v) for k, v in scalars.items()},
        order=np.asarray(records.order, dtype=np.int32),
        step=records.step,
        record=dict(columns),
        max_gap=np.asarray(records.max_gap),
    )


def select_origins(reference: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the origins subtracted from outputs, output unit: reference constant → coefficient → origin."""
    return {n: v for n, v in reference.items() if isinstance(v, dict)}


def _subtract_origins(
    columns: Mapping[str, np.ndarray], reference: Reference
) -> tuple[dict[str, np.ndarray], Mapping[str, float]]:
    """Subtract origins from output columns and their ranges, and from an output computed from three axes."""
    names = {name_reference(n): n for n in columns}
    offsets = {names[n]: sum(parts.values()) for n, parts in select_origins(reference).items()}
    outputs = {n: columns[n] - origin for n, origin in offsets.items()}
    scalars = {n: v for n, v in reference.items() if not isinstance(v, dict)}
    for name, origin in offsets.items():
        range_names = (n for n in (f"{name}_low", f"{name}_high") if n in scalars)
        scalars |= {n: scalars[n] - origin for n in range_names}
    if outputs and "output" not in outputs:
        length = np.linalg.norm(np.array([*outputs.values()]), axis=0)
        projections = np.array([columns.get(n, 0 * length) for n in ACROSS])
        projected_output = columns["output"] - np.array([*offsets.values()]) @ projections
        outputs["output"] = np.where(np.any(projections != 0, axis=0), projected_output, length)
    return {**columns, **outputs}, scalars


def label_groups(readings: Measurements) -> list[str]:
    """Return the label columns that are groups declared by the instrument, such as "station"."""
    return [n for n in readings.columns if readings.unit(n) is None and n not in GROUPS]


def _encode_members(
    readings: Measurements, group: str, levels: Mapping[str, tuple[str, ...]] | None
) -> Int[np.ndarray, "n"]:
    """Return the index of each reading's group member (n,), numbered as at the fit; −1 for a new member."""
    if group not in GROUPS and not readings.has(group):  # every reading is of a new member
        return np.full(len(readings), -1, dtype=np.int8)
    members, codes = readings.groups(group)
    if levels is not None:
        fitted_members = levels.get(group, ())
        code_by_member = {level: i for i, level in enumerate(fitted_members)}
        codes = np.array([code_by_member.get(level, -1) for level in members] + [-1])[codes]
        members = fitted_members
    integer_type = np.min_scalar_type(-len(members) - 1)  # the smallest integer type
    return codes.astype(integer_type)
