"""Registration of the metrology annex: decisions on conformity, certificates, report parts; heavy imports on use."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal import workshop as ws


class DecideCommand(ws.MemberOptions, ws.DecisionRule, ws.AsJson, ws.Command):
    """Decide whether limits are met, with guard bands and risks.

    Exit status: 0 if every limit is met; 1 if a limit is not met or undecided.
    """

    example = 'bayescal decide result --limit "bias: ±0.5 °/s"'
    calibration: Path = ws.Shared.calibration
    limit: list[str] = ws.opt(
        '"bias: ±0.5 °/s", "corrected reading: ±0.1 °/s over -20..60 °C"; repeat for more.', ...
    )
    population: str | None = ws.opt(
        'Mean and sd of devices of this kind, for global risks: "mean 0.1 sd 0.2 °/s".'
    )
    conformity: float = ws.opt("Recalibrate below this conformity probability (JCGM 106).", 0.95)
    out: Path | None = ws.opt("JSON file to write the decisions to.", None, "--out", "-o")
    local_gravity: float | None = ws.Shared.local_gravity

    def answer(self) -> ws.Answer:
        decisions = bc.decide(
            ws.load_saved(self.calibration, self),
            self.limit,
            **self.decision_options(),
            population=self.population,
            min_conformity=self.conformity,
            members=self.members,
            local_gravity=self.local_gravity or ws.STANDARD_GRAVITY,
        )
        if self.out is not None:
            ws.write_json(decisions.to_json_data(), self.out, indent=1)
        return ws.Answer(decisions, warning=decisions.warning)


def export_certificate(command: ws.ExportCommand) -> ws.Answer:
    """Export a digital calibration certificate, with decisions on conformity if limits are given."""
    from bayescal._annexes.metrology.certificate import generate_dcc

    command.require_one()
    (path,), gravity, decisions = command.calibrations, command.gravity, None
    if command.certificate is None:
        requirement = "a digital calibration certificate needs device, laboratory and customer"
        raise bc.InputError(f"{requirement}: give --certificate FILE.toml")
    calibration = ws.load_saved(path, command)
    if command.limit:
        options = {"members": command.members, "local_gravity": gravity}
        decisions = bc.decide(calibration, command.limit, **options, **command.decision_options())
    text = generate_dcc(calibration, command.certificate, gravity, decisions)
    if command.out is not None:
        text = f"written: {ws.write_text(text, command.out)}"
    return ws.Answer(text.removesuffix("\n"))


ANNEX = {
    "commands": (DecideCommand,),
    "exports": lambda: {"dcc": export_certificate},
    "certificate": "bayescal._annexes.metrology.certificate:read_certificate",
    "decided": "bayescal:decide",
    "reference_dcc": "bayescal:read_dcc",
}
