"""A run over partitions: what is left to do is done, what is wrong is named, and the whole is summed up."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from bayescal._core.errors import InputError
from bayescal._core.progress import tell
from bayescal._fleet.doubled import Doubled, doubled_devices
from bayescal._fleet.engine import Engine
from bayescal._fleet.find_devices import EffectCounts
from bayescal._fleet.fit_partition import PartitionDone, PartitionMoments, fit_partition
from bayescal._fleet.fleet_request import Request
from bayescal._fleet.partitions import Partition

EVERY = 2.0  # seconds between two lines of progress


@dataclass
class Run:
    """Partitions as they are done.

    Attributes:
        request: what is fitted.
        partitions: all of them.
        folder: that each writes its file to.
        engine: where they are fitted.
        done: by number.
        failed: partition → why it has no results.
    """

    request: Request
    partitions: Sequence[Partition]
    folder: Path
    engine: Engine
    done: dict[int, PartitionDone] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)

    def fit(self) -> None:
        """Fit every partition that has no results, and refuse devices that stand in several.

        Raises:
            InputError: the folder holds results of other partitions, or the engine is gone.
        """
        self._refuse_others()
        self._each({p.number: Doubled() for p in self.partitions}, known=False)
        wanted = doubled_devices(self.folder, self.partitions)
        for number, done in self.done.items():
            if done.doubled or done.dropped:  # they may stand in this partition alone by now
                wanted.setdefault(number, Doubled())
        again = {
            number: doubled
            for number, doubled in wanted.items()
            if number in self.done
            and (self.done[number].doubled, self.done[number].dropped)
            != (dict(doubled.refused), doubled.dropped)
        }
        if again:
            tell(f"devices that stand in several partitions: {len(again)} of these fitted again")
            self._each(again, known=True)

    def _refuse_others(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        own = {p.file for p in self.partitions}
        others = sorted(f.name for f in self.folder.glob("part-*.parquet") if f.name not in own)
        if others:
            raise InputError(
                f"{self.folder} holds results of more partitions ({others[0]} …) than these readings make: they are "
                "of other readings. Choose another folder, or remove them"
            )

    def _each(self, wanted: dict[int, Doubled], known: bool) -> None:
        some = [self.partitions[number] for number in wanted]
        tasks = [
            (
                self.request,
                p,
                self.folder,
                dict(wanted[p.number].refused) if known else None,
                wanted[p.number].dropped,
            )
            for p in some
        ]
        shown = _Progress(sum(p.rows for p in some))
        for outcome in self.engine.each(fit_partition, tasks):
            partition = some[outcome.index]
            if outcome.error:
                self.failed[partition.number] = outcome.error
                self.done.pop(partition.number, None)
            else:
                self.done[partition.number] = outcome.value
            shown.add(partition.rows, outcome.value)
        shown.end()

    @property
    def in_order(self) -> Iterator[PartitionDone]:
        """What was done, in the order of the partitions: so that sums do not depend on who was first."""
        return (self.done[number] for number in sorted(self.done))

    @property
    def missing(self) -> dict[str, str]:
        """File → why its devices have no results."""
        files = {name: why for done in self.in_order for name, why in done.unreadable.items()}
        files |= {
            f"{self.partitions[number].name}": why for number, why in sorted(self.failed.items())
        }
        return files

    @property
    def effects(self) -> EffectCounts:
        """What was found missing, over all devices that were searched."""
        return sum((done.effects for done in self.in_order), EffectCounts())

    def table(self) -> pd.DataFrame:
        """One row a coefficient, over the devices that are trusted."""
        total: dict[tuple[str, str], PartitionMoments] = {}
        for done in self.in_order:
            for key, one in done.moments.items():
                total[key] = total[key] + one if key in total else one
        rows = [
            {
                "coefficient": name,
                "mean": m.mean,
                "between devices": (m.square / m.count) ** 0.5,
                "typical sd": (m.variance / m.count) ** 0.5,
                "unit": unit,
                "devices": m.count,
            }
            for (name, unit), m in total.items()
        ]
        columns = ["coefficient", "mean", "between devices", "typical sd", "unit", "devices"]
        return pd.DataFrame(rows, columns=columns)


class _Progress:
    """Lines on stderr: devices done, their rate, and what is left."""

    def __init__(self, rows: int) -> None:
        self.rows, self.begun = max(rows, 1), time.monotonic()
        self.said, self.behind, self.devices, self.before = self.begun, 0, 0, 0

    def add(self, rows: int, done: PartitionDone | None) -> None:
        self.behind += rows
        if done is not None:
            self.devices += done.devices
            self.before += done.devices if done.again else 0
        if time.monotonic() > self.said + EVERY:
            self.said = time.monotonic()
            self._tell()

    def end(self) -> None:
        if self.said > self.begun:
            self._tell()

    def _tell(self) -> None:
        passed = time.monotonic() - self.begun
        rate = (self.devices - self.before) / passed
        left = passed * (self.rows / max(self.behind, 1) - 1)
        found = f", {self.before:,} of them found done" if self.before else ""
        tell(f"{self.devices:,} devices{found}, {rate:,.0f} a second, about {left:,.0f} s left")
