"""Start-up: the import is cheap, JAX is set up in time, batched factorisations do not hang."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("jax", "numpy", "scipy", "pandas", "xarray", "matplotlib", "arviz_base", "numpyro")
COMPUTING = ("jax", "equinox", "numpyro", "scipy", "pandas", "xarray", "matplotlib", "arviz_base")
OWN = ("NPROC", "BAYESCAL_CACHE", "JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME")

# As a calibration does it: a loop, in its body factorisations that do not depend on each other.
INDEPENDENT_FACTORISATIONS = """
import bayescal
import bayescal.effects  # JAX is set up by whoever imports it after a model
import jax
import jax.numpy as jnp

n, batch, steps, independent = 24, 100, 50, 6
root = jax.random.normal(jax.random.key(1), (steps, batch, n, n))
matrices = root @ jnp.swapaxes(root, -1, -2) + n * jnp.eye(n)
right = jnp.ones((batch, n, 1))

@jax.jit
def total(matrices):
    def body(m):
        parts = []
        for k in range(independent):
            factor = jnp.linalg.cholesky(m + k * jnp.eye(n))
            parts.append(jax.scipy.linalg.solve_triangular(factor, right, lower=True).sum())
        return sum(parts)
    return jax.lax.map(body, matrices).sum()

for _ in range(20):
    total(matrices).block_until_ready()
print("finished")
"""

SETTINGS = """
import json
import os
import bayescal
import bayescal.effects, importlib.util  # JAX is set up by whoever imports it after a model,
importlib.util.find_spec("jax")  # not by who only asks whether it is there
import jax
jax.jit(lambda x: x + 1)(1.0).block_until_ready()
print(json.dumps({
    "nproc": os.environ.get("NPROC"),
    "dtype": str(jax.numpy.zeros(1).dtype),
    "cache": jax.config.jax_compilation_cache_dir,
    "least_time": jax.config.jax_persistent_cache_min_compile_time_secs,
}))
"""


def run_python(code: str, variables: Mapping[str, str] | None = None, seconds: float = 120) -> str:
    """Standard output of `code`, run afresh; of what start-up reads, only `variables` are set."""
    environment = {name: value for name, value in os.environ.items() if name not in OWN}
    environment |= {"PYTHONPATH": str(ROOT), **(variables or {})}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def outcomes(*commands: Sequence[object]) -> list[tuple[int, str, list[str]]]:
    """Of commands, one after another in one process: status, what each says, what of `COMPUTING` is imported then."""
    code = f"""
import contextlib, io, json, sys
from bayescal._cli.main import run_command
told = []
for words in json.loads(sys.stdin.read()):
    sys.argv[1:] = words
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = run_command()
    told.append((status, said.getvalue(), [n for n in {COMPUTING!r} if n in sys.modules]))
print(json.dumps(told))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps([[str(word) for word in words] for words in commands]),
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "models")])},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def settings(variables: Mapping[str, str]) -> dict[str, str | float | None]:
    return json.loads(run_python(SETTINGS, variables))


def test_importing_bayescal_imports_nothing_heavy() -> None:
    loaded = run_python(
        f"import sys, bayescal; print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert loaded.strip() == "[]"


HEADER = "rate_input [deg/s],temperature [degC],output [deg/s]\n"
BAD_FILES = {
    "no bytes": b"",
    "unknown unit": HEADER.replace("degC", "furlong").encode() + b"1,20,1\n",
    "NaN": HEADER.encode() + b"1,20,1\n2,nan,1\n",
}
BAD_REQUESTS = (
    "none.csv --instrument mems_gyro",
    f"{ROOT / 'pyproject.toml'} --instrument gyroscope",
    f"{ROOT / 'pyproject.toml'} --instrument mems_gyro --method guess",
)


def test_what_is_wrong_is_refused_before_anything_that_computes(tmp_path: Path) -> None:
    """A bad file of any kind by `calibrate`, one by other commands that read, a bad request; help."""
    commands: list[tuple[object, ...]] = [("--help",), ("imu", "--help")]
    for kind, content in BAD_FILES.items():
        path = tmp_path / f"{kind}.csv"
        path.write_bytes(content)
        for command in ("calibrate", "fit", "compare") if kind == "NaN" else ("calibrate",):
            commands.append((command, path, "--instrument", "mems_gyro"))
    for request in BAD_REQUESTS:
        commands.append(("calibrate", *request.split()))
    for command, (status, said, loaded) in zip(commands, outcomes(*commands), strict=True):
        assert (status, loaded) == (0 if "--help" in command else 2, []), (command, said)


def test_commands_of_an_affine_instrument_import_no_jax(tmp_path: Path) -> None:
    """What each has imported when it ends: scipy to compute, matplotlib to draw, pandas for a table of devices."""
    table, rest, fitted = (tmp_path / name for name in ("table.csv", "rest.csv", "fitted.nc"))
    of = ("--instrument", "mems_gyro")
    commands = (
        ("simulate", *of, "--effect", "bias.thermal_lag=0.05", "--out", table),
        ("simulate", "--instrument", "still_sensor", "--out", rest),
        ("noise", rest),
        ("fit", table, *of, "--out", fitted),
        ("check", fitted),
        ("discover", fitted),
        ("predict", fitted, table, "--out", tmp_path / "predicted.csv"),
        ("compensate", fitted, table, "--out", tmp_path / "compensated.csv"),
        *(("export", fitted, "--format", name) for name in ("c", "python", "json")),
        ("budget", fitted),
        ("calibrate", table, *of, "--out", tmp_path / "result"),
        ("batch", table, *of, "--out", tmp_path / "fleet.parquet"),
    )
    for command, (status, said, loaded) in zip(commands, outcomes(*commands), strict=True):
        more = {"calibrate": ["matplotlib"], "batch": ["pandas", "matplotlib"]}.get(command[0], [])
        assert (status in (0, 1), loaded) == (True, ["scipy", *more]), (command, said)


@pytest.mark.slow
def test_independent_batched_factorisations_in_a_loop_finish(tmp_path: Path) -> None:
    variables = {"BAYESCAL_CACHE": str(tmp_path)}
    try:
        printed = run_python(INDEPENDENT_FACTORISATIONS, variables, seconds=120)
    except subprocess.TimeoutExpired:
        pytest.fail("JAX hung: its workers wait for each other (see bayescal/_core/python311.py)")
    assert printed.strip() == "finished"


def test_the_users_number_of_workers_is_respected() -> None:
    assert settings({"NPROC": "3", "BAYESCAL_CACHE": ""})["nproc"] == "3"


def test_double_precision_and_a_cache_in_the_users_folder(tmp_path: Path) -> None:
    got = settings({"XDG_CACHE_HOME": str(tmp_path)})
    folder = tmp_path / "bayescal" / "jax"
    assert got["dtype"] == "float64"
    assert got["cache"] == str(folder)
    assert got["least_time"] == 0
    assert any(folder.iterdir()), "a small program was not kept"


def test_an_empty_cache_variable_turns_the_cache_off() -> None:
    assert settings({"BAYESCAL_CACHE": ""})["cache"] is None
