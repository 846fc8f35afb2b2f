"""A user's own effect, as docs/own_effect.md shows it: written, found and added."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import bayescal as bc
from tests.support.command_line import Ran, needs_installation, run
from tests.support.reported import unpaint
from tests.support.shown_output import assert_as_shown, blocks

pytestmark = needs_installation
PAGE = (Path(__file__).resolve().parents[2] / "docs" / "own_effect.md").read_text("utf-8")
(MY_EFFECTS,) = blocks(PAGE, "python")

REFUSED = "bayescal discover with_humidity/calibration.nc"
REPORT = "bayescal report line/calibration.nc with_humidity/calibration.nc --effects my_effects.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("own_effect")


@pytest.fixture(scope="module")
def followed(folder: Path) -> dict[str, Ran]:
    """Every command of the page, in order, by its text."""
    (folder / "my_effects.py").write_text(MY_EFFECTS, encoding="utf-8")
    done = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        unpaint(patch)
        for block in blocks(PAGE, "sh"):
            for command in block.splitlines():
                name, *arguments = shlex.split(command)
                assert name == "bayescal"
                done[command] = run(*arguments)
                assert done[command].status == 0, f"{command}\n{done[command].err}"
        for further in (REFUSED, REPORT):
            done[further] = run(*further.split()[1:])
    return done


def _one(followed: dict[str, Ran], start: str) -> Ran:
    return next(ran for command, ran in followed.items() if command.startswith(f"bayescal {start}"))


@pytest.mark.nightly
def test_discovery_finds_the_effect(followed: dict[str, Ran]) -> None:
    printed = _one(followed, "discover line/calibration.nc --effects").out
    assert_as_shown("\n".join(printed.splitlines()[:2]), blocks(PAGE, "text")[1])
    row = next(line for line in printed.splitlines() if line.startswith("bias.humidity"))
    assert row.endswith("finding")
    assert "°/s/%" in row


@pytest.mark.nightly
def test_the_coefficient_is_what_was_simulated(followed: dict[str, Ran]) -> None:
    printed = _one(followed, "fit damp.csv --instrument mems_gyro --effects").out
    row = next(line for line in printed.splitlines() if line.startswith("bias.humidity"))
    mean, _, sd = row.split()[1:4]
    assert float(mean) == pytest.approx(0.02, abs=3 * float(sd))


@pytest.mark.nightly
def test_a_saved_calibration_asks_for_the_file_with_its_effect(followed: dict[str, Ran]) -> None:
    refused = followed[REFUSED]
    assert refused.status == 2


def damp(size: float) -> bc.Effect:
    return bc.Effect(
        "bias.damp",
        "bias",
        basis=lambda r: r["humidity"],
        coefficients=(bc.Coefficient("deg/s/%", bc.Normal(0.0, size)),),
        columns=("humidity",),
    )
