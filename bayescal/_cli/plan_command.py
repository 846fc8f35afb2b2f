"""Where to measure next, as a command."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import print_result
from bayescal._cli.options import Commands, OwnParts

commands = Commands()


@commands.example('bayescal plan result --limit "corrected reading: ±0.1 °/s over -20..60 °C"')
def plan(
    calibration: Path,
    own: OwnParts,
    limit: str,
    count: int = 12,
    member: list[str] | None = None,
    json_: bool = False,
) -> None:
    """Where to measure next: campaigns, and their readings, by the uncertainty that they would leave."""
    from bayescal._cli import saved

    members = options.named_values(member, "--member")
    found = bc.plan_readings(
        saved.load_saved(calibration, own), limit, count=count, members=members
    )
    print_result(found.data() if json_ else found)
