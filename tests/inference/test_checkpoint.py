"""A fit that is stopped goes on where it was, and ends with the same draws; a file of anything else is refused."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import bayescal as bc
from bayescal._inference import checkpoint, nuts_chains
from bayescal_models import mems_gyro

ROOT = Path(__file__).resolve().parents[2]
MODEL = mems_gyro.INSTRUMENT.baseline()
CHAINS = bc.NUTS(warmup=150, draws=250, chains=2)  # blocks of 100 and 50, then 100, 100 and 50

RUN = """
import os, signal, sys, time
import bayescal as bc
from bayescal._inference import checkpoint
from bayescal_models import mems_gyro

file, readings, warmup, draws, at = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
checkpoint.PAUSE = 0.0
plain, count = checkpoint.to_disk, 0

def dying(path):  # the new file stands beside the old one, not yet in its place
    global count
    count += not path.is_dir()
    if count == at:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.2 * (at < 0))  # a slow disk, so that a kill at random meets every state
    plain(path)

checkpoint.to_disk = dying
print("begun", flush=True)
method = bc.NUTS(warmup=warmup, draws=draws, chains=2)
model = mems_gyro.INSTRUMENT.baseline()
data = bc.read(readings, mems_gyro.INSTRUMENT)
bc.fit(model, data, method, seed=3, strict=False, checkpoint=file)
"""


class Stopped(Exception):
    """In place of a kill, where no process has to die."""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, bc.Measurements]:
    rng = np.random.default_rng(5)
    temperature = np.linspace(-30.0, 70.0, 24)
    output = 1.0 + 0.03 * temperature + rng.normal(0, 0.2, 24)
    made = bc.Measurements.from_arrays(mems_gyro.INSTRUMENT, temperature=temperature, output=output)
    file = made.write(tmp_path_factory.mktemp("readings") / "gyro.parquet")
    return file, bc.read(file, mems_gyro.INSTRUMENT)


@pytest.fixture(scope="module")
def whole(data) -> bc.Calibration:
    """The chains, never stopped and without a checkpoint."""
    return bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False)


def vectors(calibration: bc.Calibration) -> tuple[np.ndarray, ...]:
    return calibration.draws()


@contextmanager
def stopped_at(monkeypatch, count: int) -> Iterator[None]:
    """Have the run inside end at its `count`-th write, before anything is written."""
    plain, seen = checkpoint.Checkpoint.write, []

    def write(self):
        seen.append(1)
        if len(seen) == count:
            raise Stopped
        plain(self)

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "PAUSE", 0.0)
        patched.setattr(checkpoint.Checkpoint, "write", write)
        with pytest.raises(Stopped):
            yield


@pytest.mark.slow
def test_chains_that_were_stopped_end_with_the_same_draws(
    tmp_path, data, whole, monkeypatch
) -> None:
    file = tmp_path / "run.nc"
    with stopped_at(monkeypatch, 2):  # in warm-up; the killed process below: in the draws
        bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False, checkpoint=file)
    begun = checkpoint.open_checkpoint(
        file, checkpoint.fingerprint(MODEL, data[1], CHAINS, 3, whole.reference)
    )
    assert 0 < begun.notes["NUTS"] <= 100  # pieces are as long as the processor makes them
    resumed = bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False, checkpoint=file)
    for one, other in zip(vectors(whole), vectors(resumed), strict=True):
        np.testing.assert_array_equal(one, other)
    assert resumed.verdict == whole.verdict


@pytest.mark.slow
def test_a_killed_process_leaves_a_whole_file_to_go_on_from(tmp_path, data, whole) -> None:
    file = tmp_path / "run.nc"
    with started(file, data[0], CHAINS, at=4) as process:
        assert process.wait(timeout=200) == -signal.SIGKILL
    assert len(list(tmp_path.glob(".run.nc.*"))) == 1  # what it was writing when it died
    resumed = bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False, checkpoint=file)
    np.testing.assert_array_equal(vectors(whole)[0], vectors(resumed)[0])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.nc"]


def started(file: Path, readings: Path, method: bc.NUTS, at: int) -> subprocess.Popen:
    """A process that runs the fit and is killed at its `at`-th write."""
    numbers = (str(n) for n in (method.warmup, method.draws, at))
    path = os.pathsep.join([str(ROOT), str(ROOT / "models")])
    return subprocess.Popen(
        [sys.executable, "-c", RUN, str(file), str(readings), *numbers],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory, data) -> Path:
    """The chains' checkpoint, with all of them in it."""
    file = tmp_path_factory.mktemp("finished") / "run.nc"
    bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False, checkpoint=file)
    return file


