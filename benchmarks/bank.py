"""A bank of campaigns, measured in turn with a row of results each; an interrupted bank resumes where it stopped."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from benchmarks.record import RESULTS, read_lines, today, write_lines

Row = dict[str, Any]
# What a row says of its campaign: where these are the same, it came out as it had before.
OUTCOME = ("crash", "status", "verdict", "final", "added")


@dataclass(frozen=True)
class Bank:
    """Campaigns whose rows are in one file, `benchmarks/results/NAME.jsonl`.

    Attributes:
        name: name of the file.
        cases: all campaigns in the order of measurement, each with the values of `fields` that identify it.
        measure: function from a campaign to its row.
        fields: fields of a row that identify its campaign.
    """

    name: str
    cases: Callable[[], Iterable[tuple[tuple[Any, ...], Any]]]
    measure: Callable[[Any], Row]
    fields: tuple[str, ...] = ("seed",)

    @property
    def rows(self) -> list[Row]:
        return read_lines(RESULTS / f"{self.name}.jsonl")

    def run(self) -> None:
        """Measure the campaigns without a row."""
        done_keys = {self._key(row) for row in self.rows}
        for key, case in self.cases():
            if key not in done_keys:
                self._keep(self._measured(key, case))

    def again(self, count: int, seed: str) -> list[tuple[Row, Row]]:
        """Measure a random sample of the campaigns with a row again; return their old and new rows."""
        rows_by_key = {self._key(row): row for row in self.rows}
        cases = [(key, case) for key, case in self.cases() if key in rows_by_key]
        drawn = random.Random(seed).sample(cases, min(count, len(cases)))
        pairs = [(rows_by_key[key], self._measured(key, case)) for key, case in drawn]
        for _, row in pairs:
            self._keep(row)
        return pairs

    def _key(self, row: Row) -> tuple[Any, ...]:
        return tuple(row[field] for field in self.fields)

    def _measured(self, key: tuple[Any, ...], case: Any) -> Row:
        """Measure a campaign's row; an error is recorded as a row without a correct answer."""
        start = time.process_time()
        row: Row = dict(zip(self.fields, key, strict=True))
        try:
            row |= self.measure(case)
        except Exception as error:
            row["crash"] = f"{type(error).__name__}: {error}"
        row |= {"seconds": row.get("seconds", time.process_time() - start), "day": today()}
        outcome = {name: row[name] for name in OUTCOME if name in row}
        print(f"{self.name} {key}: {row['seconds']:.1f} s {outcome}", file=sys.stderr, flush=True)
        return row

    def _keep(self, row: Row) -> None:
        rows = [other for other in self.rows if self._key(other) != self._key(row)]
        write_lines(RESULTS / f"{self.name}.jsonl", (*rows, row))


def same_outcome(old: Row, new: Row) -> bool:
    """Return whether the outcome of a campaign is unchanged."""
    return all(old.get(name) == new.get(name) for name in OUTCOME)
