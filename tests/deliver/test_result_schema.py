"""result.json is what docs/result_schema.md says: these keys, these types, and plain JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import bayescal as bc
from bayescal_models import mems_gyro
from tests.support.command_line import write_bent_table
from tests.support.inside import result_of, write_plain_json

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "result_schema.md").read_text("utf-8")
DOCUMENTED = dict(re.findall(r"^- `([^`]+)` \(([a-z ]+)\)", PAGE, re.MULTILINE))
KNOWN = {"noise.white": 0.1}  # °/s
TYPES = {
    "string": str,
    "number": (int, float),
    "integer": int,
    "boolean": bool,
    "object": dict,
    "list": list,
    "null": type(None),
}

# The keys of schema bayescal.result/2, which no later version may drop.
KEYS = {
    "": "schema complete search calibration instrument method seed versions reference readings holdout gate steps "
    "check missing coefficients hyperparameters identifiability verdict", "reference": "T0",
    "readings": "file sha256 rows groups", "holdout": "file sha256 rows", "gate": "ok reason",
    "search": "weighed complete stopped ending seconds structures averaged_over",
    "search.structures[]": "effects correlated_noise noise log_evidence probability",
    "search.averaged_over[]": "effects probability",
    "other_path": "noise added log_bayes_factor in_words",
    "steps[]": "effects added dropped rmse rmse_fitted unit holdout_rmse leave_one_group_out "
    "log_evidence noise noise_floor verdict", "steps[].leave_one_group_out": "group n rmse",
    "steps[].log_evidence": "value se",
    "steps[].noise": "law white correlated diffusion tau slope curvature freedom",
    "check[]": "step against log_bayes_factor worst", "check[].worst": "from to group size unit",
    "missing[]": "step nothing_missing_probability unstated correlated_noise noise_laws unnamed sets candidates "
    "unknown", "missing[].sets[]": "effects probability",
    "missing[].candidates[]": "effect form probability log_bayes_factor source z size size_sd unit "
    "shape visibility minimum_detectable kind indistinguishable_from",
    "missing[].unknown[]": "column size unit log_bayes_factor probability",
    "coefficients[]": "name effect unit mean sd interval95 contraction averaged",
    "hyperparameters[]": "name effect unit mean sd interval95 contraction averaged",
    "identifiability": "null_directions", "verdict": "ok reasons",
}  # fmt: skip


def _refuse(token: str) -> None:
    raise AssertionError(f"{token} is not JSON")


def read_back(trail: bc.SearchPath, folder: Path) -> dict[str, Any]:
    write_plain_json(result_of(trail), folder / "result.json")
    return json.loads((folder / "result.json").read_text("utf-8"), parse_constant=_refuse)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A line through a bent table, at known noise, with hold-out data."""
    folder, instrument = tmp_path_factory.mktemp("written"), mems_gyro.INSTRUMENT
    bent = bc.read(write_bent_table(folder / "bent.csv"), instrument)
    trail = bc.calibrate(
        instrument.baseline().fix(KNOWN),
        bent,
        holdout=bent,
        reference={"T0": 50.0},
        method=bc.LeastSquares(),
    )
    return read_back(trail, folder)


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A sampled line, with a coefficient of which the readings say nothing."""
    idle = bc.Effect(
        "bias.idle",
        "bias",
        basis=lambda r: 1e-9 * r["temperature"],
        coefficients=(bc.Coefficient("deg/s/degC", bc.Normal(0.0, 1.0)),),
        columns=("temperature",),
    )
    instrument = mems_gyro.INSTRUMENT
    readings = bc.read(mems_gyro.TABLE, instrument)
    trail = bc.calibrate(instrument.baseline() + idle, readings, max_effects=1)
    return read_back(trail, tmp_path_factory.mktemp("sampled"))


@pytest.fixture(scope="module")
def shut(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Correlated noise taken for white: the fit converged, and the gate is shut."""
    trail = bc.calibrate(
        mems_gyro.INSTRUMENT.baseline(),
        mems_gyro.simulate(seed=4, noise_law="ornstein_uhlenbeck"),
        method=bc.LeastSquares(),
        widen_noise=False,
        max_effects=0,
    )
    return read_back(trail, tmp_path_factory.mktemp("shut"))


@pytest.fixture(params=["written", "sampled", "shut"])
def data(request: pytest.FixtureRequest) -> dict[str, Any]:
    return request.getfixturevalue(request.param)


def values(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value with its path as the page writes it, containers included."""
    yield path, value
    if isinstance(value, dict):
        for key, inner in value.items():
            below = f"{path}.{key}" if path else key
            starred = f"{path}.*"
            yield from [(starred, inner)] if starred in DOCUMENTED else values(inner, below)
    elif isinstance(value, list):
        for inner in value:
            yield from values(inner, f"{path}[]")


@pytest.mark.parametrize("path", KEYS)
def test_the_keys_of_the_schema_are_there(path: str, data: dict[str, Any]) -> None:
    found = [v for p, v in values(data) if p == path and v is not None]
    for one in found:
        assert set(KEYS[path].split()) <= set(one)


def test_every_key_is_documented_with_its_type(data: dict[str, Any]) -> None:
    for path, value in values(data):
        if path in DOCUMENTED:
            allowed = tuple(TYPES[name] for name in DOCUMENTED[path].split(" or "))
            flat = tuple(t for a in allowed for t in (a if isinstance(a, tuple) else (a,)))
            assert isinstance(value, flat), f"{path}: {value!r} is no {DOCUMENTED[path]}"
            assert not (isinstance(value, bool) and bool not in flat), path
        else:
            assert isinstance(value, dict | list) or value is None, f"{path} is not documented"


def test_values_have_their_documented_meaning(written: dict[str, Any]) -> None:
    assert written["schema"] == "bayescal.result/2"
    assert written["reference"]["T0"] == 50.0
    assert written["fixed"] == KNOWN
    assert written["readings"]["rows"] == written["holdout"]["rows"] == 18
    assert re.fullmatch(r"[0-9a-f]{64}", written["readings"]["sha256"])
    first, last = written["steps"][0], written["steps"][-1]
    assert first["added"] is None
    assert last["added"] == "bias.temperature_quadratic"
    assert last["holdout_rmse"] < first["holdout_rmse"]
    assert last["effects"] == [*first["effects"], last["added"]]


def test_candidates_come_in_order_of_probability(data: dict[str, Any]) -> None:
    # or nothing was sought
    assert data["missing"] or not data["search"]["weighed"] or len(data["steps"]) == 1
    for missing in data["missing"]:
        probabilities = [c["probability"] for c in missing["candidates"]]
        tested = [p for p in probabilities if p is not None]
        assert tested == sorted(tested, reverse=True)
        assert probabilities == tested + [None] * (len(probabilities) - len(tested))
        assert all(0 <= p <= 1 for p in tested)
