"""The annex of fleets: the command for many devices at once. Heavy modules load inside it."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

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
    method: str = ws.opt(
        "least-squares, marginal or nuts.", "least-squares", callback=ws.Shared.method.callback
    )
    workers: int | None = ws.opt("Processes of this machine that share the work.", min=1)
    scheduler: str | None = ws.opt("tcp://host:8786: a Dask cluster that does the work.")
    find: bool = ws.opt("Search each device's missing effects: a second a device.", False)
    time_limit: float | None = ws.Shared.time_limit
    seed: int = ws.Shared.seed

    def answer(self) -> ws.Answer:
        from bayescal._annexes.fleet.engine import open_cluster

        _refuse_place(self.out, self.files)
        chosen = ws.instrument_named(self.instrument)
        effects = ws.load_effects(self, chosen, None)
        model = ws.compose(chosen, self, effects)
        own_files = [] if self.effects_file is None else [self.effects_file]
        if ws.is_file_reference(self.instrument):  # the workers need the user's Python files too
            own_files.append(Path(self.instrument.rpartition(":")[0]))
        cluster = open_cluster(self.workers, self.scheduler, own_files)
        with cluster if self.workers or self.scheduler else nullcontext() as client:
            batch = bc.fit_batch(
                model,
                self.files,
                method=ws.create_method(self.method),
                seed=self.seed,
                reference={**ws.parse_numbers(self.reference, "--reference")},
                client=client,
                out=self.out,
                columns=self.read_options(),
                find=self.find,
                effects=effects,
            )
        self.keep()
        bad, lost = len(batch) - batch.fitted, len(batch.missing)
        messages = [f"{bad} of {len(batch)} devices have no result, or none to rely on"] * bool(bad)
        messages += [f"{lost} files have none"] * bool(lost)
        data, why = {"file": str(self.out), **batch.data()}, "; ".join(messages)
        return ws.Answer(batch, data, ok=not messages, why=why, written=str(self.out))


ANNEX = {"commands": (BatchCommand,)}


def _refuse_place(out: Path, files: list[Path]) -> None:
    """Refuse a place that results cannot be written to, before anything is read."""
    if out.is_file() and {*out.resolve().parents} & {*(file.resolve() for file in files)}:
        raise bc.InputError(f"--out {out} is a file of the folder that is read: name another")
