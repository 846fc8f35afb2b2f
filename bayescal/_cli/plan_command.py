"""Where to measure next, as a command."""

from __future__ import annotations

from typing import Annotated

import typer

import bayescal as bc
from bayescal._cli import options
from bayescal._cli.console import print_result
from bayescal._cli.options import Commands, OwnParts

commands = Commands()


@commands.example('bayescal plan result --limit "corrected reading: ±0.1 °/s over -20..60 °C"')
def plan(
    calibration: options.Saved,
    own: OwnParts,
    limit: Annotated[
        str,
        typer.Option(
            "--limit",
            help='On what is to be known better, as `bayescal decide` takes it: "bias.temperature: ±1e-3 °/s/°C".',
            show_default=False,
        ),
    ],
    count: Annotated[
        int, typer.Option("--count", help="Readings of the best campaign to pick.", min=0)
    ] = 12,
    member: options.Members = None,
    json_: options.Json = False,
) -> None:
    """Where to measure next: campaigns, and their readings, by the uncertainty that they would leave."""
    from bayescal._cli import saved

    members = options.named_values(member, "--member")
    found = bc.plan_readings(
        saved.load_saved(calibration, own), limit, count=count, members=members
    )
    print_result(found.data() if json_ else found)
