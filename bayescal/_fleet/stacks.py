"""Frames of many devices stacked, so that one compiled program sees them all.

A table without time and without groups becomes a stack of frames by a few array operations; else frames are built
one by one. Devices with other numbers of readings are padded to a common one; a padded reading repeats the last
and counts nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

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
)
from bayescal._model.model import Model
from bayescal._model.parameters import bind

STEP = 1.25  # from one rung of the ladder to the next
NUMBERS = 2_000_000  # readings in one stack at most
POINT = "temperature_point"


class DeviceStack(NamedTuple):
    """Devices of one shape.

    Attributes:
        devices: their indices in the block.
        frame: stacked frames; leaves (b, …).
        y: outputs, (b, n).
        real: 1 where a reading is one, 0 where it is padding, (b, n).
        counts: sizes of the groups, common to all.
        levels: members of the groups of each device.
    """

    devices: np.ndarray
    frame: Frame
    y: np.ndarray
    real: np.ndarray
    counts: tuple[tuple[str, int], ...]
    levels: list[dict[str, tuple[str, ...]]]


class _Single(NamedTuple):
    """A device that waits for others of its shape; as in `DeviceStack`."""

    device: int
    frame: Frame
    y: np.ndarray
    counts: tuple[tuple[str, int], ...]
    levels: dict[str, tuple[str, ...]]


class Refusal(NamedTuple):
    """A device of the block that cannot be fitted, and why."""

    device: int
    reason: str


def plain(block: DeviceBlock) -> bool:
    """Whether the frames need nothing but the numbers: no time, no groups, no labels."""
    labels = {name for name, unit in block.units.items() if unit is None}
    return labels <= {DEVICE} and not {"time", POINT} & set(block.values)


def stacks(
    model: Model, block: DeviceBlock, reference: Reference, padded: bool, most: int
) -> Iterator[DeviceStack | Refusal]:
    """The devices of a block by shape, at most so many at once; or a device that is refused.

    Args:
        model: what is to be fitted.
        block: the devices.
        reference: constants of the bases in place of the devices' own.
        padded: whether padded readings are left out by their weights, so that shapes go to a common ladder.
        most: devices in one stack.
    """
    sizes = np.unique(block.counts)
    rungs = {int(n): _rung(int(n)) if padded and plain(block) else int(n) for n in sizes}
    if plain(block):
        for rung in sorted(set(rungs.values())):
            members = np.flatnonzero(np.isin(block.counts, [n for n in rungs if rungs[n] == rung]))
            at_once = max(1, min(most, NUMBERS // rung))
            yield from _plain_stacks(model, block, members, rung, reference, at_once)
        return
    waiting: dict[tuple, list[_Single]] = {}
    for i in range(len(block.names)):
        try:
            made = _single(model, block, i, reference)
        except BayescalError as error:
            yield Refusal(i, str(error))
            continue
        kind = (str(jax.tree.map(jnp.shape, made.frame)), made.counts)
        waiting.setdefault(kind, []).append(made)
        if len(waiting[kind]) >= min(most, NUMBERS // max(1, len(made.y))):
            yield _joined(waiting.pop(kind))
    for rest in waiting.values():
        yield _joined(rest)


def _rung(count: int) -> int:
    """The least rung of the ladder that holds so many readings."""
    rung = 8
    while rung < count:
        rung = int(np.ceil(rung * STEP))
    return rung


def _single(model: Model, block: DeviceBlock, index: int, reference: Reference) -> _Single:
    readings = block.measurements(index)
    layout, levels = bind(model, readings)
    frame = build_frame(readings, {**reference_of(readings), **reference})
    frame = jax.tree.map(np.asarray, frame)
    return _Single(
        device=index, frame=frame, y=readings["output"], counts=layout.counts, levels=levels
    )


def _joined(made: list[_Single]) -> DeviceStack:
    y = np.stack([m.y for m in made])
    return DeviceStack(
        devices=np.array([m.device for m in made]),
        frame=jax.tree.map(lambda *a: np.stack(a), *(m.frame for m in made)),
        y=y,
        real=np.ones_like(y),
        counts=made[0].counts,
        levels=[m.levels for m in made],
    )


def _plain_stacks(
    model: Model,
    block: DeviceBlock,
    members: np.ndarray,
    rung: int,
    reference: Reference,
    most: int,
) -> Iterator[DeviceStack | Refusal]:
    few = members[block.counts[members] == block.counts[members].min()]
    try:
        bind(model, block.measurements(int(few[0])))
    except BayescalError:  # too few readings for the model: say of each how many
        good = []
        for i in members:
            try:
                bind(model, block.measurements(int(i)))
                good.append(i)
            except BayescalError as error:
                yield Refusal(int(i), str(error))
        members = np.array(good, dtype=int)
    counts = (*((group, 0 if group == "cell" else 1) for group in GROUPS), ("reading", rung))
    for begin in range(0, len(members), most):
        some = members[begin : begin + most]
        columns, real, scalars = _matrices(block, some, rung)
        scalars |= {
            name: np.full(len(some), float(v))
            for name, v in reference.items()
            if not isinstance(v, dict)
        }
        shape = real.shape
        codes = {g: np.full(shape, -1 if g == "cell" else 0) for g in GROUPS}
        frame = Frame(  # NumPy arrays, until they are fitted
            columns=columns,
            labels={},
            rates={},
            codes=codes,
            reference=scalars,
            order=np.broadcast_to(np.arange(rung), shape),
            step=-np.ones(shape),
            record=dict(columns),
        )
        levels = {g: () if g == "cell" else ("1",) for g in GROUPS}
        own = [
            {**levels, DEVICE: (block.names[i],)} if DEVICE in block.values else levels
            for i in some
        ]
        yield DeviceStack(
            devices=some, frame=frame, y=columns["output"], real=real, counts=counts, levels=own
        )


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
        if block.units[name] == "degC":
            mean = np.sum(columns[name] * real, axis=1) / counts
            scalars[reference_name(name)] = np.round(mean)
        if name not in ("output", UNCERTAINTY):
            scalars[f"{name}_low"] = columns[name].min(axis=1)
            scalars[f"{name}_high"] = columns[name].max(axis=1)
    return columns, real, scalars
