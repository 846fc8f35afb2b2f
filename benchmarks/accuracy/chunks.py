"""Campaigns drawn from the priors in chunks, each with a seed of its own, kept in a file and taken up again."""

from __future__ import annotations

import argparse
import hashlib
import sys
import time
import zlib
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, Protocol

import bayescal as bc
from bayescal._inference import sampled_products
from bayescal._inference.problem import Problem
from bayescal._inference.record import Record
from bayescal._model.frame import build_frame, reference_of
from bayescal._model.parameters import bind
from benchmarks.record import add_line, read_lines

REPLICATES = 1000
PROPOSALS, ROUNDS = 2048, 3  # of `Marginal`


class Chunked(Protocol):
    """Campaigns of one instrument that are run a chunk at a time."""

    @property
    def name(self) -> str:
        """Of the instrument."""
        ...

    @property
    def chunk(self) -> int:
        """Campaigns in a chunk."""
        ...

    @property
    def fingerprint(self) -> str:
        """Changes with whatever a chunk's numbers depend on."""
        ...

    def run(self, index: int) -> dict[str, Any]:
        """What is found in one chunk, a list for each claim."""
        ...


def seed_of(name: str, index: int) -> int:
    """Of one chunk; unlike from instrument to instrument, so that their data sets are independent."""
    return zlib.crc32(f"{name} {index}".encode())


def fingerprint_of(model: bc.Model, outputs: Iterable[float], *more: str) -> str:
    """A hash of a model's unknowns, of readings drawn from it, and of what else is given."""
    parts = [*model.unknowns, *(f"{value:.6e}" for value in outputs), *more]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def promoted(model: bc.Model, plan: bc.Measurements) -> tuple[str, ...]:
    """What `Marginal` promotes, chosen once, on the plan's own readings, because one program serves all data sets."""
    layout, _ = bind(model, plan)
    frame = build_frame(plan, reference_of(plan))
    record = Record(model.instrument, frame, plan["output"])
    return sampled_products.choose(Problem(layout, record), None)[0].layout.promoted


def collect(campaigns: Chunked, replicates: int, file: Path | None = None) -> list[dict[str, Any]]:
    """At least so many campaigns, in chunks; those that a file holds are taken from it, the others added to it."""
    known = "" if file is None else campaigns.fingerprint
    lines = [] if file is None else read_lines(file)
    done = {row["chunk"]: row for row in lines if row["fingerprint"] == known}
    size = campaigns.chunk
    wanted = range(-(-replicates // size))
    for index in wanted:
        if index in done:
            continue
        begun = time.perf_counter()
        found = campaigns.run(index)
        head = {"fingerprint": known, "chunk": index, "seed": seed_of(campaigns.name, index)}
        done[index] = {**head, **found, "seconds": round(time.perf_counter() - begun, 1)}
        if file is not None:
            add_line(file, done[index])
            counted = f"{campaigns.name}: {(index + 1) * size} of {replicates}"
            print(counted, end="\r", file=sys.stderr)
    return [done[index] for index in wanted]


def asked(
    arguments: list[str] | None, module: str, about: str | None, known: Collection[str]
) -> tuple[list[str], int]:
    """Instruments and replicates that a command names; all, and `REPLICATES`, if it names none.

    Args:
        arguments: of the command line.
        module: that was run, for its usage.
        about: what it says of itself.
        known: instruments.

    Raises:
        SystemExit: an instrument is not known.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=about)
    parser.add_argument("names", nargs="*", default=[], help="instruments; all if none is named")
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    given = parser.parse_args(arguments if arguments is not None else [])
    if unknown := set(given.names) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    return given.names or list(known), given.replicates
