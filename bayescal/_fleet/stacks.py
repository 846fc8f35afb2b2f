"""Frames of many devices stacked, so that one compiled program sees them all.

A table without time and without groups becomes a stack of frames by a few array operations; else frames are built
one by one. Devices with other numbers of readings are padded to a common one; a padded reading repeats the last
and counts nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.errors import BayescalError
from bayescal._data.column import UNCERTAINTY
from bayescal._fleet.devices import DEVICE, DeviceBlock
from bayescal._model.frame import (
    GROUPS,
    Frame,
    Reference,
    build_frame,
    reference_name,
    reference_of,
    rounded_means,
)
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, Levels, bind

STEP = 1.25  # from one padded number of readings to the next
NUMBERS = 2_000_000  # readings in one stack at most


class DeviceFrame(NamedTuple):
    """One device as a fit takes it.

    Attributes:
        device: its index in the block.
        layout: where its unknowns stand.
        levels: members of its groups.
        frame: what the effects see.
        y: outputs, (n,).
    """

    device: int
    layout: Layout
    levels: Levels
    frame: Frame
    y: np.ndarray


class DeviceStack(NamedTuple):
    """Devices of one shape, as `DeviceFrame` with a leading axis.

    Attributes:
        devices: their indices in the block, (b,).
        layout: common to all.
        levels: members of the groups of each.
        frame: stacked frames; leaves (b, …).
        y: outputs, (b, n).
        real: 1 where a reading is one, 0 where it is padding, (b, n).
    """

    devices: np.ndarray
    layout: Layout
    levels: Sequence[Levels]
    frame: Frame
    y: np.ndarray
    real: np.ndarray

    def padded(self) -> DeviceStack:
        """A few devices more, the last one repeated, so that few programs are compiled: at most an eighth above 64."""
        few = len(self.devices)
        step = max(64, 1 << max((few - 1).bit_length() - 4, 0))
        many = 1 << (few - 1).bit_length() if few < 64 else -(-few // step) * step
        pick = np.minimum(np.arange(many), few - 1)
        if many == few:
            return self
        frame = jax.tree.map(lambda a: np.asarray(a)[pick], self.frame)
        return self._replace(frame=frame, y=self.y[pick], real=self.real[pick])


Refuse = Callable[[int, BayescalError], Any]  # takes the index of a device that cannot be fitted


def frames(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse
) -> Iterator[DeviceFrame]:
    """The devices of a block one by one; `refuse` is called with those that cannot be fitted, and why."""
    for i in range(len(block.names)):
        readings = block.measurements(i)
        try:
            layout, levels = bind(model, readings)
            frame = build_frame(readings, {**reference_of(readings), **reference})
        except BayescalError as error:
            refuse(i, error)
            continue
        yield DeviceFrame(
            i, layout, levels, jax.tree.map(np.asarray, frame), np.asarray(readings["output"])
        )


def stacks(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse, most: int
) -> Iterator[DeviceStack]:
    """The devices of a block by shape, at most so many at once; arguments as of `frames`."""
    labels = {name for name, unit in block.units.items() if unit is None}
    if labels <= {DEVICE} and not {"time", "temperature_point"} & block.values.keys():
        yield from _stacks_of_numbers(model, block, reference, refuse, most)
        return
    waiting: dict[tuple, list[DeviceFrame]] = {}
    for one in frames(model, block, reference, refuse):
        kind = (str(jax.tree.map(jnp.shape, one.frame)), one.layout.counts)
        waiting.setdefault(kind, []).append(one)
        if len(waiting[kind]) >= min(most, NUMBERS // max(1, len(one.y))):
            yield _stacked(waiting.pop(kind))
    for rest in waiting.values():
        yield _stacked(rest)


def _stacked(made: Sequence[DeviceFrame]) -> DeviceStack:
    devices, layouts, levels, each, ys = zip(*made, strict=True)
    y = np.stack(ys)
    frame = jax.tree.map(lambda *a: np.stack(a), *each)
    return DeviceStack(np.array(devices), layouts[0], levels, frame, y, np.ones_like(y))


def _stacks_of_numbers(
    model: Model, block: DeviceBlock, reference: Reference, refuse: Refuse, most: int
) -> Iterator[DeviceStack]:
    """Devices whose frames need nothing but their numbers: no time, no groups, no labels."""
    rungs = np.array([_rung(int(n)) for n in range(int(block.counts.max()) + 1)])[block.counts]
    constants = {name: v for name, v in reference.items() if not isinstance(v, dict)}
    levels = {g: () if g == "cell" else ("1",) for g in GROUPS}
    for rung in np.unique(rungs).tolist():
        counts = (*((group, len(names)) for group, names in levels.items()), ("reading", rung))
        layout = Layout(model, counts)
        few = block.counts <= layout.size  # readings, perhaps not enough for the model
        for one in np.flatnonzero(few & (rungs == rung)).tolist():
            try:
                bind(model, block.measurements(one))
            except BayescalError as error:
                refuse(one, error)
                rungs[one] = 0
        members = np.flatnonzero(rungs == rung)
        at_once = max(1, min(most, NUMBERS // rung))
        for begin in range(0, len(members), at_once):
            some = members[begin : begin + at_once]
            columns, real, scalars = _matrices(block, some, rung)
            shape = real.shape
            frame = Frame(  # NumPy arrays, until they are fitted
                columns=columns,
                labels={},
                rates={},
                codes={g: np.full(shape, len(names) - 1) for g, names in levels.items()},
                reference={**scalars, **{n: np.full(len(some), v) for n, v in constants.items()}},
                order=np.broadcast_to(np.arange(rung), shape),
                step=-np.ones(shape),
                record=dict(columns),
                silence=np.full(len(some), np.inf),
            )
            own = [levels] * len(some)
            if DEVICE in block.values:
                own = [{**levels, DEVICE: (block.names[i],)} for i in some]
            yield DeviceStack(some, layout, own, frame, columns["output"], real)


def _rung(count: int) -> int:
    """The least of a ladder of numbers of readings that is no smaller."""
    rung = 8
    while rung < count:
        rung = int(np.ceil(rung * STEP))
    return rung


def _matrices(
    block: DeviceBlock, some: np.ndarray, rung: int
) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray]]:
    """Columns (b, rung), which readings are real, and the reference constants of each device."""
    counts = block.counts[some]
    within = np.arange(rung)
    rows = block.starts[some][:, None] + np.minimum(within, counts[:, None] - 1)
    real = (within < counts[:, None]).astype(float)
    numbers = [name for name, unit in block.units.items() if unit is not None]
    columns = {name: block.values[name][rows] for name in numbers}
    scalars = {}
    for name in numbers:
        low, high = columns[name].min(axis=1), columns[name].max(axis=1)
        if block.units[name] == "degC":
            mean = np.sum(columns[name] * real, axis=1) / counts
            sd = np.sqrt(np.sum((columns[name] - mean[:, None]) ** 2 * real, axis=1) / counts)
            scalars[reference_name(name)] = rounded_means(mean, sd, low, high)
        if name not in ("output", UNCERTAINTY):
            scalars |= {f"{name}_low": low, f"{name}_high": high}
    return columns, real, scalars
