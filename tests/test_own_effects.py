"""A user's own effect, as docs/own_effect.md shows it: written, found and added."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from command_line import Ran, needs_installation, run
from shown_output import assert_as_shown, blocks

pytestmark = needs_installation
PAGE = (Path(__file__).resolve().parents[1] / "docs" / "own_effect.md").read_text("utf-8")
(MY_EFFECTS,) = blocks(PAGE, "python")


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ran]:
    """Every command of the page, in order, by its text."""
    folder = tmp_path_factory.mktemp("own_effect")
    (folder / "my_effects.py").write_text(MY_EFFECTS, encoding="utf-8")
    done = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks(PAGE, "sh"):
            for command in block.splitlines():
                name, *arguments = shlex.split(command)
                assert name == "bayescal"
                done[command] = run(*arguments)
                assert done[command].status == 0, f"{command}\n{done[command].err}"
        refused = "bayescal discover with_humidity/calibration.nc"
        done[refused] = run(*refused.split()[1:])
    return done


def _one(followed: dict[str, Ran], start: str) -> Ran:
    return next(ran for command, ran in followed.items() if command.startswith(f"bayescal {start}"))


def test_the_effect_is_a_few_lines() -> None:
    lines = [line for line in MY_EFFECTS.splitlines() if line.strip() and "import" not in line]
    assert len(lines) <= 5


def test_check_names_the_column_that_no_effect_uses(followed: dict[str, Ran]) -> None:
    printed = _one(followed, "check").out
    assert_as_shown(printed, blocks(PAGE, "text")[0])
    assert printed.splitlines()[3].startswith("humidity ")


def test_discovery_finds_the_effect(followed: dict[str, Ran]) -> None:
    printed = _one(followed, "discover line/calibration.nc --effects").out
    assert_as_shown("\n".join(printed.splitlines()[:2]), blocks(PAGE, "text")[1])
    row = next(line for line in printed.splitlines() if line.startswith("bias.humidity"))
    assert row.endswith("finding")
    assert "°/s/%" in row
    assert "unexplained" not in printed


def test_readings_kept_apart_are_predicted_to_the_noise(followed: dict[str, Ran]) -> None:
    printed = [
        ran.out for command, ran in followed.items() if command.startswith("bayescal predict")
    ]
    assert_as_shown("".join(printed), blocks(PAGE, "text")[2])


def test_the_coefficient_is_what_was_simulated(followed: dict[str, Ran]) -> None:
    printed = _one(followed, "fit damp.csv --instrument mems_gyro --effects").out
    row = next(line for line in printed.splitlines() if line.startswith("bias.humidity"))
    mean, _, sd = row.split()[1:4]
    assert float(mean) == pytest.approx(0.02, abs=3 * float(sd))


def test_a_saved_calibration_asks_for_the_file_with_its_effect(followed: dict[str, Ran]) -> None:
    refused = followed["bayescal discover with_humidity/calibration.nc"]
    assert refused.status == 2
    assert "uses the effect bias.humidity, which 'mems_gyro' does not have" in refused.said[0]
    assert "--effects my_effects.py" in refused.said[0]