@pytest.mark.slow
def test_a_finished_run_is_not_run_again(data, whole, finished, monkeypatch) -> None:
    monkeypatch.setattr(nuts_chains, "_block_of", lambda *_: pytest.fail("it ran"))
    again = bc.fit(MODEL, data[1], CHAINS, seed=3, strict=False, checkpoint=finished)
    np.testing.assert_array_equal(vectors(whole)[0], vectors(again)[0])
    assert (again.verdict, again.log_evidence) == (whole.verdict, whole.log_evidence)


@pytest.mark.slow
def test_the_checkpoint_of_another_run_is_refused(data, finished, monkeypatch) -> None:
    before = finished.read_bytes()
    other = data[1].with_column("output", data[1]["output"] + 1e-12)
    wider = MODEL.with_noise(bc.White(bc.HalfCauchy(0.2)))
    trials = [
        (MODEL, data[1], CHAINS, 2, r"seed differs \(3, now 2\)"),
        (MODEL, other, CHAINS, 3, "readings differs"),
        (MODEL, data[1], bc.NUTS(draws=100), 3, "method differs"),
        (wider, data[1], CHAINS, 3, "model differs"),
        (MODEL + "bias.temperature_quadratic", data[1], CHAINS, 3, "effects differs"),
    ]
    for model, readings, method, seed, said in trials:
        with pytest.raises(bc.InputError, match=f"checkpoint of another run: .*{said}"):
            bc.fit(model, readings, method, seed=seed, checkpoint=finished)
    monkeypatch.setattr(checkpoint, "version", lambda name: "0.0")
    with pytest.raises(bc.InputError, match="another run: versions differs"):
        bc.fit(MODEL, data[1], CHAINS, seed=3, checkpoint=finished)
    assert finished.read_bytes() == before


def test_an_effect_of_another_form_is_another_model(data) -> None:
    def effect(power: int) -> bc.Effect:
        return bc.Effect(
            "bias.power",
            "bias",
            basis=lambda r: r.centred() ** power,
            coefficients=(bc.Coefficient("deg/s", bc.Normal(0.0, 1.0)),),
        )

    one, same, other = (
        checkpoint.fingerprint(MODEL + effect(k), data[1], bc.NUTS(), 0, {}) for k in (2, 2, 3)
    )
    assert one == same
    assert one["model (hash)"] != other["model (hash)"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "half", "calibration"])
def test_a_file_that_is_no_checkpoint_is_refused_and_kept(
    tmp_path, data, whole, finished, kind
) -> None:
    file = tmp_path / "run.nc"
    if kind == "text":
        file.write_text("temperature,output\n20,1\n")
    elif kind == "half":
        file.write_bytes(finished.read_bytes()[: finished.stat().st_size // 2])
    else:
        whole.save(file)
    before = file.read_bytes()
    with pytest.raises(
        bc.InputError, match=r"run\.nc.* a checkpoint of a fit. Name|run\.nc' is no checkp"
    ):
        bc.fit(MODEL, data[1], CHAINS, seed=3, checkpoint=file)
    assert file.read_bytes() == before


def test_a_checkpoint_needs_a_place(tmp_path, data) -> None:
    with pytest.raises(bc.InputError, match=r"name it …nc, not 'run\.txt'"):
        bc.fit(MODEL, data[1], checkpoint=tmp_path / "run.txt")
    with pytest.raises(bc.InputError, match="there is no folder"):
        bc.fit(MODEL, data[1], checkpoint=tmp_path / "none" / "run.nc")


@pytest.mark.nightly
def test_a_process_killed_at_any_moment_goes_on(tmp_path, data) -> None:
    method = bc.NUTS(warmup=1000, draws=3000, chains=2)  # 40 blocks
    whole = bc.fit(MODEL, data[1], method, seed=3, strict=False)
    file, random, seen = tmp_path / "run.nc", np.random.default_rng(7), set()
    own = checkpoint.fingerprint(MODEL, data[1], method, 3, whole.reference)
    for _ in range(8):
        with started(file, data[0], method, at=-1) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(random.uniform(2.0, 14.0))
            process.kill()
        seen.add(checkpoint.open_checkpoint(file, own).notes.get("NUTS"))
    assert seen - {None, 4000}, "no kill met the chains: the machine is faster than this test"
    resumed = bc.fit(MODEL, data[1], method, seed=3, strict=False, checkpoint=file)
    for one, other in zip(vectors(whole), vectors(resumed), strict=True):
        np.testing.assert_array_equal(one, other)
