"""What the annex of fleets offers: the command for many devices at once. Heavy modules load inside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import bayescal as bc
from bayescal import InputError
from bayescal._search.own_files import in_a_file
from bayescal.workshop import (
    Answer,
    ColumnOptions,
    Commands,
    ModelOptions,
    compose,
    instrument_named,
    method_named,
    named_numbers,
    own_effects,
    refuse_unknown_method,
)

if TYPE_CHECKING:
    from distributed import Client


commands = Commands(
    {
        "files": {
            "help": "Files of readings, or folders of them: a Parquet dataset, CSVs, logs.",
            "callback": None,  # folders too
        },
        "find": "Search each device's missing effects: a second a device.",
        "method": {
            "help": "least-squares, marginal or nuts.",
            "callback": refuse_unknown_method,
        },
        "out": {
            "help": "Parquet file to write; or a folder, for it and a summary in JSON.",
            "names": ["--out", "-o"],
        },
        "population": (
            "Coefficient whose mean and standard deviation over the devices are estimated; 'all', or repeat."
        ),
        "scheduler": "tcp://host:8786: a Dask cluster that does the work.",
        "workers": {"help": "Processes of this machine that share the work.", "min": 1},
    }
)

ANNEX = {"commands": commands}


@commands.example("bayescal batch lot.parquet --instrument mems_gyro -o results.parquet")
def batch(
    *,
    files: list[Path],
    instrument: str,
    out: Path,
    columns: ColumnOptions,
    choice: ModelOptions,
    method: str = "least-squares",
    population: list[str] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    find: bool = False,
    time_limit: float | None = None,
    seed: int = 0,
) -> Answer:
    """Fit every device of files with a column 'device'."""
    _refuse_place(out, files)
    chosen = instrument_named(instrument)
    own = own_effects(choice, chosen, None)
    model = compose(chosen, choice, own)
    own_files = [] if choice.effects_file is None else [choice.effects_file]
    if in_a_file(instrument):  # the workers need the user's Python files too
        own_files.append(Path(instrument.rpartition(":")[0]))
    with _cluster(workers, scheduler, own_files) as client:
        found = bc.fit_batch(
            model,
            files,
            method=method_named(method),
            population=True if population == ["all"] else population or False,
            seed=seed,
            reference={**named_numbers(choice.reference, "--reference")},
            client=client,
            out=out,
            columns=columns.for_read(),
            find=bc.Find(effects=own) if find else False,
        )
    columns.keep()
    bad, lost = len(found) - found.fitted, len(found.missing)
    said = [f"{bad} of {len(found)} devices have no result, or none to rely on"] * bool(bad)
    said += [f"{lost} files have none"] * bool(lost)
    data = {"file": str(out), **found.data()}
    return Answer(found, data, ok=not said, why="; ".join(said), written=lambda: str(out))


def _refuse_place(out: Path, files: list[Path]) -> None:
    """Refuse a place that results cannot be written to, before anything is read."""
    if out in files:
        raise InputError(f"--out {out}: that is a file of readings; name another")
    if out.suffix and out.suffix != ".parquet":
        raise InputError(f"--out: a batch is saved as Parquet: name it ….parquet, not {out.name!r}")
    if out.is_file() and not out.suffix:
        raise InputError(f"--out {out}: that is a file, a folder was expected; name another")


@contextmanager
def _cluster(
    workers: int | None, scheduler: str | None, own_files: list[Path]
) -> Iterator[Client | None]:
    """The cluster that is asked for, with the user's own files; None for this process. Refuses two kinds at once."""
    if workers is None and scheduler is None:
        yield None
        return
    if workers is not None and scheduler is not None:
        raise InputError("--workers and --scheduler: give one of them, a cluster here or elsewhere")
    from bayescal._annexes.fleet.engine import open_cluster

    with open_cluster(workers, scheduler) as client:
        for own in own_files:
            client.upload_file(str(own))
        yield client
