"""Registration of the fleet annex: the command `batch` for many devices. Heavy modules are imported on use."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

from typer import Argument

import bayescal as bc
from bayescal import workshop as ws


class BatchCommand(ws.ColumnOptions, ws.ModelOptions, ws.AsJson, ws.Command):
    """Fit every device of files with a column 'device'."""

    example = "bayescal batch lot.parquet --instrument mems_gyro -o results.parquet"
    files: list[Path] = Argument(
        help="Files of readings, or folders of them: a Parquet dataset, CSVs, logs."
    )
    instrument: str = ws.Shared.instrument
    out: Path = ws.opt("Parquet file to write.", ..., "--out", "-o")
    method: ws.MethodName = ws.opt("Method of inference.", "least-squares")
    workers: int | None = ws.opt("Number of local worker processes.", min=1)
    scheduler: str | None = ws.opt("Address of a Dask cluster to use, such as tcp://host:8786.")
    find: bool = ws.opt("Search each device for missing effects (about 1 s per device).", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed

    def answer(self) -> ws.Answer:
        from bayescal._annexes.fleet.engine import open_cluster

        inputs = {file.resolve() for file in self.files}
        if self.out.is_file() and not inputs.isdisjoint(self.out.resolve().parents):
            raise bc.InputError(f"--out {self.out} is in a folder of readings: choose another")
        instrument = ws.instrument_named(self.instrument)
        effects = ws.load_effects(self, instrument, None)
        model = ws.compose(instrument, self, effects)
        user_files = [] if self.effects_file is None else [self.effects_file]
        if ws.is_file_reference(self.instrument):  # the workers need the user's Python files too
            user_files.append(Path(self.instrument.rpartition(":")[0]))
        cluster = open_cluster(self.workers, self.scheduler, user_files)
        options: dict[str, Any] = {"seed": self.seed, "out": self.out, "find": self.find}
        options |= {"method": ws.create_method(self.method), "columns": self.read_options()}
        options |= {"reference": ws.parse_numbers(self.reference, "--reference")}
        with cluster if self.workers or self.scheduler else nullcontext() as client:
            batch = bc.fit_batch(model, self.files, client=client, effects=effects, **options)
        self.save_options()
        n_failed, n_unread = len(batch) - batch.fitted_count, len(batch.file_errors)
        failures = [f"{n_failed} of {len(batch)} devices have no reliable result"] * bool(n_failed)
        failures += [f"{n_unread} files have no result"] * bool(n_unread)
        data = {"file": str(self.out), **batch.to_json_data()}
        return ws.Answer(batch, data, why="; ".join(failures), written=str(self.out))


ANNEX = {"commands": (BatchCommand,)}
