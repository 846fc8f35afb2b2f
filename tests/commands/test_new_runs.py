"""Readings of use are taken as they come: without runs, with gaps, in other formats."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import bayescal as bc
from bayescal_models import inclinometer
from tests.support.inside import compensate_file
from tests.support.made_up import bent_sensor


def test_a_file_without_runs_is_one_new_run(tmp_path) -> None:
    """Of an inclinometer, whose model has an offset of each run."""
    instrument, made = inclinometer.INSTRUMENT, inclinometer.simulate(seed=0)
    calibration = bc.fit(instrument.baseline(), made, bc.LeastSquares())
    table = pd.read_csv(made.select(made["run"] == made["run"][0]).write(tmp_path / "one.csv"))
    table.assign(run="never seen").to_csv(tmp_path / "named.csv", index=False)
    table.drop(columns="run").to_csv(tmp_path / "none.csv", index=False)
    both = [bc.read(tmp_path / name, instrument) for name in ("named.csv", "none.csv")]
    correct = bc.compensator(calibration, members={"axis": both[0]["axis"][0]})
    for use in (
        lambda r: bc.predict(calibration, r).mean,
        lambda r: bc.predict(calibration, r).sd,
        lambda r: correct(r, warn=False).uncertainty,
    ):
        np.testing.assert_array_equal(use(both[0]), use(both[1]))


@pytest.mark.parametrize(("suffix", "memory"), [(".tsv", False), (".parquet", True)])
def test_gaps_come_out_empty_and_are_counted(suffix, memory, tmp_path) -> None:
    chosen = bc.compensator(bent_sensor.calibration() if memory else bent_sensor.gyro())
    record = bent_sensor.readings(2) if memory else bent_sensor.gyro().readings
    names = [n for n in ("run", "time", "temperature", "humidity", "output") if record.has(n)]
    table = pd.DataFrame({f"{n} [{u}]" if (u := record.unit(n)) else n: record[n] for n in names})
    output = f"output [{record.unit('output')}]"
    table.loc[[3, 8], output] = np.nan
    path, out = tmp_path / f"in{suffix}", tmp_path / "made" / f"out{suffix}"
    if suffix == ".parquet":
        table.to_parquet(path)
    else:
        table.to_csv(path, index=False, sep="\t")
    done = compensate_file(chosen, path, out)
    assert done.missing == 2 and done.rows == len(table) and done.unsolved == 0
    back = pd.read_parquet(out) if suffix == ".parquet" else pd.read_csv(out, sep="\t")
    value = np.asarray(pd.to_numeric(back.iloc[:, -2], errors="coerce"), float)
    assert np.flatnonzero(np.isnan(value)).tolist() == [3, 8]
    kept = record.select(np.setdiff1d(np.arange(len(table)), [3, 8]))
    np.testing.assert_allclose(value[~np.isnan(value)], chosen(kept, warn=False).value, rtol=1e-9)


@pytest.mark.slow
def test_a_repeated_row_stays_a_row(tmp_path) -> None:
    record = bent_sensor.readings(2)
    record.write(tmp_path / "in.csv")
    lines = (tmp_path / "in.csv").read_text().splitlines()
    (tmp_path / "in.csv").write_text("\n".join([*lines[:5], lines[4], *lines[5:], ""]))
    done = compensate_file(
        bc.compensator(bent_sensor.calibration()), tmp_path / "in.csv", tmp_path / "out.csv"
    )
    value = pd.read_csv(tmp_path / "out.csv").iloc[:, -2].to_numpy()
    assert done.rows == len(record) + 1 and value[3] == value[4] and not np.isnan(value).any()
